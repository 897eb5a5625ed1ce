"""What the track tells: pose, velocity and their covariances, in A's camera frame and north-east-down."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.direction import direction_of
from buddyline.solver_service.geometry.rotation import Floats, inner, matrix_to_quat, rotation_exp, rotation_log, skew
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.lights import COLUMNS
from buddyline.solver_service.track.state import NAV, PHI, R_, V_, State
from buddyline.solver_service.track.trail import EstimateStatus

# A position no better than this share of the range is not told: of the range that it tells, and of that at the light
# nearest in time. Without lights an estimate drifts, and the farther it has drifted the more such a share of it is.
WORST_SHARE: Final = 0.2
# A fix contradicts beyond this chi^2 of 6 degrees of freedom, an attitude beyond it of 3: chances of 1e-5 and 3e-7.
CONTRADICTS: Final = 33.0
# a x b = _ACROSS (a b^T), the product's nine numbers row by row.
_ACROSS: Final = -skew(np.eye(3)).reshape(3, 9)
# r @ _ABOUT_DOWN = down x r.
_ABOUT_DOWN: Final = skew(np.array((0.0, 0.0, 1.0))).T


@dataclass(frozen=True, eq=False)
class TrackRow:
    """The track at one time, between both clocks as a fix's stamp is, as the message Track has it."""

    stamp_ns: int
    t_a_b_m: Floats
    q_a_b_xyzw: Floats
    covariance: Floats
    v_a_b_mps: Floats
    v_covariance: Floats
    lights: int
    age_s: float
    range_m: float
    t_ned_m: Floats
    sigma_ned_m: Floats
    azimuth_rad: float
    sigma_azimuth_rad: float
    inclination_rad: float
    sigma_inclination_rad: float


def at_one_time(state: State, rates_radps: Floats) -> State:
    """Bring both nodes' parts to one time, between their clocks as a fix's stamp is: A half the offset back, B on.

    Here and below: states may be a batch, with leading axes.
    """
    half_s = 0.5 * np.asarray(state.clock_s)[..., None]
    turns = rotation_exp(rates_radps * np.stack((-half_s, half_s), axis=-2))
    return state.moved(state.r_m + half_s * state.v_mps, state.v_mps, state.R @ turns)


def at_one_time_jacobian(state: State, rates_radps: Floats) -> Floats:
    """Give the errors (..., NAV, C) of the state at one time by the state's errors of COLUMNS."""
    J = np.zeros((*state.r_m.shape[:-1], NAV, len(COLUMNS)))
    J[..., range(NAV), range(NAV)] = 1.0
    J[..., range(3), range(3, 6)] = 0.5 * np.asarray(state.clock_s)[..., None]
    turned = 0.5 * (state.R @ rates_radps[..., None])[..., 0]
    J[..., PHI[0], NAV] = -turned[..., 0, :]
    J[..., PHI[1], NAV] = turned[..., 1, :]
    # The errors are those of plus: r turns with phi_B and v with phi_A, which the clock turns here.
    half = skew(0.5 * np.asarray(state.clock_s)[..., None] * state.v_mps)
    J[..., R_, PHI[0]], J[..., R_, PHI[1]] = -half, half
    J[..., R_, NAV] = 0.5 * state.v_mps - (skew(turned[..., 1, :]) @ state.r_m[..., None])[..., 0]
    J[..., V_, NAV] = (skew(turned[..., 0, :]) @ state.v_mps[..., None])[..., 0]
    return J


def pose_jacobian(now: State) -> Floats:
    """Give the errors (..., 12, NAV) of t_a_b, of the rotation, of v_a_b and of t_ned by those of a state at one time.

    With psi = phi_B - phi_A, t = R_A^T r errs by dt = R_A^T (dr - [r]x psi), and w = R_A^T psi.
    """
    toward = now.R[..., 0, :, :].swapaxes(-1, -2)
    J = np.zeros((*toward.shape[:-2], 12, NAV))
    J[..., 0:3, R_] = toward
    across = skew(now.r_m)
    J[..., 0:3, PHI[0]], J[..., 0:3, PHI[1]] = toward @ across, -toward @ across
    J[..., 3:6, PHI[0]], J[..., 3:6, PHI[1]] = -toward, toward
    J[..., 6:9, V_] = toward
    J[..., 9:12, R_] = np.eye(3)
    J[..., 9:12, PHI[1]] = -across
    return J


def of_offset(r_m: Floats) -> tuple[Floats, Floats, Floats]:
    """Give by what (3, 3) a fix's place, and its turn, move with the velocity v, and its turn with the turn rates w.

    Per second between the clocks, for B at r_m (3,) (`as_a_fix_sees_it`).
    """
    range_m = math.sqrt(float(r_m @ r_m))
    e = r_m / range_m
    half_along = 0.5 * np.outer(e, e)
    return np.eye(3) - half_along, skew(e) / range_m, half_along


