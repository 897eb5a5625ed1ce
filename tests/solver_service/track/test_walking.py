"""How much biases walk, and nodes without a unit: slopes against differences, and that it is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.anchors import kalman
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.moving import TrackMoves
from buddyline.solver_service.track.state import ACCEL_BIAS, GYRO_BIAS, MOUNT, MOVING, PHI, SHAKE, SIZE, V_, State
from buddyline.solver_service.track.stepping import TrackSteps
from buddyline.solver_service.track.strapdown import (
    Increments,
    Noise,
    guessed_noise,
    kept_shares,
    predicted,
    process_noise,
    propagate,
)
from buddyline.solver_service.track.walking import FIRST, LEAST, OF_NODES, WALKS, Walking, joint

from tests.solver_service.track.dives import Setting, make

STEP_S = 0.1
STILL = np.zeros((MOVING, MOVING))


def transition() -> Floats:
    """Biases move both attitudes and the velocity; what moved is forgotten within a second."""
    F = np.zeros((MOVING, SIZE))
    F[range(MOVING), range(MOVING)] = 0.9
    for node in (0, 1):
        F[PHI[node], GYRO_BIAS[node]] = -STEP_S * np.eye(3)
    F[V_, ACCEL_BIAS[1]] = -STEP_S * np.eye(3)
    return F


def looking() -> Floats:
    H = np.zeros((9, SIZE))
    H[0:3, PHI[0]] = H[3:6, PHI[1]] = H[6:9, V_] = np.eye(3)
    return H


def walk_of(walking: Walking) -> Floats:
    walk = np.zeros(SIZE)
    for density, biases in zip(walking.densities[:2], (GYRO_BIAS, ACCEL_BIAS), strict=True):
        for of_node in biases:
            walk[of_node] = density**2 * STEP_S
    return walk[MOVING:]


def followed(walking: Walking, seen: Floats, noise: Floats, *, learns: bool) -> tuple[Walking, Floats, Floats]:
    """Filter residuals (N, 9); return what was learned, the state's error and its covariance."""
    F, H = transition(), looking()
    x, P = np.zeros(SIZE), np.eye(SIZE) * 1e-6
    for y in seen:
        x = np.concatenate((F @ x, x[MOVING:]))
        walk = walk_of(walking.cautious() if learns else walking)
        P = predicted(P, F, STILL, walk)
        walking = walking.stepped(F, walk, (True, True))
        error, P, _, inverse, gain = kalman(P, H, y - H @ x, noise)
        taught = walking.taught(y - H @ x, inverse, H, gain)
        walking = taught if learns else replace(taught, logs=walking.logs, information=walking.information)
        x = x + error
    return walking, x, P


def test_slopes_are_those_of_differences() -> None:
    seen, noise = np.random.default_rng(3).normal(0.0, 1e-3, (12, 9)), np.eye(9) * 1e-6
    walking, _, _ = followed(Walking(), seen, noise, learns=False)
    for k in (0, 1):
        off = 1e-3 * np.eye(WALKS)[k]
        ends = [followed(Walking(Walking().logs + sign * off), seen, noise, learns=False) for sign in (1.0, -1.0)]
        moved, spread = ((ends[0][i] - ends[1][i]) / 2e-3 for i in (1, 2))
        assert np.abs(walking.spread[k] - spread).max() < 1e-5 * np.abs(spread).max()
        # The gross residuals' limit is not reached, so that the state's slope is exact.
        assert np.abs(walking.moved[:, k] - moved).max() < 1e-5 * np.abs(moved).max()


@pytest.mark.parametrize("times", [0.3, 3.0])
def test_the_walk_is_found_whatever_was_believed(times: float) -> None:
    rng = np.random.default_rng(11)
    true = Walking(Walking().logs + 2.0 * np.log(times))
    F, H = transition(), looking()
    x = np.zeros(SIZE)
    sigma = np.repeat((2e-4, 2e-4, 3e-3), 3)
    seen = np.empty((600, 9))
    for k in range(len(seen)):
        x = np.concatenate((F @ x, x[MOVING:] + rng.normal(0.0, 1.0, SIZE - MOVING) * np.sqrt(walk_of(true))))
        seen[k] = H @ x + rng.normal(0.0, 1.0, 9) * sigma
    found, _, _ = followed(Walking(), seen, np.diag(sigma**2), learns=True)
    assert found.densities[:2] / FIRST[:2] == pytest.approx(times, rel=0.35)
    # What two tracks tell is weighed by how much each has learned.
    together = joint([found, Walking()])
    assert np.abs(together.logs - found.logs).max() < 0.1


