"""systemd units: what is in them, that systemd takes them, and that none is overwritten in silence."""

import os
import shutil
import subprocess

import pytest
from buddyline.tools.cli import main
from buddyline.tools.installation import install_service

CONFIG = 'node = "a"\n[camera]\nname = "{camera}"\n[sensors]\nname = "{sensors}"\n[record]\ndirectory = "{directory}"\n'


@pytest.fixture
def root(tmp_path, monkeypatch):
    """A place for units, and a program that is installed beside a Python of its own."""
    programs = tmp_path / "a venv" / "bin"
    programs.mkdir(parents=True)
    (programs / "buddyline").write_text("#!/bin/sh\n")
    (programs / "buddyline").chmod(0o755)
    monkeypatch.setattr(install_service.sys, "executable", str(programs / "python"))
    monkeypatch.delenv("SUDO_USER", raising=False)
    monkeypatch.setattr(install_service.getpass, "getuser", lambda: "diver")
    return tmp_path / "root"


def node_config(tmp_path, camera="picamera2", sensors="i2c", directory="/var/lib/buddyline"):
    path = tmp_path / "pi.toml"
    path.write_text(CONFIG.format(camera=camera, sensors=sensors, directory=directory))
    return path


def install(*words):
    return main(["install-service", *map(str, words)])


def unit_of(root, service):
    return root / "etc/systemd/system" / f"buddyline-{service}.service"


def settings(path):
    pairs = [line.split("=", 1) for line in path.read_text().splitlines() if "=" in line and line[0] != "#"]
    return dict(pairs)


def test_a_nodes_unit_has_its_devices_and_chrony(root, tmp_path, capsys):
    assert install("node", "--config", node_config(tmp_path), "--root", root, "--run-as", "pi") == 0
    unit = settings(unit_of(root, "node"))
    program = tmp_path / "a venv" / "bin" / "buddyline"
    assert unit["ExecStart"] == f'"{program}" node --config {tmp_path}/pi.toml'
    assert (unit["Type"], unit["Restart"], unit["User"]) == ("notify", "on-failure", "pi")
    assert int(unit["WatchdogSec"]) <= 15
    assert int(unit["TimeoutStopSec"]) >= 5
    assert unit["SupplementaryGroups"] == "video i2c"
    # Each of these closes /dev to camera and I2C bus, or takes away the groups that may open them.
    assert not {"PrivateDevices", "ProtectClock", "PrivateUsers"} & set(unit)
    text = unit_of(root, "node").read_text()
    assert "DevicePolicy=closed\n" in text
    for device in ("char-video4linux", "char-media", "char-dma_heap", "char-i2c", "char-gpiochip"):
        assert f"DeviceAllow={device} rw\n" in text
    assert "written" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("camera", "sensors", "groups"),
    [("picamera2", "none", "video"), ("stored", "i2c", "i2c"), ("simulated", "simulated", None)],
)
def test_a_unit_has_only_the_groups_of_its_devices(root, tmp_path, camera, sensors, groups):
    config = node_config(tmp_path, camera, sensors)
    assert install("node", "--config", config, "--root", root, "--run-as", "pi") == 0
    unit = settings(unit_of(root, "node"))
    assert unit.get("SupplementaryGroups") == groups
    assert ("PrivateDevices" in unit) == (groups is None)


def test_a_panel_and_a_battery_gauge_need_their_groups(root, tmp_path):
    config = node_config(tmp_path, "simulated", "simulated")
    config.write_text(config.read_text() + '\n[panel]\nlamp_pin = 27\n[power]\nbattery = "ina219"\n')
    assert install("node", "--config", config, "--root", root, "--run-as", "pi") == 0
    assert settings(unit_of(root, "node"))["SupplementaryGroups"] == "i2c gpio"


