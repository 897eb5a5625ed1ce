"""The whole loop on rendered pictures, with the detector and a camera whose controls come late."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from buddyline.node.capture.cores import choose_lamps, measure_cores, measure_scene
from buddyline.node.capture.loop import ExposureLoop
from buddyline.node.config import ExposureConfig
from buddyline.node.detect import make_detector
from buddyline.node.devices import Frame
from buddyline.node.pipeline import Pipeline
from buddyline.node.sim.scenario import ENVIRONMENTS, Scenario
from buddyline.node.sim.sensor import DelayedControls
from buddyline.node.sim.world import World
from buddyline.protocol.messages import Blob, Candidates

from tests.node.rendered import lamp_picture

MS_NS = 1_000_000
STEP_NS = 100 * MS_NS
LINEAR = (np.arange(256) / 255) ** 2
SMALL = {"width_px": 410, "height_px": 308, "interruptions": False}


class ExposingNode:
    """A camera in a simulated water, with detector and loop."""

    def __init__(self, delay=4, config=None, **scenario):
        self.world = World(Scenario(**SMALL | scenario))
        self.controls = DelayedControls(delay)
        self.loop = ExposureLoop(config or ExposureConfig(), self.controls.range)
        self._pipeline = Pipeline("a", "boot", STEP_NS, make_detector())
        self.trigger = 10

    def step(self):
        """Take a frame; return it, and the error in px of each light in it that should be found (99: not found)."""
        self.trigger += 1
        stamp_ns = self.trigger * STEP_NS
        exposure, context = self.controls.take(self.trigger)
        image = self.world.render("a", stamp_ns, exposure)
        frame = Frame(image, stamp_ns, exposure=exposure, context=context)
        candidates = self._pipeline.candidates(frame)
        self.controls.follow(self.loop.update(frame, candidates))
        blobs = candidates.blobs
        found = np.array([(blob.u_px, blob.v_px) for blob in blobs[:3]]).reshape(-1, 2)
        lights = [x for x in self.world.light_truth("a", stamp_ns, 0).lights if x.visible and not x.merged]
        errors = [min(np.hypot(*(found - (x.u_px, x.v_px)).T), default=99.0) for x in lights]
        return frame, errors

    def run(self, frames):
        return [self.step() for _ in range(frames)]


@cache
def dive(environment):
    node = ExposingNode(environment=environment, seed=5)
    return node, node.run(120)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_lamps_are_found_and_their_cores_are_not_clipped(environment):
    node, taken = dive(environment)
    settled = [(frame, errors) for frame, errors in taken[30:] if not frame.context]
    errors = [error for _, of_frame in settled for error in of_frame]
    assert len(errors) > 60
    assert np.mean(np.array(errors) < 2.0) > 0.97
    assert np.median(errors) < 0.12
    assert node.loop.state == "locked"
    assert np.mean([(frame.image >= 250).mean() > 3e-5 for frame, _ in settled]) < 0.1
    assert node.loop.problem == ""


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_the_exposure_does_not_hunt_while_the_pair_swims(environment):
    """Steps up and down by turns would be hunting; a lamp that turns away and back makes few of them."""
    _, taken = dive(environment)
    amounts = [frame.exposure.amount for frame, _ in taken[30:] if not frame.context]
    steps = [b > a for a, b in pairwise(amounts) if a != b]
    assert sum(a != b for a, b in pairwise(steps)) <= 9


@pytest.mark.parametrize("environment", ["lake", "basin"])
def test_context_frames_show_the_scene(environment):
    _, taken = dive(environment)
    context = [frame for frame, _ in taken[30:] if frame.context]
    assert len(context) in (4, 5)
    lamps = [frame for frame, _ in taken[30:] if not frame.context]
    assert np.mean([frame.image.mean() for frame in context]) > 60
    assert np.mean([frame.image.mean() for frame in lamps]) < 40


@pytest.mark.parametrize("range_m", [1.0, 3.0, 10.0])
def test_the_loop_follows_the_range(range_m):
    node = ExposingNode(environment="cavern", seed=3, trajectory="rest", range_min_m=range_m, range_max_m=range_m)
    taken = node.run(60)[30:]
    errors = [error for _, of_frame in taken for error in of_frame]
    assert node.loop.state == "locked"
    assert max(errors) < 2.0


def test_a_lamp_that_is_switched_off_and_on_is_found_again():
    node = ExposingNode(environment="night_reef", seed=3, trajectory="rest", other_lamps=0)
    node.run(30)
    lit, dark = node.world, World(Scenario(**SMALL, environment="night_reef", seed=3, trajectory="rest", other_lamps=0,
                                           dead_lamps=("b.left", "b.right")))  # fmt: skip
    node.world = dark
    node.run(25)
    assert node.loop.plan.lamps.amount <= node.loop.plan.scene.amount
    node.world = lit
    taken = node.run(30)
    assert node.loop.state == "locked"
    assert max(error for _, errors in taken[20:] for error in errors) < 2.0


def test_one_lamp_that_goes_out_leaves_the_other_well_exposed():
    scenario = {"environment": "night_reef", "seed": 3, "trajectory": "rest", "other_lamps": 0}
    node = ExposingNode(**scenario)
    node.run(30)
    node.world = World(Scenario(**SMALL, **scenario, dead_lamps=("b.left",)))
    taken = node.run(40)[20:]
    assert node.loop.state == "locked"
    assert min(min(errors) for _, errors in taken) < 0.5


def test_a_strobe_leaves_the_exposure_alone():
    scenario = {"environment": "cavern", "seed": 3, "trajectory": "rest", "other_lamps": 0}
    node, quiet = ExposingNode(**scenario, strobe_s=1.3), ExposingNode(**scenario)
    amounts = [[frame.exposure.amount for frame, _ in n.run(60)[30:] if not frame.context] for n in (node, quiet)]
    assert max(amounts[0]) <= 1.4 * max(amounts[1])
    assert min(amounts[0]) >= min(amounts[1]) / 1.4


def test_pulsed_lamps_are_noticed_and_whole_periods_mend_it():
    scenario = {"environment": "night_reef", "seed": 3, "trajectory": "rest", "range_min_m": 6.0, "range_max_m": 6.0}
    scenario |= {"row_time_ns": 40_000, "pwm_hz": 937.0, "other_lamps": 0}
    node = ExposingNode(**scenario)
    node.run(60)
    assert "flicker" in node.loop.problem
    assert "flicker_hz" in node.loop.problem
    told = ExposingNode(**scenario, config=ExposureConfig(flicker_hz=937.0))
    taken = told.run(60)
    assert told.loop.problem == ""
    periods = taken[-1][0].exposure.time_ns * 937.0 / 1e9
    assert periods == pytest.approx(round(periods), abs=0.01)


@pytest.mark.parametrize(("range_m", "pwm_hz"), [(3.0, 2000.0), (6.0, 1000.0)])
def test_pulses_at_a_multiple_of_the_frame_rate_are_noticed_by_their_bands(range_m, pwm_hz):
    scenario = {"environment": "night_reef", "seed": 3, "trajectory": "rest", "row_time_ns": 40_000, "other_lamps": 0}
    scenario |= {"range_min_m": range_m, "range_max_m": range_m}
    steady, pulsed = ExposingNode(**scenario), ExposingNode(**scenario, pwm_hz=pwm_hz)
    errors = [np.median([x for _, found in node.run(30)[10:] for x in found]) for node in (steady, pulsed)]
    assert errors[1] > errors[0] + 0.1
    assert "from row to row" in pulsed.loop.problem
    assert steady.loop.problem == ""


def test_a_frame_that_does_not_say_its_exposure_changes_nothing():
    node = ExposingNode(environment="cavern", seed=3)
    before = node.loop.plan
    assert node.loop.update(Frame(np.full((308, 410, 3), 255, np.uint8), 0), message([])) is before


def blob(u_px, v_px, score=0.9, area_px=30.0):
    return Blob(
        u_px=u_px, v_px=v_px, sigma_px=0.3, area_px=area_px, peak=200.0, elongation=1.0, score=score
    )  # fmt: skip


def message(blobs, **more):
    return Candidates(
        node="a", stamp_ns=0, trigger=0, seq=0, boot="boot", width_px=410, height_px=308, blobs=blobs, **more
    )


def test_the_likeliest_two_are_taken_or_only_those_that_are_expected():
    blobs = [blob(10.0, 10.0), blob(50.0, 10.0), blob(90.0, 10.0, 0.6), blob(200.0, 10.0, 0.3)]
    assert choose_lamps(blobs) == blobs[:2]
    assert choose_lamps(blobs[2:]) == blobs[2:3]
    assert choose_lamps(blobs, 1) == blobs[:1]


def strangers(node_lamp, stranger):
    """A picture of a lamp and a stranger's; light of each core."""
    return np.clip(
        np.maximum(
            lamp_picture([(100.0, 80.0)], core=255.0 * np.sqrt(node_lamp), core_px=4.0, ground=0.0, noise=1.0),
            lamp_picture([(300.0, 200.0)], core=255.0 * np.sqrt(stranger), core_px=4.0, ground=0.0, noise=1.0),
        ),
        0,
        255,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("told", "guided"), [(0, False), (1, False), (0, True)])
