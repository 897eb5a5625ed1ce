"""Strapdown of all members: each node's inertial samples move its part of the state; gravity is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, skew
from buddyline.solver_service.network.shaking import shaking_parts
from buddyline.solver_service.network.state import (
    ACCEL_BIAS,
    BLOCK,
    COMMON,
    DATUM,
    DELAY,
    GYRO_BIAS,
    LEVER,
    MOUNT,
    MOVING,
    P_,
    PHI,
    SHAKE,
    SHOVE,
    V_,
    NetState,
    block,
    own_of_plain,
    plain_of_own,
)
from buddyline.solver_service.track.shaking import SHAKEN_S, kept_share
from buddyline.solver_service.track.strapdown import Increments, Noise

GRAVITY_MPS2: Final = np.array((0.0, 0.0, 9.80665))
_I: Final[Floats] = np.eye(3)
# By how much the frame's zero may rise or sink in a step, where the frame moves with a node.
DATUM_STEP_M: Final = 1.0
# Where an increment's rows and columns stand in a member's transition.
_INTO: Final = (
    slice(None),
    np.r_[PHI, V_, P_][:, None],
    np.r_[PHI, GYRO_BIAS, ACCEL_BIAS, MOUNT, LEVER, DELAY],
)
_CONSTANTS: Final = np.arange(MOVING, BLOCK)


@dataclass(frozen=True, eq=False)
class Move:
    """One step of all members: F, Q (n, BLOCK, BLOCK) of each member's errors.

    anchor: the member that the frame moves with, None where the frame is fixed; anchor_p_m, anchor_v_mps (3,): by how
    much it had moved before the frame followed.
    """

    F: Floats
    Q: Floats
    anchor: int | None = None
    anchor_p_m: Floats | None = None
    anchor_v_mps: Floats | None = None

    def onward(self, P: Floats) -> Floats:
        """Return F P, the rows of a matrix (N, M) moved on."""
        n = len(self.F)
        moved = P.copy()
        moved[COMMON:] = (self.F @ P[COMMON:].reshape(n, BLOCK, -1)).reshape(n * BLOCK, -1)
        if self.anchor is None or self.anchor_p_m is None or self.anchor_v_mps is None:
            return moved
        # p' = p - p_ref in errors: dp' = dp - dp_ref - [p_ref]x (phi - phi_ref); v likewise.
        ref = moved[block(self.anchor)].copy()
        p_cross, v_cross = skew(self.anchor_p_m), skew(self.anchor_v_mps)
        for member in range(n):
            own = moved[block(member)]
            turn = own[PHI] - ref[PHI]
            own[P_] -= ref[P_] + p_cross @ turn
            own[V_] -= ref[V_] + v_cross @ turn
        return moved

    def backward(self, M: Floats) -> Floats:
        """Return F^T M, for a matrix M (N, K)."""
        if self.anchor is not None:
            whole: Floats = self.onward(np.eye(len(M))).T @ M
            return whole
        n = len(self.F)
        moved = M.copy()
        moved[COMMON:] = (self.F.swapaxes(1, 2) @ M[COMMON:].reshape(n, BLOCK, -1)).reshape(n * BLOCK, -1)
        return moved

    def covariance(self, P: Floats) -> Floats:
        """Return F P F^T + Q."""
        n = len(self.F)
        after = P.copy()
        after[COMMON:] = (self.F @ P[COMMON:].reshape(n, BLOCK, -1)).reshape(n * BLOCK, -1)
        after[:, COMMON:] = (
            (np.swapaxes(after[:, COMMON:].reshape(-1, n, BLOCK), 0, 1) @ self.F.swapaxes(1, 2))
            .swapaxes(0, 1)
            .reshape(-1, n * BLOCK)
        )
        for member in range(n):
            after[block(member), block(member)] += self.Q[member]
        if self.anchor is not None:
            still = replace(self, F=np.broadcast_to(np.eye(BLOCK), self.F.shape))
            after = still.onward(still.onward(after).T)
            # The frame sinks and rises with the anchor: only differences of depth tell.
            after[DATUM, DATUM] += DATUM_STEP_M**2
        symmetric: Floats = 0.5 * (after + after.T)
        return symmetric


def moved_members(
    state: NetState, parts: Increments, noises: Sequence[Noise], shaking: Floats, span_s: float | Floats
) -> tuple[NetState, Floats, Floats, Floats]:
    """Give members (n) after a step of span_s, or of (n,) each its own, their F and Q (n, BLOCK, BLOCK), and what of Q
    is shaking (n, 2, MOVING, MOVING).

    shaking (n, 2): variances of the unit's angle in its mount, and of the velocity that shaking adds.
    """
    span = np.broadcast_to(np.asarray(span_s), (len(state),))
    h, kept = span[:, None], kept_share(span)[:, None]
    # Without a unit nothing is shaken.
    felt = (~parts.without).astype(np.float64)[:, None]
    gone, back_s = felt * (1.0 - kept), felt * (h - SHAKEN_S * (1.0 - kept))
    p, v, R0 = state.p_m, state.v_mps, state.R
    shake, shove = felt * state.shake_rad, felt * state.shove_mps
    off = rotation_exp((R0 @ shake[:, :, None])[:, :, 0])
    R = off @ parts.R @ rotation_exp(-kept * shake)
    after = replace(
        state,
        p_m=p + h * v + back_s * shove + parts.dp_m + 0.5 * h * h * GRAVITY_MPS2,
        v_mps=v + gone * shove + parts.dv_mps + h * GRAVITY_MPS2,
        R=R,
        shake_rad=kept * state.shake_rad,
        shove_mps=kept * shove,
    )

    def scaled(by: Floats) -> Floats:
        return by[:, :, None] * _I

    moved = np.zeros((len(state), MOVING, BLOCK))
    moved[_INTO] = parts.jacobian
    moved[:, P_, P_] = moved[:, V_, V_] = _I
    moved[:, P_, V_], moved[:, P_, SHOVE], moved[:, V_, SHOVE] = scaled(h), scaled(back_s), scaled(gone)
    moved[:, SHOVE, SHOVE] = moved[:, SHAKE, SHAKE] = scaled(kept)
    moved[:, PHI, SHAKE] = felt[:, :, None] * (R0 - kept[:, :, None] * R)
    moved[:, :, :MOVING] = moved[:, :, :MOVING] @ plain_of_own(p, v, shove)
    own = own_of_plain(after.p_m, after.v_mps, after.shove_mps)
    own_back = own.swapaxes(1, 2)
    F, Q = np.tile(np.eye(BLOCK), (len(state), 1, 1)), np.zeros((len(state), BLOCK, BLOCK))
    F[:, :MOVING] = own @ moved
    shaken = shaking[:, :, None, None] * shaking_parts(R, span)
    drawn = felt[:, :, None, None] * (own[:, None] @ shaken @ own_back[:, None])
    noise, walks = _noise(parts, noises, span)
    Q[:, :MOVING, :MOVING] = own @ noise @ own_back + drawn.sum(axis=1)
    Q[:, _CONSTANTS, _CONSTANTS] = walks
    return after, F, Q, drawn


def _noise(parts: Increments, noises: Sequence[Noise], span: Floats) -> tuple[Floats, Floats]:
    """Give what a step adds to members' plain errors but for shaking, as strapdown.process_noise: a covariance (n,
    MOVING, MOVING) of those that it moves, and variances (n, BLOCK - MOVING) of the constants."""
    squared = np.square([_densities(noise) for noise in noises]).T
    gyro, accel, gap_gyro, gap_accel, gyro_walk, accel_walk, rate, tilt, heading = squared
    without, gap = parts.without, parts.gap_s
    force = (accel * span + gap_accel * gap)[:, None, None] * _I
    turn = np.where(without, rate * span**3 / 3.0, gyro * span + gap_gyro * gap)
    h = span[:, None, None]
    Q = np.zeros((len(span), MOVING, MOVING))
    Q[:, V_, V_] = force
    Q[:, P_, V_] = Q[:, V_, P_] = 0.5 * h * force
    Q[:, P_, P_] = h * h / 3.0 * force
    Q[:, PHI, PHI] = turn[:, None, None] * _I
    walks = np.zeros((len(span), BLOCK))
    walks[:, GYRO_BIAS] = (span * np.where(without, rate, gyro_walk))[:, None]
    walks[:, ACCEL_BIAS] = (span * accel_walk)[:, None]
    walks[:, MOUNT] = np.where(without, span * np.array((tilt, tilt, heading)), 0.0).T
    return Q, walks[:, MOVING:]


def _densities(noise: Noise) -> tuple[float, ...]:
    return (
        noise.gyro_rad,
        noise.accel_mps,
        noise.gap_gyro_rad,
        noise.gap_accel_mps,
        noise.gyro_bias_radps,
        noise.accel_bias_mps2,
        noise.gap_rate_radps,
        noise.gap_tilt_rad,
        noise.gap_heading_rad,
    )
