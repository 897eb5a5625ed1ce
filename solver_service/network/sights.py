"""Where the lights of all other members stand in one member's picture, and how the errors move them."""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, skew
from buddyline.solver_service.network.state import BLOCK, CLOCK, P_, PHI, V_, NetState
from buddyline.solver_service.track.lights import turns_over

# The errors of the observer, then of the other node, that move a light: of each place, velocity, attitude and clock.
OF_NODE: Final = np.r_[P_, V_, PHI, CLOCK]
WIDTH: Final = 2 * len(OF_NODE)


def columns(observer: int, other: int) -> Floats:
    """Give the indices (WIDTH,) in the whole error of what moves the other's lights in the observer's picture."""
    indices: Floats = np.concatenate((1 + BLOCK * observer + OF_NODE, 1 + BLOCK * other + OF_NODE))
    return indices


def light_positions(
    state: NetState, observer: int, other: int, lights_m: Floats, rates_radps: Floats, dt_s: Floats
) -> tuple[Floats, Floats]:
    """Give a node's lights (L, 3) in the observer's camera frame at times dt_s (K,) after the state's.

    Returns X (K, L, 3) and D (K, L, 3, WIDTH): dX by the errors of `columns`. rates_radps (n, 3): turn rates. With
    a = p + R l the light's place in the net's frame, all carried on by v and w, for the other node by the difference of
    both clocks too:
    X = R_i^T (a - p_i),  dX = R_i^T (dp_j - dp_i + t_j dv_j - t_i dv_i - [a]x (phi_j - phi_i)) + R_i^T a' (dc_j - dc_i)
    """
    alike = bool((dt_s == dt_s[:1]).all())
    times = dt_s if not alike else dt_s[:1] if len(dt_s) else np.zeros(1)
    late_s = float(state.clock_s[other] - state.clock_s[observer])
    ahead = times + late_s
    toward = np.swapaxes(state.R[observer] @ turns_over(rates_radps[observer], times), 1, 2)[:, None]  # (T, 1, 3, 3)
    R_other = state.R[other] @ turns_over(rates_radps[other], ahead)
    arms = np.swapaxes(R_other @ lights_m.T, 1, 2)  # (T, L, 3)
    swept = np.swapaxes(R_other @ (skew(rates_radps[other]) @ lights_m.T), 1, 2)
    a = (state.p_m[other] + ahead[:, None] * state.v_mps[other])[:, None] + arms
    eye = (state.p_m[observer] + times[:, None] * state.v_mps[observer])[:, None]
    X = (toward @ (a - eye)[..., None])[..., 0]
    D = np.zeros((*X.shape, WIDTH))
    half = WIDTH // 2
    D[..., half : half + 3] = toward
    D[..., half + 3 : half + 6] = toward * ahead[:, None, None, None]
    D[..., half + 6 : half + 9] = -(toward @ skew(a))
    D[..., half + 9] = (toward @ (state.v_mps[other] + swept)[..., None])[..., 0]
    D[..., :half] = -D[..., half:]
    D[..., 3:6] = -toward * times[:, None, None, None]
    if alike:
        K = len(dt_s)
        X, D = np.broadcast_to(X, (K, *X.shape[1:])), np.broadcast_to(D, (K, *D.shape[1:]))
    return X, D
