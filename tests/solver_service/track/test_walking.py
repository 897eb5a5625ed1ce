"""How much biases walk, and nodes without a unit: slopes against differences, and that it is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.anchors import kalman
from buddyline.solver_service.track.state import ACCEL_BIAS, GYRO_BIAS, MOVING, PHI, SIZE, V_
from buddyline.solver_service.track.strapdown import predicted
from buddyline.solver_service.track.walking import FIRST, LEAST, OF_NODES, WALKS, Walking, joint

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
        walk = walk_of(walking)
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
