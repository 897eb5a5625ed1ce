"""The state of a pair at an instant, from which page, playback and report are drawn.

Pure: each message is given with its time, and each question with the present time; no clock is read. Live, the times
are receive times, so that another machine's clock cannot make old data look fresh; for a stored dive they are log
times.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import numpy as np
from buddyline.protocol.clock import LIVE_WITHIN_NS, S_NS
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.health import NO_LIGHT_S, stale_after_s
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    CompressedImage,
    Depth,
    Mark,
    NodeInfo,
    NodeStatus,
    Rejected,
    RelativePose,
    SolverStatus,
    Track,
)
from buddyline.protocol.topics import INFO, MARK, POSE, TRACK, Topic
from buddyline.tools.estimate import Estimate, range_gap_m, sigma_m
from buddyline.tools.health.words import duration_words
from buddyline.tools.monitor.scene import Floats, SceneFrame, frame_of
from buddyline.tools.pairs import Pair
from msgspec import UNSET, UnsetType
from numpy.typing import NDArray

KEPT_NS: Final = 150 * S_NS
# Trail and plots have at most one pose, and one point of the track, in this time.
POINT_SPACING_NS: Final = S_NS // 5
# A client that invents nodes must not fill memory and page; a solver takes 16.
MAX_NODES: Final = 64
MAX_CANDIDATES: Final = 128
MAX_REJECTED: Final = 8192
# Marks of the survey's checks, not of persons.
VERDICTS: Final = ("leg", "alarm")


@dataclass(frozen=True)
class Point:
    """A pose, or the track at one time, on trail and plots.

    at_ns: receive or log time; t_m: B in the scene, (north, east, down) from A.
    """

    at_ns: int
    estimate: Estimate
    t_m: tuple[float, float, float]
    frame: SceneFrame = field(compare=False)

    @property
    def tracked(self) -> bool:
        """Whether the point is of the track."""
        return isinstance(self.estimate, Track)

    @property
    def latency_s(self) -> float:
        """Time from a pose's exposure to at_ns; NaN for a track, and for a log that was solved offline."""
        latency_ns = self.at_ns - self.estimate.stamp_ns
        return latency_ns / S_NS if 0 < latency_ns < LIVE_WITHIN_NS and not self.tracked else math.nan


@dataclass(frozen=True)
class Shown:
    """The estimate that is shown at an instant: the track, else the newest of pose and track.

    stale: older than its topic allows. note: its age, and that there is no track, in words; "" for a fresh track.
    """

    estimate: Estimate
    stale: bool
    note: str


class Column(NamedTuple):
    """A quantity over time: t_s (n,), values (n,), and which of them are the track's (n,)."""

    t_s: Floats
    values: Floats
    tracked: NDArray[np.bool_]


UNCERTAINTY: Final = "Position's 1 sd, mm"
# What is plotted over time: the title, the value of a point (NaN where it is not known).
QUANTITIES: Final = (
    ("Range, m", lambda point: point.estimate.range_m),
    ("Azimuth, deg from north, clockwise", lambda point: _degrees(point.estimate.azimuth_rad)),
    ("Inclination, deg, up positive", lambda point: _degrees(point.estimate.inclination_rad)),
    (UNCERTAINTY, lambda point: sigma_m(point.estimate) * 1e3),
    ("Gap between both nodes' ranges, mm", lambda point: range_gap_m(point.estimate) * 1e3),
    ("Latency from exposure to here, ms", lambda point: point.latency_s * 1e3),
)


def columns(points: Iterable[Point], zero_ns: int) -> dict[str, Column]:
    """Return each quantity, by title, as far as it is known, over the time since zero_ns.

    Azimuths are continued past 360 deg, so that no line jumps where north is crossed. A quantity that is never known
    is left out.
    """
    ordered = sorted(points, key=lambda point: point.at_ns)
    t_s = np.array([(point.at_ns - zero_ns) / S_NS for point in ordered], float)
    tracked = np.array([point.tracked for point in ordered], bool)
    found = {}
    for title, value in QUANTITIES:
        values = np.array([value(point) for point in ordered], float)
        known = np.isfinite(values)
        if known.any():
            column = values[known]
            column = np.unwrap(column, period=360.0) if title.startswith("Azimuth") else column
            found[title] = Column(t_s[known], column, tracked[known])
    return found


def _degrees(angle_rad: float | UnsetType) -> float:
    return math.nan if angle_rad is UNSET else math.degrees(angle_rad)


@dataclass(frozen=True)
class Miss:
    """A trigger that ended without a pose."""

    at_ns: int
    reason: str