def as_a_fix_sees_it(state: State, rates_radps: Floats) -> tuple[State, Floats]:
    """Give the state of which a fix tells t and R_a_b, and its errors (NAV, C) by the state's errors of COLUMNS.

    A fix takes both pictures for one instant's. With the clocks c apart, B's direction is as A sees it, r + c v, and
    A's as B sees it, r; the range, and the turn about the line of sight e, which both pictures tell, are midway:
    r' = r + c (v - e (e . v) / 2),  R_B' = exp(c (e x v / |r| + e (e . (R_A w_A + R_B w_B)) / 2)) R_B
    To first order of c; how e changes by the errors is of the second.
    """
    c, r, v = float(state.clock_s), state.r_m, state.v_mps
    moved, swept, half_along = of_offset(r)
    r_per_s, turn_per_s = moved @ v, swept @ v + half_along @ (state.R @ rates_radps[..., None]).sum(axis=0)[:, 0]
    seen = state.moved(r + c * r_per_s, v, np.stack((state.R[0], rotation_exp(c * turn_per_s) @ state.R[1])))
    J = np.zeros((NAV, len(COLUMNS)))
    J[range(NAV), range(NAV)] = 1.0
    # The errors are those of plus: r turns with phi_B, v with phi_A.
    across = skew(seen.r_m)
    J[R_, V_] = c * (moved + across @ swept)
    J[R_, PHI[0]], J[R_, PHI[1]] = -c * moved @ skew(v), c * skew(r_per_s)
    J[R_, NAV] = r_per_s + across @ turn_per_s
    J[PHI[1], V_], J[PHI[1], NAV] = c * swept, turn_per_s
    return seen, J


def fix_residual(state: State, rates_radps: Floats, fix: FixSeen) -> tuple[Floats, Floats, Floats]:
    """Give by what (6,) a fix differs from a state, its Jacobian (6, C) by COLUMNS, and the fix's noise (6, 6)."""
    now, by_state = as_a_fix_sees_it(state, rates_radps)
    J = (pose_jacobian(now) @ by_state)[:6]
    toward = now.R[0].T
    gap = np.concatenate((fix.t_a_b_m - toward @ now.r_m, rotation_log(fix.R_a_b @ (toward @ now.R[1]).T)))
    return gap, J, fix.covariance + np.diag([1e-4] * 3 + [1e-5] * 3)


def fix_chi2(state: State, P: Floats, rates_radps: Floats, fix: FixSeen) -> float:
    """Give chi^2 (of 6) of the difference between a fix and a state with the covariance P (C, C) of COLUMNS."""
    gap, J, noise = fix_residual(state, rates_radps, fix)
    return float(gap @ np.linalg.solve(J @ P @ J.T + noise, gap))


def _bent(C: Floats) -> Floats:
    """Give what a place's covariance (N, 3, 3) lacks because it is bent, by the pose's covariance (N, 6, 6).

    The state's errors are a screw's (dt, w): of the second order the place errs by b = w x dt / 2 beside dt. Where one
    node alone is seen, the other's place lies on an arc, far thinner than the arc is bent: without E[b b^T] the pose
    would be many sigmas off. For normal errors E[w_j t_k w_m t_n] = W_jk W_mn + E_jm T_kn + W_jn W_mk; W is of (w, t).
    """
    of_t, of_w, both = C[:, :3, :3], C[:, 3:, 3:], C[:, 3:, :3]
    # By j, k, m, n; both again with its two axes at j and n, and at m and k.
    fourth = both[:, :, :, None, None] * both[:, None, None, :, :]
    fourth += of_w[:, :, None, :, None] * of_t[:, None, :, None, :]
    fourth += both[:, :, None, None, :] * both.swapaxes(1, 2)[:, None, :, :, None]
    bent: Floats = 0.25 * (_ACROSS @ fourth.reshape(-1, 9, 9) @ _ACROSS.T)
    return bent


def rows_of(
    stamps_ns: Sequence[int],
    times_s: Sequence[float] | Floats,
    states: State,
    P: Floats,
    rates_radps: Floats,
    statuses: Sequence[EstimateStatus],
) -> list[TrackRow | None]:
    """Give the rows of a batch of states (N), None where a position is no better than WORST_SHARE of the range.

    times_s: of the stamps, by the track. P (N, C, C): the covariances of COLUMNS. statuses: with lit_m at the lights
    nearest in time. Only what is told in north-east-down has their north_doubt: it turns all about the vertical.
    """
    now = at_one_time(states, rates_radps)
    toward = now.R[:, 0].swapaxes(-1, -2)
    J = pose_jacobian(now) @ at_one_time_jacobian(states, rates_radps)
    whole = J @ P @ J.swapaxes(-1, -2)
    whole[:, :3, :3] += _bent(whole[:, :6, :6])
    ranges_m = np.sqrt(inner(now.r_m, now.r_m))
    lit_m = np.array([status.lit_m for status in statuses])
    north_doubts = np.array([status.north_doubt for status in statuses])
    told = np.isfinite(whole).all(axis=(1, 2))
    told &= np.sqrt(np.trace(whole[:, :3, :3], axis1=1, axis2=2)) <= WORST_SHARE * np.minimum(ranges_m, lit_m)
    turned_m = now.r_m @ _ABOUT_DOWN
    whole[:, 9:, 9:] += north_doubts[:, None, None] * (turned_m[:, :, None] * turned_m[:, None, :])
    sigma_ned_m = np.sqrt(np.maximum(whole[:, range(9, 12), range(9, 12)], 0.0))
    t = (toward @ now.r_m[..., None])[..., 0]
    v = (toward @ now.v_mps[..., None])[..., 0]
    turn = matrix_to_quat(toward @ now.R[:, 1])
    return [
        TrackRow(
            stamp_ns=stamp_ns,
            t_a_b_m=t[i],
            q_a_b_xyzw=turn[i],
            covariance=whole[i, :6, :6],
            v_a_b_mps=v[i],
            v_covariance=whole[i, 6:9, 6:9],
            lights=statuses[i].lights,
            age_s=max(float(times_s[i]) - statuses[i].light_s, 0.0),
            range_m=float(ranges_m[i]),
            t_ned_m=now.r_m[i],
            sigma_ned_m=sigma_ned_m[i],
            **vars(direction_of(now.r_m[i], whole[i, 9:, 9:])),
        )
        if told[i]
        else None
        for i, stamp_ns in enumerate(stamps_ns)
    ]
