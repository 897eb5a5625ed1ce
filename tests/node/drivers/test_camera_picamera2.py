"""The camera driver over a stand-in for picamera2: times, copies, and everything that fails."""

from __future__ import annotations

import logging
import sys
import threading
from itertools import pairwise

import numpy as np
import pytest
from buddyline.node.config import CameraConfig, NodeConfig
from buddyline.node.drivers.camera_picamera2 import choose_mode, open_camera
from buddyline.node.drivers.samples import DeviceError
from buddyline.node.trigger import LOCKED_NS
from buddyline.protocol.clock import MS_NS, S_NS, ManualClock, trigger_index

from tests.node.drivers import standin_picamera2 as standin
from tests.node.drivers.picamera2_rig import PERIOD_NS, START_NS, Wall, frames, make, off_ns


def test_frames_lock_onto_the_instants_within_two_seconds_and_stay(sensor):
    sensor.ppm = 40.0
    camera = make(sensor)
    taken = frames(camera, 300)
    late = [frame for frame in taken if frame.stamp_ns - taken[0].stamp_ns >= 2 * S_NS]
    assert max(abs(off_ns(frame)) for frame in late) <= LOCKED_NS
    triggers = [trigger_index(frame.stamp_ns, PERIOD_NS) for frame in late]
    assert triggers == list(range(triggers[0], triggers[0] + len(late)))
    camera.close()


def test_stamp_is_the_middle_of_exposure_of_the_middle_row_on_the_wall_clock(sensor):
    seen = []
    sensor.alter_metadata = lambda metadata: seen.append(metadata["SensorTimestamp"])
    sensor.wall_shift_ns = 5 * S_NS
    camera = make(sensor, CameraConfig(exposure_us=6000))
    (frame,) = frames(camera, 1)
    boot_to_wall_ns = sensor.start_ns - standin.BOOT_NS + 5 * S_NS
    expected_ns = seen[-1] + (1232 - 1) / 2 * 18_904 - 317 * 18_904 / 2 + boot_to_wall_ns
    assert frame.stamp_ns == pytest.approx(expected_ns, abs=2000)
    assert frame.row_time_ns == pytest.approx(2 * 18_904, abs=5)
    assert camera.row_time_ns == frame.row_time_ns


@pytest.mark.parametrize("padding", [1, 32, 64, 256])
def test_luminance_comes_without_padding_and_outlives_the_buffer(sensor, padding):
    """Padding of one byte is the case where a slice would still be the camera's own memory."""
    sensor.padding = padding
    camera = make(sensor)
    taken = frames(camera, 10)
    for frame in taken:
        assert frame.image.shape == (616, 820)
        assert frame.image.dtype == np.uint8
        assert frame.image.flags.c_contiguous
        assert frame.image.min() == frame.image.max() != 99


def test_colour_comes_as_bgr(sensor):
    camera = make(sensor, CameraConfig())
    (frame,) = frames(camera, 1)
    assert frame.image.shape == (616, 820, 3)
    assert frame.image.max() == frame.image.min()


def test_pictures_are_in_colour_by_default(sensor, monkeypatch):
    monkeypatch.setattr("buddyline.node.drivers.camera_picamera2.boottime_ns", sensor.boottime_ns)
    for asked, dimensions in (({}, 3), ({"colour": False}, 2)):
        config = NodeConfig(node="a", camera=CameraConfig(name="picamera2", **asked))
        camera = open_camera(config, Wall(sensor))
        camera._boottime = sensor.boottime_ns
        (frame,) = frames(camera, 1)
        assert frame.image.ndim == dimensions
        camera.close()


def test_everything_is_fixed_before_the_start(sensor):
    seen = []
    sensor.alter_metadata = lambda metadata: seen.append(metadata["Active"])
    camera = make(sensor, CameraConfig(exposure_us=5000, gain=3.0))
    frames(camera, 1)
    first = seen[0]
    assert (first["AeEnable"], first["ExposureTime"], first["AnalogueGain"]) == (False, 5000, 3.0)
    assert first["AwbEnable"] is False
    assert first["NoiseReductionMode"] == 0
    low, high = first["FrameDurationLimits"]
    assert low == high == pytest.approx(100_000, abs=20)
    assert "AfMode" not in first


