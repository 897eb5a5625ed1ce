"""Common parts of ST's inertial chips: identity, settings that are read back, six-byte vectors."""

from __future__ import annotations

from typing import ClassVar, Self

import numpy as np
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.samples import DeviceError, Vector

WHO_AM_I = 0x0F


def decode_vectors(data: bytes) -> Vector:
    """Return little-endian 16-bit counts as rows of three, (n, 3)."""
    return np.frombuffer(data, "<i2").reshape(-1, 3).astype(np.float64)


class StChip:
    """One chip on a bus.

    Subclasses give its identities, its possible addresses, and SETTINGS: (register, value) in the order of writing.
    """

    NAME: ClassVar[str]
    ADDRESSES: ClassVar[tuple[int, ...]]
    IDENTITIES: ClassVar[tuple[int, ...]]
    SETTINGS: ClassVar[tuple[tuple[int, int], ...]]

    def __init__(self, bus: I2cBus, address: int) -> None:
        self.bus = bus
        self.address = address

    @classmethod
    def find(cls, bus: I2cBus) -> Self | None:
        """Return the chip if one of its addresses answers with its identity, else None."""
        for address in cls.ADDRESSES:
            try:
                identity = bus.read(address, WHO_AM_I, 1)[0]
            except DeviceError:
                continue
            if identity in cls.IDENTITIES:
                return cls(bus, address)
        return None

    def start(self) -> None:
        """Check the identity, write the settings and read them back."""
        identity = self.bus.read(self.address, WHO_AM_I, 1)[0]
        if identity not in self.IDENTITIES:
            expected = " or ".join(f"0x{value:02x}" for value in self.IDENTITIES)
            raise self.bus.error(
                self.address,
                WHO_AM_I,
                f"answers 0x{identity:02x}, {self.NAME} would answer {expected}: name the chip that is there",
            )
        for register, value in self.SETTINGS:
            self.bus.write(self.address, register, value)
            kept = self.bus.read(self.address, register, 1)[0]
            if kept != value:
                raise self.bus.error(self.address, register, f"{self.NAME} kept 0x{kept:02x} in place of 0x{value:02x}")

    def check_setting(self, register: int, value: int) -> None:
        """Read one control register back; raise DeviceError if it differs from value."""
        found = self.bus.read(self.address, register, 1)[0]
        if found != value:
            what = f"{self.NAME} has reset: 0x{found:02x} in place of 0x{value:02x}"
            raise self.bus.error(self.address, register, what)

    def check_settings(self) -> None:
        """Read all control registers back; raise DeviceError if one has lost its value."""
        for register, value in self.SETTINGS:
            self.check_setting(register, value)
