"""Lights of a node that was out of sight for seconds: its place is wide, and pictures are far from linear in it."""

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.network.estimate import NetEstimate
from buddyline.solver_service.network.sights import light_positions
from buddyline.solver_service.network.state import BLOCK, COMMON, P_, PHI, NetState, block
from buddyline.solver_service.track.lights import Sight, pixels_of

from tests.solver_service.network.test_jacobians import LIGHTS_M, PINHOLE, a_state, an_estimate


def pixels(state: NetState, observer: int, other: int) -> Floats:
    """Give where the other's lights stand in the observer's picture (2, 2)."""
    X, _ = light_positions(state, [observer], [other], LIGHTS_M[None], np.zeros((3, 3)), np.zeros((1, 1)))
    return pixels_of(PINHOLE, X[0, 0])


def seen(state: NetState, observer: int, other: int) -> Sight:
    """Give the observer's picture of the other's lights, without noise."""
    bearings, tangents = PINHOLE.rays(pixels(state, observer, other))
    return Sight(0, 0.0, observer, bearings, tangents, np.full(2, 0.7), np.zeros(2), np.zeros(2))


def wide_estimate(true: NetState, off_m: Floats) -> NetEstimate:
    """Give an estimate of three members of which the place of the second is known to a metre."""
    error = np.zeros(COMMON + 3 * BLOCK)
    error[block(1)][P_] = off_m
    estimate = an_estimate(true.plus(error))
    for _ in estimate.members:
        estimate.shaking = estimate.shaking.joined()
    # A node that has no pictures is gone.
    estimate.intake._hear(1, 0.0)
    estimate.covariance = 1e-10 * np.eye(COMMON + 3 * BLOCK)
    estimate.covariance[block(1), block(1)][P_, P_] = np.eye(3)
    estimate.covariance[block(1), block(1)][PHI, PHI] = 0.05**2 * np.eye(3)
    return estimate


@pytest.mark.parametrize("seed", [0, 1, 2, 4, 5])
def test_a_wide_place_ends_where_the_lights_say(seed: int) -> None:
    true = a_state(seed)
    estimate = wide_estimate(true, np.random.default_rng(seed).normal(0.0, 0.8, 3))
    estimate._take_lights([(0, seen(true, 0, 1))])
    assert estimate.state is not None
    assert np.abs(pixels(estimate.state, 0, 1) - pixels(true, 0, 1)).max() < 0.2
    off = estimate.state.minus(true)[block(1)][P_]
    assert off @ np.linalg.solve(estimate.covariance[block(1), block(1)][P_, P_], off) < 14.2
