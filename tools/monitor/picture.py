"""What is known of a pair at an instant: the state that page, playback and report draw from.

Pure: messages go in with the time at which they came, questions are asked with the present time, and nothing here
asks a clock. Live, the times are those of this machine, so that nobody else's clock makes a thing look fresh;
of a stored dive they are its log times.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import stale_after_s
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    CompressedImage,
    Depth,
    Message,
    NodeInfo,
    NodeStatus,
    Rejected,
    RelativePose,
    SolverStatus,
)
from buddyline.protocol.topics import ATTITUDE, CANDIDATES, DEPTH, IMAGE, INFO, NODE_STATUS, POSE, Topic
from buddyline.tools.monitor.scene import Frame, frame_of

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
    t_m: tuple[float, float, float]
    levelled: bool
    range_m: float
    azimuth_rad: float | None
    inclination_rad: float | None
    range_gap_m: float
    latency_s: float | None
    sigma_m: float


@dataclass(frozen=True)
class Miss:
    """A trigger that ended without a pose."""

    at_ns: int
    reason: str
    detail: str


@dataclass
class NodePicture:
    """What is known of one node. heard_ns: by topic's name, when its newest message came."""

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

    def seen(self, trigger: int) -> Candidates | None:
        """Return this node's candidates of one trigger, where they are still kept."""
        return next((frame for frame in reversed(self.candidates) if frame.trigger == trigger), None)

    def seen_at(self, stamp_ns: int) -> Candidates | None:
        """Return the candidates found in the picture of this stamp, where they are still kept."""
        return next((frame for frame in reversed(self.candidates) if frame.stamp_ns == stamp_ns), None)


class PairPicture:
    """The state of one pair: the first one that a solver speaks of, else the first two nodes by name."""

    def __init__(self) -> None:
        self.nodes: dict[str, NodePicture] = {}
        self.pair: tuple[str, str] | None = None
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
        self.other_pairs: set[tuple[str, str]] = set()
        self._frame = Frame.unknown()

    def take(self, message: Message, node: str | None, at_ns: int) -> None:
        """Take one message that came at at_ns; node: of a picture, whose message does not name it."""
        self.first_ns = at_ns if self.first_ns is None else self.first_ns
        self.last_ns = at_ns if self.last_ns is None else max(self.last_ns, at_ns)
        if isinstance(message, RelativePose | Rejected | SolverStatus):
            pair = (message.node_a, message.node_b)
            if self.pair is None:
                self.pair = pair
            if pair != self.pair:
                self.other_pairs.add(pair)
                return
            if isinstance(message, SolverStatus):
                self._take_solver(message, at_ns)
            else:
                self._take_result(message, at_ns)
            return
        sender = getattr(message, "node", node)
        if isinstance(sender, str):
            self._take_node(self.nodes.setdefault(sender, NodePicture(sender)), message, at_ns)

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

    def pose_age_ns(self, now_ns: int) -> int | None:
        """Return how old the newest pose is, None where there is none."""
        return None if self.pose_ns is None else max(now_ns - self.pose_ns, 0)

    def is_stale(self, now_ns: int) -> bool:
        """Return whether what the scene shows of B is no longer so."""
        age_ns, a = self.pose_age_ns(now_ns), self.nodes.get(self.ends()[0] or "")
        stale_ns = round(stale_after_s(POSE) * S_NS) if a is None else a.stale_after_ns(POSE)
        return age_ns is None or age_ns >= stale_ns

    def frame(self) -> Frame:
        """Return how A's camera stands in the scene, by A's newest attitude."""
        return self._frame

    def recent(self, now_ns: int, within_ns: int) -> list[Point]:
        """Return the poses of the last so many ns, oldest first."""
        return [point for point in self.points if now_ns - within_ns <= point.at_ns <= now_ns]

    def _take_node(self, node: NodePicture, message: Message, at_ns: int) -> None:
        kind = _KINDS.get(type(message))
        if kind is None:
            return
        topic, field_name = kind
        node.heard_ns[topic.name] = at_ns
        if isinstance(message, Candidates):
            node.candidates.append(message)
            return
        if isinstance(message, NodeStatus):
            before = node.status.problem if node.status else ""
            if _subject(message.problem) != _subject(before):
                node.problem_since_ns = at_ns
        setattr(node, field_name, message)
        if isinstance(message, NodeInfo | Attitude) and node.node == self.ends()[0]:
            self._frame = frame_of(node.info, node.attitude)

    def _take_solver(self, status: SolverStatus, at_ns: int) -> None:
        before = self.solver.problem if self.solver else ""
        if _subject(status.problem) != _subject(before):
            self.solver_problem_since_ns = at_ns
        self.solver, self.solver_ns = status, at_ns

    def _take_result(self, result: RelativePose | Rejected, at_ns: int) -> None:
        self.results[result.trigger] = result
        while len(self.results) > MAX_CANDIDATES:
            del self.results[next(iter(self.results))]
        if isinstance(result, Rejected):
            self.rejected[result.reason] += 1
            self.misses.append(Miss(at_ns, result.reason, result.detail))
            return
        self.solved += 1
        self.pose, self.pose_ns = result, at_ns
        if self.points and 0 <= at_ns - self.points[-1].at_ns < POINT_SPACING_NS:
            return
        node = self.nodes.get(result.node_a)
        if node is not None:
            self._frame = frame_of(node.info, node.attitude)
        self.points.append(point_of(result, self._frame, at_ns))
        while self.points and self.points[0].at_ns < at_ns - KEPT_NS:
            self.points.popleft()


_KINDS: Final[dict[type[Message], tuple[Topic, str]]] = {
    NodeInfo: (INFO, "info"),
    Attitude: (ATTITUDE, "attitude"),
    Depth: (DEPTH, "depth"),
    NodeStatus: (NODE_STATUS, "status"),
    CompressedImage: (IMAGE, "image"),
    Candidates: (CANDIDATES, "candidates"),
}


def _subject(problem: str) -> str:
    """Return what a problem is about, without the figures that change from one report to the next."""
    return "".join(letter for letter in problem if not letter.isdigit())


def point_of(pose: RelativePose, frame: Frame, at_ns: int) -> Point:
    """Return what trail and plots keep of a pose that came at at_ns."""
    latency_ns = at_ns - pose.stamp_ns
    variance_m2 = sum(max(pose.covariance[i], 0.0) for i in (0, 7, 14))
    return Point(
        at_ns=at_ns,
        t_m=frame.place(pose),
        levelled=frame.levelled,
        range_m=pose.range_m,
        azimuth_rad=pose.azimuth_rad if isinstance(pose.azimuth_rad, float) else None,
        inclination_rad=pose.inclination_rad if isinstance(pose.inclination_rad, float) else None,
        range_gap_m=pose.range_gap_m,
        # A log that was solved offline has its poses at their own stamps: that is no latency.
        latency_s=latency_ns / S_NS if 0 < latency_ns < LIVE_WITHIN_NS else None,
        sigma_m=float(variance_m2**0.5),
    )
