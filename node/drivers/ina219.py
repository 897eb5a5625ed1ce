"""INA219, voltage and current of a battery (Texas Instruments, data sheet SBOS448G)."""

from __future__ import annotations

from typing import Final

from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.samples import BatterySample

# 8.6.1, register addresses.
CONFIGURATION: Final = 0x00
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
    return ((word ^ 0x8000) - 0x8000) * SHUNT_LSB_V


class Ina219:
    """The chip between battery and node. shunt_ohm: of its shunt; the breakout boards have 0.1 Ohm."""

    def __init__(self, bus: I2cBus, address: int, shunt_ohm: float) -> None:
        self._bus = bus
        self._address = address
        self._shunt_ohm = shunt_ohm

    def start(self) -> None:
        """Write the settings and read them back."""
        self._bus.write(self._address, CONFIGURATION, *SETTING.to_bytes(2, "big"))
        self._check()

    def read(self) -> BatterySample:
        """Return the newest means; raise DeviceError if the chip does not answer, or has reset."""
        self._check()
        voltage_v = decode_bus_voltage_v(self._word(BUS_VOLTAGE))
        current_a = decode_shunt_voltage_v(self._word(SHUNT_VOLTAGE)) / self._shunt_ohm
        return BatterySample(voltage_v, current_a)

    def _check(self) -> None:
        found = self._word(CONFIGURATION)
        if found != SETTING:
            what = f"INA219 has 0x{found:04x} in place of 0x{SETTING:04x}: it has reset, or is another chip"
            raise self._bus.error(self._address, CONFIGURATION, what)

    def _word(self, register: int) -> int:
        return int.from_bytes(self._bus.read(self._address, register, 2), "big")
