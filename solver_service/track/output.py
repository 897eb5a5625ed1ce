"""What the track tells: pose, velocity and their covariances, in A's camera frame and north-east-down."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.direction import direction_of
from buddyline.solver_service.geometry.rotation import Floats, matrix_to_quat, rotation_exp, skew
from buddyline.solver_service.track.state import CLOCK, NAV, PHI, R_, SIZE, V_, State

# A position no better than this share of the range is not told.
WORST_SHARE: Final = 0.2


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
    """Bring both nodes' parts to one time, between their clocks as a fix's stamp is: A half the offset back, B on."""
    half_s = 0.5 * state.clock_s
    turns = rotation_exp(rates_radps * np.array(((-half_s,), (half_s,))))
    return state.moved(state.r_m + half_s * state.v_mps, state.v_mps, state.R @ turns)


def at_one_time_jacobian(state: State, rates_radps: Floats) -> Floats:
    """Give the errors (NAV, SIZE) of the state at one time by the state's."""
    J = np.zeros((NAV, SIZE))
    J[:, :NAV] = np.eye(NAV)
    J[R_, V_] = 0.5 * state.clock_s * np.eye(3)
    turned_a = -0.5 * (state.R[0] @ rates_radps[0])
    J[PHI[0], CLOCK] = turned_a
    J[PHI[1], CLOCK] = 0.5 * (state.R[1] @ rates_radps[1])
    # The errors are those of plus: r turns with phi_A, which the clock turns here.
    across = skew(turned_a)
    J[R_, CLOCK] = 0.5 * state.v_mps - across @ state.r_m
    J[V_, CLOCK] = -across @ state.v_mps
    return J


def pose_jacobian(now: State) -> Floats:
    """Give the errors (9, NAV) of t_a_b, of the rotation and of v_a_b by those of a state at one time.

    t = R_A^T r with r = exp(phi_A) r + dr, so dt = R_A^T dr whatever phi_A is, and w = R_A^T (phi_B - phi_A).
    """
    toward = now.R[0].T
    J = np.zeros((9, NAV))
    J[0:3, R_] = toward
    J[3:6, PHI[0]], J[3:6, PHI[1]] = -toward, toward
    J[6:9, V_] = toward
    return J


def pose_of(state: State, P: Floats, rates_radps: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Give t_a_b_m (3,), its and the rotation's covariance (6, 6), v_a_b_mps (3,) and its covariance (3, 3)."""
    now = at_one_time(state, rates_radps)
    toward = now.R[0].T
    J = pose_jacobian(now) @ at_one_time_jacobian(state, rates_radps)
    whole = J @ P @ J.T
    return toward @ now.r_m, whole[:6, :6], toward @ now.v_mps, whole[6:, 6:]


def row_of(stamp_ns: int, state: State, P: Floats, rates_radps: Floats, lights: int, age_s: float) -> TrackRow | None:
    """Give the row of a state, None where its position is no better than WORST_SHARE of the range."""
    now = at_one_time(state, rates_radps)
    r, toward = now.r_m, now.R[0].T
    range_m = math.sqrt(float(r @ r))
    J = np.zeros((12, NAV))
    J[:9] = pose_jacobian(now)
    J[9:, R_] = np.eye(3)
    J[9:, PHI[0]] = -skew(r)
    J = J @ at_one_time_jacobian(state, rates_radps)
    whole = J @ P @ J.T
    covariance, v_covariance, of_ned = whole[:6, :6], whole[6:9, 6:9], whole[9:, 9:]
    if not np.isfinite(whole).all() or math.sqrt(float(np.trace(covariance[:3, :3]))) > WORST_SHARE * range_m:
        return None
    return TrackRow(
        stamp_ns=stamp_ns,
        t_a_b_m=toward @ r,
        q_a_b_xyzw=matrix_to_quat(now.R[0].T @ now.R[1]),
        covariance=covariance,
        v_a_b_mps=toward @ now.v_mps,
        v_covariance=v_covariance,
        lights=lights,
        age_s=age_s,
        range_m=range_m,
        t_ned_m=r.copy(),
        sigma_ned_m=np.sqrt(np.diag(of_ned)),
        **vars(direction_of(r, of_ned)),
    )
