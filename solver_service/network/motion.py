"""Strapdown of all members: each node's inertial samples move its part of the state; gravity is known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, skew
from buddyline.solver_service.network.shaking import shaking_parts
from buddyline.solver_service.network.state import (
    ACCEL_BIAS,
    BLOCK,
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
_INTO: Final = np.ix_(np.r_[PHI, V_, P_], np.r_[PHI, GYRO_BIAS, ACCEL_BIAS, MOUNT, LEVER, DELAY])


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
        moved[1:] = (self.F @ P[1:].reshape(n, BLOCK, -1)).reshape(n * BLOCK, -1)
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
        moved[1:] = (np.swapaxes(self.F, 1, 2) @ M[1:].reshape(n, BLOCK, -1)).reshape(n * BLOCK, -1)
        return moved

    def covariance(self, P: Floats) -> Floats:
        """Return F P F^T + Q."""
        n = len(self.F)
        after = P.copy()
        after[1:] = (self.F @ P[1:].reshape(n, BLOCK, -1)).reshape(n * BLOCK, -1)
        after[:, 1:] = (
            (np.swapaxes(after[:, 1:].reshape(-1, n, BLOCK), 0, 1) @ np.swapaxes(self.F, 1, 2))
            .swapaxes(0, 1)
            .reshape(-1, n * BLOCK)
        )
        for member in range(n):
            after[block(member), block(member)] += self.Q[member]
        if self.anchor is not None:
            still = replace(self, F=np.broadcast_to(np.eye(BLOCK), self.F.shape))
            after = still.onward(still.onward(after).T)
            # The frame sinks and rises with the anchor: only differences of depth tell.
            after[0, 0] += DATUM_STEP_M**2
        symmetric: Floats = 0.5 * (after + after.T)
        return symmetric


def moved_member(
    state: NetState, member: int, parts: Increments, part: int, noise: Noise, shaking: Floats, span_s: float
) -> tuple[dict[str, Floats], Floats, Floats, Floats]:
    """Give a member's fields after a step, its F (BLOCK, BLOCK) and Q (BLOCK, BLOCK), and what of that is shaking.

    part: which of the parts is the member's. shaking (2,): variances of the unit's angle in its mount, and of the
    velocity that shaking adds.
    """
    kept = kept_share(span_s)
    felt = 0.0 if parts.without[part] else 1.0
    gone, back_s = felt * (1.0 - kept), felt * (span_s - SHAKEN_S * (1.0 - kept))
    p, v, R0 = state.p_m[member], state.v_mps[member], state.R[member]
    shake, shove = felt * state.shake_rad[member], state.shove_mps[member]
    R = rotation_exp(R0 @ shake) @ parts.R[part] @ rotation_exp(-kept * shake)
    after = {
        "p_m": p + span_s * v + back_s * shove + parts.dp_m[part] + 0.5 * span_s**2 * GRAVITY_MPS2,
        "v_mps": v + gone * shove + parts.dv_mps[part] + span_s * GRAVITY_MPS2,
        "R": R,
        "shake_rad": kept * state.shake_rad[member],
        "shove_mps": kept * shove,
    }
    F = np.eye(BLOCK)
    F[:MOVING] = 0.0
    F[_INTO] = parts.jacobian[part]
    F[P_, P_] = F[V_, V_] = _I
    F[P_, V_] = span_s * _I
    F[P_, SHOVE] = back_s * _I
    F[V_, SHOVE] = gone * _I
    F[SHOVE, SHOVE] = F[SHAKE, SHAKE] = kept * _I
    F[PHI, SHAKE] = felt * (R0 - kept * R)
    F[:, :MOVING] = F[:, :MOVING] @ plain_of_own(p, v, shove)
    T = np.eye(BLOCK)
    T[:MOVING, :MOVING] = own_of_plain(after["p_m"], after["v_mps"], after["shove_mps"])
    moving = T[:MOVING, :MOVING]
    drawn = felt * shaking[:, None, None] * (moving @ shaking_parts(R, span_s) @ moving.T)
    Q = T @ _noise(float(parts.gap_s[part]), noise, span_s, without=bool(parts.without[part])) @ T.T
    Q[:MOVING, :MOVING] += drawn.sum(axis=0)
    return after, T @ F, Q, drawn


def _noise(gap_s: float, noise: Noise, span_s: float, *, without: bool) -> Floats:
    """Give what a step adds to a member's plain errors (BLOCK, BLOCK) but for shaking; as strapdown.process_noise."""
    Q = np.zeros((BLOCK, BLOCK))
    force = noise.accel_mps**2 * span_s + noise.gap_accel_mps**2 * gap_s
    Q[V_, V_] = force * _I
    Q[P_, V_] = Q[V_, P_] = 0.5 * span_s * force * _I
    Q[P_, P_] = span_s * span_s / 3.0 * force * _I
    if without:
        Q[PHI, PHI] = noise.gap_rate_radps**2 * span_s**3 / 3.0 * _I
        Q[GYRO_BIAS, GYRO_BIAS] = noise.gap_rate_radps**2 * span_s * _I
        walks = np.array((noise.gap_tilt_rad, noise.gap_tilt_rad, noise.gap_heading_rad))
        Q[MOUNT, MOUNT] = np.diag(walks**2 * span_s)
    else:
        Q[PHI, PHI] = (noise.gyro_rad**2 * span_s + noise.gap_gyro_rad**2 * gap_s) * _I
        Q[GYRO_BIAS, GYRO_BIAS] = noise.gyro_bias_radps**2 * span_s * _I
    Q[ACCEL_BIAS, ACCEL_BIAS] = noise.accel_bias_mps2**2 * span_s * _I
    return Q
