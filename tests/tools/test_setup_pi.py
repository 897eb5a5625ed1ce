"""`setup pi` says what is to do and changes nothing; with --apply it does each step once; then it runs doctor.

apt-get, dpkg-query, make and systemctl are stand-ins that note their calls; tests/chroots.py has the real ones, in a
Debian system of its own.
"""

import argparse
import getpass
import os

import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.installation import pi, setup_pi

from tests.tools.test_image import CONFIG

STAND_IN = """\
#!/bin/sh
printf '%s %s\\n' "$(basename "$0")" "$*" >> {folder}/said
case "$(basename "$0") $*" in
  dpkg-query*) cat {folder}/installed ;;
  "apt-get install"*) shift 2; for one; do echo "$one installed" >> {folder}/installed; done ;;
  "systemctl enable"*) mkdir -p {units}/multi-user.target.wants; ln -s x {units}/multi-user.target.wants/$2 ;;
esac
"""


class PiInFolder:
    """A Pi in a folder: its files, and what its programs were called with."""

    def __init__(self, folder):
        self.folder, self.root = folder, folder / "root"
        self.config = folder / "a.toml"
        self.config.write_text(CONFIG.format(node="a"))
        (self.root / "boot" / "firmware").mkdir(parents=True)
        self.boot = self.root / "boot" / "firmware" / "config.txt"
        self.boot.write_text("dtparam=audio=on\n")
        (folder / "installed").write_text("git installed\nchrony config-files\n")
        (folder / "said").touch()
        units = self.root / "etc" / "systemd" / "system"
        for name in ("dpkg-query", "apt-get", "make", "systemctl"):
            program = folder / "bin" / name
            program.parent.mkdir(exist_ok=True)
            program.write_text(STAND_IN.format(folder=folder, units=units))
            program.chmod(0o755)

    def steps(self, **options):
        user = getpass.getuser()
        given = {"config": str(self.config), "clock_from": None, "clock_chip": "none", "address": None} | options
        return setup_pi.steps(argparse.Namespace(**given), user, self.root)

    def said(self):
        """Return the calls since the last time."""
        calls = (self.folder / "said").read_text().splitlines()
        (self.folder / "said").write_text("")
        return calls


@pytest.fixture
def machine(tmp_path, monkeypatch):
    machine = PiInFolder(tmp_path)
    (tmp_path / "copy" / ".venv").mkdir(parents=True)
    (tmp_path / "copy" / "Makefile").touch()
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setattr(setup_pi.sys, "prefix", str(tmp_path / "copy" / ".venv"))
    monkeypatch.setattr(setup_pi, "MODULES", {"pi": ("json",), "keys": ("nowhere_to_be_found",)})
    return machine


