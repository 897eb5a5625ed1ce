"""The fast part of inertial samples, and how much of it the lights say is the unit's alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.records import in_order, parted, pass_over
from buddyline.solver_service.track.strapdown import SampleGrid, integrate, moved_by_shares, propagate
from buddyline.solver_service.track.vibration import Shares, fast_part, sudden_turn

from tests.solver_service.track.dives import KnownDive, Setting, make, score
from tests.solver_service.track.test_track_jacobians import a_state, samples

STAMPS_NS = np.arange(2000) * 10_000_000
INNER = slice(200, -200)


def wave(hz: float) -> Floats:
    return np.sin(2.0 * np.pi * hz * STAMPS_NS * 1e-9)[:, None]


def test_slow_motion_has_no_fast_part_and_shaking_is_all_fast() -> None:
    assert np.abs(fast_part(STAMPS_NS, 5.0 + wave(0.5))[INNER]).max() < 0.01
    assert np.abs(fast_part(STAMPS_NS, wave(4.0)) - wave(4.0))[INNER].max() < 0.01


@pytest.mark.parametrize(("shaken_by", "parted"), [(0.0, False), (1.0, False), (3.0, True)])
def test_what_is_no_more_than_white_noise_is_left(shaken_by: float, parted: bool) -> None:
    """Shaking of variance shaken_by^2, the noise's being 1."""
    noise = np.random.default_rng(9).normal(0.0, 1.0, (len(STAMPS_NS), 3))
    values = 20.0 * wave(0.3) + noise + np.sqrt(2.0) * shaken_by * wave(4.0)
    assert bool(fast_part(STAMPS_NS, values).any()) is parted


def test_runs_on_both_sides_of_a_gap_are_parted_by_themselves() -> None:
    values = wave(0.4) + 0.1 * wave(5.0)
    keep = np.ones(len(values), dtype=bool)
    keep[900:960] = False
    parted = fast_part(STAMPS_NS[keep], values[keep])
    alone = fast_part(STAMPS_NS[:900], values[:900])
    assert np.array_equal(parted[:900], alone)
    assert not fast_part(STAMPS_NS[:200], values[:200]).any()
    assert not fast_part(np.zeros(5, np.int64), np.ones((5, 6))).any()


def test_a_sudden_turn_is_told_from_shaking_by_the_octave_below() -> None:
    """A head turned by 0.5 rad within 0.6 s, beside shaking of the unit alone."""
    t = STAMPS_NS * 1e-9
    turning = np.abs(t - 10.0) < 0.3
    turn = np.where(turning, 0.5 * np.pi / 1.2 * np.cos(np.pi * (t - 10.0) / 0.6), 0.0)[:, None] * np.ones(3)
    shaken = 0.02 * np.sqrt(2.0) * np.hstack((wave(2.5), wave(4.0), wave(7.0)))
    said = sudden_turn(STAMPS_NS, turn + shaken)
    lost = np.cumsum(fast_part(STAMPS_NS, turn), axis=0) * 0.01
    near = np.abs(t - 10.0) < 0.5
    assert 0.7 < np.sqrt((lost[near] ** 2).mean()) / np.sqrt((said[near] ** 2).mean()) < 1.5
    assert said[np.abs(t - 10.0) > 3.0][200:-200].max() < 0.02 * said.max()
    assert not sudden_turn(STAMPS_NS[:1], turn[:1]).any()
    assert not sudden_turn(np.zeros(5, np.int64), np.ones((5, 3))).any()


def test_shares_are_least_squares() -> None:
    rng = np.random.default_rng(5)
    truth = np.array((0.2, 0.9, 0.5, 0.7))
    shares = Shares()
    for _ in range(400):
        moved = rng.normal(0.0, 2.0, (4, 4))
        shares = shares.taught(moved @ truth + rng.normal(0.0, 0.7, 4), np.eye(4) / 0.49, moved)
    assert shares.best().ravel() == pytest.approx(truth, abs=0.05)
    assert not Shares().best().any()


@pytest.mark.parametrize("column", range(4))
def test_what_a_share_moves(column: int) -> None:
    state = a_state(3)
    rng = np.random.default_rng(8)
    fast = rng.normal(0.0, 0.1, (2, 41, 6))

    def after(share: float) -> tuple[object, Floats]:
        grid = np.linspace(0.0, 0.1, 41)
        values = np.empty((2, 41, 6))
        for node in (0, 1):
            t, force, turn = samples(node)
            values[node] = np.stack([np.interp(grid, t, of) for of in (*force.T, *turn.T)], axis=1)
        of_sensor = slice(3 * (column % 2), 3 * (column % 2) + 3)
        values[column // 2, :, of_sensor] -= share * fast[column // 2, :, of_sensor]
        told = np.ones((2, 40), dtype=bool)
        still = state.with_parts(lever_m=0.0)
        both = integrate(
            still, SampleGrid(np.stack((grid, grid)), values, told, values[:, -1, 3:], values[:, [0, -1], 3:], fast)
        )
        assert both.by_fast is not None
        moved, _ = propagate(still, both, 0.1)
        return moved, moved_by_shares(moved, both.by_fast)

    (more, _), (less, _), (middle, moved) = after(1e-3), after(-1e-3), after(0.0)
    numeric = (more.minus(middle) - less.minus(middle)) / 2e-3  # type: ignore[attr-defined]
    assert moved[:, column] == pytest.approx(numeric[: len(moved)], abs=0.02 * np.abs(numeric).max())


def shaken(dive: KnownDive, size_radps: float) -> KnownDive:
    """The dive with B's unit turned to and fro in its mount, which its camera is not."""
    b = dive.records[1]
    t = (b.imu_stamps_ns - b.imu_stamps_ns[0]) * 1e-9
    rates, phases = np.array((14.0, 19.0, 23.0)), np.array((0.3, 2.0, 4.0))
    swing = size_radps * np.sin(t[:, None] * rates + phases)
    return replace(dive, records=(dive.records[0], replace(b, gyro_radps=b.gyro_radps + swing)))


@pytest.mark.slow
def test_a_unit_that_shakes_alone_costs_little_once_the_lights_have_told_so() -> None:
    still = make(21, Setting(seconds=12.0))
    dive = shaken(still, 0.04)
    good, bad = (score(each, smooth(each.records, each.fixes, each.stamps_ns).rows) for each in (still, dive))
    assert np.median(bad.errors_m) < 1.35 * np.median(good.errors_m)
    assert bad.nees < 1.6
    a, b = dive.records
    records = in_order(a), parted(in_order(b))
    track = TrackFilter(a.node, b.node, keep_s=np.inf)
    pass_over(track, records, dive.fixes)
    assert track.main is not None
    assert track.main.shares.best()[1, 1] > 0.8