@pytest.mark.parametrize(
    ("model", "blanking"), [("imx708", 40), ("imx708", 58), ("imx219", 32), ("imx219", 50), ("imx999", 21)]
)
def test_the_line_time_is_measured_with_any_blanking_of_the_kernel(sensor, model, blanking):
    """A line 1.3 % too short puts the middle of exposure of the middle row off by 114 us on the IMX708."""
    sensor.model, sensor.blanking, sensor.line_ns = model, blanking, 13_365.1
    seen = []
    sensor.alter_metadata = lambda metadata: seen.append((metadata["SensorTimestamp"], metadata["ExposureTime"]))
    camera = make(sensor, CameraConfig(colour=False, exposure_us=4000))
    frame = frames(camera, 60)[-1]
    boot_to_wall_ns = sensor.start_ns - standin.BOOT_NS
    expected_ns = seen[-1][0] + (1232 - 1) / 2 * 13_365.1 - seen[-1][1] * 500 + boot_to_wall_ns
    assert frame.stamp_ns == pytest.approx(expected_ns, abs=5000)
    assert camera.row_time_ns == pytest.approx(2 * 13_365.1, abs=5)


def test_camera_module_3_gets_a_fixed_focus(sensor):
    sensor.controls |= {"AfMode", "LensPosition"}
    sensor.model = "imx708"
    seen = []
    sensor.alter_metadata = lambda metadata: seen.append(metadata["Active"])
    frames(make(sensor), 1)
    frames(make(sensor, CameraConfig(focus_dioptres=5.0)), 1)
    assert {active["AfMode"] for active in seen} == {0}
    assert {active["LensPosition"] for active in seen} == {0.5, 5.0}


def test_a_global_shutter_has_no_row_time(sensor):
    sensor.model = "imx296"
    camera = make(sensor)
    (frame,) = frames(camera, 1)
    assert frame.row_time_ns == camera.row_time_ns == 0


def test_the_widest_view_with_enough_pixels_is_chosen(sensor):
    assert choose_mode(sensor.modes, (820, 616))["size"] == (1640, 1232)
    assert choose_mode(sensor.modes, (820, 616))["bit_depth"] == 10
    assert choose_mode(sensor.modes, (640, 480))["size"] == (1640, 1232)
    assert choose_mode(sensor.modes, (1920, 1080))["size"] == (3280, 2464)
    with pytest.raises(DeviceError, match="no mode has 4056x3040"):
        choose_mode(sensor.modes, (4056, 3040))


@pytest.mark.parametrize("rate_hz", [1, 5, 7, 20])
def test_frames_lock_at_other_rates_too(sensor, rate_hz):
    period_ns = round(1e9 / rate_hz)
    sensor.ppm = -30.0
    camera = make(sensor, period_ns=period_ns)
    taken = frames(camera, 4 * rate_hz + 4)
    late = [frame for frame in taken if frame.stamp_ns - taken[0].stamp_ns >= 2 * S_NS + period_ns]
    assert late
    assert max(abs(off_ns(frame, period_ns)) for frame in late) <= LOCKED_NS
    triggers = [trigger_index(frame.stamp_ns, period_ns) for frame in late]
    assert triggers == list(range(triggers[0], triggers[0] + len(late)))


def test_lost_frames_leave_a_gap_and_no_wrong_frame(sensor):
    sensor.lost = {40, 41, 55}
    camera = make(sensor)
    taken = frames(camera, 80)
    triggers = [trigger_index(frame.stamp_ns, PERIOD_NS) for frame in taken]
    late = [b - a for a, b in pairwise(triggers[25:])]
    assert sorted(late)[-2:] == [2, 3]
    assert max(abs(off_ns(frame)) for frame in taken[25:]) <= 2 * LOCKED_NS


def test_a_wall_clock_set_in_mid_dive_is_followed(sensor):
    sensor.set_wall = {60: S_NS + 41 * MS_NS}
    camera = make(sensor)
    taken = frames(camera, 120)
    assert max(abs(off_ns(frame)) for frame in taken[-20:]) <= LOCKED_NS
    gaps = np.diff([frame.stamp_ns for frame in taken])
    assert gaps.max() > S_NS


