"""Samples of the sensors, the two kinds of device, and the error of a device that fails."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from buddyline.protocol.errors import BuddylineError
from numpy.typing import NDArray

Vector = NDArray[np.float64]

STANDARD_GRAVITY_MPS2 = 9.80665


class DeviceError(BuddylineError):
    """A device that fails; the text names bus, address and register."""


class AbsentError(DeviceError):
    """A device that is absent, or in use elsewhere; it may become available later."""


class SettlingError(DeviceError):
    """A chip that was just started and has no reading yet; it needs no restart."""


class ImuReading(NamedTuple):
    """What an inertial unit's chips said, as bytes.

    stamps_ns: of each sample in `motion`. mag: of the last sample; None without a magnetometer.
    """

    stamps_ns: Sequence[int]
    motion: bytes
    mag: bytes | None


@dataclass(frozen=True, slots=True, eq=False)
class ImuSample:
    """One reading in the body frame, (3,) each.

    accel_mps2: specific force, so (0, 0, -9.8) of a level node at rest. mag_t: None without a magnetometer, and where
    it was not read. saturated: acceleration or rate was at full scale, so that the true one may be larger.
    temperature_degc: of the gyroscope, once a second; else None.
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

    After each wait the processor's caches are cold, and a sample then costs several times what the next one does. So a
    FIFO is read every turn_ns, or single samples are and their readings decoded some at a time.
    turn_ns: the time between two readings. readings: how many are decoded together. problem: what is wrong although
    samples come; "" if nothing.
    """

    name: str

    @property
    def turn_ns(self) -> int: ...  # noqa: D102

    @property
    def readings(self) -> int: ...  # noqa: D102

    @property
    def problem(self) -> str: ...  # noqa: D102

    def wake_ns(self, instant_ns: int) -> int:
        """Return the best instant for a reading near this one."""
        ...

    def fetch(self) -> ImuReading:
        """Return the newest reading; raise DeviceError if there is none. The next call tries again."""
        ...

    def decode(self, reading: ImuReading) -> Iterator[ImuSample]:
        """Give the samples of a reading, in their order; raise DeviceError at one that the chips did not measure.

        SettlingError: they have just been started. Any other: they are started again, and what was read meanwhile does
        not count.
        """
        ...


class DepthDevice(Protocol):
    """A pressure sensor that converts while the caller does other work: no method waits."""

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
