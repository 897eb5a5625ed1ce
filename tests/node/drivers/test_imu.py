"""Inertial units over chips on the wire: one contract for all of them, then what each decodes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buddyline.node.drivers import l3gd20h, lis3mdl, lsm6ds, lsm303d
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.imu import Lsm6dsOnlyBoard, MinImu9V3, MinImu9V5, MinImu9V6
from buddyline.node.drivers.ms5837 import Ms5837
from buddyline.node.drivers.registry import open_depth, open_imu
from buddyline.node.drivers.samples import DeviceError, ImuDevice, ImuSample, SettlingError
from buddyline.node.drivers.watch import FROZEN_READINGS, SETTLING_NS
from buddyline.protocol.clock import MS_NS, S_NS, ManualClock
from buddyline.protocol.errors import BuddylineError

from tests.node.drivers import wire
from tests.node.drivers.wire import Adapter, Sky, StWire

UNITS = ("minimu9_v3", "minimu9_v5", "minimu9_v6", "lsm6ds")


def plug(adapter: Adapter, name: str, sky: Sky) -> dict[int, StWire]:
    clock = adapter.clock
    chips = {
        "minimu9_v3": lambda: {0x1D: wire.lsm303d(sky), 0x6B: wire.l3gd20h(sky)},
        "minimu9_v5": lambda: {0x6B: wire.lsm6ds(sky, 0x69, clock), 0x1E: wire.lis3mdl(sky)},
        "minimu9_v6": lambda: {0x6B: wire.lsm6ds(sky, 0x6C, clock), 0x1E: wire.lis3mdl(sky)},
        "lsm6ds": lambda: {0x6A: wire.lsm6ds(sky, 0x6C, clock)},
    }[name]()
    adapter.chips.update(chips)
    return chips


def turn(device: ImuDevice, clock: ManualClock) -> list[ImuSample]:
    """Give what the next turn of the loop reads."""
    clock.set_ns(clock.now_ns() + device.turn_ns)
    return list(device.decode(device.fetch()))


def read(device: ImuDevice, clock: ManualClock) -> ImuSample:
    """Give the newest sample of the next turn that has one; a chip that starts is waited for."""
    for _ in range(20):
        try:
            samples = turn(device, clock)
        except SettlingError:
            continue
        if samples:
            return samples[-1]
    raise AssertionError("no sample")


def test_vectors_are_little_endian_and_signed(bus):
    data = bytes([0x00, 0x40, 0xFF, 0xFF, 0x00, 0x80])
    g = 9.80665
    assert lsm303d.decode_accel(data)[0] == pytest.approx(np.array([16384, -1, -32768]) * 0.122e-3 * g)
    assert lsm303d.decode_mag(data)[0] == pytest.approx(np.array([16384, -1, -32768]) * 0.160e-7)
    assert l3gd20h.decode_gyro(data)[0] == pytest.approx(np.radians(np.array([16384, -1, -32768]) * 17.5e-3))
    assert lis3mdl.decode_mag(data)[0] == pytest.approx(np.array([16384, -1, -32768]) / 6842 * 1e-4)
    rows = lsm6ds.Lsm6dso(bus, 0x6B).decode(bytes([0, 1, *2 * (1, 0, 2, 0, 3, 0, *data)]))
    (accel, again), (gyro, _), temperature_degc = rows
    assert temperature_degc == 26.0
    assert again == pytest.approx(accel)
    assert accel == pytest.approx(np.array([16384, -1, -32768]) * 0.122e-3 * g)
    assert gyro == pytest.approx(np.radians(np.array([1, 2, 3]) * 17.5e-3))


@pytest.fixture(params=UNITS)
def unit(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def sky() -> Sky:
    return Sky()


def test_auto_finds_each_unit(unit, adapter, bus, clock, sky):
    plug(adapter, unit, sky)
    device = open_imu(bus, "auto", clock=clock)
    assert device.name == ("minimu9_v6" if unit == "lsm6ds" else unit)
    assert open_imu(bus, unit, clock=clock).name == unit


@pytest.mark.parametrize("choice", ["auto", "named"])
@pytest.mark.parametrize("name", ["minimu9_v5", "minimu9_v6"])
def test_a_magnetometer_that_is_silent_at_the_start_is_named_and_found_later(name, choice, adapter, bus, clock, sky):
    chips = plug(adapter, name, sky)
    chips[0x1E].absent = True
    device = open_imu(bus, "auto" if choice == "auto" else name, clock=clock)
    for _ in range(5):
        assert read(device, clock).mag_t is None
        assert "no magnetometer" in device.problem
        assert "address 0x1e" in device.problem
        clock.set_ns(clock.now_ns() + 10 * MS_NS)
    chips[0x1E].absent = False
    clock.set_ns(clock.now_ns() + S_NS)
    assert read(device, clock).mag_t is not None
    assert device.problem == ""


def test_a_board_named_without_a_magnetometer_has_no_problem(adapter, bus, clock, sky):
    plug(adapter, "lsm6ds", sky)
    device = open_imu(bus, "lsm6ds", clock=clock)
    assert read(device, clock).mag_t is None
    assert device.problem == ""


def test_a_sample_is_in_si_units_and_stamped(unit, adapter, bus, clock, sky):
    sky.gyro = (1000, -2000, 3000)
    plug(adapter, unit, sky)
    device = open_imu(bus, unit, clock=clock)
    clock.set_ns(clock.now_ns() + S_NS)
    sample = read(device, clock)
    assert 0 <= clock.now_ns() - sample.stamp_ns <= (0 if unit == "minimu9_v3" else S_NS // 104)
    assert np.linalg.norm(sample.accel_mps2) == pytest.approx(9.80, abs=0.01)
    assert sample.accel_mps2[2] < 0
    assert np.degrees(sample.gyro_radps) == pytest.approx([17.5, -35.0, 52.5], abs=0.05)
    if unit == "lsm6ds":
        assert sample.mag_t is None
    else:
        assert 15e-6 < np.linalg.norm(sample.mag_t) < 60e-6
    assert device.problem == ""


def test_the_mount_turns_all_three_vectors(unit, adapter, bus, clock, sky):
    """Board's x forward, y left, z up, in a body of x forward, y right, z down."""
    sky.noisy = False
    sky.accel, sky.gyro, sky.mag = (0, 100, 16384), (0, 1000, 0), (1000, 500, 0)
    plug(adapter, unit, sky)
    sample = read(open_imu(bus, unit, np.diag([1.0, -1.0, -1.0]), clock), clock)
    assert sample.accel_mps2[2] < -9.7
    assert sample.gyro_radps[1] == pytest.approx(-math.radians(17.5))
    if sample.mag_t is not None:
        assert sample.mag_t[1] / sample.mag_t[0] == pytest.approx(-0.5)


