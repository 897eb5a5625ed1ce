"""INA219, voltage and current of a battery (Texas Instruments, data sheet SBOS448G)."""

from __future__ import annotations

from typing import Final

from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.samples import BatterySample
from buddyline.node.drivers.ti_chip import TiChip, decode_signed

# 8.6.1, register addresses.
SHUNT_VOLTAGE: Final = 0x01
BUS_VOLTAGE: Final = 0x02

# 8.6.2.1: 32 V, 320 mV across the shunt, means of 128 samples of both (68 ms), continuous. After a reset: 0x399F.
SETTING: Final = 0x3FFF
SHUNT_LSB_V: Final = 10e-6  # 8.6.3.1
BUS_LSB_V: Final = 4e-3  # 8.6.3.2


def decode_bus_voltage_v(word: int) -> float:
    """Return the voltage of the bus-voltage register: bits 15 to 3."""
    return (word >> 3) * BUS_LSB_V


def decode_shunt_voltage_v(word: int) -> float:
    """Return the voltage of the shunt-voltage register: two's complement."""
    return decode_signed(word) * SHUNT_LSB_V


class Ina219(TiChip):
    """The chip between battery and node. shunt_ohm: of its shunt; the breakout boards have 0.1 Ohm."""

    NAME = "INA219"
    CONFIGURATION = 0x00

    def __init__(self, bus: I2cBus, address: int, shunt_ohm: float) -> None:
        super().__init__(bus, address, SETTING)
        self._shunt_ohm = shunt_ohm

    def read(self) -> BatterySample:
        """Return the newest means; raise DeviceError if the chip does not answer, or has reset."""
        self._check_setting()
        voltage_v = decode_bus_voltage_v(self._word(BUS_VOLTAGE))
        current_a = decode_shunt_voltage_v(self._word(SHUNT_VOLTAGE)) / self._shunt_ohm
        return BatterySample(voltage_v, current_a)
