"""L3GD20H: gyroscope of the MinIMU-9 v3 (ST DocID023469)."""

from __future__ import annotations

import math
from typing import Final

from buddyline.node.drivers.samples import Vector
from buddyline.node.drivers.st_chip import StChip, decode_vectors

AUTO_INCREMENT: Final = 0x80
OUT_TEMPERATURE: Final = 0x26  # the status, then the rates at 0x28, follow: one burst of eight bytes

GYRO_RADPS_PER_COUNT: Final = math.radians(17.50e-3)  # +-500 deg/s


def decode_gyro(data: bytes) -> Vector:
    """Return the angular rate in rad/s, (n, 3) in the chip's frame, of six bytes each at +-500 deg/s."""
    return decode_vectors(data) * GYRO_RADPS_PER_COUNT


def decode_temperature(data: bytes) -> float:
    """Return the chip's temperature in degrees C, of its first byte: a degree a count, falling; its zero is not known.

    Taken as 25 degrees: only differences count.
    """
    return 25.0 - int.from_bytes(data[:1], "little", signed=True)


class L3gd20h(StChip):
    """Gyroscope at 200 Hz nominal (189.4 Hz measured), +-500 deg/s."""

    NAME = "L3GD20H"
    ADDRESSES = (0x6B, 0x6A)
    IDENTITIES = (0xD7,)
    SETTINGS = (
        (0x39, 0x00),  # LOW_ODR: off
        (0x23, 0x90),  # CTRL4: no update between low and high byte, +-500 deg/s
        (0x20, 0x6F),  # CTRL1: 200 Hz, all axes on
    )

    def read_gyro(self) -> bytes:
        """Return eight bytes: temperature, status, and six of the rates, for `decode_gyro`."""
        return self.bus.read(self.address, OUT_TEMPERATURE | AUTO_INCREMENT, 8)