@pytest.mark.parametrize("R", [np.eye(2), np.diag([1.0, 1.0, -1.0]), np.eye(3) * 2])
def test_a_mount_that_is_no_rotation_is_refused(R, adapter, bus, clock, sky):
    plug(adapter, "minimu9_v6", sky)
    with pytest.raises(BuddylineError, match="mount"):
        open_imu(bus, "auto", R, clock)


def test_an_empty_bus_is_an_error_that_names_the_units(adapter, bus, clock):
    with pytest.raises(DeviceError, match=r"bus 1: no minimu9_v3 or .*minimu9_v6 answers.*i2cdetect"):
        open_imu(bus, "auto", clock=clock)


def test_a_wrong_identity_is_not_taken_for_the_chip(adapter, bus, clock, sky):
    plug(adapter, "minimu9_v5", sky)
    adapter.chips[0x6B].registers[0x0F] = 0x6A  # an LSM6DSL
    for name in ("minimu9_v5", "auto"):
        with pytest.raises(DeviceError, match="answers"):
            open_imu(bus, name, clock=clock)


def test_unknown_names_are_refused_with_the_known_ones(bus, clock):
    with pytest.raises(BuddylineError, match="minimu9_v6"):
        open_imu(bus, "mpu6050", clock=clock)
    with pytest.raises(BuddylineError, match="ms5837_02ba"):
        open_depth(bus, "bar100", clock)


