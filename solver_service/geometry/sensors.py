"""What attitude and depth of both nodes say, in the terms that a pose can be tried against."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.observation import Observation, Sensed
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats, quat_to_matrix
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
_UNKNOWN: Final = (math.nan,) * 4
_NO_TURN: Final = (0.0, 0.0, 0.0, 1.0)
# Square length of a quaternion below which it is no rotation's: a unit one with rounding errors is far above.
_LEAST_LENGTH2: Final = 0.25


@dataclass(eq=False, slots=True)
class Sensors:
    """Attitudes and depths at T triggers; the second axis holds A's value first.

    R_ned_camera: (T, 2, 3, 3) from the cameras' frames to magnetic north, east, down; the bar level where the attitude
    is unknown. down: (T, 2, 3) in each bar frame. known: (T, 2) whether the attitude is, both: (T,) whether both are.
    speaks: (3, T) whether tilt, heading and depth may speak. Variances, rad^2 per axis: tilts_variance (T,) of both
    tilts together, fall_variance (T,) of the tilt that depths are compared by, A's where it is known, heading_variance
    (T,) of both headings' difference. depth_m: (T,) of B's port below A's, NaN where unknown. depth_variance: (T,) m^2.
    """

    R_ned_camera: Floats
    down: Floats
    known: NDArray[np.bool_]
    both: NDArray[np.bool_]
    speaks: NDArray[np.bool_]
    tilts_variance: Floats
    fall_variance: Floats
    heading_variance: Floats
    depth_m: Floats
    depth_variance: Floats


def find_sensors(observations: Sequence[Observation], rigs: RigPair, checks: frozenset[str]) -> Sensors:
    """Bring attitudes and depths into the cameras' frames; what is not finite is as good as not there."""
    rows = [_row_of(one) for seen in observations for one in (seen.sensed_a, seen.sensed_b)]
    table = np.array(rows).reshape(-1, 2, len(rows[0]))
    known = table[..., 4] > 0.0
    # Headings corrected to true north, and not: both count alike.
    R_ned_body = rigs.R_magnetic_ned @ quat_to_matrix(table[..., :4])
    R_ned_camera = np.where(known[..., None, None], R_ned_body @ rigs.R_body_camera, rigs.R_ned_upright)
    of_a, of_b = table[:, 0, 5:], table[:, 1, 5:]
    tilts_variance, heading_variance, _, depth_variance = (of_a + of_b).T
    known_a, known_b = known.T
    below_m = np.where(known_a | known_b, of_b[:, 2] - of_a[:, 2], np.nan)
    both, speaks = known_a & known_b, np.zeros((3, len(known)), dtype=bool)
    if "attitude" in checks:
        # Where an attitude is unknown, its tilt is that of an upright diver.
        speaks[0], speaks[1] = True, both
    if "depth" in checks:
        speaks[2] = np.isfinite(below_m)
    return Sensors(
        R_ned_camera=R_ned_camera,
        down=(rigs.R_bar_camera @ R_ned_camera[..., 2, :, None])[..., 0],
        known=known,
        both=both,
        speaks=speaks,
        tilts_variance=tilts_variance,
        fall_variance=np.where(known_a, of_a[:, 0], of_b[:, 0]),
        heading_variance=heading_variance,
        depth_m=below_m,
        depth_variance=depth_variance,
    )


def _row_of(sensed: Sensed) -> tuple[float, ...]:
    """Give quaternion, 1 if it is known, variances of tilt and heading, depth (NaN: unknown) and its variance (9,)."""
    depth_m, sigma_m = sensed.depth_m, sensed.depth_sigma_m
    depth2 = sigma_m * sigma_m if sigma_m is not None and math.isfinite(sigma_m) else 0.0
    depth = math.nan if depth_m is None else depth_m, depth2 + 0.5 * _DEPTH_SIGMA_M**2
    x, y, z, w = _finite(sensed.q_ned_body_xyzw, _UNKNOWN)
    length2 = x * x + y * y + z * z + w * w
    if not _LEAST_LENGTH2 < length2 < math.inf:
        return *_NO_TURN, 0.0, _UPRIGHT_SIGMA_RAD**2, math.inf, *depth
    roll_rad, pitch_rad, yaw_rad = _finite(sensed.sigma_rad, _DEFAULT_SIGMA_RAD)
    roll2, pitch2, yaw2 = roll_rad * roll_rad, pitch_rad * pitch_rad, yaw_rad * yaw_rad
    # Roll turns about the body's x axis, pitch about the horizontal across it, yaw about the vertical.
    steep = 2.0 * (x * z - w * y) / length2
    roll2_in_yaw = roll2 * steep * steep
    tilt2 = 0.5 * (pitch2 + roll2 - roll2_in_yaw) + _MOUNT_SIGMA_RAD**2
    return x, y, z, w, 1.0, tilt2, yaw2 + roll2_in_yaw + _HEADING_SIGMA_RAD**2, *depth


def _finite(values: Floats | None, unknown: tuple[float, ...]) -> Sequence[float]:
    """Give a vector's numbers; `unknown` where they are not finite or not as many."""
    if values is None or len(values) != len(unknown):
        return unknown
    numbers: list[float] = values.tolist()
    return numbers if math.isfinite(sum(numbers)) else unknown


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
    if offset_rad != 0.0:
        c, s = math.cos(offset_rad), math.sin(offset_rad)
        cosine, sine = c * cosine + s * sine, c * sine - s * cosine
    angle: Floats = 2.0 * np.arctan2(sine, 1.0 + level + cosine)
    return angle


def heading_offset(T_a_b: SE3, covariance: Floats, R_ned_a: Floats, R_ned_b: Floats) -> tuple[float, float]:
    """Give what is to be added to B's heading for both to agree with a pose, rad, and the pose's own variance of it.

    covariance: (6, 6) of the pose. R_ned_a, R_ned_b: (3, 3) from the cameras' frames.
    """
    (xx, xy, _), (yx, yy, _), _ = (R_ned_a @ T_a_b.R @ R_ned_b.T).tolist()
    return math.atan2(yx - xy, xx + yy), float(R_ned_a[2] @ covariance[3:, 3:] @ R_ned_a[2])
