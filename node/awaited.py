"""A camera that could not be opened at the start: it is tried again while the rest of the node runs."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable
from typing import Final

from buddyline.node.devices import CameraDevice, ExposureControl, Frame
from buddyline.node.drivers.health import DeviceHealth
from buddyline.node.drivers.samples import DeviceError
from buddyline.protocol.clock import S_NS, Clock
from buddyline.protocol.messages import NodeInfo

RETRY_NS: Final = 2 * S_NS


class AwaitedCamera:
    """Tries every two seconds to open a camera; once that has worked, passes its frames on.

    reason: why it could not be opened at first. on_open: called once it is open, in the thread that takes its frames.
    """

    def __init__(
        self, open_camera: Callable[[], CameraDevice], reason: str, clock: Clock, on_open: Callable[[], None]
    ) -> None:
        self._open = open_camera
        self._clock = clock
        self._on_open = on_open
        self._camera: CameraDevice | None = None
        self._health = DeviceHealth("camera")
        self._health.update(reason)
        self._skipped: Counter[str] = Counter()

    @property
    def is_open(self) -> bool:
        """Whether the camera is open."""
        return self._camera is not None

    @property
    def skipped(self) -> Counter[str]:
        """Number of frames not passed on, by reason."""
        return self._skipped if self._camera is None else self._camera.skipped

    @property
    def row_time_ns(self) -> int:
        """Time from one row to the next; 0 before the camera is open."""
        return 0 if self._camera is None else self._camera.row_time_ns

    @property
    def problem(self) -> str:
        """What is wrong with the camera; "" if nothing."""
        return self._health.problem if self._camera is None else self._camera.problem

    @property
    def exposure_control(self) -> ExposureControl | None:
        """What changes its exposure; None before it is open."""
        return None if self._camera is None else self._camera.exposure_control

    def info(self) -> NodeInfo | None:
        """Return None: the calibration is in the configuration."""
        return None

    def next_frame(self, stop: threading.Event) -> Frame | None:
        """Wait for the camera, then for its next frame; None once stop is set."""
        while self._camera is None:
            if self._clock.wait_until_ns(self._clock.now_ns() + RETRY_NS, stop):
                return None
            try:
                self._camera = self._open()
            except DeviceError as error:
                self._health.update(str(error))
                continue
            self._health.update("")
            self._on_open()
        return self._camera.next_frame(stop)

    def close(self) -> None:
        """Free the camera."""
        if self._camera is not None:
            self._camera.close()
