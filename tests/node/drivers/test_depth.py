"""Depth out of pressure, and the zero at the surface."""

from __future__ import annotations

import pytest
from buddyline.node.drivers.depth import STANDARD_AIR_PA, ZERO_SAMPLES, SurfaceZero, depth_m, load_zero, save_zero
from buddyline.node.drivers.samples import DepthSample


def feed(zero: SurfaceZero, pressures_pa: list[float]) -> list[bool]:
    return [zero.update(DepthSample(i * 50_000_000, p, 12.0)) for i, p in enumerate(pressures_pa)]


@pytest.mark.parametrize(("density", "depth"), [(997.0, 30.55), (1025.0, 29.71)])
def test_depth_of_the_datasheet_pressure(density, depth):
    assert depth_m(399_980.0, 399_980.0 - 298_660.0, density) == pytest.approx(depth, abs=0.005)


def test_depth_is_zero_at_the_surface_and_negative_above():
    assert depth_m(98_000.0, 98_000.0, 997.0) == 0.0
    assert depth_m(97_000.0, 98_000.0, 997.0) < 0.0


def test_zero_is_the_median_of_two_seconds_of_air():
    zero = SurfaceZero()
    told = feed(zero, [95_000.0 + (i % 3 - 1) * 20.0 for i in range(ZERO_SAMPLES - 1)] + [95_400.0] * 100)
    assert told.index(True) == ZERO_SAMPLES - 1
    assert all(told[ZERO_SAMPLES:])
    assert zero.measured
    assert zero.surface_pa == 95_000.0


def test_splashes_do_not_set_a_zero():
    zero = SurfaceZero()
    feed(zero, [101_000.0, 102_500.0] * 100)
    assert not zero.measured
    assert zero.surface_pa == STANDARD_AIR_PA


@pytest.mark.parametrize("under_m", [0.45, 0.7])
def test_a_start_under_water_gives_no_zero(under_m):
    """With air at 101.3 kPa, 0.7 m of water are 108.2 kPa: no air is that heavy."""
    zero = SurfaceZero()
    feed(zero, [STANDARD_AIR_PA + 997.0 * 9.80665 * under_m] * ZERO_SAMPLES)
    assert not zero.measured
    assert "not started in calm air" in zero.problem
    assert zero.sigma_m(0.0) > 0.25


def test_swell_and_one_low_reading_leave_the_zero_alone():
    zero = SurfaceZero()
    feed(zero, [101_000.0] * ZERO_SAMPLES + [101_000.0, 98_000.0] * 50 + [100_000.0] * 100)
    assert zero.surface_pa == 101_000.0
    assert zero.problem == ""


def test_a_start_under_water_takes_standard_pressure_with_its_uncertainty():
    zero = SurfaceZero()
    feed(zero, [130_000.0] * 100)
    assert not zero.measured
    assert zero.sigma_m(3.0) > 0.25


@pytest.mark.parametrize(("pressure_pa", "surface_pa"), [(104_000.0, 101_000.0), (101_500.0, 101_500.0)])
def test_the_days_zero_survives_a_restart(pressure_pa, surface_pa):
    """A restart at 30 cm must not take that depth as the surface; a change of the weather may move the zero."""
    zero = SurfaceZero(remembered_pa=101_000.0)
    feed(zero, [pressure_pa] * ZERO_SAMPLES)
    assert zero.surface_pa == surface_pa
    assert zero.sigma_m(0.0) < 0.05


def test_sigma_grows_with_depth():
    zero = SurfaceZero()
    feed(zero, [101_000.0] * ZERO_SAMPLES)
    assert zero.sigma_m(0.0) < 0.04
    assert 0.08 < zero.sigma_m(30.0) < 0.12


HOUR_NS = 3600 * 10**9


def test_a_stored_zero_is_valid_for_half_a_day(tmp_path):
    path = tmp_path / "dives" / "a-surface.json"
    save_zero(path, 100 * HOUR_NS, 98_765.0)
    assert load_zero(path, 101 * HOUR_NS) == 98_765.0
    assert load_zero(path, 113 * HOUR_NS) is None
    assert load_zero(path, 99 * HOUR_NS) is None
    assert [p.name for p in path.parent.iterdir()] == ["a-surface.json"]


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"stamp_ns": 1}', '{"stamp_ns": 1, "surface_pa": 3e5}'])
def test_a_damaged_file_gives_no_zero(tmp_path, text):
    path = tmp_path / "zero.json"
    path.write_text(text)
    assert load_zero(path, 2) is None


def test_a_missing_file_gives_no_zero(tmp_path):
    assert load_zero(tmp_path / "zero.json", 2) is None