@dataclass
class NodePicture:
    """The state of one node: the newest message of each topic, under the topic's name.

    heard_ns: its receive or log time, by the topic's name.
    """

    node: str
    info: NodeInfo | None = None
    attitude: Attitude | None = None
    depth: Depth | None = None
    mark: Mark | None = None
    status: NodeStatus | None = None
    image: CompressedImage | None = None
    candidates: deque[Candidates] = field(default_factory=lambda: deque(maxlen=MAX_CANDIDATES))
    heard_ns: dict[str, int] = field(default_factory=dict)
    problem_since_ns: int = 0
    left_ns: int | None = None

    def stale_after_ns(self, topic: Topic) -> int:
        """Return the age from which this node's messages on a topic are stale."""
        return round(stale_after_s(topic, 0.0 if self.info is None else self.info.trigger_period_ns / S_NS) * S_NS)

    def is_stale(self, topic: Topic, now_ns: int) -> bool:
        """Return whether the newest message of a topic is stale; False if none has come."""
        heard_ns = self.heard_ns.get(topic.name)
        return heard_ns is not None and now_ns - heard_ns >= self.stale_after_ns(topic)

    def age_ns(self, what: str, now_ns: int) -> int | None:
        """Return the age of the newest message of this kind; None if none has come."""
        heard_ns = self.heard_ns.get(what)
        return None if heard_ns is None else max(now_ns - heard_ns, 0)

    def alive_ns(self) -> int:
        """Return the time of the newest message of its own, of any topic except NodeInfo; 0: none."""
        others = (INFO.name, MARK.name)
        return max((ns for what, ns in self.heard_ns.items() if what not in others), default=0)

    def shown(self) -> Candidates | None:
        """Return the candidates of the newest picture if they are still kept; without pictures the newest ones."""
        if self.image is None:
            return self.candidates[-1] if self.candidates else None
        stamp_ns = self.image.stamp_ns
        return next((frame for frame in reversed(self.candidates) if frame.stamp_ns == stamp_ns), None)

    def set_back(self, now_ns: int) -> None:
        """Count what was heard later than now as old: this machine's clock was set back."""
        self.heard_ns = {name: passed(at_ns, now_ns) for name, at_ns in self.heard_ns.items()}
        self.problem_since_ns = min(self.problem_since_ns, now_ns)
        self.left_ns = None if self.left_ns is None else min(self.left_ns, now_ns)

    def take(self, envelope: Envelope) -> None:
        """Take one of the node's messages."""
        message, name = envelope.message, envelope.topic.name.removeprefix("node_")
        if not hasattr(self, name) or (isinstance(message, Mark) and message.kind not in VERDICTS):
            return
        self.heard_ns[envelope.topic.name] = envelope.time_ns
        if isinstance(message, Candidates):
            self.candidates.append(message)
            return
        if isinstance(message, NodeStatus) and _is_new_problem(self.status, message):
            self.problem_since_ns = envelope.time_ns
        setattr(self, name, message)


def passed(at_ns: int, now_ns: int) -> int:
    """Return a time; one later than now, of a clock that was set back, as one that is too old to count."""
    return at_ns if at_ns <= now_ns else now_ns - KEPT_NS


def node_in(nodes: dict[str, NodePicture], name: str) -> NodePicture | None:
    """Return the state of a node, a new one where it is not known yet; None where there are too many."""
    known = nodes.get(name)
    if known is None and len(nodes) < MAX_NODES:
        known = nodes[name] = NodePicture(name)
    return known


