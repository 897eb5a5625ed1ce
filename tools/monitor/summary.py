"""A whole dive in one pass: what the report tells of it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import Record
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import Depth, NodeInfo, Rejected, RelativePose, Truth
from buddyline.protocol.topics import CANDIDATES, IMAGE, parse_key
from buddyline.tools.dives import Dive
from buddyline.tools.monitor.coverage import Coverage
from buddyline.tools.monitor.panel import marked_picture, result_words
from buddyline.tools.monitor.picture import Miss, PairPicture, Point, point_of
from buddyline.tools.monitor.replay import Keyframe
from buddyline.tools.monitor.scene import Floats

TOPICS: Final = (
    "info", "candidates", "attitude", "depth", "image", "status", "node_status", "pose", "rejected", "truth",
    "solver_status",
)  # fmt: skip
MAX_POINTS: Final = 3000
MIN_SPACING_NS: Final = S_NS // 5
DEPTH_SPACING_NS: Final = S_NS
JOINED_NS: Final = 3 * S_NS // 2


@dataclass
class Shot:
    """A picture of one node, marked, and what became of it."""

    node: str
    at_ns: int
    drawing: str
    words: str


@dataclass
class Summary:
    """What the report shows. errors_m: (n, 2) distance from the true position and error of the range."""

    picture: PairPicture
    coverage: Coverage
    points: list[Point] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)
    misses: list[Miss] = field(default_factory=list)
    depths: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    pose_times_ns: list[int] = field(default_factory=list)
    ranges_m: list[float] = field(default_factory=list)
    sigmas_m: list[float] = field(default_factory=list)
    gaps_m: list[float] = field(default_factory=list)
    shots: dict[str, Shot] = field(default_factory=dict)
    infos: dict[str, list[NodeInfo]] = field(default_factory=dict)
    errors_m: Floats = field(default_factory=lambda: np.zeros((0, 2)))
    bad: int = 0


def summarize(dive: Dive) -> Summary:
    """Read a dive once, from its first message to its last."""
    summary = Summary(PairPicture(), Coverage(dive.start_ns, dive.end_ns))
    spacing_ns = max(MIN_SPACING_NS, (dive.end_ns - dive.start_ns) // MAX_POINTS)
    truths: dict[int, Truth] = {}
    poses: list[tuple[int, Floats, float]] = []
    for record in dive.records(*TOPICS):
        parsed = parse_key(record.key)
        if parsed is None:
            continue
        summary.counts[record.key] += 1
        try:
            message = record.decode()
        except MessageError:
            summary.bad += 1
            continue
        if isinstance(message, Truth):
            if message.trigger is not None and isinstance(message.trigger, int):
                truths[message.trigger] = message
            continue
        if message is None:
            continue
        summary.picture.take(message, parsed[1][0], record.log_time_ns)
        if isinstance(message, RelativePose) and summary.picture.pose is message:
            poses.append((message.trigger, np.array(message.t_a_b_m), message.range_m))
            _take_pose(summary, message, record, spacing_ns)
        elif isinstance(message, Rejected):
            summary.coverage.add(record.log_time_ns, message.reason)
            summary.misses.append(Miss(record.log_time_ns, message.reason, ""))
        elif isinstance(message, Depth):
            line = summary.depths.setdefault(message.node, [])
            if not line or record.log_time_ns - line[-1][0] >= max(DEPTH_SPACING_NS, spacing_ns):
                line.append((record.log_time_ns, message.depth_m))
        elif isinstance(message, NodeInfo):
            known = summary.infos.setdefault(message.node, [])
            if not known or known[-1].camera != message.camera or known[-1].light_left_m != message.light_left_m:
                known.append(message)
    summary.coverage.complete = True
    summary.errors_m = _errors(poses, truths)
    _take_shots(summary, dive)
    return summary


def _take_pose(summary: Summary, pose: RelativePose, record: Record, spacing_ns: int) -> None:
    at_ns = record.log_time_ns
    frame = summary.picture.frame()
    point = point_of(pose, frame, at_ns)
    summary.coverage.add(at_ns, None)
    summary.pose_times_ns.append(at_ns)
    summary.ranges_m.append(pose.range_m)
    summary.sigmas_m.append(point.sigma_m)
    summary.gaps_m.append(pose.range_gap_m)
    before_ns = summary.points[-1].at_ns if summary.points else None
    if before_ns is not None and 0 <= at_ns - before_ns < spacing_ns:
        return
    summary.points.append(point)
    joined = before_ns is not None and at_ns - before_ns <= max(JOINED_NS, 2 * spacing_ns)
    summary.keyframes.append(
        Keyframe(
            round((at_ns - summary.coverage.begin_ns) / S_NS, 3),
            [round(x, 4) for x in point.t_m],
            [round(x, 4) for x in frame.R_s_a.ravel().tolist()],
            [round(x, 4) for x in frame.turn_b(pose).ravel().tolist()],
            joined,
        )
    )


def _errors(poses: list[tuple[int, Floats, float]], truths: dict[int, Truth]) -> Floats:
    found = [
        (float(np.linalg.norm(t_m - np.array(truths[trigger].t_a_b_m))), range_m - math.hypot(*truths[trigger].t_a_b_m))
        for trigger, t_m, range_m in poses
        if trigger in truths
    ]
    return np.array(found).reshape(-1, 2)


def _take_shots(summary: Summary, dive: Dive) -> None:
    """Take one picture of each node near the middle of the dive, where there are pictures."""
    middle_ns = (summary.coverage.begin_ns + summary.coverage.end_ns) // 2
    picture = PairPicture()
    for reader in dive.readers:
        nodes = [parsed[1][0] for key in reader.keys if (parsed := parse_key(key)) and parsed[0] is IMAGE]
        if not nodes:
            continue
        for record in reader.records(_shot_topic, middle_ns):
            if record.log_time_ns > middle_ns + 20 * S_NS:
                break
            parsed = parse_key(record.key)
            if parsed is None:
                continue
            try:
                message = record.decode()
            except MessageError:
                continue
            if message is not None:
                picture.take(message, parsed[1][0], record.log_time_ns)
                _take_shot(summary, picture, record.log_time_ns)
            if all(node in summary.shots for node in nodes):
                break


def _shot_topic(key: str) -> bool:
    parsed = parse_key(key)
    return parsed is not None and parsed[0].name in (IMAGE.name, CANDIDATES.name, "pose", "rejected")


def _take_shot(summary: Summary, picture: PairPicture, at_ns: int) -> None:
    for node in picture.nodes.values():
        if node.image is None or node.node in summary.shots:
            continue
        frame = node.seen_at(node.image.stamp_ns)
        result = picture.results.get(frame.trigger) if frame is not None else None
        if frame is not None and result is not None:
            drawing = marked_picture(node.image, frame, result, node.node)
            summary.shots[node.node] = Shot(node.node, at_ns, drawing, result_words(result, node.node))
