"""A stand-in for picamera2, with the parts of it that the camera driver meets.

It behaves like the real package where that matters: strides are padded, a request's buffer is overwritten once
it is released and used again, a request that is never released starves the camera, controls ride on the next
released request and show some frames later, unknown controls are refused, waiting times out, and a job that
was waited for in vain is still there. Time is a manual clock: waiting moves it on to the next frame.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import Enum
from types import ModuleType
from typing import Any

import numpy as np
from buddyline.protocol.clock import ManualClock

BOOT_NS = 4_321_000_000_000
PIPELINE_NS = 12_000_000  # from the end of readout to the completed request


class Sensor:
    """The world side, for tests to set. IMX219's timing: 18.904 us lines, 32 lines of shortest blanking."""

    def __init__(self, clock: ManualClock) -> None:
        self.clock = clock
        self.start_ns = clock.now_ns()
        self.model = "imx219"
        self.line_ns = 18_904.0
        self.blanking = 32
        self.cameras = [{"Model": "imx219", "Num": 0, "Id": "/base/imx219"}]
        self.modes = [
            mode((640, 480), 10, (1000, 752, 1280, 960), 103.33),
            mode((1640, 1232), 10, (0, 0, 3280, 2464), 41.85),
            mode((1640, 1232), 8, (0, 0, 3280, 2464), 41.85),
            mode((1920, 1080), 10, (680, 692, 1920, 1080), 47.57),
            mode((3280, 2464), 10, (0, 0, 3280, 2464), 21.19),
            {"format": "YUYV"},
        ]
        self.controls = {
            "AeEnable", "ExposureTime", "AnalogueGain", "FrameDurationLimits", "AwbEnable", "ColourGains",
            "NoiseReductionMode", "Sharpness", "ScalerCrop",
        }  # fmt: skip
        # The beginning of a curve like that of the sensor's own tuning.
        self.tunings = {"imx219.json": {"gamma_curve": [0, 0, 1024, 5040, 16384, 40642, 32768, 54979, 65535, 65535]}}
        self.ppm = 0.0
        self.padding = 64
        self.pipeline_frames = 3  # behind the buffers, until a control shows
        self.picture: Callable[[int], int] = lambda number: number % 256
        # What is seen with an exposure (ms, times gain); in place of `picture` where set.
        self.view: Callable[[float], np.ndarray] | None = None
        self.lost: set[int] = set()
        self.silent_from: int | None = None
        self.job_error: Exception | None = None
        self.open_error: Exception | None = None
        self.alter_metadata: Callable[[dict[str, Any]], None] = lambda metadata: None
        self.set_wall: dict[int, int] = {}
        self.opened = 0
        self.closed = 0
        self.has_encoder = True
        self.encoder_error: Exception | None = None
        self.encoders: list[MJPEGEncoder] = []
        self.wall_shift_ns = 0

    def boottime_ns(self) -> int:
        return self.clock.now_ns() - self.start_ns + BOOT_NS

    def wall_ns(self) -> int:
        return self.clock.now_ns() + self.wall_shift_ns


def mode(size, bit_depth, crop, fps) -> dict[str, Any]:
    return {"format": "SRGGB", "size": size, "bit_depth": bit_depth, "crop_limits": crop, "fps": fps}


class Request:
    def __init__(self, camera: Picamera2, buffer: np.ndarray, metadata: dict[str, Any]) -> None:
        self._camera = camera
        self.buffer = buffer
        self._metadata = metadata
        self._references = 1
        self.stream_map = {"main": object()}

    def get_metadata(self) -> dict[str, Any]:
        return dict(self._metadata)

    def acquire(self) -> None:
        if self._references == 0:
            raise RuntimeError("CompletedRequest: acquiring lock with ref_count 0")
        self._references += 1

    def release(self) -> None:
        self._references -= 1
        if self._references < 0:
            raise RuntimeError("CompletedRequest: lock now has negative ref_count")
        if self._references == 0:
            self._camera._recycle(self.buffer)


