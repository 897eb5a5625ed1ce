"""Where the lights of members stand in the pictures of others, and how the errors move them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, Indices, skew
from buddyline.solver_service.network.state import BLOCK, CLOCK, COMMON, P_, PHI, V_, NetState
from buddyline.solver_service.track.lights import Sight, turns_over
from buddyline.solver_service.track.moving import KNOWN_CLOCK_S

# The errors of the observer, then of the other node, that move a light: of each place, velocity, attitude and clock.
OF_NODE: Final = np.r_[P_, V_, PHI, CLOCK]
WIDTH: Final = 2 * len(OF_NODE)


def columns(observers: Sequence[int], others: Sequence[int]) -> Indices:
    """Give the indices (B, WIDTH) in the whole error of what moves the others' lights in the observers' pictures."""
    of_both = np.stack((observers, others), axis=1)
    indices: Indices = (COMMON + BLOCK * of_both[:, :, None] + OF_NODE).reshape(-1, WIDTH)
    return indices


def light_positions(
    state: NetState,
    observers: Sequence[int],
    others: Sequence[int],
    lights_m: Floats,
    rates_radps: Floats,
    times_s: Floats,
) -> tuple[Floats, Floats]:
    """Give other nodes' lights (B, L, 3) in observers' camera frames (B), at times_s (B, T) after the state's.

    Returns X (B, T, L, 3) and D (B, T, L, 3, WIDTH + 1): dX by the errors of `columns`, and by the picture's own time.
    rates_radps (n, 3): turn rates.
    With a = p + R l the light's place in the net's frame, all carried on by v and w, for the other node by the
    difference of both clocks too:
    X = R_i^T (a - p_i),  dX = R_i^T (dp_j - dp_i + t_j dv_j - t_i dv_i - [a]x (phi_j - phi_i)) + R_i^T a' (dc_j - dc_i)
    dX/dt = R_i^T (a' - v_i) - w_i x X
    """
    i, j = list(observers), list(others)
    ahead = times_s + (state.clock_s[j] - state.clock_s[i])[:, None]  # (B, T)
    R_observer = state.R[i][:, None] @ turns_over(rates_radps[i], times_s)
    toward = R_observer.swapaxes(-1, -2)[:, :, None]  # (B, T, 1, 3, 3)
    R_other = state.R[j][:, None] @ turns_over(rates_radps[j], ahead)
    v_mps, lamps = state.v_mps[j][:, None], lights_m.swapaxes(1, 2)
    arms = np.swapaxes(R_other @ lamps[:, None], -1, -2)  # (B, T, L, 3)
    swept = np.swapaxes(R_other @ (skew(rates_radps[j]) @ lamps)[:, None], -1, -2)
    a = (state.p_m[j][:, None] + ahead[..., None] * v_mps)[:, :, None] + arms
    eye = (state.p_m[i][:, None] + times_s[..., None] * state.v_mps[i][:, None])[:, :, None]
    X = (toward @ (a - eye)[..., None])[..., 0]
    D = np.zeros((*X.shape, WIDTH + 1))
    half = WIDTH // 2
    D[..., half : half + 3] = toward
    D[..., half + 3 : half + 6] = toward * ahead[..., None, None, None]
    D[..., half + 6 : half + 9] = -(toward @ skew(a))
    moving = v_mps[:, :, None] + swept
    D[..., half + 9] = (toward @ moving[..., None])[..., 0]
    D[..., :half] = -D[..., half:WIDTH]
    D[..., 3:6] = -toward * times_s[..., None, None, None]
    seen_moving = (toward @ (moving - state.v_mps[i][:, None, None])[..., None])[..., 0]
    D[..., WIDTH] = seen_moving + X @ skew(rates_radps[i])[:, None]
    return X, D


def by_clocks_px2(H: Floats, P: Floats) -> Floats:
    """Give the variances (B,), px^2, that Jacobians H (B, K, L, 2, C) leave out of the clocks: lights move by c v.

    P (B, C, C): of the errors of `columns`. Of the product of two unknown ones that is var c var v + cov(c, v)^2. Where
    the clocks are known it is nothing.
    """
    half = WIDTH // 2
    clock, v = np.zeros(P.shape[-1]), slice(half + 3, half + 6)
    clock[half + 9], clock[9] = 1.0, -1.0
    with_all = P @ clock
    variance_s2 = with_all @ clock
    if not H.shape[1] or (variance_s2 < KNOWN_CLOCK_S**2).all():
        return np.zeros(len(P))
    along = with_all[:, v]
    unknown = variance_s2[:, None, None] * P[:, v, v] + along[:, :, None] * along[:, None]
    by_place = H[:, 0, 0, :, half : half + 3]
    moved: Floats = 0.5 * np.trace(by_place @ unknown @ by_place.swapaxes(1, 2), axis1=1, axis2=2)
    return moved


class SightArrays:
    """The candidates of some pictures (B) as arrays, up to as many (K) as the fullest has; a picture may come again.

    bearings (B, K, 3), tangents (B, K, 2, 3), sigma_px (B, K): of what a picture does not have 0, 0 and 1. dt_s (B, T):
    of each after its picture's time; T is 1 where all of a picture are of one time.
    """

    def __init__(self, sights: Sequence[Sight]) -> None:
        most = max(len(sight.bearings) for sight in sights)
        self.bearings, self.tangents = np.zeros((len(sights), most, 3)), np.zeros((len(sights), most, 2, 3))
        self.sigma_px, dt_s = np.ones((len(sights), most)), np.zeros((len(sights), max(most, 1)))
        for n, sight in enumerate(sights):
            count = len(sight.bearings)
            self.bearings[n, :count], self.tangents[n, :count] = sight.bearings, sight.tangents
            self.sigma_px[n, :count] = sight.sigma_px
            if count:
                dt_s[n, :count], dt_s[n, count:] = sight.dt_s, sight.dt_s[-1]
        # Without a rolling shutter all candidates of a picture are of one time.
        self.dt_s = dt_s[:, :1] if (dt_s == dt_s[:, :1]).all() else dt_s
