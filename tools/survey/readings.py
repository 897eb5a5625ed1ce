"""What a dive says, as arrays: fixes of the pair, and each node's sensors and marks."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Attitude, Depth, Imu, Mark, Message, NodeInfo, Rejected, RelativePose
from buddyline.tools.dives import Dive, open_each
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.rotations import matrices_of
from msgspec import UNSET
from numpy.typing import NDArray

Stamps = NDArray[np.int64]
# An attitude is taken from neighbours no further apart than this.
ATTITUDE_GAP_NS = 500_000_000


@dataclass(frozen=True, eq=False)
class Node:
    """One node's sensors, by time. info: its calibration.

    attitude_q: (n, 4) body to NED; attitude_sigma_rad: (n, 3). mag_t: (k, 3), NaN without a magnetometer.
    """

    info: NodeInfo
    attitude_ns: Stamps
    attitude_q: Floats
    attitude_sigma_rad: Floats
    depth_ns: Stamps
    depth_m: Floats
    depth_sigma_m: Floats
    imu_ns: Stamps
    accel_mps2: Floats
    gyro_radps: Floats
    mag_t: Floats

    @property
    def R_body_camera(self) -> Floats:
        """Camera to body, (3, 3)."""
        return matrices_of(np.array(self.info.q_body_camera_xyzw))

    def attitude(self, stamps_ns: Stamps) -> tuple[Floats, Floats]:
        """Return R_ned_camera (n, 3, 3), headings magnetic, and sigma_rad (n, 3); NaN where it is not known."""
        n = len(stamps_ns)
        if len(self.attitude_ns) < 2:
            return np.full((n, 3, 3), np.nan), np.full((n, 3), np.nan)
        after = np.clip(np.searchsorted(self.attitude_ns, stamps_ns), 1, len(self.attitude_ns) - 1)
        start_ns, end_ns = self.attitude_ns[after - 1], self.attitude_ns[after]
        share = (stamps_ns - start_ns) / np.maximum(end_ns - start_ns, 1)
        known = (end_ns - start_ns <= ATTITUDE_GAP_NS) & (share >= -0.5) & (share <= 1.5)
        q_0, q_1 = self.attitude_q[after - 1], self.attitude_q[after]
        q_1 = np.where((q_0 * q_1).sum(-1, keepdims=True) < 0, -q_1, q_1)
        q = q_0 + np.clip(share, 0.0, 1.0)[:, None] * (q_1 - q_0)
        c, s = np.cos(self.info.declination_rad), np.sin(self.info.declination_rad)
        R_magnetic_true = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        R = R_magnetic_true @ matrices_of(q) @ self.R_body_camera
        R[~known] = np.nan
        sigma_rad = np.where(known[:, None], self.attitude_sigma_rad[after], np.nan)
        return R, sigma_rad

    def between(self, stamps_ns: Stamps, start_ns: int, end_ns: int) -> slice:
        """Return which samples of a series lie from start_ns to end_ns."""
        return slice(int(np.searchsorted(stamps_ns, start_ns)), int(np.searchsorted(stamps_ns, end_ns, "right")))


@dataclass(frozen=True, eq=False)
class Readings:
    """One dive of a pair. t_a_b_m: (n, 3), q_a_b: (n, 4), covariance: (n, 6, 6), in the order of time."""

    a: Node
    b: Node
    stamps_ns: Stamps
    triggers: Stamps
    t_a_b_m: Floats
    q_a_b: Floats
    covariance: Floats
    rejected: list[Rejected] = field(default_factory=list)
    marks: list[Mark] = field(default_factory=list)

    @property
    def nodes(self) -> tuple[str, str]:
        """The pair's ids, a and b."""
        return self.a.info.node, self.b.info.node


