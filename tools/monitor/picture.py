"""What is known of a pair at an instant: the state that page, playback and report draw from.

Pure: messages go in with the time at which they came, questions are asked with the present time, and nothing here
asks a clock. Live, the times are receive times, so that no other machine's clock makes a thing look fresh; of a stored
dive they are log times.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.health import stale_after_s
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    CompressedImage,
    Depth,
    NodeInfo,
    NodeStatus,
    Rejected,
    RelativePose,
    SolverStatus,
)
from buddyline.protocol.topics import INFO, POSE, Topic
from buddyline.tools.monitor.scene import Floats, SceneFrame, frame_of
from buddyline.tools.pairs import Pair
from msgspec import UNSET, UnsetType

KEPT_NS: Final = 150 * S_NS
# Poses closer together than this are one point of trail and plots.
POINT_SPACING_NS: Final = S_NS // 5
MAX_CANDIDATES: Final = 128
MAX_REJECTED: Final = 8192
LIVE_WITHIN_NS: Final = 60 * S_NS


@dataclass(frozen=True)
class Point:
    """One pose on trail and plots. at_ns: when it came; t_m: B in the scene, (north, east, down) from A."""

    at_ns: int
    pose: RelativePose
    t_m: tuple[float, float, float]
    frame: SceneFrame = field(compare=False)

    @property
    def latency_s(self) -> float:
        """From exposure to here; NaN for a log solved offline, whose poses have log times of their own stamps."""
        latency_ns = self.at_ns - self.pose.stamp_ns
        return latency_ns / S_NS if 0 < latency_ns < LIVE_WITHIN_NS else math.nan


# What is plotted over time: the title, the value of a point (NaN where it is not known).
QUANTITIES: Final = (
    ("Range, m", lambda point: point.pose.range_m),
    ("Azimuth, deg from north, clockwise", lambda point: _degrees(point.pose.azimuth_rad)),
    ("Inclination, deg, up positive", lambda point: _degrees(point.pose.inclination_rad)),
    ("Gap between both nodes' ranges, mm", lambda point: point.pose.range_gap_m * 1e3),
    ("Latency from exposure to here, ms", lambda point: point.latency_s * 1e3),
)


def columns(points: Sequence[Point], zero_ns: int) -> dict[str, tuple[Floats, Floats]]:
    """Return, by title, the times from zero_ns (s) at which each quantity is known, and its values there.

    Azimuths are continued past 360 deg, so that no line jumps where north is crossed. A quantity that is never known
    is left out.
    """
    t_s = np.array([(point.at_ns - zero_ns) / S_NS for point in points], float)
    found = {}
    for title, value in QUANTITIES:
        values = np.array([value(point) for point in points], float)
        known = np.isfinite(values)
        if known.any():
            column = values[known]
            found[title] = t_s[known], np.unwrap(column, period=360.0) if title.startswith("Azimuth") else column
    return found


def _degrees(angle_rad: float | UnsetType) -> float:
    return math.nan if angle_rad is UNSET else math.degrees(angle_rad)


def sigma_m(pose: RelativePose) -> float:
    """Return a position's uncertainty: the root of the sum of its three variances."""
    return math.sqrt(sum(max(pose.covariance[i], 0.0) for i in (0, 7, 14)))


@dataclass(frozen=True)
class Miss:
    """A trigger that ended without a pose."""

    at_ns: int
    reason: str


@dataclass
class NodePicture:
    """What is known of one node: the newest message of each topic, under the topic's name.

    heard_ns: when it came, by topic's name.
    """

    node: str
    info: NodeInfo | None = None
    attitude: Attitude | None = None
    depth: Depth | None = None
    status: NodeStatus | None = None
    image: CompressedImage | None = None
    candidates: deque[Candidates] = field(default_factory=lambda: deque(maxlen=MAX_CANDIDATES))
    heard_ns: dict[str, int] = field(default_factory=dict)
    problem_since_ns: int = 0
    left_ns: int | None = None

    def stale_after_ns(self, topic: Topic) -> int:
        """Return the age from which what it sends on a topic is stale."""
        return round(stale_after_s(topic, 0.0 if self.info is None else self.info.trigger_period_ns / S_NS) * S_NS)

    def is_stale(self, topic: Topic, now_ns: int) -> bool:
        """Return whether the newest message of a topic is stale; False where none ever came."""
        heard_ns = self.heard_ns.get(topic.name)
        return heard_ns is not None and now_ns - heard_ns >= self.stale_after_ns(topic)

    def age_ns(self, what: str, now_ns: int) -> int | None:
        """Return how long ago a message of this kind came, None where none ever did."""
        heard_ns = self.heard_ns.get(what)
        return None if heard_ns is None else max(now_ns - heard_ns, 0)

    def alive_ns(self) -> int:
        """Return when the last sign of life came (0: never)."""
        return max((ns for what, ns in self.heard_ns.items() if what != INFO.name), default=0)

    def shown(self) -> Candidates | None:
        """Return the candidates of the newest picture, where they are still kept; without pictures the newest."""
        if self.image is None:
            return self.candidates[-1] if self.candidates else None
        stamp_ns = self.image.stamp_ns
        return next((frame for frame in reversed(self.candidates) if frame.stamp_ns == stamp_ns), None)

    def take(self, envelope: Envelope) -> None:
        """Take one of the node's messages."""
        message, name = envelope.message, envelope.topic.name.removeprefix("node_")
        if not hasattr(self, name):
            return
        self.heard_ns[envelope.topic.name] = envelope.time_ns
        if isinstance(message, Candidates):
            self.candidates.append(message)
            return
        if isinstance(message, NodeStatus) and _is_new_problem(self.status, message):
            self.problem_since_ns = envelope.time_ns
        setattr(self, name, message)


