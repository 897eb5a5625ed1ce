"""How nodes without inertial units move, step by step: auxiliary residuals, and what is learned from them."""

from __future__ import annotations

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.guessing import LEAST, MOST, NEAR, GuessedMotion
from buddyline.solver_service.track.moving import TrackMoves
from buddyline.solver_service.track.smoother import Path, smoothed
from buddyline.solver_service.track.state import MOVING, SIZE, V_, State
from buddyline.solver_service.track.trail import EstimateStatus, Look, Step, Trail
from buddyline.solver_service.track.walking import FIRST, Walking

from tests.solver_service.track.dives import Setting, make

STEP_S = 0.1
COUNT = 60
CALM = FIRST[[2, 3, 3]]
LIT = Look(0, 0, 0.0, ((0, 0, 0.5),)), Look(1, 0, 0.0, ((0, 0, 0.5),))


def filtered(seen: Floats, walk: float, noise: float) -> Trail:
    """Filter velocities (N, 3) that are seen with a variance, and walk with another a step."""
    F, Q = np.eye(SIZE)[:MOVING], np.zeros((MOVING, MOVING))
    Q[V_, V_] = walk * np.eye(3)
    P, state = 1e-3 * np.eye(SIZE), State.at_rest(np.array((5.0, 0.0, 0.0)), np.tile(np.eye(3), (2, 1, 1)))
    steps = Trail()
    for k, v in enumerate(seen):
        before = state
        P = P.copy()
        P[V_, V_] += walk * np.eye(3)
        gain = P[V_, V_][0, 0] / (P[V_, V_][0, 0] + noise)
        state = state.moved(state.r_m, state.v_mps + gain * (v - state.v_mps), state.R)
        P[V_, V_] *= 1.0 - gain
        steps.append(
            Step(
                k * STEP_S,
                before.row,
                state.row,
                P,
                F,
                Q,
                np.zeros(SIZE - MOVING),
                np.zeros((2, 3)),
                EstimateStatus(0.0),
            )
        )
    return steps


def test_auxiliary_residuals_are_those_of_the_whole_dive_at_once() -> None:
    """A step's noise is off by q s: the difference of two velocities by all that was seen, with its covariance."""
    walk, noise = 4e-3, 1e-2
    seen = np.random.default_rng(7).normal(0.0, 0.2, (COUNT, 3))
    found = smoothed(filtered(seen, walk, noise), auxiliary=True).auxiliary[1:, 0]
    apart = np.diff(np.eye(COUNT), axis=0)
    information = np.eye(COUNT) / noise + apart.T @ apart / walk
    information[0, 0] += 1.0 / (1e-3 + walk)
    covariance = np.linalg.inv(information)
    moved = apart @ covariance @ seen / noise
    assert found[:, 0] == pytest.approx((moved**2).sum(axis=1) / walk**2, rel=1e-6)
    left = np.diagonal(apart @ covariance @ apart.T)
    assert found[:, 1] == pytest.approx(3.0 * (walk - left) / walk**2, rel=1e-6)
    assert found[:, 2] == pytest.approx(walk)


@pytest.mark.parametrize("times", [0.3, 4.0])
def test_a_velocity_s_walk_is_found_whatever_was_believed(times: float) -> None:
    rng, noise = np.random.default_rng(11), 1e-3
    true = 0.5 * (times * CALM[0]) ** 2 * STEP_S
    seen = np.cumsum(rng.normal(0.0, np.sqrt(2.0 * true), (600, 3)), axis=0) + rng.normal(0.0, np.sqrt(noise), (600, 3))
    guessed = GuessedMotion.of(Walking())
    for _ in range(8):
        walk = 2.0 * guessed.calm[0] ** 2 * STEP_S
        path = smoothed(filtered(seen, walk, noise), auxiliary=True)
        guessed = guessed.relearned(path_of(path.auxiliary))
    assert guessed.calm[0] / CALM[0] == pytest.approx(times / np.sqrt(2.0), rel=0.1)


def path_of(
    auxiliary: Floats, *, without: tuple[bool, bool] = (True, True), looks: dict[int, tuple[Look, ...]] | None = None
) -> Path:
    """A path of which only what is learned from is there; each step has a light of both nodes, unless looks differ."""
    count, nothing = len(auxiliary), np.zeros(0)
    return Path(
        t_s=STEP_S * np.arange(count),
        rates_radps=nothing,
        states=nothing,
        halves=nothing,
        drawn=nothing,
        without=np.tile(without, (count, 1)),
        statuses=[],
        looks=[(looks or {}).get(k, LIT) for k in range(count)],
        oldest=nothing,
        auxiliary=auxiliary,
    )


def known(calm: Floats) -> GuessedMotion:
    return GuessedMotion(calm, np.zeros(1), calm[None])


def as_expected(densities: Floats) -> Floats:
    """Residuals of steps (N, 3) that are just as expected, where both nodes move by these densities."""
    walked = densities**2 * STEP_S * (2.0, 1.0, 1.0)
    return np.stack((np.full_like(walked, 3.0), np.full_like(walked, 3.0), walked), axis=-1)


