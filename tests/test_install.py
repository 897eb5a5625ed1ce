"""`make install` keeps constraints, the editable installation, and what was added before."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.processes import PATIENCE_S, REPOSITORY

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
FAKE = '#!/bin/sh\necho "$(basename "$0") $*" >> "$(dirname "$0")/said"\n'


class FakeInstallation:
    """A copy of what make reads, with a pip and a program that only note how they are called."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        for name in ("Makefile", "pyproject.toml", "constraints.txt"):
            shutil.copy(REPOSITORY / name, folder)
        self.programs = folder / ".venv" / "bin"
        self.programs.mkdir(parents=True)
        for name in ("pip", "buddyline", "python", "fake_python"):
            (self.programs / name).write_text(FAKE)
            (self.programs / name).chmod(0o755)
        self.site = folder / ".venv" / "lib" / "python3.11" / "site-packages"
        self.site.mkdir(parents=True)

    def make(self, *words: str) -> list[str]:
        """Run make; return the calls of its programs since the last time."""
        said = self.programs / "said"
        said.unlink(missing_ok=True)
        environment = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
        done = subprocess.run(
            ["make", f"PYTHON={self.programs}/fake_python", *words],
            capture_output=True,
            text=True,
            timeout=PATIENCE_S,
            check=False,
            cwd=self.folder,
            env=environment,
        )
        assert done.returncode == 0, done.stderr
        return said.read_text().splitlines() if said.exists() else []

    def installs(self, *words: str) -> list[str]:
        """Run make; return what pip was asked for, from its constraints on."""
        return [call.partition("-c ")[2] for call in self.make(*words) if call.startswith("pip install")]


@pytest.fixture
def checkout(tmp_path: Path) -> FakeInstallation:
    return FakeInstallation(tmp_path)


@pytest.mark.parametrize("words", [("install",), ("demo",), (".venv/.test",)], ids=lambda words: words[0])
def test_a_folder_of_its_name_does_not_hide_the_package(checkout: FakeInstallation, words: tuple[str, ...]) -> None:
    shutil.copytree(REPOSITORY / "buddyline", checkout.folder / "buddyline")
    checkout.make(*words)
    beside = checkout.folder / "programs"
    (beside / "buddyline").mkdir(parents=True)
    program = f"import site; site.addsitedir({str(checkout.site)!r}); import buddyline; print(buddyline.__file__)"
    told = subprocess.run(
        [sys.executable, "-S", "-c", program],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=True,
        cwd=beside,
    )
    assert Path(told.stdout.strip()).resolve() == checkout.folder / "buddyline" / "__init__.py"


def test_extras_add_up_and_stay(checkout: FakeInstallation) -> None:
    assert checkout.installs("install") == ["constraints.txt -e ."]
    assert checkout.installs("install", "EXTRAS=keys,monitor") == ["constraints.txt -e .[keys,monitor]"]
    assert checkout.installs("install", "EXTRAS=plots") == ["constraints.txt -e .[keys,monitor,plots]"]
    assert checkout.make("demo", "ARGS=--seconds 3") == ["buddyline demo --seconds 3"]
    # A pull that changes what is needed leaves nothing out.
    os.utime(checkout.folder / "pyproject.toml", (4e9, 4e9))
    assert checkout.installs("demo") == ["constraints.txt -e .[keys,monitor,plots]"]


def test_a_pi_sees_the_systems_packages_and_keeps_its_constraints(checkout: FakeInstallation) -> None:
    other = "CONSTRAINTS=node/examples/bookworm.txt"
    calls = checkout.make("install", "EXTRAS=pi", other)
    assert calls[0] == "fake_python -m venv --system-site-packages .venv"
    assert calls[1].endswith("-c node/examples/bookworm.txt -e .[pi]")
    assert checkout.installs("install", "EXTRAS=keys") == ["node/examples/bookworm.txt -e .[keys,pi]"]
    assert (REPOSITORY / "node/examples/bookworm.txt").exists()


def test_all_that_the_tests_need_is_pinned() -> None:
    pins = dict(line.split("==") for line in (REPOSITORY / "constraints.txt").read_text().splitlines() if "==" in line)
    pinned = {canonicalize_name(name): version for name, version in pins.items()}
    missing, seen, others, waiting = set(), set(), set(), [Requirement("buddyline[dev]")]
    while waiting:
        wanted = waiting.pop()
        name = canonicalize_name(wanted.name)
        if (name, frozenset(wanted.extras)) in seen:
            continue
        seen.add((name, frozenset(wanted.extras)))
        package = distribution(wanted.name)
        if name != "buddyline" and package.version != pinned.get(name):
            # Newer or older ones, as `make matrix` tries them, may need others.
            others.add(name)
            missing |= set() if name in pinned else {name}
            continue
        waiting += [
            one
            for one in map(Requirement, package.requires or ())
            if one.marker is None or any(one.marker.evaluate({"extra": extra}) for extra in (*wanted.extras, ""))
        ]
    assert not missing, "constraints.txt leaves these to the day of the installation"
    assert others or len(seen) > 40, "the requirements were not followed"
