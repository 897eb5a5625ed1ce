"""The drawings of docs/build are what their script draws, and sound."""

import importlib.util
from xml.etree import ElementTree

import pytest

from tests.processes import REPOSITORY

FOLDER = REPOSITORY / "docs" / "build"


def load():
    spec = importlib.util.spec_from_file_location("draw", FOLDER / "draw.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_drawing_is_as_the_script_draws_it_and_is_shown():
    drawings = load().DRAWINGS
    page = (FOLDER / "README.md").read_text()
    assert {path.name for path in FOLDER.glob("*.svg")} == set(drawings)
    for name, draw in drawings.items():
        assert (FOLDER / name).read_text() == str(draw()), "run python docs/build/draw.py"
        assert f"]({name})" in page


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.svg")), ids=lambda path: path.name)
def test_a_drawing_stays_within_its_frame(path):
    root = ElementTree.fromstring(path.read_text())
    width, height = float(root.get("width")), float(root.get("height"))
    for one in root.iter("{http://www.w3.org/2000/svg}text"):
        # About 7 px a letter.
        long = 7.0 * len(one.text)
        left = float(one.get("x")) - {"start": 0.0, "middle": 0.5, "end": 1.0}[one.get("text-anchor")] * long
        assert left >= 0.0
        assert left + long <= width + 10.0, one.text
        assert 0.0 < float(one.get("y")) < height, one.text
