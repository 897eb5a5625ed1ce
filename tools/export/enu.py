"""Where A's camera is in a world of east, north, up with its origin on the surface, for other programs' viewers.

Those viewers know one tree of frames. Of more than two nodes each may be placed by several others.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import Final, TypeVar

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Depth, NodeInfo, NodePose, Track
from buddyline.solver_service.geometry.rotation import quat_to_matrix, rotation_exp
from msgspec import UNSET
from numpy.typing import NDArray

M = TypeVar("M", Attitude, Depth)

R_ENU_NED: Final = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
# Least time between two transforms of A's camera: a viewer needs no more.
SPACING_NS: Final = S_NS // 20
# A parent that has not placed a frame for this time is its parent no longer.
SILENT_NS: Final = S_NS
# Attitudes and depths that are kept: the rows of `track_lag` come more than a second late.
KEPT: Final = 256


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
        self._depths: dict[str, deque[Depth]] = {}
        self._attitudes: dict[str, deque[Attitude]] = {}
        self._placed_ns: dict[str, int] = {}
        # The pair whose track places the base, and the base's newest attitude at its last row.
        self._tracked: tuple[str, str] | None = None
        self._tracked_ns = 0

    def take(self, message: NodeInfo | Depth) -> None:
        """Take a node's calibration or depth."""
        if isinstance(message, NodeInfo):
            self.infos[message.node] = message
        else:
            self._depths.setdefault(message.node, deque(maxlen=KEPT)).append(message)

    def position_m(self, node: str, at_ns: int | None = None) -> NDArray[np.float64]:
        """Return where a node's camera is: below the origin, or at it as long as its depth is not known.

        The gauge tells how deep its port is; how far that is below the camera is known with an attitude. at_ns: None:
        last.
        """
        depths, attitudes, info = self._depths.get(node), self._attitudes.get(node), self.infos.get(node)
        if not depths:
            return np.zeros(3)
        depth = depths[-1] if at_ns is None else _nearest(reversed(depths), at_ns)
        above_m = 0.0
        if attitudes and info is not None:
            R_enu_camera = _camera(_nearest(reversed(attitudes), depth.stamp_ns), info)
            above_m = -float((R_enu_camera @ np.array(info.depth_port_m))[2])
        return np.array([0.0, 0.0, above_m - depth.depth_m])

    def orientation(self, attitude: Attitude) -> NDArray[np.float64] | None:
        """Return R_enu_camera of the base.

        None for another node, without a calibration, too soon after the last, or while a track places the base.
        """
        node, stamp_ns = attitude.node, attitude.stamp_ns
        self._attitudes.setdefault(node, deque(maxlen=KEPT)).append(attitude)
        info, before_ns = self.infos.get(node), self._placed_ns.get(node)
        if node != self.base or info is None:
            return None
        if self._tracked is not None and self._tracked[0] == node and abs(stamp_ns - self._tracked_ns) <= SILENT_NS:
            return None
        if before_ns is not None and 0 <= stamp_ns - before_ns < SPACING_NS:
            return None
        self._placed_ns[node] = stamp_ns
        return _camera(attitude, info)

    def tracked(self, track: Track) -> NDArray[np.float64] | None:
        """Return R_enu_camera of the base at the stamp of a track's row: B is then where the row's t_ned_m says.

        That is the base's attitude, turned by the smallest rotation to this end: the track knows both nodes' compasses,
        the attitude its own alone. None for another node's track, a second track, or without a near attitude.
        """
        pair, info = (track.node_a, track.node_b), self.infos.get(track.node_a)
        attitudes = self._attitudes.get(track.node_a)
        if track.node_a != self.base or track.t_ned_m is UNSET or info is None or not attitudes:
            return None
        newest_ns = attitudes[-1].stamp_ns
        if self._tracked not in (None, pair) and abs(newest_ns - self._tracked_ns) <= SILENT_NS:
            return None
        attitude = _nearest(reversed(attitudes), track.stamp_ns)
        if abs(attitude.stamp_ns - track.stamp_ns) > SILENT_NS:
            return None
        self._tracked, self._tracked_ns = pair, newest_ns
        R_enu_camera = _camera(attitude, info)
        return _between(R_enu_camera @ np.array(track.t_a_b_m), R_ENU_NED @ np.array(track.t_ned_m)) @ R_enu_camera


def _camera(attitude: Attitude, info: NodeInfo) -> NDArray[np.float64]:
    """Return R_enu_camera by an attitude."""
    R_ned_body, R_body_camera = quat_to_matrix(np.array((attitude.q_ned_body_xyzw, info.q_body_camera_xyzw)))
    R_enu_camera: NDArray[np.float64] = R_ENU_NED @ (R_ned_body @ R_body_camera)
    return R_enu_camera


def _nearest(newest_first: Iterable[M], at_ns: int) -> M:
    """Return the message nearest to a time; of two that are as near, the newer."""
    messages = iter(newest_first)
    best = next(messages)
    for message in messages:
        if abs(message.stamp_ns - at_ns) >= abs(best.stamp_ns - at_ns):
            break
        best = message
    return best


def _between(v: NDArray[np.float64], w: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smallest rotation that brings the direction of v (3,) to that of w (3,)."""
    axis, inner = np.cross(v, w), float(v @ w)
    sine = float(np.linalg.norm(axis))
    # Where they are opposed, or one is zero, no axis is the smallest rotation's.
    if sine <= 1e-12 * abs(inner) or sine == 0.0:
        return np.eye(3)
    return rotation_exp(axis / sine * math.atan2(sine, inner))
