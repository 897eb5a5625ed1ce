"""The loop against a lamp, a tone curve and a camera with delay: it settles, stays, and stays within the bounds."""

from collections import deque
from itertools import pairwise

import numpy as np
import pytest
from buddyline.node.capture.cores import CLIPPED, Core, SceneLight
from buddyline.node.capture.exposure import Exposure, ExposureRange, inverse_tone_curve, srgb_to_linear
from buddyline.node.capture.lock import LOST, ExposureLock, Metering
from hypothesis import given, settings
from hypothesis import strategies as st

SQUARE = (np.arange(256) / 255) ** 2
PI_CURVE = inverse_tone_curve([0, 0, 1024, 5040, 4096, 15312, 16384, 40642, 32768, 54979, 49152, 61183, 65535, 65535])
CURVES = {"square": SQUARE, "pi": PI_CURVE, "srgb": srgb_to_linear()}
RANGE = ExposureRange(75_000, 25_000_000, 4.0, line_ns=18_904.0, linear=SQUARE)
SEEN_FROM = 8
"""Grey level from which a lamp is found."""


class LampCamera:
    """A camera that looks at one lamp of `light` per ms, with a delay, a tone curve, and noise in its grey levels."""

    def __init__(self, light, delay=0, true_curve="square", believed="square", noise=0.0, seed=0):
        self.light, self.noise, self.scene_light = light, noise, 0.01
        self._true = CURVES[true_curve]
        self.range = ExposureRange(75_000, 25_000_000, 4.0, line_ns=18_904.0, linear=CURVES[believed])
        self.lock = ExposureLock(self.range, context_every=20)
        self._pipe = deque([self.lock.plan] * delay)
        self._rng = np.random.default_rng(seed)
        self.trigger = 0
        self.asked = []

    def level(self, exposure):
        """Grey level of the lamp's core."""
        shaken = 1.0 + self.noise * self._rng.uniform(-1, 1)
        return int(np.searchsorted(self._true, min(self.light * shaken * exposure.amount, 1.0)))

    def step(self, seen=True):
        self._pipe.append(self.lock.plan)
        exposure = self._pipe.popleft().at(self.trigger)
        self.trigger += 1
        level = self.level(exposure)
        cores = []
        if seen and level >= SEEN_FROM:
            cores = [Core(100.0, 100.0, float(self.range.linear[level]), level >= CLIPPED)]
        context = self.lock.plan.is_context(exposure)
        scene = SceneLight(min(self.scene_light * exposure.amount, 1.0), 0.0) if context else None
        plan = self.lock.update(Metering(exposure, cores, scene))
        self.asked.append(plan)
        return level

    def run(self, frames, seen=True):
        return [self.step(seen) for _ in range(frames)]


def settled(eye):
    """Whether the lamp is well exposed with what is asked for now, or as well as the bounds let it be."""
    amount = eye.lock.plan.lamps.amount
    level = eye.level(eye.lock.plan.lamps)
    return 90 <= level < CLIPPED or amount <= 1.35 * eye.range.least or amount >= eye.lock.plan.scene.amount / 1.35


lights = st.floats(-2.7, 1.5).map(lambda power: 10.0**power)
delays = st.integers(0, 12)
curves = st.sampled_from(sorted(CURVES))


@settings(max_examples=150, deadline=None)
@given(lights, lights, delays, curves, curves, st.integers(0, 60))
def test_it_recovers_from_any_change_of_light(before, after, delay, true_curve, believed, frames):
    eye = LampCamera(before, delay, true_curve, believed, noise=0.05)
    eye.run(frames)
    eye.light = after
    eye.run(80 + 4 * delay)
    assert settled(eye)


@settings(max_examples=100, deadline=None)
@given(lights, delays, curves, curves, st.floats(0.0, 0.08), st.integers(0, 5))
def test_it_never_hunts_at_a_constant_light(light, delay, true_curve, believed, noise, seed):
    """Once settled it may follow the noise by a step, and then stands still, whatever delay and tone curve are."""
    eye = LampCamera(light, delay, true_curve, believed, noise, seed)
    eye.run(120 + 4 * delay)
    before = len(eye.asked)
    eye.run(200)
    amounts = [plan.lamps.amount for plan in eye.asked[before:]]
    assert sum(a != b for a, b in zip(amounts[1:], amounts, strict=False)) <= 1
    assert max(amounts) <= 1.4 * min(amounts)


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(lights, st.booleans()), max_size=40), delays)
def test_every_exposure_is_one_that_the_camera_has(steps, delay):
    eye = LampCamera(1.0, delay)
    for light, seen in steps:
        eye.light = light
        eye.run(3, seen)
    for plan in eye.asked:
        for exposure in (plan.lamps, plan.scene):
            assert 75_000 <= exposure.time_ns <= 25_000_000
            assert 1.0 <= exposure.gain <= 4.0
            lines = exposure.time_ns / 18_904.0
            assert abs(lines - round(lines)) < 1e-3
            assert exposure.gain == 1.0 or exposure.time_ns > 0.89 * 25_000_000


@pytest.mark.parametrize("delay", [0, 4, 10])
def test_a_lamp_that_turns_towards_the_camera_is_clipped_for_few_frames(delay):
    """Sixty times as bright from one frame to the next: the rungs are asked for without waiting for answers."""
    eye = LampCamera(0.1, delay)
    eye.run(60)
    eye.light = 6.0
    levels = eye.run(60)
    assert sum(level >= CLIPPED for level in levels) <= 2 * delay + 8
    assert settled(eye)


