"""The coach's benchmark: what it steers, and a simulated dive in which the words are followed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buddyline.node.sim.glow import SCALE_PX, stands_out
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.scene import Lamp, Scene
from buddyline.node.sim.trajectory import PairMotion
from buddyline.protocol.clock import S_NS
from buddyline.tools.bench.coach import (
    CASES,
    DIVES,
    NEVER,
    WATERS,
    WITHIN_S,
    asked_for,
    beginning,
    fade,
    follow,
    lamps_in_view,
    lose,
    missing,
    some_lamp,
)
from buddyline.tools.bench.steering import (
    RAMP_S,
    SEEN_SHARE,
    START_NS,
    TICK_S,
    TURN_DEGPS,
    Murky,
    SteeredDive,
    Steering,
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
    "case",
    [
        f"{NEVER}one looks up or down",
        pytest.param(f"{NEVER}a lamp beyond each border", marks=pytest.mark.slow),
        pytest.param(f"{NEVER}one looks away", marks=pytest.mark.slow),
    ],
)
def test_before_the_first_fix_the_words_lead_to_one(case: str) -> None:
    dives = [lose(WATERS[k % len(WATERS)], case, 8800 + k, imu=False) for k in range(4)]
    counted = [follow(dive) for dive in dives if dive is not None]
    assert len(counted) >= 2
    assert sum(time_s <= WITHIN_S for time_s in counted) >= 0.9 * len(counted)


@pytest.mark.parametrize("seed", [8800, 8804])
def test_a_lamp_that_is_dark_from_the_start_is_named_whichever_node_has_it(seed: int) -> None:
    dive = lose("cavern", f"{NEVER}a lamp is dark", seed, imu=True)
    assert dive is not None
    assert some_lamp(seed) == {8800: "a.left", 8804: "b.left"}[seed]
    assert follow(dive) <= WITHIN_S
    assert not dive.scenario.dead_lamps


@pytest.mark.slow
def test_a_lamp_that_goes_out_while_none_looks_is_named_in_time() -> None:
    found = fade(DIVES[1], "night_reef", 2001, imu=True, turn_degps=TURN_DEGPS)
    assert found is not None
    assert follow(found[0]) <= WITHIN_S


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
    dive = lose("lake", case, 7, imu=False)
    assert dive is not None
    assert follow(dive) <= WITHIN_S


def test_in_murky_water_a_lamp_is_seen_from_a_share_of_the_range() -> None:
    murky = Murky("basin", range_max_m=10.0)
    on_axis = np.array((0.0, 0.0, 1.0))
    for share, seen in ((0.95, True), (1.0, False)):
        far_m = share * SEEN_SHARE * murky.far_m * on_axis
        lamp = Lamp(far_m, -on_axis, np.zeros(2), 1.0, math.radians(12.0))
        assert stands_out(lamp, murky.water, SCALE_PX) is seen
    assert murky.water.ambient == Scenario("basin").water.ambient


def test_a_dive_that_loses_its_fix_says_why_and_its_divers_stay() -> None:
    found = fade(DIVES[0], "lake", 20002, imu=False, turn_degps=TURN_DEGPS)
    assert found is not None
    dive, why = found
    assert why == "looks away"
    t_s = (dive.now_ns - START_NS) / S_NS
    assert "looks away" in missing(Scene(dive.scenario, dive.motion), t_s)
    before, now = (dive.base.placement(0, t_s + later_s) for later_s in (0.0, 5.0))
    assert np.linalg.norm(now.position_ned_m - before.position_ned_m) < 0.01
    # Nobody comes back by himself.
    assert follow(dive) <= WITHIN_S


def test_a_lamp_that_is_put_out_is_dark_until_it_is_lit() -> None:
    dive = SteeredDive(Scenario("cavern", interruptions=False), imu=False)

    def seen() -> list[str]:
        return missing(Scene(dive.scenario, dive.motion), 1.0)

    assert seen() == []
    dive.put_out("b.left")
    assert seen() == ["dead lamp"]
    dive.put_out()
    assert seen() == []
