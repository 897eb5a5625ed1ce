"""ADS1115, the voltage of a battery behind a divider (Texas Instruments, data sheet SBAS444D)."""

from __future__ import annotations

from typing import Final

from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.samples import BatterySample
from buddyline.node.drivers.ti_chip import TiChip, decode_signed

# 9.6.1, address pointer register.
CONVERSION: Final = 0x00

# 9.6.3: input against ground (MUX 1xx), +-4.096 V (PGA 001), continuous (MODE 0), 128 samples a second (DR 100),
# no comparator (COMP_QUE 11). After a reset: 0x8583.
SETTING: Final = 0x4283
INPUT_SHIFT: Final = 12
# Bit 15 (OS) starts a single conversion when written, and says whether one runs when read.
STATUS_BIT: Final = 0x8000
LSB_V: Final = 125e-6  # 9.3.3, full-scale range 4.096 V
FULL_SCALE: Final = 0x7FFF


def decode_conversion_v(word: int) -> float:
    """Return the voltage at the input of the conversion register (9.6.2): two's complement."""
    return decode_signed(word) * LSB_V


class Ads1115(TiChip):
    """One input of the chip. divider: battery's voltage over the input's; the input takes no more than the supply's."""

    NAME = "ADS1115"
    CONFIGURATION = 0x01
    STATUS_BITS = STATUS_BIT

    def __init__(self, bus: I2cBus, address: int, channel: int, divider: float) -> None:
        super().__init__(bus, address, SETTING | channel << INPUT_SHIFT)
        self._divider = divider

    def read(self) -> BatterySample:
        """Return the newest conversion; raise DeviceError if the chip does not answer, has reset, or is over range."""
        self._check_setting()
        word = self._word(CONVERSION)
        if word == FULL_SCALE:
            raise self._bus.error(self._address, CONVERSION, "ADS1115 is over its range of 4.096 V: check the divider")
        return BatterySample(decode_conversion_v(word) * self._divider)