@pytest.mark.parametrize(("told", "taken"), [(1e4, 0.2), (4.0, 0.2 * np.e**0.5), (1.0, 0.2 * np.e), (0.25, 1.0)])
def test_a_small_walk_that_little_light_has_told_is_taken_to_be_larger(told: float, taken: float) -> None:
    """By two sigmas of its logarithm, but it is no larger than at first."""
    logs, information = Walking().logs, Walking().information
    logs[:2] += 2.0 * np.log(0.2)
    information[:2, :2] = told * np.eye(2)
    cautious = Walking(logs, information).cautious()
    assert cautious.densities[:2] / FIRST[:2] == pytest.approx(taken, rel=0.02)
    assert (cautious.logs[2:] == logs[2:]).all()
    larger = replace(Walking(), logs=Walking().logs + 1.0, information=information)
    assert (larger.cautious().logs == larger.logs).all()


@pytest.mark.parametrize("learns", [True, False])
def test_what_little_light_has_told_of_a_walk_is_not_believed_in_darkness_live(*, learns: bool) -> None:
    """A pass over a dive that is over is given a walk that is cautious already."""
    a, b = make(1, Setting(seconds=1.0)).records
    moves = TrackMoves((a.node, b.node))
    estimate = Estimate(0.5, at_rest(), np.eye(SIZE), 0.5, learns=learns)
    small = Walking(Walking().logs - 3.0)
    estimate.walking = small
    taken = small.cautious() if learns else small
    for noise in moves._noises(estimate, 0.5):
        assert (noise.gyro_bias_radps, noise.accel_bias_mps2) == pytest.approx(taken.densities[:2].tolist())


def test_a_node_without_a_unit_tells_nothing_of_its_biases() -> None:
    walk = walk_of(Walking())
    alone = Walking().stepped(transition(), walk, (False, False))
    assert alone.followed == OF_NODES
    assert not alone.spread.any()
    both = Walking().stepped(transition(), walk, (False, True))
    assert len(both.spread) == WALKS
    assert not both.spread[0, GYRO_BIAS[0], GYRO_BIAS[0]].any()
    assert both.spread[0, GYRO_BIAS[1], GYRO_BIAS[1]].any()


def accelerated(walking: Walking, seen: Floats, noise: Floats, *, learns: bool) -> tuple[Walking, Floats]:
    """Filter velocities (N, 3) of nodes without units, which their acceleration alone changes; as `followed`."""
    F, H = np.eye(SIZE)[:MOVING], np.eye(SIZE)[V_]
    x, P = np.zeros(SIZE), np.eye(SIZE) * 1e-6
    for y in seen:
        guessed = np.zeros((3, SIZE, SIZE))
        guessed[0, V_, V_] = walking.densities[2] ** 2 * STEP_S * np.eye(3)
        P = predicted(P, F, guessed[0, :MOVING, :MOVING], np.zeros(SIZE - MOVING))
        walking = walking.stepped(F, np.zeros(SIZE - MOVING), (False, False), guessed)
        error, P, _, inverse, gain = kalman(P, H, y - H @ x, noise)
        walking = walking.taught(y - H @ x, inverse, H, gain, learns=learns)
        x = x + error
    return walking, P


def test_slopes_by_a_nodes_own_motion_are_those_of_differences() -> None:
    seen, noise = np.random.default_rng(4).normal(0.0, 0.2, (12, 3)), np.eye(3) * 0.01
    walking, _ = accelerated(Walking(), seen, noise, learns=False)
    off = 1e-3 * np.eye(WALKS)[2]
    ends = [accelerated(Walking(Walking().logs + sign * off), seen, noise, learns=False)[1] for sign in (1.0, -1.0)]
    spread = (ends[0] - ends[1]) / 2e-3
    assert np.abs(walking.spread[0] - spread).max() < 1e-5 * np.abs(spread).max()
    assert (walking.logs == Walking().logs).all()


@pytest.mark.parametrize("times", [0.6, 3.0, 0.01])
def test_a_nodes_own_motion_is_found_but_never_taken_for_rest(times: float) -> None:
    rng = np.random.default_rng(12)
    steps = rng.normal(0.0, times * FIRST[2] * np.sqrt(STEP_S), (600, 3))
    seen = np.cumsum(steps, axis=0) + rng.normal(0.0, 0.03, (600, 3))
    found, _ = accelerated(Walking(), seen, np.eye(3) * 0.03**2, learns=True)
    least = np.exp(0.5 * LEAST[2]) / FIRST[2]
    assert found.densities[2] / FIRST[2] == pytest.approx(max(times, least), rel=0.2)
    assert (found.logs[:2] == Walking().logs[:2]).all()


TILT_RAD = 0.0175


