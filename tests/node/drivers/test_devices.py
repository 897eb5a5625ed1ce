"""Sources over chips on the wire: messages, rates, and what happens when a chip or the clock misbehaves."""

from __future__ import annotations

import logging
import threading
from itertools import pairwise

import numpy as np
import pytest
from buddyline.node.attitude import VqfAttitude, attitudes
from buddyline.node.config import CalibrationConfig, NodeConfig, RecordConfig, SensorsConfig
from buddyline.node.drivers.devices import Metronome, open_sensors
from buddyline.node.drivers.ms5837 import compensate_30ba
from buddyline.node.drivers.registry import open_imu
from buddyline.node.geomagnetism import MagnetometerCalibration
from buddyline.protocol.clock import MS_NS, S_NS, ManualClock
from buddyline.protocol.codec import encode
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Attitude, CameraModel, Depth, Imu
from msgspec import UNSET

from tests.node.drivers import wire
from tests.node.drivers.wire import Adapter, Sky

NEVER = threading.Event()


def d1_for(pressure_pa: float) -> int:
    """Raw pressure of the data sheet's chip at its own temperature; found by bisection."""
    low, high = 1, 2**24 - 1
    while low < high:
        middle = (low + high) // 2
        if compensate_30ba(wire.WORDS_30BA[1:], middle, wire.D2_30BA)[0] * 10.0 < pressure_pa:
            low = middle + 1
        else:
            high = middle
    return low


@pytest.fixture
def sky() -> Sky:
    return Sky()


@pytest.fixture
def gauge(adapter: Adapter, clock: ManualClock) -> wire.Ms5837Wire:
    chip = wire.Ms5837Wire(clock, wire.WORDS_30BA, d1_for(101_000.0), wire.D2_30BA)
    adapter.chips[0x76] = chip
    return chip


@pytest.fixture
def board(adapter: Adapter, sky: Sky, clock: ManualClock) -> dict[int, wire.StWire]:
    chips = {0x6B: wire.lsm6ds(sky, 0x6C, clock), 0x1E: wire.lis3mdl(sky)}
    adapter.chips.update(chips)
    return chips


@pytest.fixture
def without_fifo(adapter: Adapter, sky: Sky) -> dict[int, wire.StWire]:
    """A board that is read sample by sample, five of which are decoded together."""
    chips = {0x1D: wire.lsm303d(sky), 0x6B: wire.l3gd20h(sky)}
    adapter.chips.update(chips)
    return chips


@pytest.fixture
def config(tmp_path) -> NodeConfig:
    return NodeConfig(
        node="a", sensors=SensorsConfig(name="i2c"), record=RecordConfig(directory=str(tmp_path / "dives"))
    )


def collect(source, clock: ManualClock, seconds: float) -> list:
    """Run a source until the clock has advanced by this time."""
    end_ns = clock.now_ns() + int(seconds * S_NS)
    messages: list = []
    while clock.now_ns() < end_ns:
        messages += source.next_messages(NEVER) or []
    return messages


pytest.importorskip("vqf", reason="vqf is not installed: make install EXTRAS=pi")


@pytest.mark.parametrize(("identity", "counts_per_degc"), [(0x69, 16), (0x6C, 256)])
def test_the_gyroscope_s_temperature_comes_once_a_second(config, clock, adapter, sky, identity, counts_per_degc):
    chip = wire.lsm6ds(sky, identity, clock)
    adapter.chips.update({0x6B: chip, 0x1E: wire.lis3mdl(sky)})
    imu, _depth = open_sensors(config, clock)
    collect(imu, clock, 0.1)
    chip.registers.update(enumerate((-12 * counts_per_degc).to_bytes(2, "little", signed=True), 0x20))
    samples = [m for m in collect(imu, clock, 4.0) if isinstance(m, Imu)]
    told = [m.temperature_degc for m in samples if m.temperature_degc is not UNSET]
    imu.close()
    assert len(told) == 4
    assert set(told[1:]) == {13.0}


def test_imu_at_104_hz_attitude_at_54_and_compass_at_25(config, clock, board, gauge):
    imu, depth = open_sensors(config, clock)
    messages = collect(imu, clock, 6.0)
    samples = [m for m in messages if isinstance(m, Imu)]
    attitudes = [m for m in messages if isinstance(m, Attitude)]
    assert 6 * 104 - 15 <= len(samples) <= 6 * 104
    steps_ns = np.diff([sample.stamp_ns for sample in samples])
    assert steps_ns == pytest.approx(S_NS / 104, rel=0.1)
    assert steps_ns[200:] == pytest.approx(S_NS / 104, rel=0.02)
    assert sum(m.mag_t is not UNSET for m in samples) == pytest.approx(6 * 25, abs=5)
    assert 150 < len(attitudes) < 200
    assert all(b.stamp_ns - a.stamp_ns <= 20 * MS_NS for a, b in pairwise(attitudes))
    assert attitudes[-1].stamp_ns == samples[-1].stamp_ns
    assert all(encode(m) for m in messages)
    assert imu.problem == ""
    x, y, _, _ = attitudes[-1].q_ned_body_xyzw  # level, as the sky's counts have it
    assert abs(x) + abs(y) < 0.02
    for source in (imu, depth):
        source.close()