class PairPicture:
    """The state of one pair, and of all nodes.

    pair: the one to follow; None: the first that a solver reports, and until then the first two nodes by name.
    nodes: shared with other pairs' pictures; None: its own.
    """

    def __init__(self, pair: Pair | None = None, nodes: dict[str, NodePicture] | None = None) -> None:
        self.nodes: dict[str, NodePicture] = {} if nodes is None else nodes
        self.pair = pair
        self.pose: RelativePose | None = None
        self.pose_ns: int | None = None
        self.track: Track | None = None
        self.track_ns: int | None = None
        self.points: deque[Point] = deque()
        self._kept_ns: dict[type, int] = {}
        self.misses: deque[Miss] = deque(maxlen=MAX_REJECTED)
        self.rejected: Counter[str] = Counter()
        self.solved = 0
        self.results: dict[int, RelativePose | Rejected] = {}
        self.solver: SolverStatus | None = None
        self.solver_ns: int | None = None
        self.solver_heard_ns: int | None = None
        self.solver_problem_since_ns = 0
        self.solver_left_ns: int | None = None
        self.solvers: set[str] = set()
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.other_pairs: set[Pair] = set()

    def take(self, envelope: Envelope) -> None:
        """Take one message, received at its time_ns."""
        message, at_ns = envelope.message, envelope.time_ns
        self.heard(at_ns)
        if len(envelope.ids) == 1:
            node = node_in(self.nodes, envelope.node)
            if node is not None:
                node.take(envelope)
            return
        pair = envelope.node, envelope.ids[1]
        self.pair = self.pair or pair
        if pair != self.pair:
            self.other_pairs.add(pair)
            return
        self.solver_heard_ns = at_ns
        if isinstance(message, SolverStatus):
            if _is_new_problem(self.solver, message):
                self.solver_problem_since_ns = at_ns
            self.solver, self.solver_ns = message, at_ns
        elif isinstance(message, Track):
            self.track, self.track_ns = message, at_ns
            self._keep(message, at_ns)
        elif isinstance(message, RelativePose | Rejected):
            self._take_result(message, at_ns)

    def heard(self, at_ns: int) -> None:
        """Note that something has come at this time, of this pair or of another."""
        self.first_ns = at_ns if self.first_ns is None else self.first_ns
        self.last_ns = at_ns if self.last_ns is None else max(self.last_ns, at_ns)

    def set_back(self, now_ns: int) -> None:
        """Count what came later than now as old: this machine's clock was set back. Trail and plots begin anew."""
        for name in ("pose_ns", "track_ns", "solver_ns", "solver_heard_ns"):
            at_ns = getattr(self, name)
            if at_ns is not None:
                setattr(self, name, passed(at_ns, now_ns))
        self.solver_problem_since_ns = min(self.solver_problem_since_ns, now_ns)
        self.solver_left_ns = None if self.solver_left_ns is None else min(self.solver_left_ns, now_ns)
        self.points.clear()
        self.misses.clear()
        self._kept_ns.clear()
        self.first_ns = self.last_ns = now_ns

    def alive(self, name: str, alive: bool, at_ns: int) -> None:
        """Take a change of the names that are alive: `node/<id>` or `solver/...`."""
        kind, _, node = name.partition("/")
        left_ns = None if alive else at_ns
        if kind == "solver":
            (self.solvers.add if alive else self.solvers.discard)(name)
            self.solver_left_ns = None if self.solvers else left_ns
        elif kind == "node" and (alive or node in self.nodes):
            known = node_in(self.nodes, node)
            if known is not None:
                known.left_ns = left_ns

    def ends(self) -> tuple[str | None, str | None]:
        """Return the ids of A and B, as far as they are known."""
        if self.pair is not None:
            return self.pair
        names = [*sorted(self.nodes), None, None]
        return names[0], names[1]

    def end_nodes(self) -> tuple[NodePicture | None, NodePicture | None]:
        """Return the states of A and B."""
        a, b = (self.nodes.get(name) if name is not None else None for name in self.ends())
        return a, b

    def pose_age_ns(self, now_ns: int) -> int | None:
        """Return the age of the newest pose; None if there is none."""
        return None if self.pose_ns is None else max(now_ns - self.pose_ns, 0)

    def shown(self, now_ns: int) -> Shown | None:
        """Return the estimate to show now: the track unless it is stale, else the newest of pose and track."""
        came = [
            (at_ns, topic, estimate)
            for at_ns, topic, estimate in ((self.track_ns, TRACK, self.track), (self.pose_ns, POSE, self.pose))
            if at_ns is not None and estimate is not None
        ]
        if not came:
            return None
        fresh = [each for each in came if now_ns - each[0] < self._stale_after_ns(each[1])]
        at_ns, _, estimate = fresh[0] if fresh else max(came, key=lambda each: each[0])
        age_s = max(now_ns - at_ns, 0) / S_NS
        notes = [] if fresh else [f"STALE: {duration_words(age_s)} old"]
        if isinstance(estimate, Track):
            dark_s = age_s + estimate.age_s
            notes += [f"no light for {duration_words(dark_s)}"] if fresh and dark_s > NO_LIGHT_S else []
        elif self.track_ns is None:
            notes.append("no track, the last pose")
        else:
            notes.append(f"no track for {duration_words((now_ns - self.track_ns) / S_NS)}, the last pose")
        return Shown(estimate, not fresh, ", ".join(notes))

    def is_stale(self, now_ns: int) -> bool:
        """Return whether the shown estimate is missing or stale."""
        shown = self.shown(now_ns)
        return shown is None or shown.stale

    def track_is_fresh(self, now_ns: int) -> bool:
        """Return whether there is a track that is not stale."""
        return self.track_ns is not None and now_ns - self.track_ns < self._stale_after_ns(TRACK)

    def _stale_after_ns(self, topic: Topic) -> int:
        a = self.end_nodes()[0]
        return round(stale_after_s(topic) * S_NS) if a is None else a.stale_after_ns(topic)

    def frame(self) -> SceneFrame:
        """Return the orientation of A's camera in the scene, by A's newest attitude."""
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
        self._keep(result, at_ns)

    def _keep(self, estimate: Estimate, at_ns: int) -> None:
        """Keep a point of trail and plots, unless the last of its kind is close."""
        last_ns = self._kept_ns.get(type(estimate))
        if last_ns is not None and 0 <= at_ns - last_ns < POINT_SPACING_NS:
            return
        self._kept_ns[type(estimate)] = at_ns
        frame = self.frame()
        self.points.append(Point(at_ns, estimate, frame.place(estimate), frame))
        while self.points and self.points[0].at_ns < at_ns - KEPT_NS:
            self.points.popleft()


def _is_new_problem(before: NodeStatus | SolverStatus | None, status: NodeStatus | SolverStatus) -> bool:
    """Return whether a status has another problem than the one before; different figures in its text do not count."""
    one, other = (
        "".join(letter for letter in text if not letter.isdigit())
        for text in ((before.problem if before else ""), status.problem)
    )
    return one != other