def tilting(walking: Walking, seen: Floats, *, learns: bool) -> tuple[Walking, Floats, Floats]:
    """Filter tilts (N, 2) of A's attitude messages, of which only the error changes; give its covariance and state."""
    P, F_still = np.zeros((SIZE, SIZE)), np.eye(SIZE)[:MOVING]
    P[SHAKE[0], SHAKE[0]] = np.diag((1.0, 1.0, 0.0)) * TILT_RAD**2
    H, noise = np.eye(SIZE)[SHAKE[0]][:2], np.eye(2) * 0.005**2
    estimate = Estimate(0.0, at_rest(), P, 0.0, without=[True, True])
    parts = unmoved()
    for y in seen:
        tilt = Noise(0.0, 0.0, gap_accel_mps=0.0, gap_rate_radps=0.0, gap_heading_rad=0.0, tilt_rad=TILT_RAD)
        noises = 2 * (tilt._replace(gap_tilt_rad=walking.densities[4] * TILT_RAD),)
        shares = kept_shares(parts.without, noises, STEP_S)
        F = F_still.copy()
        F[SHAKE[0], SHAKE[0]] = F[SHAKE[1], SHAKE[1]] = shares[0] * np.eye(3)
        after = estimate.state.with_parts(shake_rad=shares[:, None] * estimate.state.shake_rad)
        guessed, drift = TrackSteps._guessed(estimate, after, F, parts, noises, noises, STEP_S, shares)
        added = guessed_noise(parts, noises, STEP_S, shares)[2]
        walking = walking.stepped(F, np.zeros(SIZE - MOVING), (False, False), guessed, drift)
        P = predicted(estimate.covariance, F, added[:MOVING, :MOVING], np.zeros(SIZE - MOVING))
        off = y - after.shake_rad[0, :2]
        error, P, _, inverse, gain = kalman(P, H, off, noise)
        walking = walking.taught(off, inverse, H, gain, learns=learns)
        estimate = replace(estimate, state=after.plus(error), covariance=P)
    return walking, estimate.covariance, estimate.state.shake_rad[0]


def at_rest() -> State:
    R = np.stack((np.eye(3), np.eye(3)))
    far_m = np.array((0.0, 0.0, 5.0))
    return State.at_rest(far_m, R)


def unmoved() -> Increments:
    """What two nodes without a unit tell of their motion in a step: nothing."""
    turns, three = np.stack((np.eye(3), np.eye(3))), np.zeros((2, 3))
    both = np.ones(2, dtype=bool)
    return Increments(turns, three, three, np.zeros((2, 9, 16)), np.full(2, STEP_S), three, None, both, np.zeros(2))


def swinging(rng: np.random.Generator, count: int, lasts_s: float) -> Floats:
    """Tilt errors (N, 2) of TILT_RAD that are forgotten within lasts_s, and the messages' noise."""
    kept = np.exp(-STEP_S / lasts_s)
    errors = rng.normal(0.0, TILT_RAD, (count, 2))
    for k in range(1, count):
        errors[k] = kept * errors[k - 1] + np.sqrt(1.0 - kept * kept) * errors[k]
    return errors + rng.normal(0.0, 0.005, (count, 2))


def test_slopes_by_a_tilts_wandering_are_those_of_differences() -> None:
    seen = swinging(np.random.default_rng(5), 12, 0.35)
    walking, _, _ = tilting(Walking(), seen, learns=False)
    off = 1e-3 * np.eye(WALKS)[4]
    ends = [tilting(Walking(Walking().logs + sign * off), seen, learns=False) for sign in (1.0, -1.0)]
    spread, moved = ((ends[0][i] - ends[1][i]) / 2e-3 for i in (1, 2))
    assert np.abs(walking.spread[2] - spread).max() < 1e-4 * np.abs(spread).max()
    assert np.abs(walking.moved[SHAKE[0], 2] - moved).max() < 1e-4 * np.abs(moved).max()


@pytest.mark.slow
def test_how_long_a_tilts_error_lasts_is_found() -> None:
    rng = np.random.default_rng(6)
    for lasts_s in (0.5, 5.0):
        found, _, _ = tilting(Walking(), swinging(rng, 3000, lasts_s), learns=True)
        assert 2.0 / found.densities[4] ** 2 == pytest.approx(lasts_s, rel=0.3)


def test_a_tilts_error_never_outgrows_its_stated_sigma() -> None:
    """As a walk it was off by three of them after ten seconds, and lights a second apart were believed to share it."""
    parts, noise = unmoved(), Noise(0.0, 0.0, gap_tilt_rad=TILT_RAD, tilt_rad=TILT_RAD)
    P = np.zeros((SIZE, SIZE))
    for _ in range(100):
        shares = kept_shares(parts.without, (noise, noise), 0.1)
        after, F = propagate(at_rest(), parts, 0.1, shares)
        Q, walk, _ = process_noise(after, parts, (noise, noise), np.zeros(3), 0.1, shares)
        P = predicted(P, F, Q, walk)
    tilts = [np.diag(P[SHAKE[node], SHAKE[node]] + P[MOUNT[node], MOUNT[node]])[:2] for node in (0, 1)]
    assert np.sqrt(tilts) == pytest.approx(np.full((2, 2), TILT_RAD), rel=1e-3)
    heading = np.sqrt(P[MOUNT[0], MOUNT[0]][2, 2])
    assert heading == pytest.approx(noise.gap_heading_rad * np.sqrt(10.0))
