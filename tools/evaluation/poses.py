"""Errors of poses against truth, one value per pose."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from buddyline.protocol.messages import RelativePose, Track
from buddyline.tools.evaluation.ned import angles_of, wrapped
from buddyline.tools.evaluation.rotation import Floats, conjugate, multiply, normalized, rotate, rotation_vector
from buddyline.tools.evaluation.truth import PoseHistory, TruthTrack
from msgspec import UNSET
from numpy.typing import NDArray

# A pose is wrong if its position error is above this share of the true range.
WRONG_SHARE: Final = 0.1


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """The errors of N poses with truth, in order of time; NaN where a value is not known.

    t_m, true_t_m: (N, 3), in A's camera frame. range_m, azimuth_rad, inclination_rad: published minus true.
    bearing_rad: angle between the published and the true direction to B. azimuth and inclination: compared with true
    NED if the dive has A's true poses in it; else with the truth rotated by A's measured attitude, and then they do not
    contain the compass's own error.
    nees6, nees3: NEES of the pose and of the position; their means are 6 and 3 if the covariance is true. right_pair:
    1, 0 or NaN.
    """

    stamp_ns: NDArray[np.int64]
    trigger: NDArray[np.int64]
    t_m: Floats
    true_t_m: Floats
    true_range_m: Floats
    translation_m: Floats
    rotation_rad: Floats
    range_m: Floats
    bearing_rad: Floats
    azimuth_rad: Floats
    inclination_rad: Floats
    nees6: Floats
    nees3: Floats
    wrong: NDArray[np.bool_]
    right_pair: Floats

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def select(self, chosen: NDArray[np.bool_]) -> PoseErrors:
        """Return the poses for which chosen (N,) holds."""
        return PoseErrors(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})


def nees(errors: Floats, covariances: Floats) -> Floats:
    """Return e^T P^-1 e for errors (N, k) and covariances (N, k, k); NaN where P is not positive definite."""
    result = np.full(len(errors), np.nan)
    if not len(errors):
        return result
    symmetric = 0.5 * (covariances + covariances.transpose(0, 2, 1))
    # The matrix has metres and radians: scaled to a unit diagonal, the test of definiteness does not depend on units.
    diagonal = np.diagonal(symmetric, axis1=1, axis2=2)
    positive = np.asarray((diagonal > 0.0).all(axis=1))
    scale = 1.0 / np.sqrt(np.where(positive[:, None], diagonal, 1.0))
    scaled = symmetric * scale[:, :, None] * scale[:, None, :]
    sound = positive & (np.linalg.eigvalsh(scaled)[:, 0] > 1e-12)
    whitened = (errors * scale)[sound]
    solved = np.linalg.solve(scaled[sound], whitened[:, :, None])[:, :, 0]
    result[sound] = (whitened * solved).sum(axis=1)
    return result


@dataclass(frozen=True, eq=False)
class Differences:
    """Differences of n poses from the truth; t_m, true_t_m (n, 3), the others (n,), as in PoseErrors."""

    t_m: Floats
    true_t_m: Floats
    true_range_m: Floats
    translation_m: Floats
    rotation_rad: Floats
    nees6: Floats
    nees3: Floats


def differences(found: Sequence[tuple[RelativePose | Track, tuple[Floats, Floats]]]) -> Differences:
    """Compare poses, or samples of a track, with their truth: t_a_b_m and q_a_b_xyzw."""
    poses = [pose for pose, _ in found]
    t_m = np.array([pose.t_a_b_m for pose in poses]).reshape(-1, 3)
    q = normalized(np.array([pose.q_a_b_xyzw for pose in poses]).reshape(-1, 4))
    covariances = np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6)
    true_t_m = np.array([known[0] for _, known in found]).reshape(-1, 3)
    true_q = np.array([known[1] for _, known in found]).reshape(-1, 4)
    offset_m, w_rad = true_t_m - t_m, rotation_vector(multiply(true_q, conjugate(q)))
    return Differences(
        t_m=t_m,
        true_t_m=true_t_m,
        true_range_m=np.linalg.norm(true_t_m, axis=1),
        translation_m=np.linalg.norm(offset_m, axis=1),
        rotation_rad=np.linalg.norm(w_rad, axis=1),
        nees6=nees(np.concatenate([offset_m, w_rad], axis=1), covariances),
        nees3=nees(offset_m, covariances[:, :3, :3]),
    )


def _angle_between(one: Floats, other: Floats) -> Floats:
    angle: Floats = np.arctan2(np.linalg.norm(np.cross(one, other), axis=1), (one * other).sum(axis=1))
    return angle


def _published(values: Sequence[object]) -> Floats:
    return np.array([np.nan if value is UNSET else value for value in values], dtype=float)


def _ned_of_a(poses: Sequence[RelativePose], ned_camera_a: PoseHistory | None) -> Floats:
    """Return q_ned_camera (N, 4) of node a at each pose; NaN where unknown."""
    q_ned_camera = np.full((len(poses), 4), np.nan)
    for i, pose in enumerate(poses if ned_camera_a is not None else ()):
        known = ned_camera_a.at(pose.stamp_ns + pose.skew_ns // 2) if ned_camera_a is not None else None
        if known is not None:
            q_ned_camera[i] = known[1]
    return q_ned_camera


def pose_errors(
    poses: Sequence[RelativePose],
    track: TruthTrack,
    is_right: Callable[[RelativePose], bool | None],
    ned_camera_a: PoseHistory | None,
) -> PoseErrors:
    """Compare the poses of one pair with truth; poses without truth are left out.

    ned_camera_a: node a's camera in NED, for azimuth and inclination.
    """
    found = [(pose, known) for pose in poses if (known := track.at(pose.stamp_ns, pose.trigger)) is not None]
    found.sort(key=lambda pair: pair[0].stamp_ns)
    known_poses = [pose for pose, _ in found]
    off = differences(found)

    true_azimuth_rad, true_inclination_rad = angles_of(rotate(_ned_of_a(known_poses, ned_camera_a), off.true_t_m))
    right = (is_right(pose) for pose in known_poses)
    return PoseErrors(
        stamp_ns=np.array([pose.stamp_ns for pose in known_poses], dtype=np.int64),
        trigger=np.array([pose.trigger for pose in known_poses], dtype=np.int64),
        range_m=np.array([pose.range_m for pose in known_poses]) - off.true_range_m,
        bearing_rad=_angle_between(off.t_m, off.true_t_m),
        azimuth_rad=wrapped(_published([pose.azimuth_rad for pose in known_poses]) - true_azimuth_rad),
        inclination_rad=_published([pose.inclination_rad for pose in known_poses]) - true_inclination_rad,
        wrong=off.translation_m > WRONG_SHARE * off.true_range_m,
        right_pair=np.array([np.nan if verdict is None else float(verdict) for verdict in right]),
        **vars(off),
    )
