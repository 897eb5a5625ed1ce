"""The contracts on imports hold, and each one finds a module that breaks it, planted in a copy of the tree."""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from tests.imports import FOLDERS, circles, imported_by, modules
from tests.processes import PATIENCE_S, REPOSITORY

GEOMETRY = "buddyline.solver_service.geometry"


def outside_of_geometry(root):
    """Return what geometry imports beside itself, numpy and the standard library, by module."""
    allowed = {"numpy", *sys.stdlib_module_names}
    found = {}
    for name, path in modules(root).items():
        if name == GEOMETRY or name.startswith(f"{GEOMETRY}."):
            foreign = {
                one
                for one in imported_by(name, path)
                if one.partition(".")[0] not in allowed and one != GEOMETRY and not one.startswith(f"{GEOMETRY}.")
            }
            if foreign:
                found[name] = foreign
    return found


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """A copy of the sources, laid out as they are installed, with the configuration beside it."""
    root = tmp_path_factory.mktemp("tree")
    # Without what building writes, the contracts must hold too.
    left_out = shutil.ignore_patterns("__pycache__", "_version.py")
    for folder in FOLDERS:
        shutil.copytree(REPOSITORY / folder, root / folder, ignore=left_out)
    package = root / "names" / "buddyline"
    package.mkdir(parents=True)
    for path in (root / "buddyline").glob("*.py"):
        (package / path.name).symlink_to(path)
    for folder in set(FOLDERS) - {"buddyline"}:
        (package / folder).symlink_to(root / folder)
    shutil.copy(REPOSITORY / "pyproject.toml", root)
    return root


@pytest.fixture
def plant(tree):
    """Puts a module into the tree, and takes it out again."""
    planted = []

    def put(path, text):
        planted.append(tree / path)
        assert not planted[-1].exists()
        planted[-1].write_text(text)

    yield put
    for path in planted:
        path.unlink()


def lint(tree) -> str:
    """Return what import-linter says of the tree."""
    script = Path(sys.executable).with_name("lint-imports")
    if not script.exists():
        pytest.skip("import-linter is not installed")
    done = subprocess.run(
        [script, "--config", tree / "pyproject.toml", "--cache-dir", tree / "cache"],
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
        check=False,
        cwd=tree / "names",
    )
    assert "Contracts: " in done.stdout, done.stdout + done.stderr
    return done.stdout


def broken(said: str) -> list[str]:
    """Return the names of the contracts that are broken."""
    return [line.removesuffix(" BROKEN") for line in said.splitlines() if line.endswith(" BROKEN")]


def test_the_tree_keeps_its_contracts(tree):
    assert broken(lint(tree)) == []
    assert outside_of_geometry(tree) == {}
    assert circles(tree) == []


WAY = "imports run one way: protocol <- node, solver_service <- tools"
ZENOH = "zenoh is imported in protocol.zenoh_bus alone"
SIMULATOR = "nothing at run time imports the simulator"
COMMANDS = "nothing imports the commands that simulate"


@pytest.mark.parametrize(
    ("path", "text", "contracts"),
    [
        ("protocol/planted.py", "import buddyline.tools.cli\n", [WAY]),
        ("node/planted.py", "def f():\n    from buddyline.solver_service import core\n", [WAY]),
        ("solver_service/planted.py", "from buddyline.node import config\n", [WAY]),
        ("tools/planted.py", "def f():\n    import zenoh\n", [ZENOH]),
        ("solver_service/geometry/planted.py", "import zenoh.ext\n", [ZENOH]),
        ("node/planted.py", "from buddyline.node.sim import world\n", [SIMULATOR]),
        ("tools/planted.py", "from buddyline.node.sim.world import World\n", [SIMULATOR]),
        ("solver_service/planted.py", "import buddyline.node.sim\n", [WAY, SIMULATOR]),
        ("tools/planted.py", "from buddyline.tools import simulate\n", [COMMANDS]),
        ("tools/survey/planted.py", "from buddyline.tools.demo.dashboard import Dashboard\n", [COMMANDS]),
    ],
)
def test_import_linter_finds_what_breaks_a_contract(tree, plant, path, text, contracts):
    plant(path, text)
    said = lint(tree)
    assert broken(said) == contracts
    assert ".planted" in said


def test_every_contract_of_import_linter_is_tried():
    configured = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    assert [contract["name"] for contract in configured] == [WAY, ZENOH, SIMULATOR, COMMANDS]


@pytest.mark.parametrize(
    ("text", "foreign"),
    [
        ("import scipy.optimize\n", {"scipy.optimize"}),
        ("def f():\n    from cv2 import aruco\n", {"cv2", "cv2.aruco"}),
        ("from buddyline.protocol import clock\n", {"buddyline.protocol", "buddyline.protocol.clock"}),
        ("from .. import config\n", {"buddyline.solver_service", "buddyline.solver_service.config"}),
        ("from ..prior import PosePrior\n", {"buddyline.solver_service.prior"}),
        ("import msgspec\n", {"msgspec"}),
        ("from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import zenoh\n", {"zenoh"}),
        ("import math\nimport numpy.linalg\nfrom . import camera\nfrom .rig import Rig\n", set()),
    ],
)
def test_geometry_is_numpy_and_the_standard_library(tree, plant, text, foreign):
    plant("solver_service/geometry/planted.py", text)
    found = outside_of_geometry(tree)
    assert foreign <= found.get(f"{GEOMETRY}.planted", set())
    assert bool(found) == bool(foreign)


def test_an_import_cycle_is_found(tree, plant):
    plant("tools/planted.py", "from buddyline.tools.planted_too import f\n")
    plant("tools/planted_too.py", "def f():\n    import buddyline.tools.planted\n")
    assert circles(tree) == [["buddyline.tools.planted", "buddyline.tools.planted_too"]]


def test_every_package_is_installed():
    configured = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    there = {name for name, path in modules(REPOSITORY).items() if path.name == "__init__.py"}
    assert set(configured) == there