def files(root):
    return {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_saying_it_changes_nothing(machine):
    before = files(machine.root)
    told = list(machine.steps())
    assert not any(step.done for step in told)
    assert files(machine.root) == before
    assert {call.split()[0] for call in machine.said()} == {"dpkg-query"}
    meant = "\n".join(step.means for step in told)
    for word in ("chrony", "+ dtparam=i2c_arm=on", "+ i2c-dev", "+ local stratum 8", "+ address1=192.168.2.2/24"):
        assert word in meant


def test_each_step_is_done_once(machine, monkeypatch):
    for step in machine.steps(clock_chip="ds3231"):
        step.do()
    said = machine.said()
    # What dpkg calls "config-files" is not installed.
    (install,) = (call for call in said if call.startswith("apt-get install"))
    assert "chrony" in install
    assert " git " not in install
    assert f"make -C {machine.folder}/copy install EXTRAS=keys,pi" in [
        call.partition(" CONSTRAINTS")[0] for call in said
    ]
    assert machine.boot.read_text().startswith("dtparam=audio=on\n")
    assert "dtoverlay=i2c-rtc,ds3231\n" in machine.boot.read_text()
    assert machine.boot.with_name("config.txt.before").read_text() == "dtparam=audio=on\n"
    tether = machine.root / setup_pi.TETHER_FILE[1:]
    assert tether.stat().st_mode & 0o777 == 0o600
    assert (machine.root / "var" / "lib" / "buddyline").is_dir()
    unit = (machine.root / "etc" / "systemd" / "system" / setup_pi.UNIT).read_text()
    assert f"--config {machine.config}" in unit
    assert "SupplementaryGroups=video i2c gpio" in unit
    monkeypatch.setattr(setup_pi, "MODULES", {"pi": ("json",), "keys": ("json",)})
    again = list(machine.steps(clock_chip="ds3231"))
    assert [step.name for step in again if not step.done] == []
    # Another clock chip is one step more, not all of them. What a person has written since is shown, and kept.
    machine.boot.write_text("dtparam=spi=on\n")
    (step,) = (step for step in machine.steps(clock_chip="ds3231") if not step.done)
    assert "+ dtparam=i2c_arm=on" in step.means
    step.do()
    assert machine.boot.with_name("config.txt.before2").read_text() == "dtparam=spi=on\n"
    chrony = machine.root / "etc" / "chrony" / "chrony.conf"
    chrony.write_text(f"refclock PPS /dev/pps0\n{chrony.read_text()}")
    (step,) = (step for step in machine.steps(clock_chip="ds3231") if not step.done)
    assert step.means.splitlines()[1:] == [f"{'':<20}- refclock PPS /dev/pps0"]
    step.do()
    assert [step.name for step in machine.steps(clock_chip="pi5") if not step.done] == ["devices"]


def test_a_relative_folder_for_logs_is_where_the_service_writes(machine):
    machine.config.write_text(machine.config.read_text().replace('"/var/lib/buddyline"', '"dives"'))
    (step,) = (step for step in machine.steps() if step.name == "folder")
    step.do()
    assert (machine.root / "var" / "lib" / "buddyline" / "dives").is_dir()


def test_what_stands_in_the_way_is_named(machine, capsys, monkeypatch):
    (machine.folder / "bin" / "apt-get").write_text("#!/bin/sh\nexit 100\n")
    with pytest.raises(BuddylineError, match=r"`apt-get update` ended with 100"):
        next(machine.steps()).do()
    machine.boot.unlink()
    with pytest.raises(BuddylineError, match="for Raspberry Pi OS"):
        next(machine.steps())
    with pytest.raises(BuddylineError, match="no such user"):
        setup_pi.run(argparse.Namespace(run_as="nobody_of_this_name", apply=False))
    monkeypatch.setattr(setup_pi.os, "geteuid", lambda: 1000)
    with pytest.raises(BuddylineError, match="call it with sudo"):
        setup_pi.run(argparse.Namespace(run_as="root", apply=True))


def test_run_says_what_is_to_do_then_does_it_then_calls_doctor(machine, capsys, monkeypatch):
    monkeypatch.setattr(setup_pi, "Path", lambda *parts: machine.root if parts == ("/",) else pi.Path(*parts))
    monkeypatch.setattr(setup_pi.os, "geteuid", lambda: 0)
    user = getpass.getuser()
    args = argparse.Namespace(
        config=str(machine.config), clock_from=None, clock_chip="none", address="keep", run_as=user, apply=False
    )
    assert setup_pi.run(args) == 0
    assert "to do; nothing was changed" in capsys.readouterr().out
    args.apply = True
    assert setup_pi.run(args) == 0
    assert "restart the Pi" in capsys.readouterr().out
    assert not (machine.root / setup_pi.TETHER_FILE[1:]).exists()
    monkeypatch.setattr(setup_pi, "MODULES", {"pi": ("json",), "keys": ("json",)})
    doctor = machine.folder / "bin" / "doctor"
    doctor.write_text(f'#!/bin/sh\necho "$*" > {machine.folder}/doctor_said\nexit 1\n')
    doctor.chmod(0o755)
    monkeypatch.setattr(setup_pi, "_program", lambda: [str(doctor)])
    args.apply = False
    assert setup_pi.run(args) == 1
    assert "to do " not in capsys.readouterr().out
    assert (machine.folder / "doctor_said").read_text() == f"doctor --config {machine.config}\n"
