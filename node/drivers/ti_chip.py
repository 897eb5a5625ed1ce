"""Common parts of TI's gauges: registers of 16 bits, the high byte first, and one setting that is read back."""

from __future__ import annotations

from typing import ClassVar

from buddyline.node.drivers.i2c import I2cBus


def decode_signed(word: int) -> int:
    """Return the count of a register in two's complement."""
    return (word ^ 0x8000) - 0x8000


class TiChip:
    """One chip on a bus. setting: what its register CONFIGURATION is to hold, but for STATUS_BITS, which it changes."""

    NAME: ClassVar[str]
    CONFIGURATION: ClassVar[int]
    STATUS_BITS: ClassVar[int] = 0

    def __init__(self, bus: I2cBus, address: int, setting: int) -> None:
        self._bus = bus
        self._address = address
        self._setting = setting

    def start(self) -> None:
        """Write the setting and read it back."""
        self._bus.write(self._address, self.CONFIGURATION, *self._setting.to_bytes(2, "big"))
        self._check_setting()

    def _check_setting(self) -> None:
        """Raise DeviceError if the chip does not answer, or has lost its setting."""
        found = self._word(self.CONFIGURATION) & ~self.STATUS_BITS
        if found != self._setting:
            what = f"{self.NAME} has 0x{found:04x} in place of 0x{self._setting:04x}: it has reset, or is another chip"
            raise self._bus.error(self._address, self.CONFIGURATION, what)

    def _word(self, register: int) -> int:
        return int.from_bytes(self._bus.read(self._address, register, 2), "big")