def test_a_log_gives_the_recorded_attitudes_again(config, clock, board, gauge):
    imu, _ = open_sensors(config, clock)
    messages = collect(imu, clock, 6.0)
    imu.close()
    samples = [m for m in messages if isinstance(m, Imu)]
    recorded = [m for m in messages if isinstance(m, Attitude)]
    again = list(attitudes(samples, VqfAttitude(MagnetometerCalibration.none())))
    assert len(recorded) > len(again) / 2
    assert [one for one in again if one.stamp_ns in {told.stamp_ns for told in recorded}] == recorded


def test_depth_follows_once_the_surface_is_found(config, clock, board, gauge):
    imu, depth = open_sensors(config, clock)
    first = depth.next_messages(NEVER)[0]
    assert isinstance(first, Depth)
    assert abs(first.depth_m) < 0.02
    gauge.d1 = d1_for(101_000.0 + 997.0 * 9.80665 * 10.0)
    dived = collect(depth, clock, 2.0)
    assert 38 <= len(dived) <= 41
    assert dived[-1].depth_m == pytest.approx(10.0, abs=0.02)
    assert dived[-1].sigma_m < 0.06
    assert encode(dived[-1])
    imu.close()


def test_a_restart_under_water_keeps_the_days_surface(config, clock, board, gauge):
    imu, depth = open_sensors(config, clock)
    depth.next_messages(NEVER)
    imu.close()
    gauge.d1 = d1_for(101_000.0 + 997.0 * 9.80665 * 0.5)
    clock.set_ns(clock.now_ns() + 600 * S_NS)
    imu, depth = open_sensors(config, clock)
    again = depth.next_messages(NEVER)[0]
    assert again.depth_m == pytest.approx(0.5, abs=0.02)
    imu.close()


