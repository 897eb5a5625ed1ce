"""Both battery gauges: the data sheets' figures, and chips on the wire under unmodified smbus2."""

import pytest
from buddyline.node.config import NodeConfig, PowerConfig, SensorsConfig
from buddyline.node.drivers.ads1115 import Ads1115, decode_conversion_v
from buddyline.node.drivers.ina219 import Ina219, decode_bus_voltage_v, decode_shunt_voltage_v
from buddyline.node.drivers.registry import open_gauge
from buddyline.node.drivers.samples import DeviceError
from buddyline.node.power.watch import BatteryGauge

from tests.node.drivers.wire import Chip


class WordChip(Chip):
    """A chip of Texas Instruments: a pointer, and registers of 16 bits, the high byte first."""

    def __init__(self, resets, read_only):
        super().__init__()
        self.resets, self.read_only = resets, read_only
        self.reset()

    def reset(self):
        self.words, self.pointer = dict(self.resets), 0

    def write(self, data):
        self.pointer = data[0]
        assert len(data) in (1, 3)
        if len(data) == 3 and self.pointer not in self.read_only:
            self.words[self.pointer] = int.from_bytes(data[1:], "big")

    def read(self, n):
        return self.value(self.pointer).to_bytes(2, "big")[:n].ljust(n, b"\xff")

    def value(self, register):
        return self.words[register]


class Ina219Wire(WordChip):
    """It measures only in a continuous mode; bus_v and shunt_v are what is at its pins."""

    def __init__(self, bus_v, shunt_v):
        super().__init__({0x00: 0x399F, 0x01: 0, 0x02: 0, 0x03: 0, 0x04: 0, 0x05: 0}, {0x01, 0x02, 0x03, 0x04})
        self.bus_v, self.shunt_v = bus_v, shunt_v

    def value(self, register):
        measures = self.words[0x00] & 7 == 7
        if register == 0x01 and measures:
            # The range of the gain setting clips it.
            full_v = 0.04 * 2 ** (self.words[0x00] >> 11 & 3)
            return round(max(-full_v, min(full_v, self.shunt_v)) / 10e-6) & 0xFFFF
        if register == 0x02 and measures:
            return round(self.bus_v / 4e-3) << 3 | 2
        return self.words[register]


class Ads1115Wire(WordChip):
    """It converts the input that the multiplexer names, with the range that the gain names."""

    RANGES_V = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256, 0.256, 0.256)

    def __init__(self, inputs_v):
        super().__init__({0x00: 0, 0x01: 0x8583, 0x02: 0x8000, 0x03: 0x7FFF}, {0x00})
        self.inputs_v = inputs_v

    def value(self, register):
        config = self.words[0x01]
        continuous = not config & 0x0100
        if register == 0x01:
            return config & 0x7FFF if continuous else config | 0x8000
        if register == 0x00 and continuous and config >> 14 & 1:
            counts = round(self.inputs_v[config >> 12 & 3] / self.RANGES_V[config >> 9 & 7] * 32768)
            return max(-32768, min(32767, counts)) & 0xFFFF
        return self.words[register]


def test_the_data_sheets_figures_are_decoded():
    # SBOS448G, 8.6.3.1: the shunt voltage of -320 mV is 0x8300, of 320 mV 0x7D00; 8.6.3.2: 32 V is 0x1F40 << 3.
    assert decode_shunt_voltage_v(0x8300) == pytest.approx(-0.32)
    assert decode_shunt_voltage_v(0x7D00) == pytest.approx(0.32)
    assert decode_bus_voltage_v(0x1F40 << 3) == pytest.approx(32.0)
    # SBAS444D, 9.5.4: full scale is 0x7FFF and 0x8000, one step below zero 0xFFFF.
    assert decode_conversion_v(0x7FFF) == pytest.approx(4.096, abs=2e-4)
    assert decode_conversion_v(0x8000) == pytest.approx(-4.096)
    assert decode_conversion_v(0xFFFF) == pytest.approx(-125e-6)