def test_a_strangers_bright_lamp_does_not_hide_the_other_nodes(told, guided):
    """It is 10,000 times as bright. Context frames show the other, or the solver says which one it is."""
    controls = DelayedControls(0)
    loop = ExposureLoop(ExposureConfig(context_every=10), controls.range)
    found = 0
    for trigger in range(150):
        exposure, context = controls.take(trigger)
        image = strangers(0.5 * exposure.amount, 5000.0 * exposure.amount)
        blobs = [blob(300.0, 200.0)] if image[200, 300, 1] > 20 else []
        if image[80, 100, 1] > 20:
            lamp = blob(100.0, 80.0)
            blobs = [lamp, *blobs] if told else [*blobs, lamp]
            found += trigger >= 75 and not context
        more = {"elsewhere": 0} if guided and trigger % 10 != 5 else {}
        frame = Frame(image, trigger, exposure=exposure, context=context)
        controls.follow(loop.update(frame, message(blobs, **more), told if len(blobs) == 2 else 0))
    assert found >= 60


def test_cores_are_measured_in_linear_light():
    for core, clipped in ((80.0, False), (150.0, False), (900.0, True)):
        image = lamp_picture([(100.0, 80.0)], core=core, core_px=6.0, ground=0.0, noise=0.0)
        (measured,) = measure_cores(image, [blob(100.0, 80.0, area_px=np.pi * 36)], LINEAR)
        assert measured.clipped is clipped
        assert measured.light == pytest.approx(min(core / 255, 1.0) ** 2, rel=0.1)
        (grey,) = measure_cores(image.max(axis=2), [blob(100.0, 80.0, area_px=np.pi * 36)], LINEAR)
        assert grey == measured


def test_a_hot_pixel_is_no_core():
    image = np.full((60, 80, 3), 50, np.uint8)
    image[30, 40] = 255
    (measured,) = measure_cores(image, [blob(40.0, 30.0, area_px=60.0)], LINEAR)
    assert measured.light == pytest.approx((50 / 255) ** 2)


def test_cores_at_the_border_and_scenes_of_any_shape_are_measured():
    image = np.full((3, 5), 128, np.uint8)
    assert len(measure_cores(image, [blob(-0.4, -0.4), blob(4.4, 2.4)], LINEAR)) == 2
    scene = measure_scene(np.full((3, 5, 3), 255, np.uint8), LINEAR)
    assert (scene.mean, scene.clipped) == (1.0, 1.0)
