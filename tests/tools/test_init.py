"""Starting configurations: they load, name every setting, and overwrite nothing."""

import msgspec
import pytest
from buddyline.node.config import load_node_config
from buddyline.solver_service.config import SolveConfig, SolverConfig, TrackConfig, load_solver_config
from buddyline.tools.cli import main
from buddyline.tools.hub import HubConfig, load_hub_config
from buddyline.tools.installation.init import HUB, SOLVER, text_of


def test_a_hub_and_a_solver_load_as_written_and_are_the_defaults(tmp_path):
    for service, load in (("hub", load_hub_config), ("solver", load_solver_config)):
        path = tmp_path / f"{service}.toml"
        assert main(["init", service, "-o", str(path)]) == 0
        assert load(str(path)) == load(None)


@pytest.mark.parametrize(("text", "configs"), [(HUB, [HubConfig]), (SOLVER, [SolverConfig, SolveConfig, TrackConfig])])
def test_every_setting_is_named(text, configs):
    for config in configs:
        for field in msgspec.structs.fields(config):
            assert f"{field.encode_name} =" in text or f"[{field.encode_name}]" in text, field.encode_name


@pytest.mark.parametrize("simulated", [False, True])
def test_a_node_has_its_own_name_and_certificate(tmp_path, simulated):
    path = tmp_path / "diver_2.toml"
    words = ["--simulated"] if simulated else []
    assert main(["init", "node", "--node", "diver_2", "-o", str(path), "--connect", "tcp/127.0.0.1:7447", *words]) == 0
    config = load_node_config(path)
    assert (config.node, config.connect, config.tls) == ("diver_2", "tcp/127.0.0.1:7447", None)
    assert config.camera.name == ("simulated" if simulated else "picamera2")


def test_a_hub_that_listens_elsewhere_differs_in_one_line():
    before, after = HUB.splitlines(), text_of("hub", connect="tcp/127.0.0.1:7448").splitlines()
    assert [one for one in zip(before, after, strict=True) if one[0] != one[1]] == [
        (before[1], before[1].replace(":7447", ":7448", 1))
    ]


@pytest.mark.parametrize(("service", "simulated"), [("node", False), ("node", True), ("hub", False), ("solver", False)])
def test_a_secure_hub_takes_the_keys_along(service, simulated):
    text = text_of(service, "c", "tls/192.168.7.9:7447", simulated=simulated)
    table = text.partition("\n[tls]")[2].partition("\n[")[0]
    name = {"node": "node-c", "hub": "hub", "solver": "solver"}[service]
    assert f'certificate = "{name}.crt"' in table
    assert "#" not in table.split("\n")[1][:1]
    assert '"tls/192.168.7.9:7447"' in text


def test_nothing_is_overwritten_and_nonsense_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["init", "solver"]) == 0
    assert main(["init", "solver"]) == 2
    assert "solver.toml" in capsys.readouterr().err
    assert main(["init", "node", "--node", "A b"]) == 2
    assert main(["init", "hub", "--simulated"]) == 2
    assert main(["init", "solver", "-o", "x.toml", "--connect", "nowhere"]) == 2
    assert not (tmp_path / "x.toml").exists()


@pytest.mark.parametrize("words", [("node",), ("node", "--simulated"), ("hub",), ("solver",)])
def test_marks_are_named_where_there_are_any(words, tmp_path, capsys):
    path = tmp_path / "my new.toml"
    assert main(["init", *words, "-o", str(path)]) == 0
    out = capsys.readouterr().out
    assert ("what is marked with <-" in out) == ("# <-" in path.read_text())
    assert f"next: buddyline {words[0]} --config '{path}'" in out
