"""The survey's figures over 40 loops: minutes, so by command only (pytest -m slow)."""

import math
import shutil

import numpy as np
import pytest

from tests.tools import survey_world as world
from tests.tools.survey_figures import campaign, table

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),
    pytest.mark.skipif(shutil.which("cavern") is None, reason="survex is not installed"),
]


def rms(values):
    return math.sqrt(float((np.array(values) ** 2).mean()))


def test_loops_close_as_their_sigmas_say():
    figures = campaign("loop", 50, world.Flaws())
    print(*table(figures), sep="\n")
    assert len(figures["V, depths readings"]) >= 40
    # A centimetre, and half of one that Survex rounds away.
    assert max(figures["cavern differs, m"]) <= 0.015
    assert not any(figures["cavern's warnings"])
    # The rms of 40 such ratios has a standard deviation of about 0.1.
    for name in ("H, depths absolute", "H, depths readings", "V, depths readings"):
        assert 0.7 < rms(figures[name]) < 1.3
    for name in ("distance / sigma", "azimuth / sigma", "rise / sigma"):
        assert 0.8 < rms(figures[name]) < 1.2


def test_open_lines_end_about_as_near_as_by_hand():
    figures = campaign("line", 20, world.Flaws())
    print(*table(figures), sep="\n")
    assert np.median(figures["far end, % of length"]) < 1.5 * np.median(figures["by hand: far end, %"])
    assert 0.6 < rms(figures["far end / ellipse"]) < 1.4


def test_disturbed_stations_do_not_carry_the_line_away():
    figures = campaign("line", 20, world.Flaws(disturbed_share=0.1))
    print(*table(figures), sep="\n")
    # By hand is undisturbed here: what the nodes see of their fields must make up for it.
    assert np.median(figures["far end, % of length"]) < 1.5 * np.median(figures["by hand: far end, %"])