@pytest.mark.parametrize(
    ("directory", "writable"),
    [("/var/lib/buddyline/dives", None), ("dives", None), ("/data/my dives", '"-/data/my dives"')],
)
def test_a_unit_may_write_where_its_node_records(root, tmp_path, directory, writable):
    words = ["--config", node_config(tmp_path, directory=directory), "--root", root, "--run-as", "pi"]
    assert install("node", *words) == 0
    assert settings(unit_of(root, "node")).get("ReadWritePaths") == writable


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not on this machine")
def test_systemd_calls_the_units_well_hardened(root, tmp_path):
    """Of 10 for a service that may do everything; 2.5 at most."""
    for service, words in {"node": ["--config", node_config(tmp_path)], "hub": [], "solver": []}.items():
        assert install(service, *words, "--root", root, "--run-as", "nobody") == 0
        done = subprocess.run(
            ["systemd-analyze", "security", "--offline=true", "--threshold=25", str(unit_of(root, service))],
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stdout[-3000:]


def test_root_is_asked_for_a_user(root, monkeypatch, capsys):
    monkeypatch.setattr(install_service.getpass, "getuser", lambda: "root")
    assert install("hub", "--root", root) == 2
    assert "--run-as USER" in capsys.readouterr().err
    assert not unit_of(root, "hub").exists()
    monkeypatch.setenv("SUDO_USER", "diver")
    assert install("hub", "--root", root) == 0
    assert settings(unit_of(root, "hub"))["User"] == "diver"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not on this machine")
@pytest.mark.parametrize("user", [False, True])
def test_systemd_accepts_the_units(root, tmp_path, monkeypatch, user):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    config = node_config(tmp_path, directory="/data/my dives, 100 %")
    where = ["--user"] if user else ["--root", root, "--run-as", "root"]
    for service, words in {"node": ["--config", config], "hub": [], "solver": []}.items():
        assert install(service, *words, *where) == 0
    units = sorted((tmp_path / "config/systemd/user" if user else unit_of(root, "hub").parent).glob("*.service"))
    assert len(units) == 3
    done = subprocess.run(
        ["systemd-analyze", "verify", *(["--user"] if user else []), *map(str, units)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)},
    )
    told = [line for line in done.stderr.splitlines() if "buddyline" in line]
    assert (done.returncode, told) == (0, [])


def test_a_unit_that_was_changed_is_shown_and_kept(root, tmp_path, capsys):
    words = ["hub", "--root", root, "--run-as", "pi"]
    assert install(*words) == 0
    path = unit_of(root, "hub")
    assert install(*words) == 0
    assert "is as it should be" in capsys.readouterr().out
    changed = path.read_text().replace("RestartSec=2", "RestartSec=9")
    path.write_text(changed)
    assert install(*words) == 2
    error = capsys.readouterr().err
    assert "-RestartSec=9" in error
    assert "+RestartSec=2" in error
    assert "--force replaces it" in error
    assert path.read_text() == changed
    assert install(*words, "--force") == 0
    assert "replaced" in capsys.readouterr().out
    assert "RestartSec=2" in path.read_text()


def test_print_writes_nothing(root, tmp_path, capsys):
    assert install("hub", "--print", "--root", root) == 0
    assert "[Service]" in capsys.readouterr().out
    assert not root.exists()


def test_the_next_commands_are_named(root, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    assert install("solver", "--user") == 0
    out = capsys.readouterr().out
    for command in ("daemon-reload", "enable buddyline-solver", "journalctl --user -fu buddyline-solver"):
        assert command in out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["node"], "--config"),
        (["node", "--config", "nowhere.toml"], "nowhere.toml: cannot be read"),
        (["hub", "--run-as", "pi\nExecStart=/bin/sh"], "not a user's name"),
        (["hub", "--user", "--root", "x"], "neither"),
    ],
)
def test_bad_arguments_of_a_unit_give_a_one_line_error(root, words, says, capsys):
    assert install(*words) == 2
    assert says in capsys.readouterr().err
    assert not root.exists()


def test_a_program_that_is_not_installed_is_reported(root, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(install_service.sys, "executable", str(tmp_path / "python"))
    assert install("hub", "--print") == 2
    assert "make install" in capsys.readouterr().err


def test_a_place_that_cannot_be_written_is_reported(root, tmp_path, capsys):
    root.mkdir()
    (root / "etc").write_text("")
    assert install("hub", "--root", root) == 2
    assert "cannot be written" in capsys.readouterr().err
