"""LSM6DS33 and LSM6DSO: accelerometer and gyroscope of the MinIMU-9 v5 and v6 (ST DocID027423, DS12140)."""

from __future__ import annotations

import math
from typing import ClassVar, Final

from buddyline.node.drivers.samples import STANDARD_GRAVITY_MPS2, Vector
from buddyline.node.drivers.st_chip import WHO_AM_I, StChip, decode_vector
from buddyline.node.drivers.watch import FULL_SCALE_COUNTS, SensorWatch

OUT_TEMPERATURE: Final = 0x20  # gyroscope and accelerometer follow at 0x22 and 0x28: one burst of fourteen bytes

ACCEL_MPS2_PER_COUNT: Final = 0.122e-3 * STANDARD_GRAVITY_MPS2  # +-4 g
GYRO_RADPS_PER_COUNT: Final = math.radians(17.50e-3)  # +-500 deg/s


def decode_motion(data: bytes) -> tuple[Vector, Vector]:
    """Return specific force in m/s2 and angular rate in rad/s, (3,) each, of twelve bytes from OUTX_L_G on."""
    return decode_vector(data[6:]) * ACCEL_MPS2_PER_COUNT, decode_vector(data[:6]) * GYRO_RADPS_PER_COUNT


def decode_temperature(data: bytes, counts_per_degc: float) -> float:
    """Return the chip's temperature in degrees C, of its first two bytes; 0 counts are 25 degrees."""
    return 25.0 + int.from_bytes(data[:2], "little", signed=True) / counts_per_degc


class Lsm6ds(StChip):
    """Both at 208 Hz, +-4 g and +-500 deg/s; the two chips have the same registers here."""

    NAME = "LSM6DS33 or LSM6DSO"
    ADDRESSES = (0x6B, 0x6A)
    IDENTITIES: ClassVar[tuple[int, ...]] = (0x69, 0x6C)
    COUNTS_PER_DEGC: ClassVar[dict[int, float]] = {0x69: 16.0, 0x6C: 256.0}
    SETTINGS = (
        (0x12, 0x44),  # CTRL3_C: no update between low and high byte, addresses advance in a burst
        (0x10, 0x58),  # CTRL1_XL: 208 Hz, +-4 g
        (0x11, 0x54),  # CTRL2_G: 208 Hz, +-500 deg/s
    )

    _counts_per_degc = 256.0

    def start(self) -> None:
        """Check the identity, write the settings and read them back."""
        super().start()
        self._counts_per_degc = self.COUNTS_PER_DEGC[self.bus.read(self.address, WHO_AM_I, 1)[0]]

    @property
    def watches(self) -> tuple[SensorWatch, SensorWatch]:
        """Return what judges accelerometer and gyroscope."""
        return (
            SensorWatch(f"{self.NAME} accelerometer", self, FULL_SCALE_COUNTS * ACCEL_MPS2_PER_COUNT),
            SensorWatch(f"{self.NAME} gyroscope", self, FULL_SCALE_COUNTS * GYRO_RADPS_PER_COUNT),
        )

    @property
    def chips(self) -> tuple[StChip, ...]:
        """Return the chips whose settings are to be checked."""
        return (self,)

    def read_motion(self) -> bytes:
        """Return the fourteen bytes of temperature, gyroscope and accelerometer."""
        return self.bus.read(self.address, OUT_TEMPERATURE, 14)

    def decode(self, data: bytes) -> tuple[Vector, Vector, float]:
        """Return specific force in m/s2 and angular rate in rad/s, (3,) each, and the temperature in degrees C."""
        return *decode_motion(data[2:]), decode_temperature(data, self._counts_per_degc)


class Lsm6ds33(Lsm6ds):
    """The chip of the MinIMU-9 v5."""

    NAME = "LSM6DS33"
    IDENTITIES = (0x69,)


class Lsm6dso(Lsm6ds):
    """The chip of the MinIMU-9 v6."""

    NAME = "LSM6DSO"
    IDENTITIES = (0x6C,)
