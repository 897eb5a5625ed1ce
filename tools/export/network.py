"""Export all nodes of a net: TUM a node, one table, or TRC for motion capture programs."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NodeInfo, NodePose
from buddyline.protocol.topics import NET_POSE
from buddyline.tools.columns import in_order
from buddyline.tools.dives import first_with_net, open_each
from buddyline.tools.evaluation.rotation import Floats, normalized, rotate
from buddyline.tools.measure.tables import tum_line
from buddyline.tools.progress import counted

_AXES: Final = ("north", "east", "down", "w_north", "w_east", "w_down")
_UPPER: Final = [(row, column) for row in range(6) for column in range(row, 6)]
_COLUMNS: Final = (
    *("stamp_ns", "net", "node", "fixed", "mode", "north_m", "east_m", "down_m", "q_x", "q_y", "q_z", "q_w"),
    *("v_north_mps", "v_east_mps", "v_down_mps", "sd_north_m", "sd_east_m", "sd_down_m"),
    *("sd_w_north_rad", "sd_w_east_rad", "sd_w_down_rad", "age_s"),
    # The row-major upper triangle, in m and rad.
    *(f"cov_{_AXES[row]}_{_AXES[column]}" for row, column in _UPPER),
)
_NORTH_UP_EAST: Final = np.array(((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)))


def network_lines(logs: Sequence[str], form: str, node: str | None, name: str) -> tuple[str, Iterator[str]]:
    """Return what is exported, in words, and its lines. form: "tum" or "trc"; name: of the file."""
    said, poses, infos = _chosen(logs, node)
    if form == "trc":
        return said, _trc_lines(_markers_of(poses, infos), name)
    if node is None:
        known = ", ".join(sorted({pose.node for pose in poses}))
        raise BuddylineError(f"--format tum --what net: one node a file; choose with --node: {known}")
    return said, (tum_line(pose.stamp_ns, pose.p_m, pose.q_xyzw) for pose in poses)


def network_rows(logs: Sequence[str], node: str | None) -> tuple[str, tuple[str, ...], list[dict[str, object]]]:
    """Return what is exported, in words, its columns, and its rows by time."""
    said, poses, _ = _chosen(logs, node)
    return said, _COLUMNS, [dict(zip(_COLUMNS, _row(pose), strict=True)) for pose in poses]


def _chosen(logs: Sequence[str], node: str | None) -> tuple[str, list[NodePose], dict[str, NodeInfo]]:
    """Return what is exported, in words, the poses of a node or of all, by time, and all nodes' calibrations."""
    poses, infos = _load(logs)
    known = sorted({pose.node for pose in poses})
    if node is not None:
        poses = [pose for pose in poses if pose.node == node]
    if not poses:
        raise BuddylineError(f"{', '.join(logs)}: nothing of node {node}; nodes: {', '.join(known)}")
    whose = f"node {node}" if node else f"nodes {', '.join(known)}"
    return f"{whose} in the net's frame, {len(poses)} rows", poses, infos


def _load(paths: Sequence[str]) -> tuple[list[NodePose], dict[str, NodeInfo]]:
    """Read the poses of the first log that has any, by time, and all nodes' calibrations."""
    with ExitStack() as stack:
        logs = open_each(paths, stack)
        of_node: dict[str, list[NodePose]] = {}
        for envelope in first_with_net(logs).messages(NET_POSE.name, doing="read"):
            if isinstance(envelope.message, NodePose):
                of_node.setdefault(envelope.message.node, []).append(envelope.message)
        infos: dict[str, NodeInfo] = {}
        for log in logs:
            infos = log.infos() | infos
    poses = [pose for node in sorted(of_node) for pose in in_order(of_node[node])]
    return sorted(poses, key=lambda pose: pose.stamp_ns), infos


def _row(pose: NodePose) -> tuple[object, ...]:
    sigmas = [math.sqrt(max(variance, 0.0)) for variance in pose.covariance[::7]]
    head = (pose.stamp_ns, pose.net, pose.node, int(pose.fixed), pose.mode)
    covariances = [pose.covariance[6 * row + column] for row, column in _UPPER]
    return (*head, *pose.p_m, *pose.q_xyzw, *pose.v_mps, *sigmas, pose.age_s, *covariances)


@dataclass(frozen=True, eq=False)
class Markers:
    """Each node's camera and lamps at all times of a net.

    places_m (T, M, 3): x north, y up, z east, as motion capture programs take y for up; NaN where a node has no pose.
    """

    names: list[str]
    stamps_ns: list[int]
    places_m: Floats

    @property
    def rate_hz(self) -> float:
        """Rows a second."""
        return S_NS / float(np.median(np.diff(self.stamps_ns))) if len(self.stamps_ns) > 1 else 1.0


def load_markers(logs: Sequence[str]) -> Markers:
    """Return the markers of the first log that has a net; raise BuddylineError for none."""
    return _markers_of(*_load(logs))


def _markers_of(poses: Sequence[NodePose], infos: dict[str, NodeInfo]) -> Markers:
    nodes = sorted({pose.node for pose in poses})
    marked = {node: _markers(node, infos.get(node)) for node in nodes}
    names = [marker for node in nodes for marker, _ in marked[node]]
    stamps_ns = sorted({pose.stamp_ns for pose in poses})
    row = {stamp_ns: k for k, stamp_ns in enumerate(stamps_ns)}
    places_m = np.full((len(stamps_ns), len(names), 3), np.nan)
    for pose in counted(poses, "export"):
        for marker, place_m in marked[pose.node]:
            ned_m = np.array(pose.p_m) + rotate(normalized(np.array(pose.q_xyzw)), place_m)
            places_m[row[pose.stamp_ns], names.index(marker)] = _NORTH_UP_EAST @ ned_m
    return Markers(names, stamps_ns, places_m)


def _trc_lines(markers: Markers, name: str) -> Iterator[str]:
    """Yield the lines of a TRC file, mm; cells are empty where a node has no pose."""
    rate_hz, count, names = markers.rate_hz, len(markers.stamps_ns), markers.names
    yield f"PathFileType\t4\t(X/Y/Z)\t{name}\n"
    yield "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames\n"
    yield f"{rate_hz:.17g}\t{rate_hz:.17g}\t{count}\t{len(names)}\tmm\t{rate_hz:.17g}\t1\t{count}\n"
    yield "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t\n"
    yield "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, len(names) + 1)) + "\n\n"
    for frame, (stamp_ns, places_m) in enumerate(zip(markers.stamps_ns, markers.places_m, strict=True), start=1):
        cells = [str(frame), f"{(stamp_ns - markers.stamps_ns[0]) / S_NS:.9f}"]
        cells += ["" if math.isnan(value) else repr(1e3 * value) for value in places_m.ravel().tolist()]
        yield "\t".join(cells) + "\n"


def _markers(node: str, info: NodeInfo | None) -> list[tuple[str, Floats]]:
    """Return a node's markers and their places in its camera frame."""
    markers = [(node, np.zeros(3))]
    if info is not None and info.has_lights:
        markers += [(f"{node}_left", np.array(info.light_left_m)), (f"{node}_right", np.array(info.light_right_m))]
    return markers