def of_messages(messages: Iterable[Message], name: str = "dive") -> Readings:
    """Return the readings of a dive's messages, in any order; of two alike (in two logs), the first."""
    outcomes: dict[tuple[str, str, int], RelativePose | Rejected] = {}
    marks: dict[tuple[str, int, str], Mark] = {}
    infos: dict[str, NodeInfo] = {}
    attitudes: dict[str, dict[int, Attitude]] = {}
    depths: dict[str, dict[int, Depth]] = {}
    imus: dict[str, dict[int, Imu]] = {}
    for message in messages:
        if isinstance(message, RelativePose | Rejected):
            outcomes.setdefault((message.node_a, message.node_b, message.trigger), message)
        elif isinstance(message, NodeInfo):
            infos.setdefault(message.node, message)
        elif isinstance(message, Mark):
            marks[message.node, message.stamp_ns, message.name] = message
        elif isinstance(message, Attitude):
            attitudes.setdefault(message.node, {})[message.stamp_ns] = message
        elif isinstance(message, Depth):
            depths.setdefault(message.node, {})[message.stamp_ns] = message
        elif isinstance(message, Imu):
            imus.setdefault(message.node, {})[message.stamp_ns] = message
    poses = [outcome for outcome in outcomes.values() if isinstance(outcome, RelativePose)]
    rejected = [outcome for outcome in outcomes.values() if isinstance(outcome, Rejected)]
    pairs = {(pose.node_a, pose.node_b) for pose in poses}
    if not pairs:
        raise BuddylineError(f"{name}: holds no poses; solve the dive first (buddyline solve)")
    if len(pairs) > 1:
        raise BuddylineError(f"{name}: poses of several pairs; a survey takes one pair")
    ((a, b),) = pairs
    for node in (a, b):
        if node not in infos:
            raise BuddylineError(f"{name}: holds no NodeInfo of node {node}; name its log as well")
    fixes = sorted(poses, key=lambda pose: pose.stamp_ns)
    nodes = [_node(infos[n], attitudes.get(n, {}), depths.get(n, {}), imus.get(n, {})) for n in (a, b)]
    return Readings(
        nodes[0],
        nodes[1],
        np.array([fix.stamp_ns for fix in fixes], dtype=np.int64),
        np.array([fix.trigger for fix in fixes], dtype=np.int64),
        np.array([fix.t_a_b_m for fix in fixes]),
        np.array([fix.q_a_b_xyzw for fix in fixes]),
        np.array([fix.covariance for fix in fixes]).reshape(-1, 6, 6),
        sorted(rejected, key=lambda one: one.stamp_ns),
        sorted(marks.values(), key=lambda mark: mark.stamp_ns),
    )


def _node(info: NodeInfo, attitude: dict[int, Attitude], depth: dict[int, Depth], imu: dict[int, Imu]) -> Node:
    turns = [attitude[ns] for ns in sorted(attitude)]
    levels = [depth[ns] for ns in sorted(depth)]
    samples = [imu[ns] for ns in sorted(imu)]
    nowhere = (np.nan, np.nan, np.nan)
    return Node(
        info,
        np.array(sorted(attitude), dtype=np.int64),
        np.array([one.q_ned_body_xyzw for one in turns]).reshape(-1, 4),
        np.array([one.sigma_rad for one in turns]).reshape(-1, 3),
        np.array(sorted(depth), dtype=np.int64),
        np.array([one.depth_m for one in levels], dtype=float),
        np.array([one.sigma_m for one in levels], dtype=float),
        np.array(sorted(imu), dtype=np.int64),
        np.array([one.accel_mps2 for one in samples]).reshape(-1, 3),
        np.array([one.gyro_radps for one in samples]).reshape(-1, 3),
        np.array([nowhere if one.mag_t is UNSET else one.mag_t for one in samples]).reshape(-1, 3),
    )


def of_logs(paths: list[str]) -> Readings:
    """Read a solved dive: its poses, and the nodes' own logs for what those lack (IMU, marks).

    The solved log goes first: where it was solved with another calibration than the nodes', its own holds.
    """
    with ExitStack() as stack:
        dives = open_each(paths, stack)
        dives.sort(key=lambda dive: not dive.nodes("pose"))
        return of_messages((message for dive in dives for message in _messages(dive)), ", ".join(map(str, paths)))


def _messages(dive: Dive) -> Iterator[Message]:
    for envelope in dive.messages("pose", "rejected", "info", "attitude", "depth", "imu", "mark"):
        yield envelope.message
