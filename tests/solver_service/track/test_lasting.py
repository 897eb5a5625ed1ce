"""Lights whose errors last from picture to picture."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.track.dive import _unrest, smooth
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.inputs import FrameSeen
from buddyline.solver_service.track.lights import sights_of
from buddyline.solver_service.track.records import last_ns
from buddyline.solver_service.track.seeing import counted, counted_more, note_lit
from buddyline.solver_service.track.state import SIZE, State

from tests.solver_service.track.dives import KnownDive, Setting, filter_of, make, score

NO_TIME = np.zeros(0)


@pytest.fixture(scope="module")
def dive() -> KnownDive:
    return make(1, Setting(seconds=12.0))


@pytest.mark.parametrize("poor", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_errors_of_lights_that_last_count_once_where_the_node_tells_of_them(poor: bool) -> None:
    """Half of their variance is the same a second later: taken for new in each picture, the track would be too sure."""
    dive = make(2, Setting(seconds=20.0, poor=poor, lasting_s=1.3))
    untold = [
        replace(record, frames=[replace(frame, lasting_s=NO_TIME) for frame in record.frames])
        for record in dive.records
    ]
    told, unknown = (smooth((a, b), dive.fixes, dive.stamps_ns).rows for a, b in (dive.records, untold))
    assert 0.3 < score(dive, told).nees < 1.5
    assert score(dive, unknown).nees > 2.5
    causal = filter_of(dive.records, dive.fixes).advance(last_ns(dive.records), dive.stamps_ns)
    assert 0.15 < score(dive, causal).nees < 1.5


def test_a_light_whose_error_lasts_counts_by_when_it_was_last_used(dive: KnownDive) -> None:
    frame = FrameSeen(0, np.full((2, 2), 300.0), np.full(2, 0.7), lasting_s=np.array((0.0, 1.5)))
    [sight] = sights_of(dive.records[0].node.rig, 0, [1.2], [frame])
    estimate = Estimate(
        1.0, State.at_rest(np.zeros(3), np.eye(3)[None].repeat(2, 0)), np.eye(SIZE), 1.0, confirmed=True
    )
    chosen = (0, 0, 0.5), (1, 1, 0.5)
    assert counted(chosen, sight, estimate) == chosen
    estimate.lit_s[0], estimate.lit_s[1] = 1.0, 1.19
    used = counted(chosen, sight, estimate)
    assert used == ((0, 0, 0.5), (1, 1, pytest.approx(4.25)))
    assert counted_more(chosen, used) == pytest.approx(np.array((0.0, 0.0, 3.75, 3.75)))
    note_lit(estimate, sight, used[1:])
    assert estimate.lit_s.tolist() == [[1.0, 1.2], [1.19, 1.19]]
    assert estimate.copied().lit_s is not estimate.lit_s
    again = counted(chosen, sight, estimate)
    assert math.isfinite(again[1][2])
    assert again[1][2] > 500.0
    estimate.without[1] = True
    assert counted(chosen, sight, estimate) == chosen


def test_lights_whose_errors_last_keep_their_own_chi2_and_tell_nothing_of_gaps(dive: KnownDive) -> None:
    """By the variances that they count with chi^2 would be 0.1: no path would be refused, no noise in gaps be left."""
    lit = [replace(record, frames=[told(frame, 1.3) for frame in record.frames]) for record in dive.records]
    for records, asked in ((dive.records, 0.89), (lit, 1.0)):
        track = filter_of((records[0], records[1]), dive.fixes)
        track.advance(last_ns(records))
        assert track.main is not None
        assert track.main.chi2 / track.main.chi2_dof > 0.3
        assert _unrest([track.main]) == pytest.approx(asked, abs=0.01)


def told(frame: FrameSeen, lasting_s: float) -> FrameSeen:
    return replace(frame, lasting_s=np.full(len(frame.pixels), lasting_s))
