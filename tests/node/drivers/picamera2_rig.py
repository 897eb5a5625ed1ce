"""The camera driver on a stand-in for picamera2: how tests make it, take its frames, and judge their phase."""

from __future__ import annotations

import threading

from buddyline.node.config import CameraConfig, RecordConfig
from buddyline.node.devices import Frame
from buddyline.node.drivers.camera_picamera2 import Picamera2Camera
from buddyline.protocol.clock import MS_NS, S_NS, trigger_index

from tests.node.drivers import standin_picamera2 as standin

START_NS = 1_764_000_000 * S_NS + 33 * MS_NS
PERIOD_NS = 100 * MS_NS
NEVER = threading.Event()


class Wall:
    """The node's wall clock: the sensor's, set by what the test says."""

    def __init__(self, sensor: standin.Sensor) -> None:
        self._sensor = sensor

    def now_ns(self) -> int:
        return self._sensor.wall_ns()

    def wait_until_ns(self, instant_ns: int, stop: threading.Event) -> bool:
        clock = self._sensor.clock
        clock.set_ns(max(clock.now_ns(), instant_ns - self._sensor.wall_shift_ns))
        return stop.is_set()


def make(
    sensor: standin.Sensor,
    config: CameraConfig | None = None,
    period_ns: int = PERIOD_NS,
    record: RecordConfig | None = None,
) -> Picamera2Camera:
    return Picamera2Camera(config or CameraConfig(colour=False), period_ns, Wall(sensor), sensor.boottime_ns, record)


def frames(camera: Picamera2Camera, n: int) -> list[Frame]:
    found = [camera.next_frame(NEVER) for _ in range(n)]
    return [frame for frame in found if frame is not None]


def off_ns(frame: Frame, period_ns: int = PERIOD_NS) -> int:
    return frame.stamp_ns - trigger_index(frame.stamp_ns, period_ns) * period_ns
