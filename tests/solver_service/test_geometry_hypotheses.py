"""The search: it leaves out nothing that passes both gaps."""

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.closed_form import closed_form
from buddyline.solver_service.geometry.hypotheses import find_pairs, join
from buddyline.solver_service.geometry.observation import Settings
from buddyline.solver_service.geometry.terms import Terms
from buddyline.solver_service.geometry.trigger import Sensed

from tests.solver_service.scenes import IDEAL, ODD_A, ODD_B, view

GATE = 4.5


@pytest.mark.parametrize("rigs", [(IDEAL, IDEAL), (ODD_A, ODD_B)], ids=["ideal", "odd"])
@pytest.mark.parametrize(("count", "triggers"), [(9, 200), (14, 25)], ids=["few", "many"])
def test_every_combination_within_both_gates_is_found(rigs, count, triggers):
    rng = np.random.default_rng(1)
    passing = 0
    for _ in range(triggers):
        views = tuple(view(rng.uniform((0, 0), (1640, 1232), (count, 2)), 1.0) for _ in range(2))
        terms = Terms.of(views, rigs, (Sensed(), Sensed()), Settings(), None)
        pairs = find_pairs(terms.candidates, terms.rigs, (terms.sensors.down_a, terms.sensors.down_b), terms.settings)
        none = np.zeros(pairs.split)
        ia, ib, _ = join(pairs, terms.rigs, GATE, none, by_range=True, by_twist=True)
        found = set(zip(ia.tolist(), ib.tolist(), strict=True))
        of_a, of_b = np.arange(pairs.split), np.arange(pairs.split, len(pairs.key))
        a, b, swap = (grid.ravel() for grid in np.meshgrid(of_a, of_b, (False, True), indexing="ij"))
        (of_first, of_second), bearings = pairs.ends, terms.candidates.bearings
        first, second = np.where(swap, of_second[b], of_first[b]), np.where(swap, of_first[b], of_second[b])
        levels = terms.rigs.levels
        with np.errstate(all="ignore"):
            solved = closed_form(
                np.stack((bearings[:, of_first[a]], bearings[:, first])),
                np.stack((bearings[:, of_second[a]], bearings[:, second])),
                *levels,
            )
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
        seen = replace(view(pixels, 1.0), area_px=np.full(3, area_px))
        terms = Terms.of((seen, seen), (IDEAL, IDEAL), (Sensed(), Sensed()), Settings(), None)
        pairs = find_pairs(terms.candidates, terms.rigs, (terms.sensors.down_a, terms.sensors.down_b), terms.settings)
        weights = dict(zip(zip(*pairs.ends.tolist(), strict=True), pairs.log_weight.tolist(), strict=True))
        return weights[0, 1], weights[0, 2]

    (near, far), (crowded, untouched) = log_weights(40.0), log_weights(8000.0)
    assert untouched == far
    assert crowded < near
    # As if they stood a glow's radius apart, times the root of two.
    assert crowded == pytest.approx(near + np.log(20.0**2 / (2.0 * 8000.0 / np.pi)), abs=0.02)
