"""The interfaces of cameras and sensors, and the module for each configured name."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from buddyline.node.capture.exposure import Exposure, ExposurePlan, ExposureRange
from buddyline.protocol.clock import Clock
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Message, NodeInfo
from numpy.typing import NDArray

if TYPE_CHECKING:
    from buddyline.node.config import NodeConfig


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture: BGR (H, W, 3) or luminance (H, W), uint8.

    stamp_ns: middle of exposure of the middle row, wall clock. row_time_ns: from one row to the next.
    exposure: what this very frame had, None where the camera does not tell. context: whether that was the scene's
    exposure and not the lamps'; None where it is always the same. jpeg: of a picture to be recorded that the camera's
    own encoder makes; it fails where the encoder does.
    """

    image: NDArray[np.uint8]
    stamp_ns: int
    row_time_ns: int = 0
    exposure: Exposure | None = None
    context: bool | None = None
    jpeg: Future[bytes] | None = None


class ExposureControl(Protocol):
    """A camera whose exposure can be changed while it runs. range: what it can be asked for."""

    @property
    def range(self) -> ExposureRange: ...  # noqa: D102

    def follow(self, plan: ExposurePlan) -> None:
        """Expose by this plan as soon as it can; for any thread. Each frame tells what it had."""
        ...


class CameraDevice(Protocol):
    """Gives one frame per trigger; used by one thread.

    row_time_ns: from one row's exposure to the next, 0 for a global shutter. problem: what is wrong, "" if all
    is well. skipped: frames that were not given out, by reason. exposure_control: None where the exposure is fixed, or
    not known.
    """

    @property
    def skipped(self) -> Counter[str]: ...  # noqa: D102

    @property
    def row_time_ns(self) -> int: ...  # noqa: D102

    @property
    def problem(self) -> str: ...  # noqa: D102

    @property
    def exposure_control(self) -> ExposureControl | None: ...  # noqa: D102

    def info(self) -> NodeInfo | None:
        """Return the calibration that comes with the pictures; None: it is in the configuration."""
        ...

    def next_frame(self, stop: threading.Event) -> Frame | None:
        """Wait for the next trigger's frame; None if there will be none, or stop is set."""
        ...

    def close(self) -> None:
        """Free the device."""
        ...


class Source(Protocol):
    """One sensor, or several that are read together; used by one thread.

    problem: what is wrong, "" if all is well. retries: transfers on its bus that had to be repeated. read_by: name of
    the source that gives its messages, because both are on one bus; "" for none. Its name is then its topic's.
    """

    name: str
    read_by: str

    @property
    def problem(self) -> str: ...  # noqa: D102

    @property
    def retries(self) -> int: ...  # noqa: D102

    def next_messages(self, stop: threading.Event) -> list[Message] | None:
        """Wait for the next samples (Imu, Attitude, Depth); None if there will be none, or stop is set."""
        ...

    def close(self) -> None:
        """Free the device."""
        ...


CAMERAS: Final[Mapping[str, str]] = {
    "simulated": "buddyline.node.sim.devices:open_camera",
    "stored": "buddyline.node.drivers.stored:open_camera",
    "picamera2": "buddyline.node.drivers.camera_picamera2:open_camera",
}

SENSORS: Final[Mapping[str, str]] = {
    "simulated": "buddyline.node.sim.devices:open_sensors",
    "stored": "buddyline.node.drivers.stored:open_sensors",
    "i2c": "buddyline.node.drivers.devices:open_sensors",
}


def load(registry: Mapping[str, str], what: str, name: str) -> Callable[..., Any]:
    """Import the driver of this name; raise BuddylineError if there is none, or its package is missing."""
    target = registry.get(name)
    if target is None:
        raise BuddylineError(f"{what} {name!r}: known are {', '.join(registry)}")
    module, _, attribute = target.partition(":")
    try:
        return getattr(import_module(module), attribute)  # type: ignore[no-any-return]
    except ModuleNotFoundError as error:
        raise BuddylineError(f"{what} {name!r} needs the package {error.name}: make install EXTRAS=pi") from error


def open_camera(config: NodeConfig, clock: Clock) -> CameraDevice:
    """Open the configured camera."""
    camera: CameraDevice = load(CAMERAS, "camera", config.camera.name)(config, clock)
    return camera


def open_sensors(config: NodeConfig, clock: Clock) -> list[Source]:
    """Open the configured sensors; none of them for "none"."""
    if config.sensors.name == "none":
        return []
    sources: list[Source] = load(SENSORS, "sensors", config.sensors.name)(config, clock)
    return sources
