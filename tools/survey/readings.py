"""A dive's readings as arrays: each pair's fixes, each node's sensors, and the marks."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    Depth,
    Imu,
    Mark,
    Message,
    NodeInfo,
    Rejected,
    RelativePose,
    Track,
)
from buddyline.tools.dives import open_each
from buddyline.tools.evaluation.rotation import multiply, normalized
from buddyline.tools.survey.averages import Floats, Ints
from buddyline.tools.survey.blinks import find_blinks, new_blinks
from msgspec import UNSET

# An attitude is interpolated between neighbours no further apart than this.
ATTITUDE_GAP_NS: Final = 500_000_000
# Of the track one row in this time is kept.
TRACK_NS: Final = 100_000_000
# The message fields that the survey reads of each sensor, and their lengths.
COLUMNS: Final[dict[type[Message], dict[str, int]]] = {
    Attitude: {"q_ned_body_xyzw": 4, "sigma_rad": 3},
    Depth: {"depth_m": 1, "sigma_m": 1},
    Imu: {"accel_mps2": 3, "gyro_radps": 3, "mag_t": 3},
}
TOPICS: Final = ("pose", "rejected", "info", "attitude", "depth", "imu", "mark", "candidates", "track")


class Series:
    """One sensor's samples by time: stamps_ns (n,), and by field arrays (n,) or (n, k); NaN where a sample has none."""

    def __init__(self, kind: type[Message], samples: dict[int, Message]) -> None:
        stamps = sorted(samples)
        self.stamps_ns: Ints = np.array(stamps, dtype=np.int64)
        self._columns: dict[str, Floats] = {}
        for name, width in COLUMNS[kind].items():
            values: list[Any] = [getattr(samples[stamp_ns], name) for stamp_ns in stamps]
            known = [(np.nan,) * width if value is UNSET else value for value in values]
            self._columns[name] = np.array(known, dtype=np.float64).reshape((-1, width) if width > 1 else -1)

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, name: str) -> Floats:
        return self._columns[name]

    def between(self, start_ns: int, end_ns: int) -> slice:
        """Return which samples lie from start_ns to end_ns."""
        first, last = np.searchsorted(self.stamps_ns, start_ns), np.searchsorted(self.stamps_ns, end_ns, "right")
        return slice(int(first), int(last))


@dataclass(frozen=True, eq=False)
class NodeReadings:
    """One node's sensors; info: its calibration."""

    info: NodeInfo
    attitude: Series
    depth: Series
    imu: Series

    def q_ned_camera(self, stamps_ns: Ints) -> tuple[Floats, Floats]:
        """Return camera to NED (n, 4), headings magnetic, and sigma_rad (n, 3); NaN where it is not known."""
        at_ns = self.attitude.stamps_ns
        if len(at_ns) < 2:
            return np.full((len(stamps_ns), 4), np.nan), np.full((len(stamps_ns), 3), np.nan)
        after = np.clip(np.searchsorted(at_ns, stamps_ns), 1, len(at_ns) - 1)
        start_ns, end_ns = at_ns[after - 1], at_ns[after]
        share = (stamps_ns - start_ns) / np.maximum(end_ns - start_ns, 1)
        known = ((end_ns - start_ns <= ATTITUDE_GAP_NS) & (share >= -0.5) & (share <= 1.5))[:, None]
        q_0, q_1 = self.attitude["q_ned_body_xyzw"][after - 1], self.attitude["q_ned_body_xyzw"][after]
        q_1 = np.where((q_0 * q_1).sum(-1, keepdims=True) < 0, -q_1, q_1)
        q = normalized(q_0 + np.clip(share, 0.0, 1.0)[:, None] * (q_1 - q_0))
        half_rad = self.info.declination_rad / 2
        q_magnetic_true = np.array([0.0, 0.0, -np.sin(half_rad), np.cos(half_rad)])
        q_body_camera = normalized(np.array(self.info.q_body_camera_xyzw))
        q_magnetic_camera = multiply(multiply(np.broadcast_to(q_magnetic_true, q.shape), q), q_body_camera[None])
        sigma_rad = self.attitude["sigma_rad"][after]
        return np.where(known, q_magnetic_camera, np.nan), np.where(known, sigma_rad, np.nan)


@dataclass(frozen=True, eq=False)
class PairReadings:
    """One dive of a pair a, b. t_a_b_m: (n, 3), q_a_b: (n, 4), covariance: (n, 6, 6), in the order of time.

    marks: of all nodes of the dive. track: the same of the track's rows, where the log has one; their triggers are
    numbers, and speed_mps (n,) says how fast b moves against a.
    """

    pair: tuple[NodeReadings, NodeReadings]
    stamps_ns: Ints
    t_a_b_m: Floats
    q_a_b: Floats
    covariance: Floats
    triggers: Ints
    rejected: list[Rejected]
    marks: list[Mark]
    track: PairReadings | None = None
    speed_mps: Floats | None = None

    @property
    def nodes(self) -> tuple[str, str]:
        """The ids of a and b."""
        return self.pair[0].info.node, self.pair[1].info.node