@pytest.mark.parametrize("delay", [0, 4, 10])
def test_a_single_flash_changes_nothing(delay):
    eye = LampCamera(0.3, delay)
    eye.run(80)
    before = eye.lock.plan.lamps
    for _ in range(5):
        eye.light = 300.0
        eye.step()
        eye.light = 0.3
        eye.run(9)
        assert eye.lock.plan.lamps == before
    assert eye.lock.state == "locked"


def test_more_comes_slowly_and_less_at_once():
    eye = LampCamera(1.0)
    eye.run(60)
    amounts = []
    for light in (0.25, 1.0):
        eye.light = light
        eye.run(19)
        amounts.append([plan.lamps.amount for plan in eye.asked[-19:]])
    up, down = amounts
    assert max(b / a for a, b in pairwise(up)) < 1.35
    assert min(b / a for a, b in pairwise(down)) < 0.5


def test_a_lamp_that_is_lost_is_searched_between_the_last_exposure_and_the_scenes():
    eye = LampCamera(2.0)
    eye.run(60)
    good = eye.lock.plan.lamps.amount
    eye.run(LOST + 1, seen=False)  # one of them is a context frame
    assert eye.lock.state == "search"
    eye.run(40, seen=False)
    searched = [plan.lamps.amount for plan in eye.asked[-40:]]
    scene = eye.lock.plan.scene.amount
    assert min(searched) == pytest.approx(good, rel=0.3)
    assert max(searched) == pytest.approx(scene, rel=0.1)
    assert len(set(searched)) >= 3
    eye.light = 0.05
    eye.run(12)
    assert eye.lock.state == "locked"


def test_a_lamp_seen_in_context_frames_alone_counts_as_lost():
    """Else an exposure that is too short for a lamp would never be left."""
    eye = LampCamera(0.5)
    eye.run(60)
    eye.light = 1e-3
    eye.run(100)
    assert settled(eye)


def test_the_scenes_exposure_follows_the_scene():
    for scene_light, expected in ((0.03, 5.0), (1e-5, 100.0)):
        eye = LampCamera(0.3)
        eye.scene_light = scene_light
        eye.run(600)
        assert eye.lock.plan.scene.amount == pytest.approx(expected, rel=0.35)


def test_context_frames_are_those_of_the_same_triggers_in_all_nodes():
    plan = LampCamera(0.3).lock.plan
    assert [k for k in range(100, 200) if plan.at(k) is plan.scene] == [100, 120, 140, 160, 180]


def test_a_brighter_second_lamp_counts():
    lock = ExposureLock(RANGE, 0)
    cores = [Core(0, 0, 0.1, False), Core(50, 0, 0.3, False)]
    lock.update(Metering(Exposure(1_000_000), cores))
    assert lock.plan.lamps.amount == pytest.approx(2.0, rel=0.02)


def test_pulsed_lamps_get_whole_periods():
    lock = ExposureLock(RANGE, 0, flicker_ns=1_000_000.0)
    for light in (30.0, 0.3, 0.02):
        for _ in range(30):
            exposure = lock.plan.lamps
            level = min(light * exposure.amount, 1.0)
            lock.update(Metering(exposure, [Core(0, 0, level, level >= 1.0)]))
        periods = lock.plan.lamps.time_ns / 1e6
        assert abs(periods - round(periods)) < 0.02
        assert round(periods) >= 1


@pytest.mark.parametrize("delay", [0, 4, 10])
def test_a_lamp_that_is_hidden_is_made_room_for_without_hunting(delay):
    """Context frames show a second lamp that needs 500 times the light that the first one wants."""
    eye = LampCamera(30.0, delay)
    needed = 500 * 0.6 / 30.0 * 0.01
    pipe = deque([eye.lock.plan] * delay)
    amounts = []
    for trigger in range(600):
        pipe.append(eye.lock.plan)
        exposure = pipe.popleft().at(trigger)
        level = eye.level(exposure)
        context = eye.lock.plan.is_context(exposure)
        shown = amounts and amounts[-1] >= needed
        eye.lock.update(
            Metering(
                exposure,
                [Core(0.0, 0.0, float(SQUARE[level]), level >= CLIPPED)],
                SceneLight(0.1, 0.0) if context else None,
                context and not shown,
            )
        )
        amounts.append(eye.lock.plan.lamps.amount)
    late = amounts[200:]
    assert np.mean(np.array(late) >= needed) > 0.8
    assert sum(a != b for a, b in pairwise(late)) <= 12


def lit(amount, light):
    return Metering(Exposure(round(amount * 1e6)), [Core(0.0, 0.0, light, False)])


def test_frames_older_than_what_is_asked_for_do_not_count_as_misses():
    """After a descent, frames of the rungs that were too dark for the lamp are still to come."""
    lock = ExposureLock(RANGE, 0)
    lock.update(lit(1.0, 0.6))
    for _ in range(LOST + 5):
        lock.update(Metering(Exposure(80_000), []))
    assert lock.state == "locked"
    for _ in range(LOST):
        lock.update(Metering(Exposure(1_000_000), []))
    assert lock.state == "search"


def test_one_frame_that_is_brighter_or_darker_than_the_others_changes_nothing():
    lock = ExposureLock(RANGE, 0)
    for _ in range(20):
        lock.update(lit(1.0, 0.6))
    before = lock.plan.lamps
    for odd in (0.95, 0.05):
        lock.update(lit(1.0, odd))
        for _ in range(10):
            lock.update(lit(1.0, 0.6))
            assert lock.plan.lamps == before


def test_what_is_darker_than_the_scene_gets_no_more_than_the_scene():
    """Snow in a dark cave is no lamp, however likely it looks."""
    lock = ExposureLock(RANGE, 0)
    for _ in range(100):
        lock.update(lit(lock.plan.lamps.amount, 0.01))
    assert lock.plan.lamps.amount <= 1.01 * lock.plan.scene.amount
