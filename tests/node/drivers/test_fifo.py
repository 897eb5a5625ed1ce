"""FIFOs of chips whose clock is off: are the samples stamped as they were taken, and are lost ones noticed?"""

from __future__ import annotations

import re
from itertools import pairwise

import numpy as np
import pytest
from buddyline.node.drivers.fifo_clock import FifoClock
from buddyline.node.drivers.i2c import I2cBus
from buddyline.node.drivers.imu import ImuBoard
from buddyline.node.drivers.lsm6ds import PERIOD_S, TURN_NS
from buddyline.node.drivers.registry import open_imu
from buddyline.node.drivers.samples import DeviceError, ImuSample
from buddyline.protocol.clock import MS_NS, S_NS, ManualClock

from tests.node.drivers import wire
from tests.node.drivers.conftest import START_NS
from tests.node.drivers.wire import Adapter, Lsm6dsWire, Sky

IDENTITIES = {"LSM6DS33": 0x69, "LSM6DSO": 0x6C}
# The last two are those at which reads every 40 ms meet the same phases again and again.
RATE_ERRORS = (-0.03, -0.013, 0.0, 0.021, 0.03, 10.0 / 9.615 - 1.0, -0.0385)
LOCKED_S = 3.0


def stamp_errors_s(rate_error: float, drift: float, loaded: bool, seed: int, seconds: float = 60.0) -> np.ndarray:
    """Errors of FifoClock's stamps after LOCKED_S; drift: of the rate, a second."""
    rng = np.random.default_rng(seed)
    periods_s = PERIOD_S / (1 + rate_error + drift * np.arange(int(seconds * 115)) * PERIOD_S)
    taken_s = rng.uniform(0, PERIOD_S) + np.cumsum(periods_s) + rng.normal(0, 2e-6, len(periods_s))
    clock, read, errors_s, turn = FifoClock(PERIOD_S), 0, [], 0
    while turn * TURN_NS < (seconds - 1) * S_NS:
        turn += 1
        wake_s = (clock.wake_ns(START_NS + turn * TURN_NS) - START_NS) / 1e9 + rng.exponential(1e-3 if loaded else 1e-4)
        if loaded and rng.random() < 0.05:
            wake_s += rng.uniform(0, 0.03)
        took_s = 4e-4 + (rng.exponential(2e-4) if loaded else 0)
        level = int(np.searchsorted(taken_s, wake_s + rng.uniform(0.6, 1.0) * took_s))
        if level == read:
            continue
        before_ns = START_NS + round(1e9 * wake_s)
        stamps_ns = clock.stamps_ns(level - read, before_ns, before_ns + round(1e9 * took_s))
        errors_s.extend((np.array(stamps_ns) - START_NS) / 1e9 - taken_s[read:level])
        read = level
    assert clock.lost == 0
    assert clock.period_s == pytest.approx(periods_s[read], rel=1e-3)
    return np.array(errors_s)[taken_s[: len(errors_s)] > LOCKED_S]


@pytest.mark.parametrize("loaded", [False, True], ids=["quiet", "loaded"])
@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4])
@pytest.mark.parametrize("rate_error", RATE_ERRORS)
def test_stamps_are_true_to_a_millisecond(rate_error, drift, loaded):
    errors_s = np.concatenate([stamp_errors_s(rate_error, drift, loaded, seed) for seed in (1, 2)])
    assert np.median(abs(errors_s)) < 0.25e-3
    assert abs(errors_s).max() < 1e-3


