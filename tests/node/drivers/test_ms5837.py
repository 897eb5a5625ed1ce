"""The pressure sensor: data sheet vectors, and a chip on the wire that fails in every way it can."""

from __future__ import annotations

from itertools import pairwise

import pytest
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.ms5837 import (
    RETRY_NS,
    Ms5837,
    compensate_02ba,
    compensate_30ba,
    crc4,
    decode_model,
    decode_prom,
    first_order_02ba,
    first_order_30ba,
    second_order_02ba,
    second_order_30ba,
)
from buddyline.node.drivers.samples import DepthSample, DeviceError
from buddyline.protocol.clock import MS_NS, S_NS, ManualClock
from buddyline.protocol.errors import BuddylineError

from tests.node.drivers.wire import D1_30BA, D2_30BA, WORDS_30BA, Adapter, Ms5837Wire

C_30BA = WORDS_30BA[1:]
C_02BA = (46372, 43981, 29059, 27842, 31553, 28165)
D1_02BA, D2_02BA = 6465444, 8077636


def with_crc(word0: int, c: tuple[int, ...]) -> tuple[int, ...]:
    words = (word0 & 0x0FFF, *c)
    return (words[0] | crc4(words) << 12, *c)


WORDS_02BA = with_crc(0x15 << 5, C_02BA)


@pytest.mark.parametrize(
    ("d2", "dT", "temp", "p1", "ti", "offi", "sensi", "temp2", "p2"),
    [
        (6815414, -5962, 1981, 39998, 0, 541, 225, 1981, 39998),
        (7500000, 678624, 4115, 41092, 6, 279576, 0, 4109, 41126),
        (6000000, -821376, -561, 38694, 235, 9838081, 4099200, -796, 38712),
        (5500000, -1321376, -2119, 37895, 609, 28131368, 12136494, -2728, 37827),
    ],
)
def test_30ba_matches_the_datasheet_examples(d2, dT, temp, p1, ti, offi, sensi, temp2, p2):
    terms = first_order_30ba(C_30BA, d2)
    assert (terms.dt, terms.temp) == (dT, temp)
    assert (D1_30BA * terms.sens >> 21) - terms.off >> 13 == p1
    assert second_order_30ba(terms) == (ti, offi, sensi)
    assert compensate_30ba(C_30BA, D1_30BA, d2) == (p2, temp2)


def test_30ba_datasheet_terms():
    """The sheet prints OFF as 2381326464, which its own P does not follow from."""
    terms = first_order_30ba(C_30BA, D2_30BA)
    assert (terms.off, terms.sens) == (2381323464, 1145816755)


def test_02ba_datasheet_vector():
    terms = first_order_02ba(C_02BA, D2_02BA)
    assert (terms.dt, terms.temp, terms.off, terms.sens) == (68, 2000, 5764707214, 3039050829)
    assert compensate_02ba(C_02BA, D1_02BA, D2_02BA) == (110002, 2000)


def test_02ba_second_order_in_the_cold():
    """D2 chosen for dT = -800000; terms worked out by hand from the data sheet's flow chart."""
    terms = first_order_02ba(C_02BA, 31553 * 256 - 800_000)
    assert terms.temp == 2000 - 2687
    t = terms.temp - 2000
    assert second_order_02ba(terms) == (
        int(11 * 6.4e11 / 2**35),
        31 * t * t // 8,
        63 * t * t // 32,
    )


def test_pressure_does_not_jump_where_the_orders_meet():
    c = C_30BA
    for temp in (2000, -1500):
        d2 = (c[4] << 8) + (temp - 2000) * 2**23 // c[5]
        pressures = [compensate_30ba(c, D1_30BA, d2 + i)[0] for i in range(-500, 500, 10)]
        assert max(abs(b - a) for a, b in pairwise(pressures)) <= 2


def test_crc_matches_the_datasheet_example():
    assert crc4(WORDS_30BA) == 9
    assert decode_prom(WORDS_30BA) == C_30BA


@pytest.mark.parametrize("word", range(7))
@pytest.mark.parametrize("bit", [0, 7, 11])
def test_crc_finds_each_flipped_bit(word: int, bit: int):
    words = list(WORDS_30BA)
    words[word] ^= 1 << bit
    with pytest.raises(BuddylineError, match="checksum"):
        decode_prom(words)


def test_a_prom_of_zeros_is_refused():
    with pytest.raises(BuddylineError, match="checksum"):
        decode_prom([0] * 7)


