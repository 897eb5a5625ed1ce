"""Rows between two smoothed steps: their Jacobians, and how sure they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track.between import Weights, rows_between
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.smoother import smoothed
from buddyline.solver_service.track.start import constants_of
from buddyline.solver_service.track.state import CLOCK, NAV, PHI, R_, SIZE, State
from buddyline.solver_service.track.trail import Trail

from tests.solver_service.track.dives import EPOCH_NS, Setting, filter_of, make

STEP = 1e-6
SPAN_S = 0.1
# In SPAN_S nodes turn by up to 0.01 rad, which the Jacobians leave out.
SMALL = 5e-3


def both_ends() -> tuple[State, State, Floats]:
    """Two states SPAN_S apart, with turn rates (2 steps, 2, 3)."""
    rng = np.random.default_rng(5)
    R = np.stack([rotation_exp(rng.normal(0.0, 1.0, 3)) for _ in (0, 1)])
    before = State.at_rest(np.array((4.0, -1.0, 0.5)), R).with_parts(v_mps=rng.normal(0.0, 0.5, 3))
    rates = rng.normal(0.0, 0.05, (2, 2, 3))
    after = before.moved(
        before.r_m + SPAN_S * before.v_mps,
        before.v_mps + rng.normal(0.0, 0.05, 3),
        R @ rotation_exp(SPAN_S * rates.mean(axis=0)),
    )
    return before, after, rates


def between(weights: Weights, before: State, after: State, rates: Floats) -> State:
    of_one = weights.state(State(before.row[None]), State(after.row[None]), rates[0][None], rates[1][None])
    return State(of_one.row[0])


@pytest.mark.parametrize("share", [0.0, 0.2, 0.5, 0.9, 1.0])
@pytest.mark.parametrize("rated", [True, False])
def test_jacobians_are_those_of_the_interpolation(share: float, rated: bool) -> None:
    before, after, rates = both_ends()
    weights = Weights.at(np.array([share]), np.array([SPAN_S]), np.array([rated]))
    meant = between(weights, before, after, rates)
    given = weights.jacobians(State(before.row[None]), State(after.row[None]), State(meant.row[None]))
    for end, J in enumerate(given):
        for column, error in enumerate(STEP * np.eye(SIZE)[:NAV]):
            ends = [before, after]
            ends[end] = ends[end].plus(error)
            off = between(weights, ends[0], ends[1], rates).minus(meant)[:NAV] / STEP
            # The errors of attitudes go straight, as the interpolation does at the ends, and half-way with both rates.
            if column < PHI[0].start or share in (0.0, 1.0) or (rated and share == 0.5):
                assert J[0, :NAV, column] == pytest.approx(off, abs=SMALL), (end, column)
    # The clock is the same at both steps, and between.
    assert given[0][0, -1, -1] + given[1][0, -1, -1] == pytest.approx(1.0)


def filtered(times_s: Floats, seen_s: Floats) -> tuple[float, Trail]:
    """Nodes with units that are not shaken, by steps that end at times; some of their errors are measured at seen_s."""
    dive = make(40, Setting(seconds=2.0))
    silent = [replace(one, frames=(), attitudes=[], depths=[]) for one in dive.records]
    track = filter_of((silent[0], silent[1]), ())
    state, variances = constants_of(track.nodes, np.stack((np.eye(3), dive.R_a_b[0])), dive.t_a_b_m[0])
    variances[CLOCK] = 1e-8
    still = replace(Shaking(), logs=np.full(3, -40.0))
    start_s = track.seconds(0, EPOCH_NS)
    estimate = Estimate(start_s + 1.0, state, np.diag(variances), start_s + 1.0, learns=False, shaking=still)
    track._open(estimate)
    for t_s in times_s:
        track._step(estimate, start_s + t_s, None)
        if np.abs(t_s - seen_s).min() < 1e-6:
            H = np.eye(SIZE)[np.r_[R_, PHI[0], PHI[1]]]
            track._apply(estimate, H, np.zeros(9), 1e-6 * np.eye(9))
            after = estimate.steps.last._replace(after=estimate.state.row, covariance=estimate.covariance)
            estimate.steps.last = after
    assert estimate.without == [False, False]
    return start_s, estimate.steps


@pytest.mark.parametrize("share", [0.2, 0.5, 0.8])
def test_a_row_between_two_steps_is_as_sure_as_a_step_would_be_there(share: float) -> None:
    seen_s = 1.0 + SPAN_S * np.arange(1, 6)
    asked_s, stamps = seen_s[[1, 2]] + share * SPAN_S, [EPOCH_NS] * 2
    (start_s, coarse), (_, fine) = filtered(seen_s, seen_s), filtered(np.sort([*seen_s, *asked_s]), seen_s)
    rows = [
        list(rows_between(path, start_s + asked_s, stamps))
        for path in (smoothed(fine, across=True), smoothed(coarse, across=True), smoothed(coarse))
    ]
    assert all(len(each) == 2 for each in rows)
    for step, exact, mean in zip(*rows, strict=True):
        assert in_sigmas(exact.covariance, step.covariance) == pytest.approx(np.eye(6), abs=0.04)
        assert in_sigmas(exact.v_covariance, step.v_covariance) == pytest.approx(np.eye(3), abs=0.04)
        # The mean of both covariances is larger, for both steps' errors are not the same.
        assert np.linalg.eigvalsh(in_sigmas(mean.covariance, step.covariance)).max() > 1.04


def in_sigmas(P: Floats, of: Floats) -> Floats:
    """Give a covariance in the axes, and the sigmas, of another."""
    root = np.linalg.inv(np.linalg.cholesky(of))
    return np.asarray(root @ P @ root.T)