def of_messages(messages: Iterable[Message], name: str = "dive") -> list[PairReadings]:
    """Return the readings of each pair that has poses, in the order of their first poses.

    messages: in any order; of two for one instant (the same message in two logs), the first counts. name: of the dive,
    for errors.
    """
    outcomes: dict[tuple[str, str], dict[int, RelativePose | Rejected]] = {}
    marks: dict[Mark, None] = {}
    infos: dict[str, NodeInfo] = {}
    samples: dict[tuple[type[Message], str], dict[int, Message]] = {}
    pictures: dict[str, dict[int, Candidates]] = {}
    tracks: dict[tuple[str, str], dict[int, Track]] = {}
    for message in messages:
        if isinstance(message, RelativePose | Rejected):
            outcomes.setdefault((message.node_a, message.node_b), {}).setdefault(message.trigger, message)
        elif isinstance(message, NodeInfo):
            infos.setdefault(message.node, message)
        elif isinstance(message, Mark):
            marks[message] = None
        elif isinstance(message, Track):
            tracks.setdefault((message.node_a, message.node_b), {}).setdefault(message.stamp_ns // TRACK_NS, message)
        elif isinstance(message, Candidates):
            pictures.setdefault(message.node, {}).setdefault(message.trigger, message)
        elif isinstance(message, Attitude | Depth | Imu):
            samples.setdefault((type(message), message.node), {}).setdefault(message.stamp_ns, message)

    def sensors(node: str) -> NodeReadings:
        if node not in infos:
            raise BuddylineError(f"{name}: holds no NodeInfo of node {node}; name its log as well")
        return NodeReadings(infos[node], *(Series(kind, samples.get((kind, node), {})) for kind in COLUMNS))

    for pair, of_pair in outcomes.items():
        poses = {trigger: one for trigger, one in of_pair.items() if isinstance(one, RelativePose)}
        for node in pair:
            marks |= dict.fromkeys(new_blinks(find_blinks(pictures.get(node, {}).values(), poses), marks))
    in_order = sorted(marks, key=lambda mark: mark.stamp_ns)
    found = []
    for (a, b), of_pair in outcomes.items():
        in_time = sorted(of_pair.values(), key=lambda outcome: outcome.stamp_ns)
        fixes = [outcome for outcome in in_time if isinstance(outcome, RelativePose)]
        rows = sorted(tracks.get((a, b), {}).values(), key=lambda row: row.stamp_ns)
        if not fixes:
            continue
        nodes = sensors(a), sensors(b)
        triggers = np.array([fix.trigger for fix in fixes], dtype=np.int64)
        rejected = [outcome for outcome in in_time if isinstance(outcome, Rejected)]
        track = None
        if rows:
            speed_mps = np.linalg.norm([row.v_a_b_mps for row in rows], axis=1)
            numbers = np.arange(len(rows), dtype=np.int64)
            track = PairReadings(nodes, *_columns(rows), numbers, [], in_order, speed_mps=speed_mps)
        found.append(PairReadings(nodes, *_columns(fixes), triggers, rejected, in_order, track))
    if not found:
        raise BuddylineError(f"{name}: holds no poses; solve the dive first (buddyline solve)")
    return sorted(found, key=lambda readings: int(readings.stamps_ns[0]))


def _columns(poses: Sequence[RelativePose | Track]) -> tuple[Ints, Floats, Floats, Floats]:
    """Return stamps_ns, t_a_b_m, q_a_b and covariance of poses or of the track's rows."""
    return (
        np.array([pose.stamp_ns for pose in poses], dtype=np.int64),
        np.array([pose.t_a_b_m for pose in poses]),
        normalized(np.array([pose.q_a_b_xyzw for pose in poses])),
        np.array([pose.covariance for pose in poses]).reshape(-1, 6, 6),
    )


def of_logs(paths: list[str]) -> list[PairReadings]:
    """Read a solved dive: its poses, and the nodes' own logs for what those lack (IMU, marks).

    The solved log goes first, so that the calibration that it was solved with takes precedence over the nodes'.
    """
    with ExitStack() as stack:
        dives = sorted(open_each(paths, stack), key=lambda dive: not dive.nodes("pose"))
        messages = chain.from_iterable(dive.messages(*TOPICS, doing=f"read {dive.name}") for dive in dives)
        return of_messages((envelope.message for envelope in messages), ", ".join(map(str, paths)))
