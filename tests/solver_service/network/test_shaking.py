"""What the lights tell of how much the units are shaken."""

import numpy as np
from buddyline.solver_service.network.shaking import NetShaking, shaking_parts
from buddyline.solver_service.network.state import BLOCK, MOVING, P_


def test_places_known_together_only_do_not_let_a_members_part_grow_without_an_end() -> None:
    """A light moves both places by two or three times what they are off: by itself, each part would grow each time."""
    shaking = NetShaking.of_none().joined().joined()
    drawn = shaking_parts(np.eye(3)[None].repeat(2, 0), np.full(2, 0.1))
    P, H = 1e-6 * np.eye(1 + 2 * BLOCK), np.zeros((3, 1 + 2 * BLOCK))
    one, other = (slice(1 + BLOCK * k + P_.start, 1 + BLOCK * k + P_.stop) for k in (0, 1))
    for at, beside, variance in ((one, one, 1.0), (other, other, 0.5), (one, other, 0.7), (other, one, 0.7)):
        P[at, beside] = variance * np.eye(3)
    H[:, one], H[:, other] = np.eye(3), -np.eye(3)
    S_inverse = np.linalg.inv(H @ P @ H.T + 1e-6 * np.eye(3))
    y = np.full(3, 0.3)
    for _ in range(100):
        shaking = shaking.moved(np.eye(MOVING)[None].repeat(2, 0), drawn).taught(y, S_inverse, H, P)
    whole = np.array([P[at, at][0, 0] for at in (one, other)])
    own = shaking.parts[:, :, P_, P_].diagonal(axis1=2, axis2=3) * shaking.variances[:, :, None]
    assert (own < 2.0 * whole[:, None, None]).all(), own
    assert np.isfinite(shaking.logs).all()
