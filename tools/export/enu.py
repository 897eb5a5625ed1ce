"""Where A's camera is in a world of east, north, up with its origin on the surface, for other programs' viewers.

Those viewers know one tree of frames. Of more than two nodes each may be placed by several others.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Depth, NodeInfo, NodePose
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from numpy.typing import NDArray

R_ENU_NED: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Least time between two transforms of A's camera: a viewer needs no more.
SPACING_NS: Final = S_NS // 20
# A parent that has not placed a frame for this time is its parent no longer.
SILENT_NS: Final = S_NS


class FrameTree:
    """Which frame places which: a frame has one parent at a time, and none is above itself."""

    def __init__(self) -> None:
        self._placed: dict[str, tuple[str, int]] = {}

    def parent(self, frame: str, now_ns: int) -> str | None:
        """Return what has placed a frame lately; None for a root."""
        parent, at_ns = self._placed.get(frame, ("", now_ns - 2 * SILENT_NS))
        return parent if abs(now_ns - at_ns) <= SILENT_NS else None

    def root(self, frame: str, now_ns: int) -> str:
        """Return the frame above a frame that nothing has placed."""
        while (parent := self.parent(frame, now_ns)) is not None:
            frame = parent
        return frame

    def place(self, parent: str, frame: str, now_ns: int, *, first: bool = False) -> bool:
        """Return whether the parent may place a frame now, and note that. first: it goes before any other parent."""
        held = None if first else self.parent(frame, now_ns)
        if held not in (None, parent) or self.root(parent, now_ns) == frame:
            return False
        self._placed[frame] = parent, now_ns
        return True


def net_enu(pose: NodePose) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a node's place (3,) in m and R (3, 3) of its camera, in its net's frame turned to east, north, up."""
    return R_ENU_NED @ np.array(pose.p_m), R_ENU_NED @ quat_to_matrix(np.array(pose.q_xyzw))


class NetDepths:
    """How deep the zero of each net is: as one of its nodes says, the first with a depth."""

    def __init__(self) -> None:
        self._sounded: dict[str, str] = {}

    def up_m(self, pose: NodePose, camera: BaseCamera) -> float | None:
        """Return how high the net's zero is in the world; None where this node's depth does not say it."""
        above_m = float(camera.position_m(pose.node)[2])
        if not above_m or self._sounded.setdefault(pose.net, pose.node) != pose.node:
            return None
        return above_m + pose.p_m[2]


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
