"""A card's files: what cloud-init takes, what the README says, and that each of our commands exists."""

import argparse
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from buddyline.tools.cli import COMMANDS, main
from buddyline.tools.installation.pi import PACKAGES, with_block

from tests.processes import REPOSITORY

KEY = "ssh-ed25519 AAAAC3NzaC1lZDI1NTE5AAAAIJ me@here"
CONFIG = """\
node = "{node}"
connect = "tls/192.168.2.1:7447"
[tls]
ca = "ca.crt"
certificate = "node-{node}.crt"
key = "node-{node}.key"
[camera]
name = "picamera2"
[sensors]
name = "i2c"
[record]
directory = "/var/lib/buddyline"
[panel]
lamp_pin = 27
shutdown_command = ["systemctl", "poweroff"]
"""


@pytest.fixture
def desk(tmp_path):
    """What lies on the desk before the card is made."""
    (tmp_path / "boot").mkdir()
    (tmp_path / "boot" / "config.txt").write_text("dtparam=audio=on\n[cm4]\notg_mode=1")
    (tmp_path / "id.pub").write_text(f"{KEY}\n")
    (tmp_path / "wifi").write_text('tricky "password" \\ with signs\n')
    for node in "ab":
        (tmp_path / f"{node}.toml").write_text(CONFIG.format(node=node))
        for name in (f"node-{node}.crt", f"node-{node}.key", "ca.crt"):
            (tmp_path / name).write_text(f"-----BEGIN {name}-----\n")
    return tmp_path


def image(desk, node, *words):
    return main(
        ["image", str(desk / "boot"), "--config", str(desk / f"{node}.toml"), "--source", "https://example.org/b.git",
         "--ssh-key", str(desk / "id.pub"), *words]
    )  # fmt: skip


def read(desk):
    text = (desk / "boot" / "user-data").read_text()
    assert text.startswith("#cloud-config\n")
    return json.loads(text.partition("\n")[2]), json.loads((desk / "boot" / "network-config").read_text())["network"]


def test_a_card_for_a(desk):
    assert image(desk, "a", "--gateway", "192.168.2.1", "--clock-chip", "ds3231") == 0
    user, network = read(desk)
    files = {file["path"]: file for file in user["write_files"]}
    for name in ("a.toml", "ca.crt", "node-a.crt", "node-a.key"):
        assert files[f"/home/diver/{name}"]["content"] == (desk / name).read_text()
        assert files[f"/home/diver/{name}"]["permissions"] == "0600"
    assert all(file["defer"] for file in files.values())
    assert user["users"][0]["ssh_authorized_keys"] == [KEY]
    assert network["ethernets"]["eth0"]["addresses"] == ["192.168.2.2/24"]
    assert network["ethernets"]["eth0"]["routes"] == [{"to": "default", "via": "192.168.2.1"}]
    assert "wifis" not in network
    lines = (desk / "boot" / "config.txt").read_text().splitlines()
    assert lines[:3] == ["dtparam=audio=on", "[cm4]", "otg_mode=1"]
    assert lines[4] == "[all]"
    assert {"dtparam=i2c_arm=on", "dtoverlay=i2c-rtc,ds3231", "gpio=27=op,dh", "dtparam=watchdog=on"} < set(lines)
    assert (desk / "boot" / "config.txt.before").read_text().endswith("otg_mode=1")


def test_a_card_for_b_follows_a_and_may_use_a_wireless_network(desk):
    words = ("--wifi", "boat: 5 GHz", "--wifi-password", str(desk / "wifi"), "--clock-from", "10.0.0.7")
    assert image(desk, "b", *words) == 0
    user, network = read(desk)
    (setup,) = (words for words in user["runcmd"] if "setup" in words)
    assert setup[setup.index("--clock-from") + 1] == "10.0.0.7"
    assert network["wifis"]["wlan0"]["access-points"] == {
        "boat: 5 GHz": {"password": 'tricky "password" \\ with signs'}
    }
    assert network["ethernets"]["eth0"]["addresses"] == ["192.168.2.3/24"]


def test_each_command_exists_and_is_what_the_readme_says(desk):
    assert image(desk, "a", "--gateway", "192.168.2.1") == 0
    user, _ = read(desk)
    readme = (REPOSITORY / "node" / "README.md").read_text()
    for package in PACKAGES:
        assert package in readme
    ours = [words for words in user["runcmd"] if words[0].endswith("/.venv/bin/buddyline")]
    assert ours
    for words in ours:
        command = next(command for command in COMMANDS if command.name == words[1])
        parsed = command.parser().parse_args(words[2:])
        assert isinstance(parsed, argparse.Namespace)
        assert parsed.config in {file["path"] for file in user["write_files"]}
    (make,) = (words for words in user["runcmd"] if "make" in words)
    makefile = (REPOSITORY / "Makefile").read_text()
    assert re.search(rf"^{make[make.index('-C') + 2]}:", makefile, re.MULTILINE)
    assert "EXTRAS" in makefile
    # Without `keys` a node with a certificate does not sign its log.
    assert make[-1] == "EXTRAS=keys,pi"
    assert ["systemctl", "start", "buddyline-node"] in user["runcmd"]


def test_a_second_card_replaces_our_lines_alone_and_keeps_what_was_first(desk):
    for chip in ("ds3231", "none"):
        assert image(desk, "a", "--gateway", "192.168.2.1", "--clock-chip", chip) == 0
    text = (desk / "boot" / "config.txt").read_text()
    assert text.count("dtparam=i2c_arm=on") == 1
    assert "ds3231" not in text
    assert with_block(text, ["x"]) == with_block(with_block(text, ["y"]), ["x"])
    assert "buddyline" not in (desk / "boot" / "config.txt.before").read_text()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "--wifi or --gateway"),
        (("--gateway", "here"), "--gateway here"),
        (("--gateway", "192.168.2.1", "--address", "192.168.2"), "--address 192.168.2"),
        (("--gateway", "192.168.2.1", "--user", "me; rm"), "not a user's name"),
        (("--wifi", "boat"), "go together"),
        (("--wifi", "boat", "--wifi-password", "nowhere"), "nowhere: cannot be read"),
    ],
)
def test_what_cannot_work_is_refused_before_anything_is_written(desk, capsys, words, said):
    assert image(desk, "a", *words) == 2
    assert said in capsys.readouterr().err
    assert sorted(path.name for path in (desk / "boot").iterdir()) == ["config.txt"]


def test_a_private_key_never_reaches_the_card(desk, capsys):
    (desk / "id.pub").write_text("-----BEGIN OPENSSH PRIVATE KEY-----\nsecret\n")
    assert image(desk, "a", "--gateway", "192.168.2.1") == 2
    said = capsys.readouterr().err
    assert "is no public key" in said
    assert "secret" not in said
    (desk / "a.toml").write_text(CONFIG.format(node="a").replace('"ca.crt"', '"keys/ca.crt"'))
    (desk / "id.pub").write_text(KEY)
    assert image(desk, "a", "--gateway", "192.168.2.1") == 2
    assert "keys/ca.crt" in capsys.readouterr().err


@pytest.mark.skipif(shutil.which("cloud-init") is None, reason="cloud-init is not installed")
def test_cloud_init_takes_it(desk):
    assert image(desk, "a", "--gateway", "192.168.2.1", "--wifi", "x", "--wifi-password", str(desk / "wifi")) == 0
    file = Path(desk / "boot" / "user-data")
    done = subprocess.run(
        ["cloud-init", "schema", "--config-file", file], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
