"""LSM303D: accelerometer and magnetometer of the MinIMU-9 v3 (ST DocID023312)."""

from __future__ import annotations

from typing import Final

from buddyline.node.drivers.samples import STANDARD_GRAVITY_MPS2, Vector
from buddyline.node.drivers.st_chip import StChip, decode_vectors

AUTO_INCREMENT: Final = 0x80
OUT_MAG: Final = 0x08
OUT_ACCEL: Final = 0x28

ACCEL_MPS2_PER_COUNT: Final = 0.122e-3 * STANDARD_GRAVITY_MPS2  # +-4 g
MAG_T_PER_COUNT: Final = 0.160e-3 * 1e-4  # +-4 gauss


def decode_accel(data: bytes) -> Vector:
    """Return the specific force in m/s2, (n, 3) in the chip's frame, of six bytes each at +-4 g."""
    return decode_vectors(data) * ACCEL_MPS2_PER_COUNT


def decode_mag(data: bytes) -> Vector:
    """Return the magnetic field in T, (n, 3) in the chip's frame, of six bytes each at +-4 gauss."""
    return decode_vectors(data) * MAG_T_PER_COUNT


class Lsm303d(StChip):
    """Accelerometer at 100 Hz, +-4 g, 50 Hz filter; magnetometer at 50 Hz, +-4 gauss, high resolution."""

    NAME = "LSM303D"
    ADDRESSES = (0x1D, 0x1E)
    IDENTITIES = (0x49,)
    SETTINGS = (
        (0x20, 0x6F),  # CTRL1: 100 Hz, all axes, no update between low and high byte
        (0x21, 0xC8),  # CTRL2: anti-alias filter 50 Hz, half the rate (the default is 773 Hz); +-4 g
        (0x24, 0x70),  # CTRL5: magnetometer 50 Hz, high resolution
        (0x25, 0x20),  # CTRL6: +-4 gauss
        (0x26, 0x00),  # CTRL7: continuous conversion
    )

    def read_accel(self) -> bytes:
        """Return the six bytes of the accelerometer, for `decode_accel`."""
        return self.bus.read(self.address, OUT_ACCEL | AUTO_INCREMENT, 6)

    def read_mag(self) -> bytes:
        """Return the six bytes of the magnetometer."""
        return self.bus.read(self.address, OUT_MAG | AUTO_INCREMENT, 6)

    def decode_mag(self, data: bytes) -> Vector:
        """Return the magnetic field in T, (n, 3)."""
        return decode_mag(data)
