"""LIS3MDL: magnetometer of the MinIMU-9 v5 and v6 (ST DocID024204)."""

from __future__ import annotations

from typing import Final

from buddyline.node.drivers.samples import Vector
from buddyline.node.drivers.st_chip import StChip, decode_vectors

AUTO_INCREMENT: Final = 0x80
OUT_MAG: Final = 0x28

MAG_T_PER_COUNT: Final = 1e-4 / 6842  # +-4 gauss


def decode_mag(data: bytes) -> Vector:
    """Return the magnetic field in T, (n, 3) in the chip's frame, of six bytes each at +-4 gauss."""
    return decode_vectors(data) * MAG_T_PER_COUNT


class Lis3mdl(StChip):
    """Magnetometer at 80 Hz, +-4 gauss, ultra-high performance on all axes."""

    NAME = "LIS3MDL"
    ADDRESSES = (0x1E, 0x1C)
    IDENTITIES = (0x3D,)
    SETTINGS = (
        (0x20, 0x7C),  # CTRL_REG1: x and y in ultra-high performance, 80 Hz
        (0x21, 0x00),  # CTRL_REG2: +-4 gauss
        (0x23, 0x0C),  # CTRL_REG4: z in ultra-high performance
        (0x24, 0x40),  # CTRL_REG5: no update between low and high byte
        (0x22, 0x00),  # CTRL_REG3: continuous conversion
    )

    def read_mag(self) -> bytes:
        """Return the six bytes of the magnetometer."""
        return self.bus.read(self.address, OUT_MAG | AUTO_INCREMENT, 6)

    def decode_mag(self, data: bytes) -> Vector:
        """Return the magnetic field in T, (n, 3)."""
        return decode_mag(data)
