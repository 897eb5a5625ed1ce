"""The simulated sensor: pictures of one scene with several exposures, pulses, and flashes."""

import numpy as np
import pytest
from buddyline.node.capture.exposure import Exposure, ExposurePlan
from buddyline.node.sim.scenario import ENVIRONMENTS, WATERS, DivePlan, Scenario
from buddyline.node.sim.sensor import RANGE, DelayedControls, scene_exposure, shot_noise
from buddyline.node.sim.world import World
from buddyline.protocol.errors import BuddylineError

S_NS = 1_000_000_000
QUIET = {"interruptions": False, "other_lamps": 0, "width_px": 410, "height_px": 308}


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_the_scenes_own_exposure_is_the_picture_without_one(environment):
    world = World(Scenario(environment=environment, seed=2, **QUIET))
    own = scene_exposure(WATERS[environment])
    plain, exposed = world.render("a", S_NS).astype(int), world.render("a", S_NS, own).astype(int)
    assert np.abs(plain - exposed).max() <= 1


def test_light_is_proportional_to_time_times_gain():
    world = World(Scenario(environment="basin", seed=2, **QUIET))
    darker, brighter = (world.render("a", S_NS, Exposure(ns)).astype(float) for ns in (1_000_000, 2_000_000))
    inside = (brighter > 60) & (brighter < 250)
    assert inside.mean() > 0.5
    ratio = (brighter[inside] / darker[inside]) ** 2
    assert np.median(ratio) == pytest.approx(2.0, rel=0.03)
    gained = world.render("a", S_NS, Exposure(500_000, 4.0)).astype(float)
    assert np.median(gained[inside] - brighter[inside]) == pytest.approx(0.0, abs=1.0)


def test_gain_is_paid_for_with_noise():
    world = World(Scenario(environment="basin", seed=2, **QUIET))
    for gain in (1.0, 9.0):
        one, two = (world.render("a", S_NS + k, Exposure(round(2e6 / gain), gain)).astype(float) for k in range(2))
        patch = (one - two)[:40, :200]
        assert np.std(patch) == pytest.approx(np.sqrt(2) * shot_noise(gain), rel=0.15)


def test_pulses_show_in_the_rows_and_not_in_whole_periods():
    scenario = Scenario(environment="cavern", seed=2, row_time_ns=20_000, pwm_hz=1000.0, pwm_depth=0.5, **QUIET)
    steady = World(Scenario(environment="cavern", seed=2, row_time_ns=20_000, **QUIET))
    pulsed = World(scenario)
    swings = []
    for time_ns in (100_000, 1_000_000):
        exposure = Exposure(time_ns)
        one, two = (world.render("a", S_NS, exposure).astype(float) for world in (steady, pulsed))
        lit = (one > 40) & (one < 240) & (two < 240)
        swings.append(np.std((two[lit] / one[lit]) ** 2))
    assert swings[0] > 0.2
    assert swings[1] < 0.05


def test_a_strobe_flashes_in_some_frames():
    scenario = Scenario(environment="cavern", seed=2, strobe_s=1.0, **QUIET)
    world, dark = World(scenario), World(Scenario(environment="cavern", seed=2, **QUIET))
    brighter = [
        world.render("a", ns).astype(float).mean() - dark.render("a", ns).astype(float).mean()
        for ns in (S_NS, S_NS + S_NS // 2)
    ]
    assert brighter[0] > 10
    assert abs(brighter[1]) < 0.1


@pytest.mark.parametrize("delay", [0, 3])
def test_controls_come_late(delay):
    controls = DelayedControls(delay)
    first = controls.take(0)[0]
    other = RANGE.exposure(0.1)
    plan = ExposurePlan(other, first, 5)
    controls.follow(plan)
    taken = [controls.take(trigger)[0] for trigger in range(1, 12)]
    assert taken == [first if k <= delay or k % 5 == 0 else other for k in range(1, 12)]


def test_an_unknown_exposure_is_named():
    with pytest.raises(BuddylineError, match="exposure: 'long'"):
        DivePlan(exposure="long")
