"""What is installed from a wheel works alone: one import name, beside folders that are called as ours are."""

import json

import pytest

from tests.processes import REPOSITORY
from tests.wheels import PIP, PYTHONS, build, interpreter, run

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]
FOLDERS = ("tools", "node", "protocol", "solver_service", "buddyline")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    return build(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module", params=PYTHONS)
def installed(request, wheel, tmp_path_factory):
    """A fresh environment of one Python with the wheel, its extra `keys` and what they need, of constraints.txt."""
    python = interpreter(request.param)
    if python is None:
        pytest.skip(f"no Python {request.param} is on the path or in ~/.pyenv")
    folder = tmp_path_factory.mktemp("environment")
    assert run(python, "-m", "venv", folder / "venv", cwd=folder).returncode == 0
    program = folder / "venv" / "bin" / "python"
    words = ("install", "--quiet", "--no-compile", "-c", REPOSITORY / "constraints.txt", f"{wheel}[keys]")
    done = run(program, "-m", "pip", "--disable-pip-version-check", *words, cwd=folder)
    if "Max retries exceeded" in done.stderr or "Failed to establish a new connection" in done.stderr:
        pytest.skip("pip reaches no package index from here")
    assert done.returncode == 0, done.stderr
    (packages,) = (folder / "venv").glob("lib/python*/site-packages")
    return program, packages


@pytest.fixture
def crowded(tmp_path):
    """A folder in which others have packages by our folders' names."""
    for name in FOLDERS[:-1]:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise ImportError('not ours')\n")
    return tmp_path


def test_the_wheel_holds_buddyline_alone_and_all_of_it(wheel, tmp_path):
    assert run(*PIP, "install", "--no-deps", "--quiet", "--target", tmp_path, wheel, cwd=tmp_path).returncode == 0
    names = sorted(path.name for path in tmp_path.iterdir() if path.name != "bin")
    assert len(names) == 2
    assert names[0] == "buddyline"
    assert names[1].endswith(".dist-info")
    folder = tmp_path / "buddyline"
    for name in ("py.typed", "node/examples/pi.toml", "tools/sample.mcap", "tools/monitor/web/index.html"):
        assert (folder / name).exists(), name
    sources = {
        path.relative_to(REPOSITORY).as_posix()
        for folder in FOLDERS
        for path in (REPOSITORY / folder).rglob("*.py")
        if "examples" not in path.parts
    }
    wanted = {path.removeprefix("buddyline/") for path in sources}
    there = {path.relative_to(folder).as_posix() for path in folder.rglob("*.py")}
    assert wanted == there, "a package is missing from [tool.setuptools] packages"


def test_all_of_it_works_beside_folders_of_the_same_names(installed, crowded):
    python, packages = installed
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
        ("keys", "init", "--hub", "127.0.0.1"),
        ("keys", "node", "a"),
        ("init", "node"),
    ):
        done = run(*program, *words, cwd=crowded)
        assert done.returncode == 0, done.stderr
    done = run(*program, "demo", "--seconds", "8", "--json", cwd=crowded)
    assert json.loads(done.stdout)["poses"] > 0, done.stderr
    script = packages.parents[2] / "bin" / "buddyline"
    done = run(script, "--version", cwd=crowded)
    assert done.stdout.startswith("buddyline "), done.stderr
    library = "import buddyline; print(len(buddyline.solve('dive.mcap').poses))"
    done = run(python, "-c", library, cwd=crowded)
    assert int(done.stdout) > 10, done.stderr