def test_sigma_is_the_error_s():
    """From the first reading on: the error of the newest sample, in its own standard deviations."""
    rng, ratios = np.random.default_rng(5), []
    for _ in range(300):
        rate_error, phase_s = rng.normal(0, 0.02), rng.uniform(0, PERIOD_S)
        period_s = PERIOD_S / (1 + rate_error)
        clock, read = FifoClock(PERIOD_S), 0
        for turn in range(1, 26):
            wake_ns = clock.wake_ns(START_NS + turn * TURN_NS) + int(rng.exponential(1e5))
            level = int(((wake_ns - START_NS) / 1e9 - phase_s) // period_s) + 1
            if level > read:
                newest_ns = clock.stamps_ns(level - read, wake_ns, wake_ns)[-1]
                read = level
                true_s = phase_s + (level - 1) * period_s
                ratios.append(((newest_ns - START_NS) / 1e9 - true_s) / clock.sigma_s)
    assert 0.3 < np.mean(np.square(ratios)) < 1.5
    assert np.mean(np.abs(ratios) > 3.0) < 0.01


def opened(adapter: Adapter, bus: I2cBus, name: str, rate_error: float = 0.0) -> tuple[ImuBoard, Lsm6dsWire]:
    chip = wire.lsm6ds(Sky(), IDENTITIES[name], adapter.clock, rate_error)
    adapter.chips[0x6B] = chip
    device = open_imu(bus, "lsm6ds", clock=adapter.clock)
    assert isinstance(device, ImuBoard)
    return device, chip


def run(device: ImuBoard, clock: ManualClock, seconds: float) -> tuple[list[ImuSample], list[str]]:
    """Read as the loop does; give the samples and what went wrong."""
    samples: list[ImuSample] = []
    errors: list[str] = []
    until_ns, next_ns = clock.now_ns() + round(seconds * S_NS), clock.now_ns()
    while clock.now_ns() < until_ns:
        next_ns += device.turn_ns
        clock.set_ns(max(clock.now_ns(), device.wake_ns(next_ns)))
        try:
            samples += device.decode(device.fetch())
        except DeviceError as error:
            errors.append(str(error))
    return samples, errors


@pytest.fixture(params=IDENTITIES)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.mark.parametrize("rate_error", [-0.03, 0.0, 0.03])
def test_every_sample_comes_once_and_is_stamped_as_it_was_taken(name, rate_error, monkeypatch, clock):
    """Over a bus of 100 kHz, whose transfers take their time."""
    adapter = Adapter(clock, bit_hz=100_000)
    adapter.attach(monkeypatch)
    with I2cBus(1) as bus:
        device, chip = opened(adapter, bus, name, rate_error)
        samples, errors = run(device, clock, 20.0)
    assert set(errors) <= {f"{name}: starts, no reading yet"}
    assert len(samples) == pytest.approx(20 * 104 * (1 + rate_error), abs=15)
    off_ns = np.array([sample.stamp_ns for sample in samples]) - chip.taken_ns[: len(samples)]
    assert abs(off_ns[200:]).max() < MS_NS
    assert np.median(abs(off_ns[200:])) < 0.4 * MS_NS
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(samples))
    assert all(clock.now_ns() >= sample.stamp_ns for sample in samples[-5:])


def test_a_late_reading_loses_nothing(name, adapter, bus, clock):
    device, chip = opened(adapter, bus, name, 0.02)
    before, _ = run(device, clock, 3.0)
    clock.set_ns(clock.now_ns() + S_NS)
    after, errors = run(device, clock, 1.0)
    stamps_ns = [sample.stamp_ns for sample in before + after]
    assert errors == []
    assert len(stamps_ns) == len(chip.taken_ns)
    assert abs(np.array(stamps_ns) - chip.taken_ns)[200:].max() < MS_NS
    assert device.problem == ""


def test_a_fifo_that_runs_over_is_noticed_counted_and_in_step_again(name, adapter, bus, clock):
    device, chip = opened(adapter, bus, name, -0.03)
    before, _ = run(device, clock, 3.0)
    clock.set_ns(clock.now_ns() + 9 * S_NS)
    after, errors = run(device, clock, 1.5)
    assert errors == []
    lost = len(chip.taken_ns) - len(before) - len(after)
    assert lost > 800
    told = re.fullmatch(r"read too late: (\d+) samples lost so far", device.problem)
    assert told is not None
    assert int(told[1]) == pytest.approx(lost, abs=1)
    assert np.array([sample.stamp_ns for sample in after[100:]]) == pytest.approx(
        np.array(chip.taken_ns[-len(after) :][100:]), abs=MS_NS, rel=0
    )
    run(device, clock, 2.0)
    assert device.problem == ""


def test_a_fifo_out_of_order_is_set_up_again(name, adapter, bus, clock):
    device, chip = opened(adapter, bus, name)
    run(device, clock, 1.0)
    word = 7 if name == "LSM6DSO" else 2
    clock.set_ns(clock.now_ns() + 60 * MS_NS)
    chip.read(0)
    del chip._fifo[:word]
    chip._taken_bytes += word
    samples, errors = run(device, clock, 1.0)
    assert "out of order" in errors[0]
    assert all(np.linalg.norm(sample.accel_mps2) == pytest.approx(9.8, abs=0.02) for sample in samples)
    assert len(samples) > 80


def test_a_chip_that_gives_no_more_samples_is_named_and_set_up_again(name, adapter, bus, clock):
    device, chip = opened(adapter, bus, name)
    run(device, clock, 1.0)
    chip.stopped = True
    _, errors = run(device, clock, 1.0)
    assert any("the chip has stopped" in error for error in errors)
    chip.stopped = False
    samples, _ = run(device, clock, 1.0)
    assert len(samples) > 80


@pytest.mark.parametrize("step_s", [-3600.0, -0.5, 0.5, 3600.0])
def test_stamps_follow_a_clock_that_is_set(name, adapter, bus, clock, step_s):
    """The chip's own time goes on."""
    device, chip = opened(adapter, bus, name)
    chip.clock = ManualClock(clock.now_ns())
    for number in range(100):
        for each in (clock, chip.clock):
            each.set_ns(each.now_ns() + TURN_NS)
        if number == 50:
            clock.set_ns(clock.now_ns() + round(step_s * S_NS))
        try:
            samples = list(device.decode(device.fetch()))
        except DeviceError:
            samples = []
        if samples and not 50 <= number < 55:
            assert all(-MS_NS < clock.now_ns() - sample.stamp_ns < 60 * MS_NS for sample in samples)
