"""Where the lights of all other members stand in one member's picture, and how the errors move them."""

from __future__ import annotations

from collections.abc import Sequence
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
    state: NetState, observer: int, others: Sequence[int], lights_m: Floats, rates_radps: Floats, dt_s: Floats
) -> tuple[Floats, Floats]:
    """Give other nodes' (B) lights (B, L, 3) in the observer's camera frame at times dt_s (K,) after the state's.

    Returns X (B, K, L, 3) and D (B, K, L, 3, WIDTH): dX by the errors of `columns`. rates_radps (n, 3): turn rates.
    Where all times are one, or there is none, K is 1. With a = p + R l the light's place in the net's frame, all
    carried on by v and w, for the other node by the difference of both clocks too:
    X = R_i^T (a - p_i),  dX = R_i^T (dp_j - dp_i + t_j dv_j - t_i dv_i - [a]x (phi_j - phi_i)) + R_i^T a' (dc_j - dc_i)
    """
    alike = bool((dt_s == dt_s[:1]).all())
    times = dt_s if not alike else dt_s[:1] if len(dt_s) else np.zeros(1)
    of_other = list(others)
    ahead = times + (state.clock_s[of_other] - state.clock_s[observer])[:, None]  # (B, T)
    toward = np.swapaxes(state.R[observer] @ turns_over(rates_radps[observer], times), 1, 2)[:, None]  # (T, 1, 3, 3)
    R_other = state.R[of_other][:, None] @ turns_over(rates_radps[of_other], ahead)
    v_mps, lamps = state.v_mps[of_other][:, None], np.swapaxes(lights_m, 1, 2)
    arms = np.swapaxes(R_other @ lamps[:, None], -1, -2)  # (B, T, L, 3)
    swept = np.swapaxes(R_other @ (skew(rates_radps[of_other]) @ lamps)[:, None], -1, -2)
    a = (state.p_m[of_other][:, None] + ahead[..., None] * v_mps)[:, :, None] + arms
    eye = (state.p_m[observer] + times[:, None] * state.v_mps[observer])[:, None]
    X = (toward @ (a - eye)[..., None])[..., 0]
    D = np.zeros((*X.shape, WIDTH))
    half = WIDTH // 2
    D[..., half : half + 3] = toward
    D[..., half + 3 : half + 6] = toward * ahead[..., None, None, None]
    D[..., half + 6 : half + 9] = -(toward @ skew(a))
    D[..., half + 9] = (toward @ (v_mps[:, :, None] + swept)[..., None])[..., 0]
    D[..., :half] = -D[..., half:]
    D[..., 3:6] = -toward * times[:, None, None, None]
    return X, D
