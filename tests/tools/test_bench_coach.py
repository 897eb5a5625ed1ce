"""The coach's benchmark: what it steers, and a simulated dive in which the words are followed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.trajectory import PairMotion
from buddyline.tools.bench.coach import (
    CASES,
    NEVER,
    RAMP_S,
    TICK_S,
    TURN_DEGPS,
    WATERS,
    WITHIN_S,
    Steering,
    asked_for,
    beginning,
    follow,
    lamps_in_view,
)


def test_words_are_read_as_turns_and_ways() -> None:
    words = ["turn a 40 deg left and 10 deg down", "turn b 20 deg up", "left lamp of b is dark"]
    assert asked_for(words).tolist() == [-40.0, 10.0, 0.0, -20.0, 0.0]
    assert asked_for(["come 1.5 m closer"]).tolist() == [0.0, 0.0, 0.0, 0.0, -1.5]
    assert asked_for(["move 0.5 m apart"]).tolist() == [0.0, 0.0, 0.0, 0.0, 0.5]


def test_a_steered_node_turns_to_the_right_without_a_jump() -> None:
    base = PairMotion(Scenario(interruptions=False))
    steered = Steering(base)
    wanted = np.array([TURN_DEGPS, 0.0, 0.0, 0.0, -0.5])
    for _ in range(10):
        steered.steer(wanted)
    turned = steered.placement(0, 1.0).R_ned_body[:, 0]
    before = base.placement(0, 1.0).R_ned_body[:, 0]
    right_rad = math.atan2(turned[1], turned[0]) - math.atan2(before[1], before[0])
    assert math.degrees(right_rad) % 360 == pytest.approx(TURN_DEGPS * (1.0 - RAMP_S / 2), abs=0.5)
    apart_m = [np.linalg.norm(m.placement(1, 1.0).position_ned_m - m.placement(0, 1.0).position_ned_m)
               for m in (base, steered)]  # fmt: skip
    assert apart_m[0] - apart_m[1] == pytest.approx(0.5 * (1.0 - RAMP_S / 2), abs=0.02)
    values = np.array([steered.added(t_s) for t_s in np.arange(0.0, 1.0, TICK_S / 50)])
    assert np.abs(np.diff(values, n=2, axis=0)).max() < 1e-3


@pytest.mark.parametrize(
    "case", [f"{NEVER}a lamp beyond each border", f"{NEVER}one looks away", f"{NEVER}one looks up or down"]
)
def test_before_the_first_fix_the_words_lead_to_one(case: str) -> None:
    found = [follow(WATERS[k % len(WATERS)], case, 8800 + k, imu=False) for k in range(4)]
    counted = [time_s for time_s in found if time_s is not None]
    assert len(counted) >= 2
    assert sum(time_s <= WITHIN_S for time_s in counted) >= 0.9 * len(counted)


def test_a_dive_begins_without_a_fix_as_its_case_says() -> None:
    rng = np.random.default_rng(3)
    begin = beginning("cavern", f"{NEVER}both look away", 8800, rng)
    assert begin is not None
    assert (np.abs(begin[[0, 2]]) >= 40.0).all()
    assert max(lamps_in_view("cavern", 8800, begin)) < 2
    assert lamps_in_view("cavern", 8800, np.zeros(5)) == [2, 2]


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES[:3])
def test_followed_the_words_give_a_fix_within_five_seconds(case: str) -> None:
    found = follow("lake", case, 7, imu=False)
    assert found is not None
    assert found <= WITHIN_S