@pytest.mark.parametrize(
    ("kind", "c1", "model"),
    [(0x1A, 34982, "30ba"), (0x00, 34982, "30ba"), (0x15, 46372, "02ba"), (0x00, 46372, "02ba"), (0x7F, 46372, "02ba")],
)
def test_the_model_follows_from_type_and_sensitivity(kind, c1, model):
    assert decode_model((kind << 5, c1, 0, 0, 0, 0, 0)) == model


@pytest.mark.parametrize(("kind", "c1"), [(0x1A, 46372), (0x15, 34982), (0x1A, 12000), (0x00, 60000)])
def test_an_unclear_model_is_refused(kind, c1):
    with pytest.raises(BuddylineError, match="name the depth sensor"):
        decode_model((kind << 5, c1, 0, 0, 0, 0, 0))


@pytest.fixture
def chip(adapter: Adapter, clock: ManualClock) -> Ms5837Wire:
    chip = Ms5837Wire(clock, WORDS_30BA, D1_30BA, D2_30BA)
    adapter.chips[0x76] = chip
    return chip


def run(device: Ms5837, clock: ManualClock, seconds: float, tick_ns: int = 10 * MS_NS):
    """Step at the IMU's pace; return samples and errors."""
    samples: list[DepthSample] = []
    errors: list[str] = []
    end_ns = clock.now_ns() + int(seconds * S_NS)
    while clock.now_ns() < end_ns:
        try:
            sample = device.step(clock.now_ns())
        except DeviceError as error:
            errors.append(str(error))
            sample = None
        if sample is not None:
            samples.append(sample)
        clock.set_ns(clock.now_ns() + tick_ns)
    return samples, errors


@pytest.mark.parametrize("tick_ns", [10 * MS_NS, 40 * MS_NS])
def test_samples_come_at_20_hz_between_imu_readings(bus: I2cBus, chip: Ms5837Wire, clock: ManualClock, tick_ns: int):
    device = Ms5837.open(bus, None, clock)
    assert device.name == "ms5837_30ba"
    start_ns = clock.now_ns()
    samples, errors = run(device, clock, 2.0, tick_ns)
    assert errors == []
    assert 38 <= len(samples) <= 40
    assert all(sample.pressure_pa == 399980.0 and sample.temperature_degc == 19.81 for sample in samples)
    stamps = [sample.stamp_ns for sample in samples]
    assert stamps[0] == start_ns + 49_040_000  # after a temperature
    assert [b - a for a, b in pairwise(stamps[:9])] == [step_ms * MS_NS for step_ms in (40, 40, 40, 80) * 2]


def test_the_temperature_is_converted_for_every_fourth_pressure(bus: I2cBus, chip: Ms5837Wire, clock: ManualClock):
    device = Ms5837.open(bus, None, clock)
    temperatures = []
    before = chip.conversions
    while len(temperatures) < 12:
        clock.set_ns(device.next_due_ns)
        sample = device.step(clock.now_ns())
        if sample is not None:
            temperatures.append(sample.temperature_degc)
            chip.d2 = D2_30BA + (100_000 if len(temperatures) > 4 else 0)
    assert chip.conversions - before == 12 + 3
    assert temperatures[:5] == [19.81] * 5
    assert len(set(temperatures[5:8])) == 1
    assert temperatures[8] > 22.0


def test_no_step_waits(bus: I2cBus, chip: Ms5837Wire, clock: ManualClock):
    """Waiting is the caller's: a step that slept would move the manual clock."""
    device = Ms5837.open(bus, None, clock)
    for _ in range(20):
        before_ns = clock.now_ns()
        device.step(before_ns)
        assert clock.now_ns() == before_ns
        clock.set_ns(max(before_ns + 1, device.next_due_ns))


def test_bar02_uses_its_own_arithmetic(bus: I2cBus, adapter: Adapter, clock: ManualClock):
    adapter.chips[0x76] = Ms5837Wire(clock, WORDS_02BA, D1_02BA, D2_02BA)
    device = Ms5837.open(bus, None, clock)
    samples, _ = run(device, clock, 0.2)
    assert device.name == "ms5837_02ba"
    assert samples[0].pressure_pa == 110002.0
    assert samples[0].temperature_degc == 20.0


def test_a_named_model_overrules_the_prom(bus: I2cBus, adapter: Adapter, clock: ManualClock):
    adapter.chips[0x76] = Ms5837Wire(clock, with_crc(0x15 << 5, C_30BA), D1_30BA, D2_30BA)
    with pytest.raises(DeviceError, match=r"address 0x76, register 0xa0: .*name the depth sensor"):
        Ms5837.open(bus, None, clock)
    samples, _ = run(Ms5837.open(bus, "30ba", clock), clock, 0.2)
    assert samples[0].pressure_pa == 399980.0


