"""What depth gauges and attitude messages tell the track: residuals and Jacobians."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_log
from buddyline.solver_service.track.state import DEPTH_OFFSET, DEPTH_SCALE, PHI, R_, SIZE, V_, State

# For how long an attitude filter errs alike: tilt, heading. A message counts dt / (2 T) of an independent one.
TILT_TIME_S: Final = 10.0
HEADING_TIME_S: Final = 100.0


def attitude_residual(state: State, node: int, R_level_camera: Floats) -> tuple[Floats, Floats]:
    """Give y (3,) = log(R_measured R^T), level axes, and H (3, SIZE)."""
    y = rotation_log(R_level_camera @ state.R[node].T)
    H = np.zeros((3, SIZE))
    H[:, PHI[node]] = np.eye(3)
    return y, H


def attitude_covariance(R_ned_body: Floats, sigma_rad: Floats, tilt_factor: float, heading_factor: float) -> Floats:
    """Give the covariance (3, 3) of an attitude's error in level axes, its variances inflated by the factors.

    An error of roll counts about the level line along the heading, of pitch about that across it, of yaw about the
    vertical. Euler's roll turns about the body's x axis; but a node's filter does not know better which way is down
    where it looks up or down, and states the same sigmas there.
    """
    x, y = R_ned_body[0, 0], R_ned_body[1, 0]
    length = math.hypot(x, y)
    ahead, across = (x / length, y / length) if length > 1e-6 else (1.0, 0.0)
    axes = np.array(((ahead, -across, 0.0), (across, ahead, 0.0), (0.0, 0.0, 1.0)))
    variances = sigma_rad**2 * np.array((tilt_factor, tilt_factor, heading_factor))
    covariance: Floats = (axes * variances) @ axes.T
    return covariance


def depth_residual(state: State, shown_m: float, age_s: float, ports_m: Floats) -> tuple[Floats, Floats]:
    """Give y (1,) and H (1, SIZE) of B's depth minus A's as shown age_s before the state's time.

    ports_m (2, 3): of the ports, camera frames. h = (1 + scale) d + offset, d = (r + R_B p_B - R_A p_A)_z - v_z age.
    """
    (xa, ya, za), (xb, yb, zb) = (state.R @ ports_m[:, :, None])[:, :, 0].tolist()
    (x, y, z), (u, v, w) = state.r_m.tolist(), (age_s * state.v_mps).tolist()
    d, scaled = z - w + zb - za, 1.0 + state.depth_scale
    H = np.zeros((1, SIZE))
    H[0, R_.start + 2] = scaled
    H[0, V_.start + 2] = -scaled * age_s
    # Turning moves what stands at p by phi x p, of which this is the downward part; r turns with phi_B, v with phi_A.
    H[0, PHI[0]] = scaled * (-v - ya), scaled * (xa + u), 0.0
    H[0, PHI[1]] = scaled * (y + yb), scaled * (-x - xb), 0.0
    H[0, DEPTH_OFFSET] = 1.0
    H[0, DEPTH_SCALE] = d
    return np.array((shown_m - scaled * d - state.depth_offset_m,)), H


class Update(NamedTuple):
    """The error (SIZE,) to add, the covariance after, chi^2 of the residual, its covariance's inverse, and the gain."""

    error: Floats
    covariance: Floats
    chi2: float
    S_inverse: Floats
    gain: Floats


def kalman(P: Floats, H: Floats, y: Floats, noise: Floats) -> Update:
    """Give what residuals y (m,) of a covariance H P H^T + noise tell."""
    across = P @ H.T
    S = H @ across + noise
    inverse = np.asarray(np.linalg.inv(S), np.float64)
    gain = across @ inverse
    after = P - gain @ across.T
    after = 0.5 * (after + after.T)
    return Update(gain @ y, after, float(y @ inverse @ y), inverse, gain)
