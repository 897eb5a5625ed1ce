"""What is installed from a wheel works alone: one import name, beside folders that are called as ours are."""

import sys
import venv

import pytest

from tests.processes import REPOSITORY
from tests.wheels import PIP, build, run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
FOLDERS = ("tools", "node", "protocol", "solver_service", "buddyline")


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A fresh environment with the wheel in it; the packages that we need are this one's."""
    folder = tmp_path_factory.mktemp("wheel")
    wheel = build(folder)
    environment = folder / "environment"
    venv.create(environment, with_pip=False)
    (packages,) = environment.glob("lib/python*/site-packages")
    done = run(*PIP, "install", "--no-deps", "--no-compile", "--quiet", "--target", packages, wheel, cwd=folder)
    assert done.returncode == 0, done.stderr
    names = sorted(path.name for path in packages.iterdir() if path.name != "bin")
    others = [path for path in sys.path if path.endswith("site-packages")]
    # Their own .pth files are not read from here, so that no editable installation of ours is found.
    (packages / "others.pth").write_text("\n".join(others) + "\n")
    return environment / "bin" / "python", packages, names


@pytest.fixture
def crowded(tmp_path):
    """A folder in which others have packages by our folders' names."""
    for name in FOLDERS[:-1]:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise ImportError('not ours')\n")
    return tmp_path


def test_site_packages_hold_buddyline_alone(installed):
    _, packages, names = installed
    assert len(names) == 2
    assert names[0] == "buddyline"
    assert names[1].endswith(".dist-info")
    assert (packages / "buddyline" / "py.typed").exists()
    sources = {
        path.relative_to(REPOSITORY).as_posix()
        for folder in FOLDERS
        for path in (REPOSITORY / folder).rglob("*.py")
        if path.name != "__pycache__" and "examples" not in path.parts
    }
    wanted = {path.removeprefix("buddyline/") for path in sources}
    there = {path.relative_to(packages / "buddyline").as_posix() for path in (packages / "buddyline").rglob("*.py")}
    assert wanted == there, "a package is missing from [tool.setuptools] packages"


def test_commands_work_beside_folders_of_the_same_names(installed, crowded):
    python, packages, _ = installed
    program = (python, "-m", "buddyline")
    where = run(python, "-c", "import buddyline.tools.cli as cli; print(cli.__file__)", cwd=crowded)
    assert where.stdout.startswith(str(packages)), where.stderr
    for words in (
        ("--help",),
        ("simulate", "dive.mcap", "--seconds", "3"),
        ("sample",),
        ("solve", "sample.mcap", "-o", "solved.mcap"),
        ("solve", "dive.mcap", "-o", "poses.mcap"),
        ("export", "poses.mcap", "--format", "tum"),
    ):
        done = run(*program, *words, cwd=crowded)
        assert done.returncode == 0, done.stderr
    script = packages / "bin" / "buddyline"
    done = run(python, script, "--version", cwd=crowded)
    assert done.stdout.startswith("buddyline "), done.stderr
    library = "import buddyline; print(len(buddyline.solve('dive.mcap').poses))"
    done = run(python, "-c", library, cwd=crowded)
    assert int(done.stdout) > 10, done.stderr