@pytest.mark.parametrize("shift_s", [-3600.0, 3600.0, 5.0])
def test_metadata_on_another_clock_is_refused(sensor, shift_s, caplog):
    """As of a driver that stamps with another clock: its frames are not given out, and it is said."""

    def other_clock(metadata):
        if metadata["Number"] < 30:
            metadata["SensorTimestamp"] += int(shift_s * S_NS)

    sensor.alter_metadata = other_clock
    with caplog.at_level(logging.INFO):
        camera = make(sensor)
        (frame,) = frames(camera, 1)
    assert camera.skipped["wrong_clock"] == 30
    assert "away from CLOCK_BOOTTIME" in caplog.text
    assert camera.problem == ""
    assert abs(frame.stamp_ns - sensor.wall_ns()) < S_NS


@pytest.mark.parametrize("name", ["SensorTimestamp", "ExposureTime"])
def test_metadata_without_a_time_is_refused(sensor, name):
    sensor.alter_metadata = lambda metadata: metadata.pop(name) if metadata["Number"] == 0 else None
    camera = make(sensor)
    assert frames(camera, 1)
    assert camera.skipped["no_time"] == 1


def test_an_error_of_the_camera_thread_reopens_the_camera(sensor, caplog):
    camera = make(sensor)
    frames(camera, 5)
    sensor.job_error = RuntimeError("failed to queue request")
    with caplog.at_level(logging.INFO):
        assert frames(camera, 1)
    assert "failed to queue request" in caplog.text
    assert "back to normal" in caplog.text
    assert (sensor.opened, sensor.closed) == (2, 1)
    assert camera.problem == ""


def test_a_camera_that_stops_delivering_is_reopened_until_it_delivers(sensor, caplog):
    camera = make(sensor)
    frames(camera, 10)
    sensor.silent_from = 0
    opened = []
    plain = standin.Picamera2.__init__

    def counting(self, camera_num=0):
        opened.append(sensor.clock.now_ns())
        if len(opened) == 3:
            sensor.silent_from = None
        plain(self, camera_num)

    standin.Picamera2.__init__ = counting
    try:
        began_ns = sensor.clock.now_ns()
        with caplog.at_level(logging.INFO):
            assert frames(camera, 1)
    finally:
        standin.Picamera2.__init__ = plain
    assert len(opened) == 3
    assert caplog.text.count("no frame for 2 s") == 1
    assert sensor.clock.now_ns() - began_ns < 20 * S_NS
    assert sensor.opened - sensor.closed == 1


def test_a_camera_pulled_out_is_tried_again_until_it_is_back(sensor):
    camera = make(sensor)
    frames(camera, 3)
    sensor.job_error = OSError(19, "No such device")
    sensor.open_error = RuntimeError("Failed to initialize camera")
    stop = threading.Event()
    wall = camera._clock
    waits = []

    def wait(instant_ns, event):
        waits.append(camera.problem)
        if len(waits) == 4:
            sensor.open_error = None
        return Wall.wait_until_ns(wall, instant_ns, event)

    wall.wait_until_ns = wait
    assert camera.next_frame(stop) is not None
    assert "No such device" in waits[0]
    assert "cannot be opened" in waits[-1]


def test_stop_ends_the_waiting_and_cancels_the_job(sensor):
    camera = make(sensor)
    frames(camera, 3)
    sensor.silent_from = 0
    stop = threading.Event()
    device = camera._camera
    plain = device.wait

    def wait(job, timeout=None):
        stop.set()
        return plain(job, timeout)

    device.wait = wait
    assert camera.next_frame(stop) is None
    assert not device._jobs
    assert camera.next_frame(stop) is None


def test_a_close_that_hangs_does_not_hold_the_node_up(sensor, monkeypatch, caplog):
    monkeypatch.setattr("buddyline.node.drivers.camera_picamera2.CLOSE_S", 0.05)
    camera = make(sensor)
    gate = threading.Event()
    camera._camera.close = gate.wait
    with caplog.at_level(logging.WARNING):
        camera.close()
    assert "still closing" in caplog.text
    gate.set()
    camera.close()