def test_a_setting_that_does_not_stick_is_named(adapter, bus, clock, sky):
    chips = plug(adapter, "minimu9_v6", sky)
    chip = chips[0x6B]

    class Stubborn(dict):
        def __setitem__(self, register, value):
            super().__setitem__(register, 0x00 if register == 0x11 else value)

    chip.registers = Stubborn(chip.registers)
    with pytest.raises(DeviceError, match=r"address 0x6b, register 0x11: .*kept 0x00 in place of 0x54"):
        open_imu(bus, "minimu9_v6", clock=clock)


def test_a_brown_out_in_mid_dive_is_set_up_again(unit, adapter, bus, clock, sky):
    """The chip NACKs for a while, then is back with everything at its defaults: asleep."""
    chips = plug(adapter, unit, sky)
    device = open_imu(bus, unit, clock=clock)
    read(device, clock)
    for chip in chips.values():
        chip.absent = True
    for _ in range(5):
        with pytest.raises(DeviceError, match="no answer"):
            turn(device, clock)
    for chip in chips.values():
        chip.absent = False
        chip.power_cycle()
    clock.set_ns(clock.now_ns() + 2 * S_NS)
    sample = read(device, clock)
    assert np.linalg.norm(sample.accel_mps2) == pytest.approx(9.80, abs=0.01)
    assert (sample.mag_t is None) == (unit == "lsm6ds")


def test_an_unnoticed_brown_out_publishes_no_wrong_sample(unit, adapter, bus, clock, sky):
    chips = plug(adapter, unit, sky)
    device = open_imu(bus, unit, clock=clock)
    read(device, clock)
    for chip in chips.values():
        chip.power_cycle()
    good = 0
    for _ in range(60):
        clock.set_ns(clock.now_ns() + 30 * MS_NS)
        try:
            samples = turn(device, clock)
        except DeviceError:
            continue
        good += bool(samples)
        assert all(np.linalg.norm(sample.accel_mps2) > 9.0 for sample in samples)
    assert good > 50
    assert device.problem == ""


def stop_gyro(adapter: Adapter, unit: str) -> None:
    """Put the gyroscope to sleep, as a reset of it alone does, with zeros in its registers."""
    chip = adapter.chips[0x6A if unit == "lsm6ds" else 0x6B]
    if unit == "minimu9_v3":
        chip.power_cycle()
    else:
        chip.registers[0x11] = 0x00
        chip.registers.update((register, 0) for register in range(0x22, 0x28))


def test_a_gyroscope_that_resets_alone_is_set_up_again_and_its_zeros_are_not_published(unit, adapter, bus, clock, sky):
    sky.gyro = (300, -200, 100)
    plug(adapter, unit, sky)
    device = open_imu(bus, unit, clock=clock)
    read(device, clock)
    stop_gyro(adapter, unit)
    with pytest.raises(DeviceError, match="has reset"):
        turn(device, clock)
    for _ in range(50):
        assert read(device, clock).gyro_radps.any()


def test_a_setting_lost_without_zeros_is_found_within_a_second(unit, adapter, bus, clock, sky):
    """The accelerometer's range alone falls back to +-2 g: its readings are twice as large, and not zero."""
    chips = plug(adapter, unit, sky)
    device = open_imu(bus, unit, clock=clock)
    register, value = (0x21, 0xC0) if unit == "minimu9_v3" else (0x10, 0x50)
    chip = chips[{"minimu9_v3": 0x1D, "lsm6ds": 0x6A}.get(unit, 0x6B)]
    chip.registers[register] = value
    errors = []
    until_ns = clock.now_ns() + 1050 * MS_NS
    while clock.now_ns() < until_ns:
        try:
            sample = read(device, clock)
        except DeviceError as error:
            errors.append(str(error))
    assert len(errors) == 1
    assert f"register 0x{register:02x}" in errors[0]
    assert np.linalg.norm(sample.accel_mps2) == pytest.approx(9.80, abs=0.01)