def test_calm_walks_grow_and_shrink_as_all_residuals_ask_within_limits() -> None:
    told = as_expected(np.tile(CALM, (COUNT, 1)))
    told[:, :, 0] *= (2.0, 0.5, 1.0)
    found = known(CALM).relearned(path_of(told))
    assert found.calm == pytest.approx(CALM * np.sqrt((2.0, 0.5, 1.0)))
    told[:, :, 0] = 0.0
    shrunk = known(CALM)
    for _ in range(10):
        shrunk = shrunk.relearned(path_of(told))
    assert shrunk.calm == pytest.approx(LEAST)
    told[:, :, 0] = 1e6
    assert (known(0.99 * MOST).relearned(path_of(told)).densities <= MOST).all()


def test_a_sudden_turn_is_believed_there_alone_and_stays_believed() -> None:
    told = as_expected(np.tile(CALM, (COUNT, 1)))
    told[30, 1, 0] *= 10.0 * (2 * NEAR + 1)
    found = known(CALM).relearned(path_of(told))
    near = np.abs(np.arange(COUNT) - 30) <= NEAR
    assert (found.densities[near, 1] > 3.0 * CALM[1]).all()
    assert found.densities[~near, 1] == pytest.approx(found.calm[1])
    assert found.densities[:, [0, 2]] == pytest.approx(np.tile(found.calm[[0, 2]], (COUNT, 1)))
    assert found.at(29.96 * STEP_S) == pytest.approx(found.densities[30])
    # The next path has such a turn as is now expected.
    again = found.relearned(path_of(as_expected(found.densities)))
    assert again.densities[near, 1] == pytest.approx(found.densities[near, 1])
    # Once it is not seen any more, the step is calm again.
    told = as_expected(found.densities)
    told[20:41, 1, 0] = 0.0
    over = found.relearned(path_of(told))
    assert over.densities[near, 1] == pytest.approx(over.calm[1])


def test_a_node_that_sees_no_lamp_may_turn_as_at_first() -> None:
    dark = Look(1, 0, 0.0, ()), Look(0, 0, 0.0, ((0, 0, 0.5),))
    path = path_of(as_expected(np.tile(LEAST, (COUNT, 1))), looks={30: dark})
    found = known(LEAST).relearned(path).densities
    near = np.abs(np.arange(COUNT) - 30) <= NEAR
    assert found[near, 2] == pytest.approx(CALM[2])
    assert found[~near, 2] == pytest.approx(LEAST[2])
    assert found[:, :2] == pytest.approx(np.tile(LEAST[:2], (COUNT, 1)))


def test_a_node_that_tells_no_picture_may_turn_as_at_first_and_both_may_swim_off() -> None:
    """B is silent for a second; then both are for half a second."""
    looks = {k: LIT[:1] for k in range(20, 30)} | dict.fromkeys(range(40, 50), ())
    found = known(LEAST).relearned(path_of(as_expected(np.tile(LEAST, (COUNT, 1))), looks=looks)).densities
    # A light just before or after still tells how a node turns.
    assert found[23:27] == pytest.approx(np.tile((*LEAST[:2], CALM[2]), (4, 1)))
    assert found[43:47] == pytest.approx(np.tile(CALM, (4, 1)))
    told = [*range(22), *range(28, 42), *range(48, COUNT)]
    assert found[told] == pytest.approx(np.tile(LEAST, (len(told), 1)))


def test_steps_in_which_a_node_may_look_elsewhere_teach_nothing_of_the_calm_ones() -> None:
    """Their residuals are small, for they take more noise than there is."""
    told = as_expected(np.tile(CALM, (COUNT, 1)))
    told[12:, 2, 0] = 0.0
    looks = dict.fromkeys(range(8, COUNT), LIT[:1])
    assert known(CALM).relearned(path_of(told, looks=looks)).calm == pytest.approx(CALM)


def test_nothing_is_learned_of_a_node_that_has_a_unit() -> None:
    told = as_expected(np.tile(CALM, (COUNT, 1)))
    told[:, :, 0] *= 2.0
    found = known(CALM).relearned(path_of(told, without=(False, True)))
    assert found.calm == pytest.approx(CALM * (1.0, 1.0, np.sqrt(2.0)))


def test_each_node_turns_by_its_own_walk() -> None:
    a, b = make(4, Setting(seconds=3.0)).records
    moves = TrackMoves((a.node, b.node))
    moves.guessed = GuessedMotion(CALM, np.array((0.0, 1.0)), np.array(((0.1, 0.2, 0.3), (0.4, 0.5, 0.6))))
    estimate = Estimate(0.0, State.at_rest(np.ones(3), np.tile(np.eye(3), (2, 1, 1))), np.eye(SIZE), 0.0)
    estimate.without = [True, True]
    for t_s, push, rates in ((-1.0, 0.1, (0.2, 0.3)), (0.5, 0.4, (0.5, 0.6)), (2.0, 0.4, (0.5, 0.6))):
        noises = moves._noises(estimate, t_s)
        assert [noise.gap_accel_mps for noise in noises] == [push, push]
        assert tuple(noise.gap_rate_radps for noise in noises) == rates