class PairPicture:
    """The state of one pair, and of all nodes.

    pair: the one to follow; without, the first that a solver speaks of, and until then the first two nodes by name.
    """

    def __init__(self, pair: Pair | None = None) -> None:
        self.nodes: dict[str, NodePicture] = {}
        self.pair = pair
        self.pose: RelativePose | None = None
        self.pose_ns: int | None = None
        self.points: deque[Point] = deque()
        self.misses: deque[Miss] = deque(maxlen=MAX_REJECTED)
        self.rejected: Counter[str] = Counter()
        self.solved = 0
        self.results: dict[int, RelativePose | Rejected] = {}
        self.solver: SolverStatus | None = None
        self.solver_ns: int | None = None
        self.solver_problem_since_ns = 0
        self.solver_left_ns: int | None = None
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.other_pairs: set[Pair] = set()

    def take(self, envelope: Envelope) -> None:
        """Take one message, which came at its time_ns."""
        message, at_ns = envelope.message, envelope.time_ns
        self.first_ns = at_ns if self.first_ns is None else self.first_ns
        self.last_ns = at_ns if self.last_ns is None else max(self.last_ns, at_ns)
        if len(envelope.ids) == 1:
            self.nodes.setdefault(envelope.node, NodePicture(envelope.node)).take(envelope)
            return
        pair = envelope.node, envelope.ids[1]
        self.pair = self.pair or pair
        if pair != self.pair:
            self.other_pairs.add(pair)
        elif isinstance(message, SolverStatus):
            if _is_new_problem(self.solver, message):
                self.solver_problem_since_ns = at_ns
            self.solver, self.solver_ns = message, at_ns
        elif isinstance(message, RelativePose | Rejected):
            self._take_result(message, at_ns)

    def alive(self, name: str, alive: bool, at_ns: int) -> None:
        """Take what the bus says of who is there: `node/<id>` or `solver/...`."""
        kind, _, node = name.partition("/")
        left_ns = None if alive else at_ns
        if kind == "solver":
            self.solver_left_ns = left_ns
        elif kind == "node" and (alive or node in self.nodes):
            self.nodes.setdefault(node, NodePicture(node)).left_ns = left_ns

    def ends(self) -> tuple[str | None, str | None]:
        """Return the ids of A and B, as far as they are known."""
        if self.pair is not None:
            return self.pair
        names = [*sorted(self.nodes), None, None]
        return names[0], names[1]

    def end_nodes(self) -> tuple[NodePicture | None, NodePicture | None]:
        """Return what is known of A and of B."""
        a, b = (self.nodes.get(name) if name is not None else None for name in self.ends())
        return a, b

    def pose_age_ns(self, now_ns: int) -> int | None:
        """Return how old the newest pose is, None where there is none."""
        return None if self.pose_ns is None else max(now_ns - self.pose_ns, 0)

    def is_stale(self, now_ns: int) -> bool:
        """Return whether what the scene shows of B is no longer so."""
        age_ns, a = self.pose_age_ns(now_ns), self.end_nodes()[0]
        stale_ns = round(stale_after_s(POSE) * S_NS) if a is None else a.stale_after_ns(POSE)
        return age_ns is None or age_ns >= stale_ns

    def frame(self) -> SceneFrame:
        """Return how A's camera stands in the scene, by A's newest attitude."""
        node = self.end_nodes()[0]
        return SceneFrame.unknown() if node is None else frame_of(node.info, node.attitude)

    def _take_result(self, result: RelativePose | Rejected, at_ns: int) -> None:
        self.results[result.trigger] = result
        while len(self.results) > MAX_CANDIDATES:
            del self.results[next(iter(self.results))]
        if isinstance(result, Rejected):
            self.rejected[result.reason] += 1
            self.misses.append(Miss(at_ns, result.reason))
            return
        self.solved += 1
        self.pose, self.pose_ns = result, at_ns
        if self.points and 0 <= at_ns - self.points[-1].at_ns < POINT_SPACING_NS:
            return
        frame = self.frame()
        self.points.append(Point(at_ns, result, frame.place(result), frame))
        while self.points and self.points[0].at_ns < at_ns - KEPT_NS:
            self.points.popleft()


def _is_new_problem(before: NodeStatus | SolverStatus | None, status: NodeStatus | SolverStatus) -> bool:
    """Return whether a status speaks of another problem; figures in it change from one report to the next."""
    one, other = (
        "".join(letter for letter in text if not letter.isdigit())
        for text in ((before.problem if before else ""), status.problem)
    )
    return one != other
