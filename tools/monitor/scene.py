"""The pair in space: places in the scene's frame, which is north, east and down with A's camera at its origin.

If A's attitude is unknown, A is drawn level, looking north, and the scene says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from buddyline.protocol.messages import Attitude, NodeInfo
from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix
from buddyline.tools.estimate import Estimate
from msgspec import UNSET
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

# A camera that is level and looks north: x right is east, y down is down, z forward is north.
R_LEVEL: Final[Floats] = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
# Half axes of the 95 % ellipsoid of a position, in standard deviations (chi-squared, 3 degrees of freedom).
ELLIPSOID_SD: Final = 2.795
# A smaller ellipsoid looks like a point, and its axes are rounding errors.
MIN_HALF_AXIS_M: Final = 1e-4
MAX_HALF_AXIS_M: Final = 50.0
# Share of a view's height, from its middle, that is well inside it; the panel covers one side.
INSIDE: Final = 0.4


@dataclass(frozen=True)
class SceneFrame:
    """The orientation of A's camera: R_s_a maps its frame into the scene's; levelled: by a measured attitude."""

    R_s_a: Floats
    levelled: bool

    @staticmethod
    def unknown() -> SceneFrame:
        """Return A level and looking north: its attitude is unknown."""
        return SceneFrame(R_LEVEL, False)

    def place(self, estimate: Estimate) -> tuple[float, float, float]:
        """Return B's position in the scene (m)."""
        if self.levelled and estimate.t_ned_m is not UNSET:
            return estimate.t_ned_m
        x, y, z = (self.R_s_a @ np.array(estimate.t_a_b_m)).tolist()
        return x, y, z

    def turn_b(self, estimate: Estimate) -> Floats:
        """Return R_s_b: B's camera in the scene."""
        R_s_b: Floats = self.R_s_a @ quat_to_matrix(np.array(estimate.q_a_b_xyzw))
        return R_s_b


def frame_of(info: NodeInfo | None, attitude: Attitude | None) -> SceneFrame:
    """Return a camera's orientation by its mount and its node's attitude."""
    if info is None or attitude is None:
        return SceneFrame.unknown()
    R_s_body = quat_to_matrix(np.array(attitude.q_ned_body_xyzw))
    return SceneFrame(R_s_body @ quat_to_matrix(np.array(info.q_body_camera_xyzw)), True)


def ellipsoid(estimate: Estimate, frame: SceneFrame) -> tuple[Floats, Floats]:
    """Return the half axes (3,), m, and R_s_axes (3, 3) of B's 95 % ellipsoid."""
    covariance = np.array(estimate.covariance).reshape(6, 6)[:3, :3]
    variances, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
    if np.linalg.det(axes) < 0:
        axes[:, 0] = -axes[:, 0]
    half_m = ELLIPSOID_SD * np.sqrt(np.maximum(variances, 0.0))
    return np.clip(half_m, MIN_HALF_AXIS_M, MAX_HALF_AXIS_M), frame.R_s_a @ axes


def wxyz(R: Floats) -> tuple[float, float, float, float]:
    """Return a rotation as a quaternion with its real part first."""
    x, y, z, w = matrix_to_quat(R).tolist()
    return w, x, y, z


def fields_of_view(info: NodeInfo) -> tuple[float, float]:
    """Return the camera's vertical field of view (rad) and aspect, as a pinhole would have them."""
    camera = info.camera
    return float(2.0 * np.arctan2(0.5 * info.height_px, camera.fy_px)), info.width_px / info.height_px


def fit(t_m: Floats, aspect: float) -> tuple[Floats, Floats]:
    """Return eye and target (3,) of a view from above with A, at the origin, and B, at t_m, side by side.

    aspect: width by height of the view.
    """
    target: Floats = 0.5 * t_m
    across_m = float(np.hypot(t_m[0], t_m[1]))
    forward = np.array([t_m[0], t_m[1], 0.0]) / across_m if across_m > 1e-3 else np.array([1.0, 0.0, 0.0])
    aside = np.array([-forward[1], forward[0], 0.0])
    distance_m = float(np.linalg.norm(t_m)) + 1.5
    up = np.array([0.0, 0.0, -1.0])
    if aspect < 1.0:
        # A phone held upright: one behind the other, in the upper half; the panel covers the lower.
        return target + distance_m * (0.45 * aside - forward + 0.75 * up), target - 0.6 * distance_m * up
    return target + distance_m * (0.8 * aside - 0.35 * forward + 0.5 * up), target


def holds(eye: Floats, target: Floats, fov_rad: float, points: Floats) -> bool:
    """Return whether an eye that looks at target has all points (n, 3) well inside a view of this height."""
    towards, ahead = points - eye, target - eye
    cosine = (towards @ ahead) / (np.linalg.norm(towards, axis=1) * np.linalg.norm(ahead) + 1e-9)
    return bool((cosine > np.cos(INSIDE * fov_rad)).all())


def age_colours(ages_s: Floats, whole_s: float) -> NDArray[np.uint8]:
    """Return a colour (n, 3) for each age: bright amber at 0, fading into blue at whole_s.

    Linear values, not sRGB: viser takes the colours of single points so.
    """
    share = np.clip(ages_s / whole_s, 0.0, 1.0)[:, None]
    fresh, old = np.array([1.0, 0.45, 0.04]), np.array([0.03, 0.09, 0.26])
    return np.asarray(np.round(255.0 * (fresh + (old - fresh) * np.sqrt(share))), np.uint8)
