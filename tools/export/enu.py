"""Where A's camera is in a world of east, north, up with its origin on the surface, for other programs' viewers."""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Depth, NodeInfo
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from numpy.typing import NDArray

R_ENU_NED: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Least time between two transforms of A's camera: a viewer needs no more.
SPACING_NS: Final = S_NS // 20


class BaseCamera:
    """Follows the camera of the node that all others are placed by. base: its id, None until it is known."""

    def __init__(self) -> None:
        self.base: str | None = None
        self.infos: dict[str, NodeInfo] = {}
        self._depth_m: dict[str, float] = {}
        self._placed_ns: dict[str, int] = {}

    def take(self, message: NodeInfo | Depth) -> None:
        """Take a node's calibration or depth."""
        if isinstance(message, NodeInfo):
            self.infos[message.node] = message
        else:
            self._depth_m[message.node] = message.depth_m

    def position_m(self, node: str) -> NDArray[np.float64]:
        """Return a node's position: below the origin, or at it as long as its depth is not known."""
        return np.array([0.0, 0.0, -self._depth_m.get(node, 0.0)])

    def orientation(self, attitude: Attitude) -> NDArray[np.float64] | None:
        """Return R_enu_camera of the base; None for another node, without a calibration, or too soon after the last."""
        node, stamp_ns = attitude.node, attitude.stamp_ns
        info, before_ns = self.infos.get(node), self._placed_ns.get(node)
        if node != self.base or info is None:
            return None
        if before_ns is not None and 0 <= stamp_ns - before_ns < SPACING_NS:
            return None
        self._placed_ns[node] = stamp_ns
        R_ned_body, R_body_camera = quat_to_matrix(np.array((attitude.q_ned_body_xyzw, info.q_body_camera_xyzw)))
        R_enu_camera: NDArray[np.float64] = R_ENU_NED @ (R_ned_body @ R_body_camera)
        return R_enu_camera
