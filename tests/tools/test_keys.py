"""`buddyline keys`: what it writes can be used as it is, is private, and is never overwritten."""

import argparse
import re
import stat
from datetime import UTC, datetime

import pytest
from buddyline.node.config import load_node_config
from buddyline.protocol.endpoint import host_and_port, is_loopback
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.security import Tls, check_identity
from buddyline.solver_service.config import load_solver_config
from buddyline.tools.cli import main
from buddyline.tools.client import ClientConfig, client_config
from buddyline.tools.hub import HubConfig, check_exposure, load_hub_config
from buddyline.tools.installation.authority import Authority

from tests.disks import small_disk
from tests.tools.identities import copy_of, expired, make_keys, tls


@pytest.fixture(scope="module")
def keys(tmp_path_factory):
    return make_keys(tmp_path_factory.mktemp("keys"), "a", "b")


@pytest.fixture
def spoilt(keys, tmp_path):
    """A copy that a test may spoil."""
    return copy_of(keys, tmp_path / "keys")


def test_the_written_configurations_load_and_name_the_right_identities(spoilt):
    keys = spoilt
    hub = load_hub_config(str(keys / "hub.toml"))
    assert hub.nodes == ["a", "b"]
    assert check_exposure(hub, insecure=False) is None
    words = ["--node", "a", "--connect", "tls/127.0.0.1:7447", "-o", str(keys / "a.toml")]
    assert main(["init", "node", *words]) == 0
    node = load_node_config(keys / "a.toml")
    assert (node.node, node.connect, node.tls) == ("a", "tls/127.0.0.1:7447", tls(keys, "node-a"))
    check_identity(node.tls, "node-a")
    assert load_solver_config(keys / "solver.toml").tls == tls(keys, "solver")


