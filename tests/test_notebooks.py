"""The notebooks run from the first cell to the last."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

import pytest
from buddyline.tools.cli import main

from tests.processes import PATIENCE_S, REPOSITORY, Process, free_endpoint

pytestmark = pytest.mark.slow
NOTEBOOKS = REPOSITORY / "examples" / "notebooks"
LIVE = "3_live_poses_with_asyncio.ipynb"


def run(name: str, folder: Path) -> str:
    """Run a notebook in a folder; return what its cells printed."""
    nbformat = pytest.importorskip("nbformat", reason="the extra docs is not installed")
    client = pytest.importorskip("nbclient", reason="the extra docs is not installed")
    notebook = nbformat.read(NOTEBOOKS / name, as_version=4)
    notebook.metadata.kernelspec = {"name": "python3", "display_name": "", "language": "python"}
    client.NotebookClient(notebook, timeout=PATIENCE_S, resources={"metadata": {"path": str(folder)}}).execute()
    outputs = [output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs]
    return "".join(one.get("text", "") or one.get("data", {}).get("text/plain", "") for one in outputs)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    assert main(["sample"]) == 0
    return tmp_path


def test_there_are_three_and_each_has_a_test() -> None:
    names = {path.name for path in NOTEBOOKS.glob("*.ipynb")}
    assert names == {"1_solve_and_plot_a_dive.ipynb", "2_from_pictures_to_a_pose.ipynb", LIVE}
    assert all('"outputs": []' in (NOTEBOOKS / name).read_text() for name in names), "outputs are not kept"


def test_solve_and_plot(folder: Path) -> None:
    pytest.importorskip("matplotlib")
    assert "position error of the poses: median" in run("1_solve_and_plot_a_dive.ipynb", folder)


def test_from_pictures_to_a_pose(folder: Path) -> None:
    assert " m, B at [" in run("2_from_pictures_to_a_pose.ipynb", folder)


def test_live_poses(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = free_endpoint()
    monkeypatch.setenv("BUDDYLINE_HUB", endpoint)
    with ExitStack() as stack:
        for words in (("hub", "--listen"), ("solver", "--connect"), ("play", "sample.mcap", "--loop", "--connect")):
            stack.enter_context(Process(*words, endpoint, cwd=folder))
        assert run(LIVE, folder).rstrip().endswith("]")