class MappedArray:
    def __init__(self, request: Request, stream: str, reshape: bool = True) -> None:
        assert stream == "main"
        self._request = request
        self.array: Any = None

    def __enter__(self) -> MappedArray:
        self.array = self._request.buffer
        return self

    def __exit__(self, *_: object) -> None:
        self.array = None


class Output:
    """Of picamera2.outputs."""

    def __init__(self, pts: Any = None) -> None:
        self.recording = False

    def start(self) -> None:
        self.recording = True

    def stop(self) -> None:
        self.recording = False

    def outputframe(self, frame, keyframe=True, timestamp=None, packet=None, audio=False) -> None:
        raise NotImplementedError

    def _add_stream(self, encoder_stream: Any, *args: Any, **kwargs: Any) -> None:
        pass


class Quality(Enum):
    VERY_LOW = 0
    LOW = 1
    MEDIUM = 2
    HIGH = 3
    VERY_HIGH = 4


class MJPEGEncoder:
    """The V4L2 encoder: it holds each request until a test lets it finish or lose the oldest."""

    def __init__(self, bitrate: int | None = None) -> None:
        if not Picamera2.sensor.has_encoder:
            raise RuntimeError("Hardware MJPEG not available on this platform")
        Picamera2.sensor.encoders.append(self)
        self.width = self.height = self.stride = 0
        self.format = self.name = ""
        self.framerate: float | None = None
        self.bits_per_s = 0
        self.running = False
        self.firsttimestamp: int | None = None
        self._output: Output | None = None
        self._held: deque[tuple[Request, int]] = deque()

    @property
    def output(self) -> Output | None:
        return self._output

    @output.setter
    def output(self, value: Output) -> None:
        if not isinstance(value, Output):
            raise RuntimeError("Must pass Output")
        self._output = value

    def start(self, quality: Quality | None = None) -> None:
        megabits = {Quality.MEDIUM: 30, Quality.HIGH: 40, Quality.VERY_HIGH: 50}[quality or Quality.MEDIUM]
        self.bits_per_s = int(megabits * 1e6 * self.width * self.height * self.framerate / (1920 * 1080 * 30))
        if self.format not in ("RGB888", "YUV420") or self.stride < self.width or self.output is None:
            raise RuntimeError("Unrecognised format")
        self.running = True
        self.output.start()

    def encode(self, stream: Any, request: Request) -> None:
        if not self.running:
            return
        if Picamera2.sensor.encoder_error is not None:
            raise Picamera2.sensor.encoder_error
        assert request.stream_map[stream]
        request.acquire()
        timestamp_us = int(request.get_metadata()["SensorTimestamp"] / 1000)
        if self.firsttimestamp is None:
            self.firsttimestamp = timestamp_us
        self._held.append((request, timestamp_us - self.firsttimestamp))

    def finish(self) -> None:
        """Give out the oldest picture: made-up bytes, which name a grey level of the buffer as it is now."""
        request, timestamp_us = self._held.popleft()
        grey = int(request.buffer.flat[0])
        request.release()
        assert self.output is not None
        self.output.outputframe(b"jpeg of %d" % grey, True, timestamp_us, None, False)

    def lose(self) -> None:
        """Give the oldest request back without its picture."""
        self._held.popleft()[0].release()

    def stop(self) -> None:
        if not self.running:
            raise RuntimeError("Encoder already stopped")
        self.running = False
        while self._held:
            self.lose()


class Job:
    def __init__(self) -> None:
        self.cancelled = False


