"""Samples of the sensors, the two kinds of device, and the error of a device that fails."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from buddyline.protocol.errors import BuddylineError
from numpy.typing import NDArray

Vector = NDArray[np.float64]

STANDARD_GRAVITY_MPS2 = 9.80665


class DeviceError(BuddylineError):
    """A device that fails; the text names bus, address and register."""


class AbsentError(DeviceError):
    """A device that is absent, or in use elsewhere; it may become available later."""


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """One reading in the body frame, (3,) each.

    accel_mps2: specific force, so (0, 0, -9.8) of a level node at rest. mag_t: None without a magnetometer.
    saturated: acceleration or rate was at full scale, so that the true one may be larger. temperature_degc: of the
    gyroscope; None where it is not known.
    """

    stamp_ns: int
    accel_mps2: Vector
    gyro_radps: Vector
    mag_t: Vector | None = None
    saturated: bool = False
    temperature_degc: float | None = None


@dataclass(frozen=True, slots=True)
class DepthSample:
    """Absolute pressure at the port, and the water's temperature there. stamp_ns: middle of its conversion."""

    stamp_ns: int
    pressure_pa: float
    temperature_degc: float


@dataclass(frozen=True, slots=True)
class BatterySample:
    """Voltage of the battery, and the current out of it; None where the chip does not measure that."""

    voltage_v: float
    current_a: float | None = None


class ImuDevice(Protocol):
    """Accelerometer, gyroscope and, on most boards, magnetometer.

    problem: what is wrong although samples come; "" if nothing.
    """

    name: str

    @property
    def problem(self) -> str: ...  # noqa: D102

    def read(self) -> ImuSample:
        """Return the newest sample; raise DeviceError if there is none. The next call tries again."""
        ...


class DepthDevice(Protocol):
    """A pressure sensor that converts while the caller does other work: no method waits."""

    next_due_ns: int

    @property
    def name(self) -> str:
        """What it is called in the configuration."""
        ...

    def step(self, now_ns: int) -> DepthSample | None:
        """Take the next step if one is due; return a sample if one is complete.

        Call it at every turn of the loop that owns the bus. Raises DeviceError; later calls try again.
        """
        ...


class GaugeDevice(Protocol):
    """A battery gauge."""

    def start(self) -> None:
        """Set the chip up; raise DeviceError if it cannot be."""
        ...

    def read(self) -> BatterySample:
        """Return the newest reading; raise DeviceError if there is none. The chip is then to be started again."""
        ...