def test_a_bad_checksum_is_refused_at_start(bus: I2cBus, chip: Ms5837Wire, clock: ManualClock):
    chip.words[3] ^= 1
    with pytest.raises(DeviceError, match=r"bus 1, address 0x76, register 0xa0: .*checksum"):
        Ms5837.open(bus, None, clock)


def test_an_absent_chip_is_refused_at_start(bus: I2cBus, clock: ManualClock):
    with pytest.raises(DeviceError, match="address 0x76, register 0x1e: no answer"):
        Ms5837.open(bus, None, clock)


def test_a_chip_that_disappears_and_returns_is_read_again(bus: I2cBus, chip: Ms5837Wire, clock: ManualClock):
    device = Ms5837.open(bus, None, clock)
    run(device, clock, 0.5)
    chip.absent = True
    samples, errors = run(device, clock, 1.0)
    assert samples == []
    assert 1 <= len(errors) <= S_NS // RETRY_NS + 1
    chip.absent = False
    samples, errors = run(device, clock, 1.0)
    assert errors == []
    assert len(samples) >= 14
    assert chip.resets == 2


@pytest.mark.parametrize("nacks", [1, 2, 3])
def test_single_nacks_in_mid_dive_cost_at_most_a_sample(bus, chip, clock, nacks):
    device = Ms5837.open(bus, None, clock)
    run(device, clock, 0.5)
    chip.nacks = nacks
    samples, errors = run(device, clock, 1.0)
    assert len(errors) == (1 if nacks == 3 else 0)
    assert len(samples) >= 14
    assert all(sample.pressure_pa == 399980.0 for sample in samples)


def test_a_raw_zero_is_an_error_and_never_a_depth(bus: I2cBus, chip: Ms5837Wire, clock: ManualClock):
    device = Ms5837.open(bus, None, clock)
    chip.d1 = 0
    samples, errors = run(device, clock, 0.5)
    assert samples == []
    assert errors
    assert all("register 0x00" in error and "read 0" in error for error in errors)


def test_a_reading_out_of_range_is_an_error(bus: I2cBus, chip: Ms5837Wire, clock: ManualClock):
    device = Ms5837.open(bus, None, clock)
    chip.d1 = 0xFFFFFF
    samples, errors = run(device, clock, 0.3)
    assert samples == []
    assert "out of its range" in errors[0]


def test_a_hang_ends_and_the_sensor_goes_on(bus: I2cBus, chip: Ms5837Wire, clock: ManualClock):
    device = Ms5837.open(bus, None, clock)
    run(device, clock, 0.5)
    chip.hangs = 2
    _, errors = run(device, clock, 1.0)
    assert ["hangs" in error for error in errors] == [True, True]
    samples, errors = run(device, clock, 0.5)
    assert errors == []
    assert len(samples) >= 9


@pytest.mark.parametrize("step_s", [-1.0, -3600.0, 1.0])
@pytest.mark.parametrize("phase", range(6))
def test_a_clock_that_steps_leaves_no_gap_and_no_wrong_value(bus, chip, adapter, clock, step_s, phase):
    """The chip's own time goes on: only the node's clock steps."""
    chip.clock = ManualClock(clock.now_ns())
    device = Ms5837.open(bus, "30ba", chip.clock)
    offset_ns = 0
    samples: list[DepthSample] = []
    for tick in range(100):
        if tick == 20 + phase:
            offset_ns = int(step_s * S_NS)
        try:
            sample = device.step(chip.clock.now_ns() + offset_ns)
        except DeviceError:
            sample = None
        if sample is not None and tick > 45:
            samples.append(sample)
        chip.clock.set_ns(chip.clock.now_ns() + 10 * MS_NS)
    assert len(samples) >= 9
    assert all(sample.pressure_pa == 399980.0 for sample in samples)


@pytest.mark.parametrize("bit_hz", [100_000, 400_000])
def test_a_slow_bus_is_tolerated(bus: I2cBus, adapter: Adapter, chip: Ms5837Wire, clock, bit_hz):
    """The conversion begins when the command has gone out, which is after the reading before it."""
    adapter.bit_hz = bit_hz
    device = Ms5837.open(bus, None, clock)
    samples = []
    for _ in range(100):
        clock.set_ns(max(clock.now_ns(), device.next_due_ns))
        samples.append(device.step(clock.now_ns()))
    assert sum(sample is not None for sample in samples) >= 33