def test_a_disk_that_cannot_be_written_does_not_stop_the_depth(config, clock, board, gauge, monkeypatch, caplog):
    def refuse(*_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("buddyline.node.drivers.devices.save_zero", refuse)
    imu, depth = open_sensors(config, clock)
    with caplog.at_level(logging.WARNING):
        assert depth.next_messages(NEVER)
    assert "Read-only" in caplog.text
    imu.close()


def test_salt_water_is_denser(config, clock, board, gauge):
    salt = NodeConfig(
        node="a",
        sensors=SensorsConfig(name="i2c", water_density_kgpm3=1027.0),
        record=config.record,
    )
    imu, depth = open_sensors(salt, clock)
    depth.next_messages(NEVER)
    gauge.d1 = d1_for(101_000.0 + 1027.0 * 9.80665 * 10.0)
    assert collect(depth, clock, 0.5)[-1].depth_m == pytest.approx(10.0, abs=0.02)
    imu.close()


def test_chips_absent_at_the_start_are_named_and_found_later(config, clock, adapter, sky, caplog, monkeypatch):
    """They are looked for every two seconds only."""
    plugged = clock.now_ns() + 30 * S_NS
    tries = 0

    def find(*args: object) -> object:
        nonlocal tries
        tries += 1
        if clock.now_ns() > plugged and 0x6B not in adapter.chips:
            adapter.chips.update({0x6B: wire.lsm6ds(sky, 0x6C, clock), 0x1E: wire.lis3mdl(sky)})
        return open_imu(*args)

    monkeypatch.setattr("buddyline.node.drivers.devices.open_imu", find)
    imu, _ = open_sensors(config, clock)
    with caplog.at_level(logging.INFO):
        messages = imu.next_messages(NEVER)
    assert messages
    assert 15 <= tries <= 17
    assert caplog.text.count("answers") == 1
    assert "back to normal" in caplog.text
    assert imu.problem == ""
    imu.close()


def test_depth_comes_with_the_inertial_unit_s_block_and_no_later(config, clock, board, gauge):
    imu, depth = open_sensors(config, clock)
    collect(imu, clock, 3.0)
    depths, sample_ns, began_ns = [], [], clock.now_ns()
    while clock.now_ns() < began_ns + 2 * S_NS:
        for message in imu.next_messages(NEVER):
            late_ns = clock.now_ns() - message.stamp_ns
            if isinstance(message, Depth):
                depths.append(message)
                # Half a conversion, and for every fourth one the temperature's.
                assert late_ns < 45 * MS_NS
            elif isinstance(message, Imu):
                sample_ns.append(message.stamp_ns)
                assert late_ns < 50 * MS_NS
    assert depth.read_by == imu.name
    assert 39 <= len(depths) <= 41
    assert np.diff(sample_ns) == pytest.approx(S_NS / 104, rel=0.02)
    imu.close()


def test_each_sensor_goes_on_while_the_other_one_is_away(config, clock, board, gauge):
    imu, depth = open_sensors(config, clock)
    collect(imu, clock, 3.0)
    board[0x6B].absent = True
    alone = collect(imu, clock, 2.0)
    assert len(alone) == sum(isinstance(m, Depth) for m in alone) >= 38
    assert imu.problem
    assert not depth.problem
    board[0x6B].absent, gauge.absent = False, True
    collect(imu, clock, 0.1)
    alone = collect(imu, clock, 2.0)
    assert not any(isinstance(m, Depth) for m in alone)
    assert sum(isinstance(m, Imu) for m in alone) >= 199
    assert depth.problem
    assert not imu.problem
    imu.close()


def test_one_sensor_absent_leaves_the_other(config, clock, board):
    """Depth is looked for every two seconds, each time for a moment only."""
    imu, depth = open_sensors(config, clock)
    assert len(collect(imu, clock, 1.1)) >= 100
    stop = threading.Event()
    tries = 0

    def wait(instant_ns: int, event: threading.Event) -> bool:
        nonlocal tries
        tries += 1
        if tries == 5:
            stop.set()
        return event.is_set()

    clock.wait_until_ns = wait  # type: ignore[method-assign]
    assert depth.next_messages(stop) is None
    assert "0x76" in depth.problem
    imu.close()


def test_a_nack_in_mid_dive_is_named_until_it_is_over(config, clock, board, gauge, caplog):
    imu, _ = open_sensors(config, clock)
    collect(imu, clock, 1.0)
    board[0x6B].absent = True
    seen = []
    plain = clock.wait_until_ns

    def wait(instant_ns: int, event: threading.Event) -> bool:
        seen.append(imu.problem)
        if len(seen) == 20:
            board[0x6B].absent = False
            board[0x6B].power_cycle()
        return plain(instant_ns, event)

    clock.wait_until_ns = wait  # type: ignore[method-assign]
    with caplog.at_level(logging.INFO):
        messages = imu.next_messages(NEVER)
    assert messages
    assert any("address 0x6b" in problem for problem in seen)
    assert imu.problem == ""
    assert caplog.text.count("no answer") == 1
    imu.close()


def test_what_was_read_before_a_failure_or_the_end_is_not_lost(config, clock, without_fifo):
    alone = NodeConfig(node="a", sensors=SensorsConfig(name="i2c", depth="none"), record=config.record)
    (imu,) = open_sensors(alone, clock)
    stop = threading.Event()
    waits = 0
    plain = clock.wait_until_ns

    def wait(instant_ns: int, event: threading.Event) -> bool:
        nonlocal waits
        waits += 1
        without_fifo[0x6B].absent = 9 <= waits < 12
        if waits == 15:
            stop.set()
        return plain(instant_ns, event)

    clock.wait_until_ns = wait  # type: ignore[method-assign]
    blocks = [imu.next_messages(stop) for _ in range(4)]
    imu.close()
    assert [len(block or ()) for block in blocks] == [5, 3, 3, 0]
    stamps_ns = [message.stamp_ns for block in blocks for message in block or ()]
    assert [(b - a) // (10 * MS_NS) for a, b in pairwise(stamps_ns)] == [1] * 7 + [4, 1, 1]


def test_readings_after_a_lost_setting_are_not_published(config, clock, without_fifo):
    """The chip resets in mid-block: what it says from then on, in the same block, does not count."""
    imu, _ = open_sensors(config, clock)
    assert len(imu.next_messages(NEVER)) == 5
    waits = 0
    plain = clock.wait_until_ns

    def wait(instant_ns: int, event: threading.Event) -> bool:
        nonlocal waits
        waits += 1
        if waits == 3:
            without_fifo[0x6B].power_cycle()
        return plain(instant_ns, event)

    clock.wait_until_ns = wait  # type: ignore[method-assign]
    assert len(imu.next_messages(NEVER)) == 2
    assert imu.problem
    after = imu.next_messages(NEVER)
    assert all(np.linalg.norm(message.accel_mps2) == pytest.approx(9.8, abs=0.02) for message in after)
    assert imu.problem == ""
    imu.close()


def test_the_name_none_leaves_a_sensor_out(config, clock, adapter):
    only = NodeConfig(node="a", sensors=SensorsConfig(name="i2c", imu="none"), record=config.record)
    (depth,) = open_sensors(only, clock)
    assert depth.name == "depth"
    depth.close()
    assert adapter.opened == 0


@pytest.mark.parametrize("field", ["imu", "depth"])
def test_unknown_names_are_refused_at_start(config, clock, adapter, field):
    wrong = NodeConfig(node="a", sensors=SensorsConfig(name="i2c", **{field: "bno085"}), record=config.record)
    with pytest.raises(BuddylineError, match=f"sensors.{field} = 'bno085': known are auto"):
        open_sensors(wrong, clock)
    assert adapter.opened == 0


def test_a_bus_that_is_absent_at_the_start_is_named_and_opened_later(config, clock, adapter, board):
    adapter.open_error = PermissionError(13, "Permission denied")
    imu, depth = open_sensors(config, clock)
    said = []
    plain = clock.wait_until_ns

    def wait(instant_ns: int, event: threading.Event) -> bool:
        said.append(imu.problem)
        if len(said) == 6:
            adapter.open_error = None
        return plain(instant_ns, event)

    clock.wait_until_ns = wait  # type: ignore[method-assign]
    assert imu.next_messages(NEVER)
    assert any("group i2c" in text for text in said)
    assert imu.problem == ""
    depth.close()
    assert adapter.opened == 0


def test_a_zero_taken_under_water_is_noticed_and_corrected(config, clock, board, gauge):
    gauge.d1 = d1_for(101_000.0 + 997.0 * 9.80665 * 0.3)
    imu, depth = open_sensors(config, clock)
    assert abs(depth.next_messages(NEVER)[0].depth_m) < 0.02
    assert depth.problem == ""
    gauge.d1 = d1_for(101_000.0 + 997.0 * 9.80665 * 5.0)
    assert collect(depth, clock, 3.0)[-1].depth_m == pytest.approx(4.7, abs=0.02)
    gauge.d1 = d1_for(101_000.0)
    assert abs(collect(depth, clock, 4.0)[-1].depth_m) < 0.02
    assert "0.30 m too deep" in depth.problem
    imu.close()


def test_the_mount_comes_from_the_configuration(config, clock, board):
    upside_down = NodeConfig(
        node="a", sensors=SensorsConfig(name="i2c", mount_xyzw=(1.0, 0.0, 0.0, 0.0)), record=config.record
    )
    imu, _ = open_sensors(upside_down, clock)
    samples = [m for m in collect(imu, clock, 0.2) if isinstance(m, Imu)]
    assert all(sample.accel_mps2[2] > 9.7 for sample in samples)
    assert len(samples) >= 8
    imu.close()


def test_declination_comes_with_the_position(config, clock, adapter):
    pytest.importorskip("pygeomag", reason="pygeomag is not installed: make install EXTRAS=pi")
    calibration = CalibrationConfig(
        camera=CameraModel(model="pinhole", fx_px=600.0, fy_px=600.0, cx_px=410.0, cy_px=308.0, distortion=[0.0] * 5),
        light_left_m=(-0.44, 0.0, 0.0),
        light_right_m=(0.44, 0.0, 0.0),
        declination_rad=0.3,
    )
    here = NodeConfig(node="a", sensors=SensorsConfig(position_deg=(59.9, 10.75)), calibration=calibration)
    info = here.node_info(clock.now_ns(), "", "", 0)
    assert np.degrees(info.declination_rad) == pytest.approx(4.9, abs=0.5)
    plain = NodeConfig(node="a", calibration=calibration)
    assert plain.node_info(clock.now_ns(), "", "", 0).declination_rad == 0.3


@pytest.mark.parametrize("step_s", [-3600, -1, 1, 3600])
def test_the_metronome_goes_on_after_the_clock_is_set(clock, step_s):
    turn = Metronome(clock)
    for _ in range(5):
        turn.wait(NEVER, 10 * MS_NS)
    clock.set_ns(clock.now_ns() + step_s * S_NS)
    before_ns = clock.now_ns()
    for i in range(1, 6):
        turn.wait(NEVER, 10 * MS_NS)
        assert clock.now_ns() - before_ns <= i * 10 * MS_NS


def test_the_metronome_catches_up_and_does_not_drift(clock):
    turn = Metronome(clock)
    start_ns = clock.now_ns()
    for _ in range(100):
        turn.wait(NEVER, 10 * MS_NS)
        clock.set_ns(clock.now_ns() + 3 * MS_NS)
    assert clock.now_ns() - start_ns == 1003 * MS_NS
