"""What the lights tell of how much the units are shaken."""

import numpy as np
import pytest
from buddyline.solver_service.network.shaking import NetShaking, shaking_parts
from buddyline.solver_service.network.state import BLOCK, COMMON, MOVING, P_


@pytest.mark.parametrize("others", [0, 6])
def test_places_known_together_only_do_not_let_a_members_part_grow_without_an_end(others: int) -> None:
    """A light moves both places by two or three times what they are off: by itself, each part would grow each time."""
    n = 2 + others
    shaking = NetShaking.of_none()
    for _ in range(n):
        shaking = shaking.joined()
    drawn, still = shaking_parts(np.eye(3)[None].repeat(n, 0), np.full(n, 0.1)), np.eye(MOVING)[None].repeat(n, 0)
    places = [slice(COMMON + BLOCK * k + P_.start, COMMON + BLOCK * k + P_.stop) for k in range(n)]
    P, H = 1e-6 * np.eye(COMMON + n * BLOCK), np.zeros((3 + 3 * others, COMMON + n * BLOCK))
    one, other = places[:2]
    for at, beside, variance in ((one, one, 1.0), (other, other, 0.5), (one, other, 0.7), (other, one, 0.7)):
        P[at, beside] = variance * np.eye(3)
    H[:3, one], H[:3, other] = np.eye(3), -np.eye(3)
    for k in range(others):
        H[3 * k + 3 : 3 * k + 6, places[2 + k]] = np.eye(3)
    S_inverse = np.linalg.inv(H @ P @ H.T + 1e-6 * np.eye(len(H)))
    y = np.concatenate((np.full(3, 0.3), np.zeros(3 * others)))
    gain = np.asarray(P @ H.T @ S_inverse, np.float64)
    for _ in range(100):
        adds = drawn * shaking.variances[:, :, None, None]
        shaking = shaking.moved(still, adds).taught(y, S_inverse, H, gain)
    whole = np.array([P[at, at][0, 0] for at in (one, other)])
    own = shaking.parts[:2, :, P_, P_].diagonal(axis1=2, axis2=3)
    assert (own < 2.0 * whole[:, None, None]).all(), own
    assert np.isfinite(shaking.logs).all()
