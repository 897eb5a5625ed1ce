"""A whole dive in one pass: what the report tells of it."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Depth, NodeInfo, Rejected, RelativePose, Truth
from buddyline.protocol.topics import CANDIDATES, IMAGE
from buddyline.tools.dives import Dive
from buddyline.tools.monitor.coverage import Coverage
from buddyline.tools.monitor.panel import marked_picture, result_words
from buddyline.tools.monitor.picture import Miss, PairPicture, Point, point_of
from buddyline.tools.monitor.replay import Keyframe
from buddyline.tools.monitor.scene import Floats

TOPICS: Final = (
    "info", "candidates", "attitude", "depth", "image", "node_status", "pose", "rejected", "truth",
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


def summarize(dive: Dive) -> Summary:
    """Read a dive once, from its first message to its last."""
    summary = Summary(PairPicture(), Coverage(dive.start_ns, dive.end_ns))
    spacing_ns = max(MIN_SPACING_NS, (dive.end_ns - dive.start_ns) // MAX_POINTS)
    truths: dict[int, Truth] = {}
    poses: list[tuple[int, Floats, float]] = []
    for envelope in dive.messages(*TOPICS):
        message, at_ns = envelope.message, envelope.time_ns
        summary.counts[envelope.key] += 1
        if isinstance(message, Truth):
            if isinstance(message.trigger, int):
                truths[message.trigger] = message
            continue
        summary.picture.take(message, envelope.node, at_ns)
        if isinstance(message, RelativePose) and summary.picture.pose is message:
            poses.append((message.trigger, np.array(message.t_a_b_m), message.range_m))
            _take_pose(summary, message, at_ns, spacing_ns)
        elif isinstance(message, Rejected):
            summary.coverage.add(at_ns, message.reason)
            summary.misses.append(Miss(at_ns, message.reason, ""))
        elif isinstance(message, Depth):
            line = summary.depths.setdefault(message.node, [])
            if not line or at_ns - line[-1][0] >= max(DEPTH_SPACING_NS, spacing_ns):
                line.append((at_ns, message.depth_m))
        elif isinstance(message, NodeInfo):
            known = summary.infos.setdefault(message.node, [])
            if not known or known[-1].camera != message.camera or known[-1].light_left_m != message.light_left_m:
                known.append(message)
    summary.coverage.complete = True
    summary.errors_m = _errors(poses, truths)
    _take_shots(summary, dive)
    return summary


def _take_pose(summary: Summary, pose: RelativePose, at_ns: int, spacing_ns: int) -> None:
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
    nodes = dive.nodes(IMAGE.name)
    if not nodes:
        return
    for envelope in dive.messages(IMAGE.name, CANDIDATES.name, "pose", "rejected", since_ns=middle_ns):
        if envelope.time_ns > middle_ns + 20 * S_NS:
            return
        picture.take(envelope.message, envelope.node, envelope.time_ns)
        _take_shot(summary, picture, envelope.time_ns)
        if all(node in summary.shots for node in nodes):
            return


def _take_shot(summary: Summary, picture: PairPicture, at_ns: int) -> None:
    for node in picture.nodes.values():
        if node.image is None or node.node in summary.shots:
            continue
        frame = node.seen_at(node.image.stamp_ns)
        result = picture.results.get(frame.trigger) if frame is not None else None
        if frame is not None and result is not None:
            drawing = marked_picture(node.image, frame, result, node.node)
            summary.shots[node.node] = Shot(node.node, at_ns, drawing, result_words(result, node.node))
