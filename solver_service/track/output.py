"""What the track tells: pose, velocity and their covariances, in A's camera frame and north-east-down."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, matrix_to_quat, rotation_exp, skew
from buddyline.solver_service.track.state import CLOCK, NAV, PHI, R_, SIZE, V_, State

# A position no better than this share of the range is not told.
WORST_SHARE: Final = 0.2


@dataclass(frozen=True, eq=False)
class TrackRow:
    """The track at one time (A's clock), as the message Track has it."""

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


def at_one_time(state: State, rate_b_radps: Floats) -> State:
    """Bring B's part of a state to A's time: what B has moved while its clock was ahead."""
    turn = rotation_exp(rate_b_radps * state.clock_s)
    return state.moved(state.r_m + state.clock_s * state.v_mps, state.v_mps, np.stack((state.R[0], state.R[1] @ turn)))


def at_one_time_jacobian(state: State, rate_b_radps: Floats) -> Floats:
    """Give the errors (NAV, SIZE) of the state at one time by the state's."""
    J = np.zeros((NAV, SIZE))
    J[:, :NAV] = np.eye(NAV)
    J[R_, V_] = state.clock_s * np.eye(3)
    J[R_, CLOCK] = state.v_mps
    J[PHI[1], CLOCK] = state.R[1] @ rate_b_radps
    return J


def pose_of(state: State, P: Floats, rate_b_radps: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Give t_a_b_m (3,), its and the rotation's covariance (6, 6), v_a_b_mps (3,) and its covariance (3, 3).

    t = R_A^T r with r = exp(phi_A) r + dr, so dt = R_A^T dr whatever phi_A is, and w = R_A^T (phi_B - phi_A).
    """
    toward = state.R[0].T
    J = np.zeros((9, NAV))
    J[0:3, R_] = toward
    J[3:6, PHI[0]], J[3:6, PHI[1]] = -toward, toward
    J[6:9, V_] = toward
    J = J @ at_one_time_jacobian(state, rate_b_radps)
    whole = J @ P @ J.T
    now = at_one_time(state, rate_b_radps)
    return toward @ now.r_m, whole[:6, :6], toward @ now.v_mps, whole[6:, 6:]


def row_of(stamp_ns: int, state: State, P: Floats, rate_b_radps: Floats, lights: int, age_s: float) -> TrackRow | None:
    """Give the row of a state, None where its position is no better than WORST_SHARE of the range."""
    t_a_b, covariance, v_a_b, v_covariance = pose_of(state, P, rate_b_radps)
    range_m = float(np.linalg.norm(t_a_b))
    if not np.isfinite(covariance).all() or math.sqrt(float(np.trace(covariance[:3, :3]))) > WORST_SHARE * range_m:
        return None
    now = at_one_time(state, rate_b_radps)
    r = now.r_m
    J = np.zeros((3, NAV))
    J[:, R_] = np.eye(3)
    J[:, PHI[0]] = -skew(r)
    J = J @ at_one_time_jacobian(state, rate_b_radps)
    of_ned = J @ P @ J.T
    flat2 = max(float(r[0] ** 2 + r[1] ** 2), 1e-12)
    flat = math.sqrt(flat2)
    by_azimuth = np.array((-r[1], r[0], 0.0)) / flat2
    by_inclination = np.array((r[0] * r[2] / flat, r[1] * r[2] / flat, -flat)) / (flat2 + float(r[2]) ** 2)
    return TrackRow(
        stamp_ns=stamp_ns,
        t_a_b_m=t_a_b,
        q_a_b_xyzw=matrix_to_quat(now.R[0].T @ now.R[1]),
        covariance=covariance,
        v_a_b_mps=v_a_b,
        v_covariance=v_covariance,
        lights=lights,
        age_s=age_s,
        range_m=range_m,
        t_ned_m=r.copy(),
        sigma_ned_m=np.sqrt(np.diag(of_ned)),
        azimuth_rad=math.atan2(r[1], r[0]) % (2.0 * math.pi),
        sigma_azimuth_rad=math.sqrt(float(by_azimuth @ of_ned @ by_azimuth)),
        inclination_rad=-math.atan2(r[2], flat),
        sigma_inclination_rad=math.sqrt(float(by_inclination @ of_ned @ by_inclination)),
    )