def test_each_node_of_a_team_has_an_identity_of_its_own(tmp_path, capsys):
    keys = make_keys(tmp_path, "a", "b", "c", "tripod_1")
    assert main(["keys", "--directory", str(keys), "node", "d"]) == 0
    hub = load_hub_config(str(keys / "hub.toml"))
    assert hub.nodes == ["a", "b", "c", "d", "tripod_1"]
    for node in hub.nodes:
        check_identity(tls(keys, f"node-{node}"), f"node-{node}")
    with pytest.raises(BuddylineError, match="node-c"):
        check_identity(tls(keys, "node-d"), "node-c")
    hub_file = keys / "hub.toml"
    hub_file.write_text(hub_file.read_text().replace('"c", ', ""))
    capsys.readouterr()
    assert main(["keys", "--directory", str(keys), "list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    of_nodes = {name.removeprefix("node-"): line for name, line in lines.items() if name.startswith("node-")}
    assert sorted(of_nodes) == ["a", "b", "c", "d", "tripod_1"]
    for node, line in of_nodes.items():
        assert (f"publishes as node {node}" in line) == (node != "c"), line
    assert "not admitted" in of_nodes["c"]


def test_private_keys_are_private(keys):
    found = {path.name: stat.S_IMODE(path.stat().st_mode) for path in keys.glob("*.key")}
    assert set(found) == {
        "ca.key",
        "hub.key",
        "node-a.key",
        "node-b.key",
        "solver.key",
        "viewer.key",
        "surveyor.key",
        "player.key",
        "ros2.key",
    }
    assert set(found.values()) == {0o600}


def test_nothing_is_overwritten(keys):
    before = {path.name: path.read_bytes() for path in keys.iterdir()}
    for words in (["init"], ["node", "a"], ["solver"], ["viewer"], ["surveyor"], ["player"], ["ros2"]):
        assert main(["keys", "--directory", str(keys), *words]) == 2
    assert {path.name: path.read_bytes() for path in keys.iterdir()} == before


def test_the_hub_keeps_what_a_person_wrote_in_its_configuration(spoilt, capsys):
    text = (spoilt / "hub.toml").read_text().replace("0.0.0.0:7447", "192.168.2.1:7448")
    (spoilt / "hub.toml").write_text(text)
    assert main(["keys", "--directory", str(spoilt), "node", "c"]) == 0
    assert (spoilt / "hub.toml").read_text() == text.replace('nodes = ["a", "b"]', 'nodes = ["a", "b", "c"]')
    (spoilt / "hub.toml").write_text("nodes = [\n]\n")
    assert main(["keys", "--directory", str(spoilt), "node", "d"]) == 0
    assert (spoilt / "hub.toml").read_text() == "nodes = [\n]\n"
    assert 'add "d"' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("spoil", "expected", "says"),
    [
        (lambda k: (k / "node-a.crt").unlink(), "node-a", ["node-a.crt", "cannot be read"]),
        (lambda k: (k / "node-a.key").unlink(), "node-a", ["node-a.key", "cannot be read"]),
        (lambda k: (k / "ca.crt").unlink(), "node-a", ["ca.crt", "cannot be read"]),
        (lambda k: (k / "node-a.crt").write_text("mistyped"), "node-a", ["node-a.crt", "not a certificate"]),
        (lambda k: (k / "ca.crt").write_text("mistyped"), "node-a", ["ca.crt", "not a certificate"]),
        (lambda k: (k / "node-a.key").write_text("mistyped"), "node-a", ["node-a.key", "not a private key"]),
        (lambda k: (k / "node-b.key").replace(k / "node-a.key"), "node-a", ["node-a.key", "not the key of"]),
        (lambda k: (k / "node-a.key").chmod(0o640), "node-a", ["node-a.key", "chmod 600"]),
        (lambda k: expired(k, "node-a"), "node-a", ["node-a.crt", "has expired"]),
        (lambda k: None, "node-b", ["node-a.crt", "'node-a'", "'node-b'"]),
        (lambda k: None, "hub", ["node-a.crt", "this end"]),
    ],
    ids=[
        "certificate missing",
        "key missing",
        "authority missing",
        "certificate mistyped",
        "authority mistyped",
        "key mistyped",
        "another's key",
        "key readable",
        "expired",
        "another's certificate",
        "client as hub",
    ],
)
def test_a_wrong_identity_is_refused_before_use_and_named(spoilt, spoil, expected, says):
    check_identity(tls(spoilt, "node-a"), "node-a")
    spoil(spoilt)
    with pytest.raises(BuddylineError) as refused:
        check_identity(tls(spoilt, "node-a"), expected)
    assert all(word in str(refused.value) for word in says), str(refused.value)


def test_a_foreign_certificate_is_refused_before_use(keys, tmp_path):
    other = make_keys(tmp_path / "other", "a")
    foreign = Tls(ca=str(keys / "ca.crt"), certificate=str(other / "node-a.crt"), key=str(other / "node-a.key"))
    with pytest.raises(BuddylineError, match=r"node-a\.crt: was not made by the authority in .*ca\.crt"):
        check_identity(foreign, "node-a")


def test_a_key_with_a_password_is_refused_without_asking_for_it(spoilt):
    from cryptography.hazmat.primitives import serialization

    path = spoilt / "node-a.key"
    key = serialization.load_pem_private_key(path.read_bytes(), None)
    path.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"secret"),
        )
    )
    with pytest.raises(BuddylineError, match="without a password"):
        check_identity(tls(spoilt, "node-a"), "node-a")


@pytest.mark.parametrize(
    ("listen", "insecure", "says"),
    [
        ("tcp/0.0.0.0:7447", False, "--insecure"),
        ("tcp/192.168.2.1:7447", False, "--insecure"),
        ("tcp/[::]:7447", False, "--insecure"),
        ("tcp/topside.local:7447", False, "--insecure"),
    ],
)
def test_a_hub_beyond_this_machine_without_tls_is_refused(listen, insecure, says):
    with pytest.raises(BuddylineError, match=says):
        check_exposure(HubConfig(listen=listen), insecure=insecure)
    warning = check_exposure(HubConfig(listen=listen), insecure=True)
    assert warning is not None
    assert "INSECURE" in warning


def test_a_hub_on_loopback_needs_nothing():
    for listen in ("tcp/127.0.0.1:7447", "tcp/127.9.9.9:1", "tcp/[::1]:7447", "tcp/localhost:7447"):
        assert check_exposure(HubConfig(listen=listen), insecure=False) is None
        assert is_loopback(listen)
    assert host_and_port("tls/[::1]:7447") == ("::1", 7447)


def test_a_list_of_nodes_without_tls_is_refused():
    with pytest.raises(BuddylineError, match=r"\[tls\]"):
        check_exposure(HubConfig(nodes=["a"]), insecure=True)