def test_a_slowly_starting_chip_is_waited_for_and_publishes_no_zero(unit, adapter, bus, clock, sky):
    sky.silent = {"gyro"}
    plug(adapter, unit, sky)
    device = open_imu(bus, unit, clock=clock)
    for _ in range(200 * MS_NS // device.turn_ns):
        with pytest.raises(SettlingError, match="no reading yet"):
            turn(device, clock)
    sky.silent, sky.gyro = set(), (300, -200, 100)
    assert read(device, clock).gyro_radps.any()


def test_a_gyroscope_that_stays_at_zero_is_never_published(unit, adapter, bus, clock, sky):
    sky.silent = {"gyro"}
    plug(adapter, unit, sky)
    device = open_imu(bus, unit, clock=clock)
    clock.set_ns(clock.now_ns() + SETTLING_NS)
    said = set()
    for _ in range(100):
        with pytest.raises(DeviceError) as raised:
            turn(device, clock)
        said.add(str(raised.value))
    assert any("gyroscope: reads zero" in text for text in said)


def test_full_scale_is_flagged_and_three_g_is_within_it(unit, adapter, bus, clock, sky):
    sky.accel = (0, 0, -3 * 16384)
    plug(adapter, unit, sky)
    device = open_imu(bus, unit, clock=clock)
    sample = read(device, clock)
    assert sample.accel_mps2[2] == pytest.approx(-3 * 9.8, abs=0.1)
    assert not sample.saturated
    sky.accel, sky.gyro = (0, 0, -5 * 16384), (0, 40_000, 0)
    assert read(device, clock).saturated
    assert "accelerometer and gyroscope at full scale" in device.problem
    sky.accel, sky.gyro = (0, 0, -16384), (0, 0, 0)
    clock.set_ns(clock.now_ns() + S_NS)
    assert not read(device, clock).saturated
    assert "full scale" in device.problem
    clock.set_ns(clock.now_ns() + 2 * S_NS)
    read(device, clock)
    assert device.problem == ""


def test_the_anti_alias_filter_of_the_lsm303d_is_half_its_rate(adapter, bus, clock, sky):
    chips = plug(adapter, "minimu9_v3", sky)
    open_imu(bus, "minimu9_v3", clock=clock)
    assert chips[0x1D].registers[0x20] >> 4 == 0b0110  # 100 Hz
    assert chips[0x1D].registers[0x21] >> 6 == 0b11  # 50 Hz


def test_a_frozen_chip_is_noticed_and_set_up_again(unit, adapter, bus, clock, sky):
    sky.noisy, sky.gyro = False, (300, -200, 100)
    plug(adapter, unit, sky)
    device = open_imu(bus, unit, clock=clock)
    given, errors = [read(device, clock)], []
    while not errors:
        try:
            given += turn(device, clock)
        except DeviceError as error:
            errors.append(str(error))
    assert "stopped" in errors[0]
    assert len(given) <= FROZEN_READINGS
    sky.noisy = True
    for _ in range(FROZEN_READINGS * 3):
        read(device, clock)


@pytest.mark.parametrize("name", ["minimu9_v3", "minimu9_v5", "minimu9_v6"])
def test_a_frozen_magnetometer_is_named_and_gives_no_field_until_it_goes_on(name, adapter, bus, clock, sky):
    plug(adapter, name, sky)
    device = open_imu(bus, name, clock=clock)
    sky.frozen.add("mag")
    fields = [read(device, clock).mag_t for _ in range(3 * FROZEN_READINGS)]
    assert sum(field is not None for field in fields) == FROZEN_READINGS
    assert "the magnetometer gives the same reading again and again: it has stopped" in device.problem
    # Nor where it was started again, and still stands.
    clock.set_ns(clock.now_ns() + 2 * S_NS)
    assert read(device, clock).mag_t is None
    sky.frozen.clear()
    clock.set_ns(clock.now_ns() + 2 * S_NS)
    assert read(device, clock).mag_t is not None
    assert device.problem == ""


@pytest.mark.parametrize("name", ["minimu9_v5", "minimu9_v6"])
def test_without_its_magnetometer_the_rest_goes_on(name, adapter, bus, clock, sky):
    chips = plug(adapter, name, sky)
    device = open_imu(bus, name, clock=clock)
    chips[0x1E].absent = True
    transfers = []
    assert read(device, clock).mag_t is None
    for _ in range(S_NS // device.turn_ns):
        sample = read(device, clock)
        assert sample.mag_t is None
        assert "address 0x1e" in device.problem
        transfers.append(chips[0x1E].transfers)
    assert transfers[-2] == transfers[0]  # not asked at each reading
    chips[0x1E].absent = False
    chips[0x1E].power_cycle()
    clock.set_ns(clock.now_ns() + S_NS)
    assert read(device, clock).mag_t is not None
    assert device.problem == ""


@pytest.mark.parametrize(
    ("cls", "name"), [(MinImu9V3, "v3"), (MinImu9V5, "v5"), (MinImu9V6, "v6"), (Lsm6dsOnlyBoard, "six")]
)
def test_find_returns_none_on_an_empty_bus(cls, name, bus, clock):
    assert cls.find(name, bus, np.eye(3), clock) is None


@pytest.mark.parametrize(
    ("bit_hz", "unit_name"), [(100_000, "minimu9_v3"), (100_000, "minimu9_v6"), (400_000, "minimu9_v6")]
)
def test_100_hz_and_the_depth_fit_on_one_bus(clock, monkeypatch, sky, bit_hz, unit_name):
    """Wire time alone, at the Pi's default 100 kHz and at 400 kHz: no turn of the loop takes half of its time."""
    adapter = Adapter(clock, bit_hz=bit_hz)
    adapter.attach(monkeypatch)
    plug(adapter, unit_name, sky)
    adapter.chips[0x76] = wire.Ms5837Wire(clock, wire.WORDS_30BA, wire.D1_30BA, wire.D2_30BA)
    with I2cBus(1) as bus:
        imu, depth = open_imu(bus, "auto", clock=clock), Ms5837.open(bus, None, clock)
        read(imu, clock)
        start_ns, longest_ns, samples, depths = clock.now_ns(), 0, 0, 0
        for number in range(2 * S_NS // imu.turn_ns):
            clock.set_ns(max(clock.now_ns(), start_ns + number * imu.turn_ns))
            before_ns = clock.now_ns()
            samples += len(list(imu.decode(imu.fetch())))
            depths += depth.step(clock.now_ns()) is not None
            longest_ns = max(longest_ns, clock.now_ns() - before_ns)
    assert longest_ns < imu.turn_ns // 2
    assert samples >= 200
    assert depths >= 38
    assert clock.now_ns() - start_ns < 2 * S_NS


def test_a_hanging_depth_sensor_delays_the_imu_once(bus, adapter, clock, sky):
    plug(adapter, "minimu9_v6", sky)
    chip = adapter.chips[0x76] = wire.Ms5837Wire(clock, wire.WORDS_30BA, wire.D1_30BA, wire.D2_30BA)
    imu, depth = open_imu(bus, clock=clock), Ms5837.open(bus, None, clock)
    read(imu, clock)
    chip.hangs = 1
    clock.set_ns(max(clock.now_ns(), depth.next_due_ns))
    with pytest.raises(DeviceError, match="hangs"):
        depth.step(clock.now_ns())
    stalled_ns = clock.now_ns()
    for _ in range(10):
        list(imu.decode(imu.fetch()))
        assert depth.step(clock.now_ns()) is None
    assert clock.now_ns() == stalled_ns