def test_a_failing_close_is_only_logged(sensor, caplog):
    camera = make(sensor)

    def fail() -> None:
        raise RuntimeError("Unable to stop preview.")

    camera._camera.close = fail
    with caplog.at_level(logging.WARNING):
        camera.close()
    assert "Unable to stop preview" in caplog.text


def test_a_missing_camera_is_named(sensor):
    sensor.cameras = []
    with pytest.raises(DeviceError, match=r"none found.*rpicam-hello"):
        make(sensor)


def test_a_camera_in_use_elsewhere(sensor):
    sensor.open_error = RuntimeError("Device or resource busy")
    with pytest.raises(DeviceError, match="cannot be opened"):
        make(sensor)
    assert sensor.opened == sensor.closed == 0


@pytest.mark.parametrize(
    ("config", "period_ns", "what"),
    [
        (CameraConfig(width_px=821, height_px=616), PERIOD_NS, "gives 820x616"),
        (CameraConfig(width_px=9000, height_px=616), PERIOD_NS, "no mode"),
        (CameraConfig(exposure_us=150_000), PERIOD_NS, "exposure 150.0 ms"),
        (CameraConfig(), 20 * MS_NS, "cannot be had"),
        (CameraConfig(sync="server"), PERIOD_NS, "SyncMode"),
    ],
)
def test_what_the_camera_cannot_do_is_refused_at_start(sensor, config, period_ns, what):
    with pytest.raises(DeviceError, match=what):
        make(sensor, config, period_ns)
    assert sensor.opened == sensor.closed == 1


def test_another_resolution_than_the_calibrations_is_refused(sensor, monkeypatch):
    plain = standin.Picamera2.configure

    def adjust(self, camera_config):
        camera_config["main"]["size"] = (816, 616)
        plain(self, camera_config)

    monkeypatch.setattr(standin.Picamera2, "configure", adjust)
    with pytest.raises(DeviceError, match=r"gives 816x616, not camera\.width_px"):
        make(sensor)


@pytest.mark.parametrize(("sync", "number", "locks"), [("server", 1, True), ("client", 2, False)])
def test_software_sync_leaves_the_clients_phase_to_libcamera(sensor, sync, number, locks):
    sensor.controls.add("SyncMode")
    seen = []
    sensor.alter_metadata = lambda metadata: seen.append(metadata["Active"])
    camera = make(sensor, CameraConfig(sync=sync))
    frames(camera, 30)
    assert seen[0]["SyncMode"] == number
    assert (len({active["FrameDurationLimits"] for active in seen}) > 1) == locks


@pytest.mark.parametrize("phase_ms", [0, 12])
def test_a_client_without_its_server_says_that_it_is_not_locked(sensor, phase_ms):
    """Frames of 5000 lines last a trigger period: the phase that they begin with is kept."""
    sensor.controls.add("SyncMode")
    sensor.line_ns = 20_000.0
    first_ns = (137_531_000 + 1231 * 10_000 - 2_000_000) % PERIOD_NS  # of the middle row's middle of exposure
    sensor.clock.set_ns(START_NS // PERIOD_NS * PERIOD_NS + PERIOD_NS - first_ns + phase_ms * MS_NS)
    sensor.start_ns = sensor.clock.now_ns()
    camera = make(sensor, CameraConfig(sync="client", colour=False, exposure_us=4000))
    frames(camera, 140)
    assert camera.problem == ""
    frames(camera, 30)
    assert ("12.0 ms away" in camera.problem and "'server'" in camera.problem) == (phase_ms == 12)
    assert (camera.problem == "") == (phase_ms == 0)


def test_without_picamera2_the_error_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(DeviceError, match="apt install python3-picamera2"):
        open_camera(NodeConfig(node="a", camera=CameraConfig(name="picamera2")), ManualClock(START_NS))


def test_a_long_dive_leaks_no_request(sensor):
    """Six buffers; one that is not released would end the stream after six frames."""
    camera = make(sensor)
    assert len(frames(camera, 200)) == 200
    assert len(camera._camera._free) == 6