def test_the_solver_and_viewers_are_refused_with_another_identity(spoilt):
    (spoilt / "solver.toml").write_text((spoilt / "viewer.toml").read_text())
    with pytest.raises(BuddylineError, match="'solver' is needed"):
        load_solver_config(spoilt / "solver.toml")


def test_a_viewer_finds_hub_and_identity_in_its_configuration(keys):
    found = client_config(argparse.Namespace(config=str(keys / "viewer.toml"), connect=None))
    assert found == ClientConfig(connect="tls/127.0.0.1:7447", tls=tls(keys, "viewer"))


def test_the_list_says_who_may_do_what_and_until_when(spoilt, capsys):
    hub = spoilt / "hub.toml"
    hub.write_text(hub.read_text().replace('nodes = ["a", "b"]', 'nodes = ["a"]\nshut_out = ["viewer"]'))
    expired(spoilt, "surveyor")
    capsys.readouterr()
    assert main(["keys", "--directory", str(spoilt), "list"]) == 0
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines()}
    assert "publishes as node a" in lines["node-a"]
    assert "(729 days)" in lines["node-a"]
    assert "not admitted" in lines["node-b"]
    assert "shut out" in lines["viewer"]
    assert "EXPIRED" in lines["surveyor"]
    assert "publishes poses" in lines["solver"]
    assert "ca" not in lines


def test_a_certificate_is_renewed_and_the_old_one_is_kept(spoilt, capsys):
    before = (spoilt / "node-a.key").read_bytes()
    assert main(["keys", "--directory", str(spoilt), "--days", "3", "renew", "node-a"]) == 0
    check_identity(tls(spoilt, "node-a"), "node-a")
    assert (spoilt / "node-a.key").read_bytes() != before
    (kept,) = spoilt.glob("node-a.until-*.key.old")
    assert kept.read_bytes() == before
    assert main(["keys", "--directory", str(spoilt), "renew", "hub"]) == 0
    check_identity(tls(spoilt, "hub"), "hub")
    capsys.readouterr()
    assert main(["keys", "--directory", str(spoilt), "renew", "node-z"]) == 2
    assert "there are hub, node-a" in capsys.readouterr().err


def test_a_full_disk_leaves_no_empty_key(tmp_path, capsys):
    with small_disk(tmp_path / "disk", 16) as disk:
        (disk / "full").write_bytes(bytes(16 << 10))
        assert main(["keys", "--directory", str(disk / "keys"), "init", "--hub", "127.0.0.1"]) == 2
        assert f"{disk / 'keys' / 'ca.key'}: cannot be written: No space left" in capsys.readouterr().err
        assert list((disk / "keys").iterdir()) == []


@pytest.mark.parametrize("words", [("--directory", "mine", "init"), ("init", "--directory", "mine")])
def test_options_may_stand_before_or_after_whose_keys_they_are_for(tmp_path, monkeypatch, words):
    monkeypatch.chdir(tmp_path)
    assert main(["keys", *words]) == 0
    assert (tmp_path / "mine" / "ca.crt").exists()


def test_no_certificate_outlives_its_authority(tmp_path, capsys):
    words = ["keys", "--directory", str(tmp_path / "keys")]
    assert main([*words, "--days", "30", "init", "--hub", "127.0.0.1"]) == 0
    assert main([*words, "node", "a"]) == 0
    assert "it is valid until" in capsys.readouterr().err
    assert main([*words, "list"]) == 0
    assert re.findall(r"\((\d+) days\)", capsys.readouterr().out) == ["29", "29"]
    for days in ("0", "36501", "9999999"):
        assert main([*words, "--days", days, "node", "b"]) == 2
        assert f"--days {days}: from 1 to 36500" in capsys.readouterr().err


def test_an_authority_that_has_ended_issues_nothing(spoilt, monkeypatch, capsys):
    monkeypatch.setattr(Authority, "ends_within", lambda self, days: datetime(2020, 1, 1, tzinfo=UTC))
    assert main(["keys", "--directory", str(spoilt), "renew", "node-a"]) == 2
    assert "ca.crt: ended on 2020-01-01; begin anew" in capsys.readouterr().err
    assert (spoilt / "node-a.crt").exists()
