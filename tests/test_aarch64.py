"""On a Raspberry Pi's processor: everything installs from wheels, and golden dives give what they give elsewhere.

Debian's Python for arm64 runs under qemu-user. It needs neither a chroot nor binfmt_misc: qemu looks for the program's
libraries in the unpacked packages (`-L`).
"""

import os
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.golden import references, stages
from tests.golden.dives import CAVERN, INERTIAL, OF_PICTURES
from tests.golden.references import compare_outcomes, compare_tracks
from tests.wheels import PIP, build, run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]
SUITE, PYTHON = "bookworm", "3.11"
# Of Raspberry Pi OS: Bookworm's and Trixie's.
PYTHONS = ("3.11", "3.13")
# What a node and the tools need; picamera2 comes from apt, and vqf is built from source.
EXTRAS = ("display", "keys", "plots", "survey", "monitor", "foxglove", "ros2", "bridge", "parquet")

MAIN = "import sys; from buddyline.tools.cli import main; sys.exit(main(sys.argv[1:]))"


def of_pi(version):
    """Say to pip for which machine it is, and that nothing may be built."""
    tags = ("manylinux_2_28_aarch64", "manylinux_2_17_aarch64", "manylinux2014_aarch64")
    return ("--only-binary=:all:", "--python-version", version, *(word for tag in tags for word in ("--platform", tag)))


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build(tmp_path_factory.mktemp("wheel"))


def installed(*words, cwd):
    """Let pip install; skip where it reaches no index."""
    done = run(*PIP, "install", "--quiet", *words, cwd=cwd)
    if "Max retries exceeded" in done.stderr or "Failed to establish a new connection" in done.stderr:
        pytest.skip("pip reaches no package index from here")
    return done


@pytest.mark.parametrize("version", PYTHONS)
def test_everything_has_a_wheel(wheel, version, tmp_path):
    words = ("--dry-run", "--ignore-installed", "--target", tmp_path, *of_pi(version))
    done = installed(*words, f"{wheel}[{','.join(EXTRAS)}]", "gpiozero", "smbus2", "pygeomag", cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@dataclass
class Arm64:
    """A program of arm64's Python with Buddyline in it."""

    root: Path
    packages: Path

    def run(self, *words):
        """Run Python; return the finished process."""
        python = self.root / "usr" / "bin" / f"python{PYTHON}"
        environment = {"PATH": os.environ["PATH"], "HOME": str(self.packages), "OPENBLAS_NUM_THREADS": "1"}
        return subprocess.run(
            ["qemu-aarch64-static", "-L", self.root, python, *words],
            capture_output=True, text=True, timeout=600, check=False, cwd=self.packages,
            env=environment | {"PYTHONPATH": str(self.packages), "PYTHONNOUSERSITE": "1"},
        )  # fmt: skip

    def buddyline(self, *words):
        """Run a command of ours; return its exit status."""
        done = self.run("-c", MAIN, *map(str, words))
        assert done.returncode in (0, 1), done.stderr
        assert "Traceback" not in done.stderr, done.stderr
        return done.returncode


@pytest.fixture(scope="module")
def pi(tmp_path_factory, wheel):
    for program in ("qemu-aarch64-static", "debootstrap"):
        if shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
    if os.geteuid() != 0:
        pytest.skip("debootstrap needs root")
    folder = tmp_path_factory.mktemp("pi")
    root, packages = folder / "root", folder / "packages"
    made = run(
        "debootstrap", "--arch=arm64", "--foreign", "--variant=minbase", "--include=python3", SUITE, root, cwd=folder
    )
    debs = sorted((root / "var" / "cache" / "apt" / "archives").glob("*.deb"))
    if made.returncode != 0 or not debs:
        pytest.skip(f"debootstrap cannot fetch arm64's packages: {(made.stdout + made.stderr).strip()[-200:]}")
    for deb in debs:
        assert run("dpkg-deb", "-x", deb, root, cwd=folder).returncode == 0, deb
    done = installed("--target", packages, *of_pi(PYTHON), wheel, cwd=folder)
    assert done.returncode == 0, done.stderr
    yield Arm64(root, packages)
    shutil.rmtree(folder)


def test_it_is_another_processor_with_its_own_libraries(pi):
    done = pi.run("-c", "import platform, cv2, zenoh; print(platform.machine(), platform.python_version())")
    machine, version = done.stdout.split() or ("", done.stderr)
    assert machine == "aarch64", version
    assert version.startswith(PYTHON)


def test_candidates_give_the_same_poses(pi, tmp_path):
    out = tmp_path / "out.mcap"
    status = pi.buddyline("solve", *CAVERN.logs, "-o", out, "--track", "none", *CAVERN.options)
    references.check(f"{CAVERN.name}.outcomes", (status, stages.outcomes_of(out)), compare_outcomes, False)


def test_pictures_give_the_same_poses(pi, tmp_path):
    dive, out = OF_PICTURES[-1], tmp_path / "out.mcap"
    status = pi.buddyline("solve", *dive.logs, "-o", out, "--track", "none")
    # OpenCV's sums round otherwise there: places differ by up to 5e-6 sigma.
    result = status, stages.outcomes_of(out)
    references.check(f"{dive.name}.outcomes", result, compare_outcomes, False, pictures=True, other_machine=True)


def test_sensors_and_lights_give_the_same_track(pi, tmp_path):
    out = tmp_path / "out.mcap"
    status = pi.buddyline("solve", *INERTIAL.logs, "-o", out, "--track", "smooth", "--track-hz", "20")
    references.check(f"{INERTIAL.name}.smooth", (status, stages.rows_of(out)), compare_tracks, False)
