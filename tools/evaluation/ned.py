"""Compare poses and tracks in NED with the truth, to check their sigmas in NED."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from buddyline.protocol.messages import RelativePose, Track
from buddyline.tools.evaluation.rotation import Floats, rotate
from buddyline.tools.evaluation.truth import PoseHistory
from buddyline.tools.progress import counted
from msgspec import UNSET


@dataclass(frozen=True)
class NedHonesty:
    """Mean squares of errors over their sigmas: 1 if the sigmas are true.

    samples: number with true NED. A compass has nearly the same error for minutes, so the values of a short dive
    scatter widely about 1.
    """

    samples: int
    north: float
    east: float
    down: float
    azimuth: float
    inclination: float


def wrapped(angle_rad: Floats) -> Floats:
    """Return angles wrapped to -pi..pi."""
    within: Floats = (angle_rad + np.pi) % (2.0 * np.pi) - np.pi
    return within


def angles_of(t_ned: Floats) -> tuple[Floats, Floats]:
    """Return azimuth (from north, clockwise) and inclination (up positive) of t_ned (N, 3)."""
    north, east, down = t_ned.T
    return np.arctan2(east, north), np.arctan2(-down, np.hypot(north, east))


def ned_honesty(
    found: Sequence[tuple[RelativePose | Track, Floats]], ned_camera_a: PoseHistory | None
) -> NedHonesty | None:
    """Compare poses, or samples of a track, each with its true t_a_b_m (3,); None if none has sigmas in NED.

    ned_camera_a: A's true camera poses in NED.
    """
    if ned_camera_a is None:
        return None
    errors, sigmas = [], []
    for said, true_t_m in counted(found, "evaluate against true NED"):
        stamp_ns = said.stamp_ns + (said.skew_ns // 2 if isinstance(said, RelativePose) else 0)
        known = ned_camera_a.at(stamp_ns)
        angles = (said.azimuth_rad, said.inclination_rad, said.sigma_azimuth_rad, said.sigma_inclination_rad)
        told = [angle for angle in angles if angle is not UNSET]
        if known is None or said.t_ned_m is UNSET or said.sigma_ned_m is UNSET or len(told) < len(angles):
            continue
        true_m = rotate(known[1], true_t_m)
        azimuth_rad, inclination_rad = angles_of(true_m[None])
        off = np.subtract((*said.t_ned_m, *told[:2]), (*true_m, *azimuth_rad, *inclination_rad))
        off[3] = wrapped(off[3:4])[0]
        errors.append(off)
        sigmas.append((*said.sigma_ned_m, *told[2:]))
    if not errors:
        return None
    squares = (np.array(errors) / np.maximum(np.array(sigmas), 1e-12)) ** 2
    return NedHonesty(len(errors), *squares.mean(axis=0).tolist())
