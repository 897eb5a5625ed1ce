"""The camera driver's exposure over a stand-in for picamera2: locked to lamps through late controls."""

from __future__ import annotations

import logging

import numpy as np
import pytest
from buddyline.node.capture.exposure import inverse_tone_curve
from buddyline.node.capture.loop import ExposureLoop
from buddyline.node.config import CameraConfig, ExposureConfig
from buddyline.node.trigger import LOCKED_NS
from buddyline.protocol.clock import MS_NS, trigger_index
from buddyline.protocol.messages import Blob, Candidates

from tests.node.drivers.picamera2_rig import NEVER, PERIOD_NS, frames, make, off_ns

LIGHT_PER_MS = 3.0
GREY = inverse_tone_curve([0, 0, 1024, 5040, 16384, 40642, 32768, 54979, 65535, 65535])


def lamp(light_per_ms):
    """A view of one lamp, through the tone curve of the stand-in's tuning file."""
    v, u = np.mgrid[-30:30, -30:30]
    shape = np.exp(-0.5 * (np.hypot(u, v) / 4.0) ** 4)

    def grey(light):
        return np.interp(np.minimum(light, 1.0), GREY, np.arange(256)).astype(np.uint8)

    def view(exposure_ms):
        ground = 1e-3 * exposure_ms
        image = np.full((616, 820, 1), grey(ground))
        image[270:330, 370:430, 0] = grey(light_per_ms * exposure_ms * shape + ground)
        return image

    return view


def look(camera, loop, n):
    """Take frames as a node does: detect, and follow the loop's plan."""
    taken = []
    for _ in range(n):
        frame = camera.next_frame(NEVER)
        area_px = float((frame.image[..., 0] > frame.image.max() / 2).sum())
        blob = Blob(u_px=400.0, v_px=300.0, sigma_px=0.1, area_px=area_px, peak=200.0, elongation=1.0, score=0.9)
        message = Candidates(
            node="a", stamp_ns=frame.stamp_ns, trigger=0, seq=0, boot="boot", width_px=820, height_px=616,
            blobs=[blob] if frame.image[300, 400, 0] > 20 else [],
        )  # fmt: skip
        camera.exposure_control.follow(loop.update(frame, message))
        taken.append(frame)
    return taken


def test_the_exposure_locks_to_a_lamp_through_late_controls(sensor):
    sensor.view = lamp(LIGHT_PER_MS)
    seen = []
    sensor.alter_metadata = seen.append
    camera = make(sensor, CameraConfig())
    control = camera.exposure_control
    loop = ExposureLoop(ExposureConfig(context_every=20), control.range)
    taken = look(camera, loop, 180)
    late = taken[100:]
    lamps = [frame for frame in late if not frame.context]
    levels = [int(frame.image[300, 400, 0]) for frame in lamps]
    assert min(levels) > 150
    assert max(levels) < 250
    assert lamps[-1].exposure.time_ns == pytest.approx(0.6 / LIGHT_PER_MS * 1e6, rel=0.3)
    assert lamps[-1].exposure.gain == pytest.approx(1.0, rel=0.01)
    # Learnt from the frames: the stand-in's pipeline is six buffers and three frames long.
    assert control.delay_frames == 9
    context = [trigger_index(frame.stamp_ns, PERIOD_NS) for frame in late if frame.context]
    assert len(context) == 4
    assert all(trigger % 20 == 0 for trigger in context)
    assert max(abs(off_ns(frame)) for frame in lamps) <= LOCKED_NS
    active = [metadata["Active"] for metadata in seen]
    assert not any(controls["AeEnable"] for controls in active)
    lines = [metadata["ExposureTime"] / 18.904 for metadata in seen]
    assert max(abs(n - round(n)) for n in lines) < 0.06


def test_each_frame_says_what_it_had_and_not_what_was_asked_for(sensor):
    view = sensor.view = lamp(LIGHT_PER_MS)
    camera = make(sensor, CameraConfig())
    loop = ExposureLoop(ExposureConfig(context_every=7), camera.exposure_control.range)
    for frame in look(camera, loop, 80):
        expected = view(frame.exposure.amount)[300, 400, 0]
        assert abs(int(frame.image[300, 400, 0]) - int(expected)) <= 2


@pytest.mark.parametrize("delay", [5, 9, 14])
def test_context_frames_come_at_their_triggers_whatever_the_delay_is(sensor, delay):
    sensor.view, sensor.pipeline_frames = lamp(LIGHT_PER_MS), delay - 6
    camera = make(sensor, CameraConfig())
    loop = ExposureLoop(ExposureConfig(context_every=10), camera.exposure_control.range)
    taken = look(camera, loop, 160)[80:]
    assert camera.exposure_control.delay_frames == delay
    context = [trigger_index(frame.stamp_ns, PERIOD_NS) % 10 for frame in taken if frame.context]
    assert context == [0] * 8


def test_a_camera_that_is_opened_again_goes_on_with_the_plan(sensor):
    sensor.view = lamp(LIGHT_PER_MS)
    camera = make(sensor, CameraConfig())
    loop = ExposureLoop(ExposureConfig(context_every=0), camera.exposure_control.range)
    before = look(camera, loop, 60)[-1].exposure
    sensor.job_error = RuntimeError("cable")
    after = look(camera, loop, 3)
    assert sensor.opened == 2
    assert [frame.exposure for frame in after] == [before] * 3


def test_without_a_tuning_file_the_tone_curve_is_taken_for_srgbs(sensor, caplog):
    caplog.set_level(logging.INFO)
    sensor.tunings, sensor.view = {}, lamp(LIGHT_PER_MS)
    camera = make(sensor, CameraConfig())
    assert "sRGB" in caplog.text
    loop = ExposureLoop(ExposureConfig(), camera.exposure_control.range)
    lamps = [frame for frame in look(camera, loop, 100)[60:] if not frame.context]
    assert all(120 < frame.image[300, 400, 0] < 250 for frame in lamps)
    assert loop.state == "locked"


def test_a_fixed_exposure_cannot_be_changed(sensor):
    camera = make(sensor, CameraConfig(exposure_us=4000, gain=2.0))
    (frame,) = frames(camera, 1)
    assert camera.exposure_control is None
    assert frame.exposure.amount == pytest.approx(8.0, rel=0.01)
    assert frame.context is None


def test_exposures_stay_within_the_frame_and_the_cameras_own_bounds(sensor):
    camera = make(sensor, CameraConfig(), 50 * MS_NS)
    limits = camera.exposure_control.range
    assert (limits.shortest_ns, limits.longest_ns) == (75_000, 47_500_000)
    assert limits.gain_max == pytest.approx(10.67, abs=0.01)
    np.testing.assert_allclose(limits.linear, GREY)


def test_lost_frames_do_not_disturb_the_exposure(sensor):
    sensor.view = lamp(LIGHT_PER_MS)
    camera = make(sensor, CameraConfig())
    loop = ExposureLoop(ExposureConfig(context_every=10), camera.exposure_control.range)
    look(camera, loop, 100)
    sensor.lost = set(range(110, 400, 37))
    lamps = [frame for frame in look(camera, loop, 150) if not frame.context]
    assert all(150 < frame.image[300, 400, 0] < 250 for frame in lamps)
