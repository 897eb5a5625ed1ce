"""The search: it leaves out nothing that passes both gaps."""

import numpy as np
import pytest
from buddyline.solver_service.geometry.batch import Batch
from buddyline.solver_service.geometry.closed_form import Bars, Spans, solve_exact
from buddyline.solver_service.geometry.observation import Observation, Settings
from buddyline.solver_service.geometry.quads import join

from tests.solver_service.scenes import IDEAL, ODD_A, ODD_B, view

GATE = 4.5


@pytest.mark.parametrize(
    ("rigs", "count", "triggers"),
    [
        pytest.param((IDEAL, IDEAL), 9, 200, id="ideal, few"),
        pytest.param((ODD_A, ODD_B), 9, 200, id="odd, few", marks=pytest.mark.slow),
        pytest.param((IDEAL, IDEAL), 14, 25, id="ideal, many", marks=pytest.mark.slow),
        pytest.param((ODD_A, ODD_B), 14, 25, id="odd, many", marks=pytest.mark.slow),
    ],
)
def test_every_combination_within_both_gates_is_found(rigs, count, triggers):
    rng = np.random.default_rng(1)
    passing = 0
    for _ in range(triggers):
        views = tuple(view(rng.uniform((0, 0), (1640, 1232), (count, 2)), 1.0) for _ in range(2))
        batch = Batch.of([Observation(*views)], rigs, Settings())
        pairs, of_a, of_b = batch.pairs, batch.pairs.of_node(0), batch.pairs.of_node(1)
        none = np.zeros(len(pairs.key))
        ia, ib, _ = join(pairs, of_a, batch.rigs, np.array([GATE]), none, by_range=True, by_twist=True)
        found = set(zip(ia.tolist(), ib.tolist(), strict=True))
        a, b, swap = (grid.ravel() for grid in np.meshgrid(of_a, of_b, (False, True), indexing="ij"))
        (of_first, of_second), bearings = pairs.ends, batch.candidates.bearing
        first, second = np.where(swap, of_second[b], of_first[b]), np.where(swap, of_first[b], of_second[b])
        left = np.stack((bearings[:, of_first[a]], bearings[:, first]))
        right = np.stack((bearings[:, of_second[a]], bearings[:, second]))
        with np.errstate(all="ignore"):
            solved = solve_exact(Spans.of(np.stack((left, right))), Bars.of(batch.rigs))
            gap = np.log(solved.range_m[0] / solved.range_m[1])
            gate = GATE * np.sqrt(pairs.variance[a] + pairs.variance[b])
            within = (np.abs(gap) < gate) & (np.abs(solved.twist_gap_rad) < gate)
            within &= solved.range_m.mean(0) > 1.5
        expected = set(zip(a[within].tolist(), b[within].tolist(), strict=True))
        passing += len(expected)
        assert expected <= found
    assert passing > 20


def test_two_candidates_within_one_glow_are_no_rarity():
    """Near each other they would speak for lights far away, and louder the nearer they are."""

    def log_weights(area_px):
        pixels = np.array([[800.0, 600.0], [820.0, 600.0], [1100.0, 600.0]])
        seen = view(pixels, 1.0)
        seen.area_px[:] = area_px
        pairs = Batch.of([Observation(seen, seen)], (IDEAL, IDEAL), Settings()).pairs
        weights = dict(zip(zip(*pairs.ends.tolist(), strict=True), pairs.log_weight.tolist(), strict=True))
        return weights[0, 1], weights[0, 2]

    (near, far), (crowded, untouched) = log_weights(40.0), log_weights(8000.0)
    assert untouched == far
    assert crowded < near
    # As if they stood a glow's radius apart, times the root of two.
    assert crowded == pytest.approx(near + np.log(20.0**2 / (2.0 * 8000.0 / np.pi)), abs=0.02)
