"""A Raspberry Pi camera through picamera2 (0.3.25 or later): free-running, one frame a trigger.

The camera is never started or stopped for a picture, and its own automatics are off. The frame duration is changed to
lock the phase; exposure time and gain follow the node's plan, where they are not fixed. Such a change is sent with
the next request and takes effect about buffers + 3 frames later: each frame's metadata say what it had.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from buddyline.node.capture.exposure import Exposure, ExposureRange, inverse_tone_curve, srgb_to_linear
from buddyline.node.capture.planned import PlannedExposures
from buddyline.node.config import CameraConfig, NodeConfig, RecordConfig
from buddyline.node.devices import Frame
from buddyline.node.drivers.camera_jpeg import CameraJpegs
from buddyline.node.drivers.health import DeviceHealth
from buddyline.node.drivers.readout import (
    GLOBAL_SHUTTERS,
    LineTimer,
    Readout,
    boottime_ns,
    clock_offset_ns,
    first_line_ns,
)
from buddyline.node.drivers.samples import AbsentError, DeviceError
from buddyline.node.picking import RecordedFrames
from buddyline.node.trigger import FollowerWatch, FrameChooser, PhaseLock, frames_per_trigger
from buddyline.protocol.clock import MS_NS, S_NS, Clock
from buddyline.protocol.messages import NodeInfo
from numpy.typing import NDArray

log = logging.getLogger(__name__)

BUFFERS: Final = 6
COLOUR_GAINS: Final = (2.0, 1.7)  # white light near 5500 K; the brightness that counts hardly depends on it

EXPOSED_SHARE: Final = 0.95
"""Longest exposure, as a share of a frame's duration."""

POLL_S: Final = 0.2
SILENCE_NS: Final = 2 * S_NS
REOPEN_NS: Final = 2 * S_NS
CLOSE_S: Final = 1.5
OLDEST_NS: Final = 2 * S_NS
EARLY_NS: Final = 5 * MS_NS

SYNC_MODES: Final = {"server": 1, "client": 2}

# What picamera2, libcamera's bindings and their threads raise when a camera or its cable fails.
CAMERA_ERRORS: Final = (RuntimeError, OSError, ValueError, LookupError, AssertionError)


