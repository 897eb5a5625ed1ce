"""The benchmark of the detector's lights: its figures hold on a scene that nothing was fitted to."""

import contextlib
import io
import json

import pytest
from buddyline.tools.bench.__main__ import main


@pytest.fixture(scope="module")
def figures():
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        assert main(["lights", "--json", "--environment", "cavern", "basin", "--scenes", "1", "--seconds", "12"]) == 0
    return json.loads(out.getvalue())


def test_lamps_are_found_at_the_exposure_that_is_locked_to_them(figures):
    for row in figures["waters"]:
        assert row["lights"] > 60
        assert row["recall"] >= 0.98
        assert row["both_first"] >= 0.97
        assert row["median_px"] < 0.05
        assert row["false"] < 0.3


def test_sigma_is_true_at_the_exposure_that_is_locked_to_the_lamps(figures):
    for row in figures["waters"]:
        assert 0.4 < row["nees"] < 1.5
        assert row["beyond"] < 0.05


def test_every_light_belongs_to_one_range(figures):
    number = {row["class"]: row["lights"] for row in figures["classes"]}
    assert sum(count for name, count in number.items() if name.endswith(" m")) == number["all"]
    assert number["clipped"] + number["not clipped"] == number["all"]
    assert number["not clipped"] > number["clipped"]
