"""Judges each sensor of an inertial unit by itself: lost settings, zeros, repeated readings, saturation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from buddyline.node.drivers.samples import DeviceError, SettlingError, Vector
from buddyline.node.drivers.st_chip import StChip
from buddyline.protocol.clock import MS_NS, S_NS

# Noise always moves the last bits. A few readings may repeat while the chip is slower than the loop;
# ten in a row mean that the chip has stopped.
FROZEN_READINGS: Final = 10
# A gyroscope at rest may read zero on all axes once (about one reading in a hundred without a bias), not three times.
ZERO_READINGS: Final = 3
# A chip gives zeros until its first conversion is done; the L3GD20H takes 250 ms.
SETTLING_NS: Final = 500 * MS_NS
CHECK_NS: Final = S_NS
FULL_SCALE_COUNTS: Final = 32_700  # of 32,768


class SensorWatch:
    """Checks the readings of one sensor.

    chip: holds its settings. limit: its full scale, in the unit of the readings.
    """

    def __init__(self, name: str, chip: StChip, limit: float) -> None:
        self._name = name
        self._chip = chip
        self._limit = limit
        self.restart(0)

    def restart(self, now_ns: int) -> None:
        """Forget earlier readings: the chip was started at now_ns."""
        self._started_ns = now_ns
        self._heard = False
        self._zeros = self._repeats = 0
        self._last: list[float] = []

    def is_saturated(self, reading: Vector, now_ns: int) -> bool:
        """Return whether a reading, (3,), is at full scale; raise DeviceError if the chip did not measure it."""
        # Plain numbers: on three of them they take a fifth of the time of numpy.
        values: list[float] = reading.tolist()
        if not any(values):
            self._judge_zero(now_ns)
        else:
            self._heard, self._zeros = True, 0
        self._repeats = self._repeats + 1 if values == self._last else 0
        self._last = values
        if self._repeats >= FROZEN_READINGS:
            raise DeviceError(f"{self._name}: the same reading {FROZEN_READINGS} times in a row: the chip has stopped")
        return max(*values, -min(values)) >= self._limit

    def _judge_zero(self, now_ns: int) -> None:
        self._chip.check_settings()
        if not self._heard and 0 <= now_ns - self._started_ns < SETTLING_NS:
            raise SettlingError(f"{self._name}: starts, no reading yet")
        self._zeros += 1
        if not self._heard or self._zeros >= ZERO_READINGS:
            raise DeviceError(f"{self._name}: reads zero on all axes: the chip sleeps or SDA is held down")


class SettingsWatch:
    """Reads the control registers of some chips back, one at a time, all of them once a second."""

    def __init__(self, chips: Sequence[StChip]) -> None:
        distinct = {id(chip): chip for chip in chips}.values()
        self._checks = [(chip, register, value) for chip in distinct for register, value in chip.SETTINGS]
        self._next = 0
        self._checked_ns = 0

    def look(self, now_ns: int) -> None:
        """Read the next register back if one is due; raise DeviceError if the chip has lost its setting."""
        if 0 <= now_ns - self._checked_ns < CHECK_NS // len(self._checks):
            return
        self._checked_ns = now_ns
        chip, register, value = self._checks[self._next]
        self._next = (self._next + 1) % len(self._checks)
        chip.check_setting(register, value)