@pytest.mark.parametrize("current_a", [0.0, 0.8, 2.9, -0.4])
def test_an_ina219_gives_voltage_and_current(bus, adapter, current_a):
    adapter.chips[0x41] = Ina219Wire(11.4, current_a * 0.1)
    chip = Ina219(bus, 0x41, 0.1)
    chip.start()
    sample = chip.read()
    assert sample.voltage_v == pytest.approx(11.4, abs=2e-3)
    assert sample.current_a == pytest.approx(current_a, abs=1e-4)


@pytest.mark.parametrize("channel", range(4))
def test_an_ads1115_gives_the_voltage_before_the_divider(bus, adapter, channel):
    adapter.chips[0x48] = Ads1115Wire([1.0 + i / 4 for i in range(4)])
    chip = Ads1115(bus, 0x48, channel, 11.0)
    chip.start()
    sample = chip.read()
    assert sample.voltage_v == pytest.approx(11.0 * (1.0 + channel / 4), abs=2e-3)
    assert sample.current_a is None


def test_an_input_over_the_range_is_no_reading(bus, adapter):
    adapter.chips[0x48] = Ads1115Wire([5.0, 0, 0, 0])
    chip = Ads1115(bus, 0x48, 0, 4.0)
    chip.start()
    with pytest.raises(DeviceError, match=r"address 0x48, register 0x00: .*over its range"):
        chip.read()


KINDS = {"ina219": (0x40, Ina219Wire(7.6, 0.05)), "ads1115": (0x48, Ads1115Wire([1.9, 0, 0, 0]))}


@pytest.fixture(params=KINDS)
def fitted(request, adapter):
    """A gauge on the wire, its chip, and its configuration."""
    address, chip = KINDS[request.param]
    chip.reset()
    chip.absent, chip.nacks, chip.hangs = False, 0, 0
    adapter.chips[address] = chip
    power = PowerConfig(battery=request.param, divider=4.0)
    return BatteryGauge(NodeConfig(node="a", sensors=SensorsConfig(name="none"), power=power)), chip, address


def test_each_gauge_is_read_by_its_name_in_the_configuration(fitted, adapter):
    gauge, _, _ = fitted
    gauge.look(0.0)
    gauge.look(1.0)
    assert gauge.sample is not None
    assert gauge.sample.voltage_v == pytest.approx(7.6, abs=2e-3)
    gauge.close()
    assert adapter.opened == 0


def test_a_chip_that_loses_its_settings_is_set_up_again_and_never_reads_zero(fitted):
    gauge, chip, address = fitted
    gauge.look(0.0)
    gauge.look(1.0)
    chip.reset()
    gauge.look(2.0)
    assert gauge.sample is None
    assert f"address 0x{address:02x}" in gauge.problem
    assert "has reset" in gauge.problem
    gauge.look(3.0)
    gauge.look(4.0)
    assert gauge.sample.voltage_v == pytest.approx(7.6, abs=2e-3)
    assert gauge.problem == ""
    gauge.close()


def test_a_chip_that_is_absent_or_hangs_is_named_and_found_later(fitted, adapter):
    gauge, chip, address = fitted
    chip.absent = True
    gauge.look(0.0)
    assert f"I2C bus 1, address 0x{address:02x}, register 0x0" in gauge.problem
    chip.absent, chip.hangs = False, 1
    gauge.look(2.5)
    assert "hangs" in gauge.problem
    gauge.look(5.0)
    gauge.look(6.0)
    assert gauge.problem == ""
    gauge.close()
    assert adapter.opened == 0


def test_a_bus_that_is_not_there_is_named(adapter):
    with pytest.raises(DeviceError, match="no /dev/i2c-7"):
        open_gauge(NodeConfig(node="a", sensors=SensorsConfig(i2c_bus=7), power=PowerConfig(battery="ina219")))