class Picamera2Camera:
    """One camera.

    Its pictures are BGR, or luminance alone. skipped: frames that were not given out, by reason. record: how pictures
    are recorded; None where none are.
    """

    def __init__(
        self,
        config: CameraConfig,
        trigger_period_ns: int,
        clock: Clock,
        boottime: Callable[[], int] = boottime_ns,
        record: RecordConfig | None = None,
    ) -> None:
        self.skipped: Counter[str] = Counter()
        self._config = config
        self._trigger_period_ns = trigger_period_ns
        self._frames = frames_per_trigger(trigger_period_ns)
        self._frame_period_ns = trigger_period_ns // self._frames
        self._clock = clock
        self._boottime = boottime
        self._health = DeviceHealth("camera")
        self._camera: Any = None
        self._record = record
        self._recorded = RecordedFrames(record.images_hz if record and record.encoder == "camera" else 0.0)
        self._jpegs: CameraJpegs | None = None
        self.exposure_control: PlannedExposures | None = None
        self._open()

    @property
    def problem(self) -> str:
        """What is wrong with it, "" where nothing is."""
        return self._health.problem

    @property
    def row_time_ns(self) -> int:
        """Time from one row of the whole view to the next, as far as it has been measured."""
        return round(self._readout(self._mode_crop).row_time_ns(self._config.height_px))

    def _readout(self, crop: tuple[int, int, int, int]) -> Readout:
        line_ns = self._timer.line_ns if self._rolling else 0.0
        return Readout.of_crop(crop, self._mode_crop, self._mode_height, line_ns)

    def info(self) -> NodeInfo | None:
        """Return None: the calibration is in the configuration."""
        return None

    def next_frame(self, stop: threading.Event) -> Frame | None:
        """Wait for the next trigger's frame; None once stop is set. A camera that fails is opened again."""
        while not stop.is_set():
            try:
                frame = self._next(stop)
            except CAMERA_ERRORS as error:
                self._health.update(f"{type(error).__name__}: {error}")
                self._reopen(stop)
                continue
            if frame is not None:
                return frame
        return None

    def close(self) -> None:
        """Free the camera."""
        camera, self._camera = self._camera, None
        jpegs, self._jpegs = self._jpegs, None
        if camera is None:
            return
        # libcamera can hang on a camera that was unplugged; the node must still end.
        closing = threading.Thread(target=_close, args=(camera, jpegs), name="camera closing", daemon=True)
        closing.start()
        closing.join(CLOSE_S)
        if closing.is_alive():
            log.warning("camera: still closing after %.1f s", CLOSE_S)

    def _open(self) -> None:
        try:
            from picamera2 import MappedArray, Picamera2
        except ModuleNotFoundError as error:
            raise DeviceError(
                f"camera: needs {error.name}: apt install python3-picamera2, then make install EXTRAS=pi"
            ) from error
        self._mapped_array: Any = MappedArray
        self._picamera2: Any = Picamera2
        if not Picamera2.global_camera_info():
            raise AbsentError("camera: none found: check its cable, and rpicam-hello --list-cameras")
        try:
            self._camera = Picamera2()
            self._configure()
            if self._record is not None and self._record.encoder == "camera":
                self._jpegs = CameraJpegs(self._camera, self._record.image_quality)
            self._camera.start()
        except CAMERA_ERRORS as error:
            self.close()
            raise AbsentError(f"camera: cannot be opened: {error}") from error
        except DeviceError:
            self.close()
            raise

    def _configure(self) -> None:
        camera, config = self._camera, self._config
        size = (config.width_px, config.height_px)
        mode = choose_mode(camera.sensor_modes, size)
        camera.configure(
            camera.create_preview_configuration(
                main={"format": "RGB888" if config.colour else "YUV420", "size": size},
                raw=None,
                buffer_count=BUFFERS,
                display=None,
                encode=None,
                sensor={"output_size": mode["size"], "bit_depth": mode["bit_depth"]},
            )
        )
        got = tuple(camera.camera_configuration()["main"]["size"])
        if got != size:
            raise DeviceError(f"camera: gives {got[0]}x{got[1]}, not camera.width_px x height_px = {size[0]}x{size[1]}")
        self._mode_crop, self._mode_height = tuple(mode["crop_limits"]), int(mode["size"][1])
        model = str(camera.camera_properties.get("Model", "unknown"))
        shortest_us = int(camera.camera_controls["FrameDurationLimits"][0])
        self._rolling = model not in GLOBAL_SHUTTERS
        self._timer = LineTimer(first_line_ns(model, shortest_us, self._mode_height))
        self._timer.update(shortest_us)
        self._lock = PhaseLock(self._trigger_period_ns, self._frames, shortest_us * 1000, self._timer.line_ns)
        self._chooser = FrameChooser(self._trigger_period_ns, self._frame_period_ns)
        self._follower = FollowerWatch(self._trigger_period_ns)
        exposure_us = config.exposure_us or 0
        if self._frame_period_ns < shortest_us * 1000 or self._frame_period_ns <= exposure_us * 1000:
            raise DeviceError(
                f"camera: a frame each {self._frame_period_ns / 1e6:.1f} ms cannot be had (mode: "
                f"{shortest_us / 1e3:.1f} ms, exposure {exposure_us / 1e3:.1f} ms): lower rate_hz or exposure_us"
            )
        camera.set_controls(self._controls(camera.camera_controls, model))

    def _first_exposure(self, known: dict[str, tuple[Any, Any, Any]], model: str) -> Exposure:
        """Return the exposure to start with; where it is not fixed, make the control that changes it."""
        if self._config.exposure_us is not None:
            return Exposure(self._config.exposure_us * 1000, self._config.gain)
        exposures = self._exposure_range(known, model)
        if self.exposure_control is None:
            self.exposure_control = PlannedExposures(
                exposures, self._trigger_period_ns, self._frame_period_ns, self._config.sync != "off"
            )
        self.exposure_control.restart()
        return self.exposure_control.first

    def _exposure_range(self, known: dict[str, tuple[Any, Any, Any]], model: str) -> ExposureRange:
        shortest_us, longest_us, _ = known["ExposureTime"]
        gain_min, gain_max, _ = known["AnalogueGain"]
        # Some lines of each frame cannot be exposed; the frame duration must not be stretched.
        longest_ns = min(round(longest_us * 1000), round(EXPOSED_SHARE * self._frame_period_ns))
        return ExposureRange(
            max(round(shortest_us * 1000), 1), longest_ns, gain_max, self._timer.line_ns, gain_min, self._linear(model)
        )

    def _linear(self, model: str) -> NDArray[np.float64]:
        """Return the light of each grey level: the inverse of the tuning file's tone curve, else of sRGB's."""
        try:
            tuning = self._picamera2.load_tuning_file(f"{model}.json")
            return inverse_tone_curve(self._picamera2.find_tuning_algo(tuning, "rpi.contrast")["gamma_curve"])
        except (*CAMERA_ERRORS, StopIteration, TypeError) as error:
            log.info("camera: tone curve not known (%s: %s); taken for sRGB's", type(error).__name__, error)
            return srgb_to_linear()

    def _exposure_controls(self, exposure: Exposure) -> dict[str, Any]:
        line_ns = self._timer.line_ns
        # A whole number of lines, whether the camera truncates or rounds.
        lines = max(round(exposure.time_ns / line_ns), 1)
        fixed = self.exposure_control is None
        return {
            "ExposureTime": exposure.time_ns // 1000 if fixed else round((lines + 0.25) * line_ns / 1000),
            "AnalogueGain": exposure.gain,
        }

    def _controls(self, known: dict[str, tuple[Any, Any, Any]], model: str) -> dict[str, Any]:
        """Return all controls to start with. Enumerations are libcamera's numbers."""
        config = self._config
        controls: dict[str, Any] = {
            "AeEnable": False,
            **self._exposure_controls(self._first_exposure(known, model)),
            "FrameDurationLimits": _limits(self._lock.duration_ns),
        }
        wanted = {
            "AwbEnable": False,
            "ColourGains": COLOUR_GAINS,
            "NoiseReductionMode": 0,
            "Sharpness": 0.0,
            "AfMode": 0,
            "LensPosition": config.focus_dioptres,
        }
        controls |= {name: value for name, value in wanted.items() if name in known}
        if config.sync != "off":
            if "SyncMode" not in known:
                raise DeviceError(f"camera: camera.sync = {config.sync!r} needs a libcamera with SyncMode")
            controls["SyncMode"] = SYNC_MODES[config.sync]
        return controls

    def _reopen(self, stop: threading.Event) -> None:
        while True:
            self.close()
            if self._clock.wait_until_ns(self._clock.now_ns() + REOPEN_NS, stop):
                return
            try:
                self._open()
                return
            except DeviceError as error:
                self._health.update(str(error))

    def _next(self, stop: threading.Event) -> Frame | None:
        request = self._wait_request(stop)
        if request is None:
            return None
        try:
            metadata = request.get_metadata()
            wrong = self._wrong_time(metadata)
            if wrong:
                self._health.update(wrong)
                return None
            self._measure_line(metadata)
            readout = self._readout(tuple(metadata.get("ScalerCrop", self._mode_crop)))
            stamp_ns = readout.middle_ns(metadata["SensorTimestamp"], metadata["ExposureTime"])
            stamp_ns += clock_offset_ns(self._boottime, self._clock.now_ns)
            exposure = exposure_of(metadata)
            steady_ns = self._ask_exposure(stamp_ns, exposure)
            self._keep_phase(steady_ns)
            if not self._chooser.is_nearest(steady_ns):
                self.skipped["not_nearest"] += 1
                return None
            control = self.exposure_control
            context = None if control is None else control.plan.is_context(exposure)
            image = self._copy(request)
            jpeg = None
            if self._jpegs is not None and self._recorded.pick(stamp_ns, context):
                jpeg = self._jpegs.encode(request, metadata["SensorTimestamp"])
        finally:
            # Controls given to set_controls ride on the request that is released next.
            request.release()
        self._health.update(self._follow(steady_ns))
        return Frame(image, stamp_ns, round(readout.row_time_ns(image.shape[0])), exposure, context, jpeg)

    def _wait_request(self, stop: threading.Event) -> Any:
        camera, asked_ns = self._camera, self._boottime()
        job = camera.capture_request(wait=False)
        while True:
            try:
                return camera.wait(job, timeout=POLL_S)
            except TimeoutError:
                if stop.is_set():
                    camera.cancel_all_and_flush()
                    return None
                if self._boottime() - asked_ns > SILENCE_NS + self._frame_period_ns:
                    camera.cancel_all_and_flush()
                    raise RuntimeError(f"no frame for {SILENCE_NS / 1e9:.0f} s") from None

    def _wrong_time(self, metadata: dict[str, Any]) -> str:
        """Return why the frame's time is unknown, "" where it is known."""
        sensor_ns = metadata.get("SensorTimestamp")
        if sensor_ns is None or metadata.get("ExposureTime") is None:
            self.skipped["no_time"] += 1
            return "a frame without SensorTimestamp or ExposureTime"
        age_ns = self._boottime() - sensor_ns
        if not -EARLY_NS <= age_ns <= OLDEST_NS:
            self.skipped["wrong_clock"] += 1
            return f"SensorTimestamp is {age_ns / 1e9:.3f} s away from CLOCK_BOOTTIME"
        return ""

    def _measure_line(self, metadata: dict[str, Any]) -> None:
        if self._timer.measured:
            return
        for name in ("ExposureTime", "FrameDuration"):
            if name in metadata:
                self._timer.update(int(metadata[name]))
        if self._timer.measured:
            log.info("camera: a line takes %.3f us", self._timer.line_ns / 1000)

    def _ask_exposure(self, stamp_ns: int, exposure: Exposure) -> int:
        """Ask for the exposure of a frame to come; return this frame's time as the phase lock is to see it."""
        control = self.exposure_control
        if control is None:
            return stamp_ns
        steady_ns = control.steady_ns(stamp_ns, exposure)
        wanted = control.next(steady_ns, exposure)
        if wanted is not None:
            self._camera.set_controls(self._exposure_controls(wanted))
        return steady_ns

    def _keep_phase(self, stamp_ns: int) -> None:
        if self._config.sync == "client":
            return  # libcamera moves this camera's frames to the server's
        duration_ns = self._lock.update(stamp_ns)
        if duration_ns is not None:
            self._camera.set_controls({"FrameDurationLimits": _limits(duration_ns)})

    def _follow(self, stamp_ns: int) -> str:
        """Return why the frames of a sync client are not locked, "" where they are or this is none."""
        if self._config.sync != "client":
            return ""
        self._follower.update(stamp_ns)
        if not self._follower.problem:
            return ""
        return f"{self._follower.problem}: camera.sync = 'client' needs a node with 'server' that runs on the same link"

    def _copy(self, request: Any) -> NDArray[np.uint8]:
        """Return a copy of the picture: the camera's buffer is overwritten once the request is released."""
        height, width = self._config.height_px, self._config.width_px
        with self._mapped_array(request, "main") as mapped:
            return np.array(mapped.array[:height, :width], np.uint8, order="C")


