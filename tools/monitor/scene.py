"""The pair in space: places in the scene's frame, which is north, east and down with A's camera at its origin.

If A's attitude is unknown, A is drawn level, looking north, and the scene says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from buddyline.protocol.messages import Attitude, NodeInfo
from buddyline.solver_service.geometry.rotation import quat_to_matrix
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


def fields_of_view(info: NodeInfo) -> tuple[float, float]:
    """Return the camera's vertical field of view (rad) and aspect, as a pinhole would have them."""
    camera = info.camera
    return float(2.0 * np.arctan2(0.5 * info.height_px, camera.fy_px)), info.width_px / info.height_px
