"""What attitude and depth of both nodes say, in the terms that a pose can be tried against."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.observation import Observation, Sensed
from buddyline.solver_service.geometry.rig import NOMINAL_R_BODY_CAMERA, RigPair
from buddyline.solver_service.geometry.rotation import Floats, inner, quat_to_matrix
from buddyline.solver_service.geometry.se3 import SE3
from numpy.typing import NDArray

# Added to what the sensors say of themselves: mount, and a heading's slow bias.
_MOUNT_SIGMA_RAD: Final = math.radians(1.0)
_HEADING_SIGMA_RAD: Final = math.radians(3.0)
# Roll, pitch and yaw of a cheap unit that does not say how good it is.
_DEFAULT_SIGMA_RAD: Final = (math.radians(2.0), math.radians(2.0), math.radians(10.0))
_DEPTH_SIGMA_M: Final = 0.02
# A diver who is not known to lie otherwise is upright to about this (1 sd).
_UPRIGHT_SIGMA_RAD: Final = 0.45
_NOWHERE: Final = (math.nan,) * 4


@dataclass(eq=False, slots=True)
class Sensors:
    """Attitudes and depths at T triggers; the second axis holds A's value first.

    R_ned_bar: (T, 2, 3, 3) from the bar frames to magnetic north, east, down; upright where the attitude is unknown.
    known: (T, 2) whether the attitude is, both: (T,) whether both are.
    tilt_variance: (T, 2) rad^2 per axis. heading_variance: (T,) of both
    headings' difference. depth_m: (T,) of B's port below A's, NaN where unknown. depth_variance: (T,).
    """

    R_ned_bar: Floats
    known: NDArray[np.bool_]
    both: NDArray[np.bool_]
    tilt_variance: Floats
    heading_variance: Floats
    depth_m: Floats
    depth_variance: Floats

    @property
    def down(self) -> Floats:
        """(T, 2, 3) in each bar frame."""
        return self.R_ned_bar[:, :, 2]


def find_sensors(observations: Sequence[Observation], rigs: RigPair) -> Sensors:
    """Bring attitudes and depths into the bar frames; what is not finite is as good as not there."""
    sensed = [(seen.sensed_a, seen.sensed_b) for seen in observations]
    q = np.array([[_finite(one.q_ned_body_xyzw, 4) for one in two] for two in sensed])
    sigma = np.array([[_finite(one.sigma_rad, 3) for one in two] for two in sensed])
    depth = np.array([[_depth_of(one) for one in two] for two in sensed])
    known = inner(q, q) > 0.25
    q[~known] = (0.0, 0.0, 0.0, 1.0)
    sigma = np.where(np.isfinite(sigma).all(-1, keepdims=True), sigma, _DEFAULT_SIGMA_RAD)
    # Headings corrected to true north, and not: both count alike.
    R_ned_body = rigs.R_magnetic_ned @ quat_to_matrix(q)
    R_ned_bar = R_ned_body @ rigs.R_body_bar
    R_ned_bar[~known] = NOMINAL_R_BODY_CAMERA
    # Roll turns about the body's x axis, pitch about the horizontal across it, yaw about the vertical.
    steep2 = R_ned_body[:, :, 2, 0] ** 2
    roll2, pitch2, yaw2 = (sigma * sigma).transpose(2, 0, 1)
    tilt = 0.5 * (pitch2 + roll2 * (1.0 - steep2)) + _MOUNT_SIGMA_RAD**2
    heading = yaw2 + roll2 * steep2 + _HEADING_SIGMA_RAD**2
    below_m = depth[:, 1, 0] - depth[:, 0, 0]
    return Sensors(
        R_ned_bar=R_ned_bar,
        known=known,
        both=known[:, 0] & known[:, 1],
        tilt_variance=np.where(known, tilt, _UPRIGHT_SIGMA_RAD**2),
        heading_variance=heading.sum(1),
        depth_m=np.where(known.any(1) & np.isfinite(below_m), below_m, np.nan),
        depth_variance=depth[:, :, 1].sum(1) + _DEPTH_SIGMA_M**2,
    )


def _finite(value: Floats | None, size: int) -> Floats | tuple[float, ...]:
    """Give a vector of this size and finite numbers, NaN for everything else."""
    if value is None or np.shape(value) != (size,) or not math.isfinite(sum(value)):
        return _NOWHERE[:size]
    return value


def _depth_of(sensed: Sensed) -> tuple[float, float]:
    """Give depth and its variance, NaN and 0 where unknown."""
    depth_m, sigma_m = sensed.depth_m, sensed.depth_sigma_m
    return (
        math.nan if depth_m is None else depth_m,
        sigma_m**2 if sigma_m is not None and math.isfinite(sigma_m) else 0.0,
    )


def turn_of(R_a_b: Floats, R_ned_a: Floats, R_ned_b: Floats) -> Floats:
    """Compare K poses R_a_b (K, 3, 3) with attitudes (K, 3, 3), frames as the poses'.

    Returns (3, K): the cosine between both downs, then cosine and sine of the turn about down from B's heading by the
    attitudes to that by the pose, each (1 + level) long.
    """
    between = R_ned_a @ R_a_b @ R_ned_b.swapaxes(-1, -2)
    level, cosine = between[..., 2, 2], between[..., 0, 0] + between[..., 1, 1]
    return np.array((level, cosine, between[..., 1, 0] - between[..., 0, 1]))


def off_rad(turn: Floats, offset_rad: float = 0.0) -> Floats:
    """Give the turn (K,) about down where offset_rad is to be added to B's heading; turn: (3, K) as `turn_of`'s."""
    level, cosine, sine = turn
    c, s = math.cos(offset_rad), math.sin(offset_rad)
    angle: Floats = 2.0 * np.arctan2(c * sine - s * cosine, 1.0 + level + c * cosine + s * sine)
    return angle


def heading_offset(T_a_b: SE3, covariance: Floats, R_ned_a: Floats, R_ned_b: Floats) -> tuple[float, float]:
    """Give what is to be added to B's heading for both to agree with a pose, rad, and the pose's own variance of it.

    covariance: (6, 6) of the pose. R_ned_a, R_ned_b: (3, 3) from the cameras' frames.
    """
    _, cosine, sine = turn_of(T_a_b.R, R_ned_a, R_ned_b).tolist()
    return math.atan2(sine, cosine), float(R_ned_a[2] @ covariance[3:, 3:] @ R_ned_a[2])