def choose_mode(modes: list[dict[str, Any]], size: tuple[int, int]) -> dict[str, Any]:
    """Return the sensor mode with the widest view that has all the pixels asked for, and no more than needed."""
    enough = [m for m in modes if "crop_limits" in m and m["size"][0] >= size[0] and m["size"][1] >= size[1]]
    if not enough:
        raise DeviceError(f"camera: no mode has {size[0]}x{size[1]} pixels")
    return max(enough, key=lambda m: (m["crop_limits"][2] * m["crop_limits"][3], -m["size"][0], m["bit_depth"]))


def exposure_of(metadata: dict[str, Any]) -> Exposure:
    """Return what a frame had, by its metadata."""
    gain = float(metadata.get("AnalogueGain", 1.0)) * float(metadata.get("DigitalGain", 1.0))
    return Exposure(int(metadata["ExposureTime"]) * 1000, gain)


def _limits(duration_ns: int) -> tuple[int, int]:
    duration_us = round(duration_ns / 1000)
    return duration_us, duration_us


def _close(camera: Any, jpegs: CameraJpegs | None) -> None:
    if jpegs is not None:
        jpegs.close()
    try:
        camera.close()
    except CAMERA_ERRORS as error:
        log.warning("camera: closing: %s: %s", type(error).__name__, error)


def open_camera(config: NodeConfig, clock: Clock) -> Picamera2Camera:
    """Open the camera; raise DeviceError where there is none."""
    return Picamera2Camera(config.camera, config.trigger_period_ns, clock, record=config.record)
