"""Our wheel, built from the files that git knows, and the Pythons of this machine."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.processes import REPOSITORY

PYTHONS = ("3.11", "3.12", "3.13")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check")


def run(*words, cwd):
    """Run a program without this repository on its path; return the finished process."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    return subprocess.run(words, capture_output=True, text=True, timeout=600, check=False, cwd=cwd, env=environment)


def interpreter(version):
    """Return a Python of a version such as 3.12, from the path or pyenv; None where there is none."""
    if version == f"{sys.version_info.major}.{sys.version_info.minor}":
        return Path(sys.executable)
    found = shutil.which(f"python{version}")
    others = sorted(Path.home().glob(f".pyenv/versions/{version}.*/bin/python{version}"))
    # The one on the path may be a shim of pyenv, which fails unless this version is chosen.
    works = (
        Path(one) for one in (found, *others) if one and run(one, "-c", "import ensurepip", cwd=".").returncode == 0
    )
    return next(works, None)


def copy_sources(folder):
    """Copy the files that git knows, but no tests, into a folder."""
    listed = run("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", cwd=REPOSITORY)
    assert listed.returncode == 0, listed.stderr
    for name in listed.stdout.split("\0"):
        if name and not name.startswith("tests/") and (REPOSITORY / name).is_file():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(REPOSITORY / name, folder / name)


def build(folder):
    """Build the wheel in a folder; skip where setuptools cannot be fetched."""
    # A copy: setuptools leaves its own folders beside the sources.
    sources = folder / "sources"
    copy_sources(sources)
    done = run(*PIP, "wheel", "--no-deps", "--quiet", "-w", folder, sources, cwd=folder)
    if "Could not find a version that satisfies the requirement setuptools" in done.stderr:
        pytest.skip("no wheel can be built: setuptools cannot be fetched from here")
    assert done.returncode == 0, done.stderr
    (wheel,) = folder.glob("buddyline-*.whl")
    return wheel