class Picamera2:
    sensor: Sensor

    @staticmethod
    def global_camera_info() -> list[dict[str, Any]]:
        return Picamera2.sensor.cameras

    @staticmethod
    def load_tuning_file(tuning_file: str, dir: str | None = None) -> dict[str, Any]:
        if tuning_file not in Picamera2.sensor.tunings:
            raise RuntimeError("Tuning file not found")
        return {"version": 2.0, "algorithms": [{"rpi.contrast": Picamera2.sensor.tunings[tuning_file]}]}

    @staticmethod
    def find_tuning_algo(tuning: dict[str, Any], name: str) -> dict[str, Any]:
        return next(algorithm for algorithm in tuning["algorithms"] if name in algorithm)[name]

    def __init__(self, camera_num: int = 0) -> None:
        sensor = Picamera2.sensor
        if sensor.open_error is not None:
            raise RuntimeError("Camera __init__ sequence did not complete.") from sensor.open_error
        sensor.opened += 1
        self._sensor = sensor
        self._config: dict[str, Any] = {}
        self._started = False
        self._pending: dict[str, Any] = {}
        self._jobs: deque[Job] = deque()
        self._frame = 0

    @property
    def sensor_modes(self) -> list[dict[str, Any]]:
        assert not self._started
        return self._sensor.modes

    @property
    def camera_properties(self) -> dict[str, Any]:
        return {"Model": self._sensor.model, "ColorFilterArrangement": 0}

    @property
    def camera_controls(self) -> dict[str, tuple[Any, Any, Any]]:
        known: dict[str, tuple[Any, Any, Any]] = dict.fromkeys(self._sensor.controls, (0, 1, 0))
        height = self._config["sensor"]["output_size"][1] if self._config else 2464
        shortest_us = int((height + self._sensor.blanking) * self._sensor.line_ns / 1000)
        known["FrameDurationLimits"] = (shortest_us, 11_767_556, 33_333)
        known["ExposureTime"] = (75, 11_766_829, 20_000)
        known["AnalogueGain"] = (1.0, 10.666667, 1.0)
        return known

    def create_preview_configuration(
        self,
        main={},  # noqa: B006
        lores=None,
        raw={},  # noqa: B006
        buffer_count=4,
        controls={},  # noqa: B006
        display="main",
        encode="main",
        queue=True,
        sensor={},  # noqa: B006
    ) -> dict[str, Any]:
        main = {"format": "XBGR8888", "size": (640, 480), **main}
        width, height = main["size"]
        main["size"] = (width - width % 2, height - height % 2)  # without a word, as the real one
        return {"main": main, "buffer_count": buffer_count, "controls": controls, "queue": queue, "sensor": sensor}

    def configure(self, camera_config: dict[str, Any]) -> None:
        if self._started:
            raise RuntimeError("Camera must be stopped before configuring")
        self._config = camera_config
        width, height = camera_config["main"]["size"]
        stride = -(-width // max(self._sensor.padding, 1)) * max(self._sensor.padding, 1)
        camera_config["main"]["stride"] = stride * (1 if camera_config["main"]["format"] == "YUV420" else 3)
        if camera_config["main"]["format"] == "YUV420":
            shape: tuple[int, ...] = (height * 3 // 2, stride)
        else:
            shape = (height, stride, 3)
        self._free = deque(np.zeros(shape, np.uint8) for _ in range(camera_config["buffer_count"]))
        self._pending = {"FrameDurationLimits": (100, 83_333), **camera_config["controls"]}

    def camera_configuration(self) -> dict[str, Any]:
        return self._config

    def set_controls(self, controls: dict[str, Any]) -> None:
        for name in controls:
            if name not in self.camera_controls:
                raise RuntimeError(f"Control {name} is not advertised by libcamera")
        self._pending |= controls

    def start(self, config: Any = None, show_preview: bool = False) -> None:
        assert self._config
        self._started = True
        self._active = self._pending
        self._pending = {}
        self._queued: deque[dict[str, Any]] = deque(
            {} for _ in range(self._config["buffer_count"] + self._sensor.pipeline_frames)
        )
        self._readout_ns = self._sensor.boottime_ns() + 137_531_000

    def capture_request(self, wait: bool | None = None, signal_function: Any = None, flush: Any = None) -> Job:
        assert wait is False
        job = Job()
        self._jobs.append(job)
        return job

    def wait(self, job: Job, timeout: float | None = None) -> Request:
        assert not job.cancelled
        assert job is self._jobs[0], "another job was left waiting and takes the frame"
        sensor = self._sensor
        deadline_ns = sensor.boottime_ns() + int((timeout or 1e9) * 1e9)
        while self._alive():
            done_ns = self._readout_ns + int(self._lines() * sensor.line_ns) + PIPELINE_NS
            if done_ns > deadline_ns:
                break
            self._until(done_ns)
            request = self._complete()
            if request is not None:
                self._jobs.popleft()
                if sensor.job_error is not None:
                    error, sensor.job_error = sensor.job_error, None
                    raise error
                return request
        self._until(deadline_ns)
        raise TimeoutError

    def cancel_all_and_flush(self) -> None:
        for job in self._jobs:
            job.cancelled = True
        self._jobs.clear()

    def close(self) -> None:
        self._sensor.closed += 1
        self._started = False

    def _alive(self) -> bool:
        silent = self._sensor.silent_from
        return self._started and bool(self._free) and (silent is None or self._frame < silent)

    def _until(self, boottime_ns: int) -> None:
        clock = self._sensor.clock
        clock.set_ns(max(clock.now_ns(), boottime_ns - BOOT_NS + self._sensor.start_ns))

    def _lines(self) -> int:
        return int(self._config["sensor"]["output_size"][1])

    def _complete(self) -> Request | None:
        """Expose one frame; None where it was lost."""
        sensor, number = self._sensor, self._frame
        self._frame += 1
        self._active |= self._queued.popleft() if self._queued else {}
        if number in sensor.set_wall:
            sensor.wall_shift_ns = sensor.set_wall[number]
        readout_ns = self._readout_ns
        lines = int(self._active["FrameDurationLimits"][0] * 1000 // sensor.line_ns)
        lines = max(lines, self._lines() + sensor.blanking)
        self._readout_ns += round(lines * sensor.line_ns * (1 + sensor.ppm * 1e-6))
        if number in sensor.lost:
            self._queued.append({})
            return None
        exposure_us = int(self._active.get("ExposureTime", 20_000) * 1000 // sensor.line_ns * sensor.line_ns / 1000)
        # The sensor's gain comes in steps; the rest is made up for digitally.
        gain = 256 / round(256 / self._active.get("AnalogueGain", 1.0))
        buffer = self._free.popleft()
        width, height = self._config["main"]["size"]
        seen = sensor.picture(number) if sensor.view is None else sensor.view(exposure_us / 1000 * gain)
        buffer[:height, :width] = seen
        buffer[:, self._config["main"]["size"][0] :] = 255  # padding is no picture
        metadata = {
            "SensorTimestamp": readout_ns,
            "ExposureTime": exposure_us,
            "AnalogueGain": gain,
            "DigitalGain": 1.0003,
            "FrameDuration": int(lines * sensor.line_ns / 1000),
            "ScalerCrop": next(
                m["crop_limits"] for m in sensor.modes if m.get("size") == self._config["sensor"]["output_size"]
            ),
            "Number": number,
            "Active": dict(self._active),
        }
        sensor.alter_metadata(metadata)
        return Request(self, buffer, metadata)

    def _recycle(self, buffer: np.ndarray) -> None:
        buffer[:] = 99  # a reader that still uses the buffer sees the next frame
        self._free.append(buffer)
        self._queued.append(self._pending)
        self._pending = {}


def modules(sensor: Sensor) -> dict[str, ModuleType]:
    """Return what `import picamera2` and the imports of its modules are to find."""
    encoders, mjpeg, outputs = (
        ModuleType(f"picamera2.{name}") for name in ("encoders", "encoders.mjpeg_encoder", "outputs")
    )
    encoders.Quality = Quality  # type: ignore[attr-defined]
    mjpeg.MJPEGEncoder = MJPEGEncoder  # type: ignore[attr-defined]
    outputs.Output = Output  # type: ignore[attr-defined]
    return {made.__name__: made for made in (module(sensor), encoders, mjpeg, outputs)}


def module(sensor: Sensor) -> ModuleType:
    """Return what `import picamera2` is to find."""
    Picamera2.sensor = sensor
    made = ModuleType("picamera2")
    made.Picamera2 = Picamera2  # type: ignore[attr-defined]
    made.MappedArray = MappedArray  # type: ignore[attr-defined]
    return made
