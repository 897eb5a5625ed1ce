"""Summarize a whole dive in one pass, for the report."""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import TRACK_SIGMA_SHARE
from buddyline.protocol.messages import Candidates, Depth, NodeInfo, Rejected, RelativePose, Track, Truth
from buddyline.tools.clock_curves import noted_curves
from buddyline.tools.dives import Dive
from buddyline.tools.estimate import Estimate, sigma_m
from buddyline.tools.evaluation.clocks import truth_moved
from buddyline.tools.evaluation.poses import PoseErrors, pose_errors
from buddyline.tools.evaluation.tracks import TrackFigures, covered_share, tracks_figures
from buddyline.tools.evaluation.truth import TruthTrack, inverted
from buddyline.tools.monitor.coverage import Coverage
from buddyline.tools.monitor.outliers import TrackPath
from buddyline.tools.monitor.panel import chosen_lights, judged_picture
from buddyline.tools.monitor.picture import PairPicture, Point
from buddyline.tools.pairs import Pair

TOPICS: Final = (
    *("info", "candidates", "attitude", "depth", "image", "node_status"),
    *("pose", "track", "rejected", "truth", "solver_status"),
)
MAX_POINTS: Final = 3000
MIN_SPACING_NS: Final = S_NS // 5
DEPTH_SPACING_NS: Final = S_NS
# Pictures are looked for in this much of the dive, from its middle on.
SHOTS_NS: Final = 20 * S_NS


@dataclass
class JudgedPicture:
    """A marked picture of one node, and its trigger's outcome."""

    at_ns: int
    drawing: str
    words: str


@dataclass
class Summary:
    """The report's content about one pair.

    points: its poses, tracks: its track; of each only some, spacing_ns apart at least. asked: stamps of the pair's
    frames, ns, by trigger. dark_s: the longest time in which the track used no light. track_coverage: where the track
    covers the dive, None without a track. depths: by node, (ns, m). depth_sigma_m: by node, the gauge's stated one.
    path: all places of the track. light_sigmas_px: stated, of the lights that the poses used. infos: by node, one for
    each calibration that it had. counts: messages by key, each once, of however many logs.
    """

    picture: PairPicture
    coverage: Coverage
    spacing_ns: int
    points: list[Point] = field(default_factory=list)
    tracks: list[Point] = field(default_factory=list)
    dark_s: float = 0.0
    track_coverage: Coverage | None = None
    poses: list[RelativePose] = field(default_factory=list)
    rejected: list[Rejected] = field(default_factory=list)
    asked: dict[int, int] = field(default_factory=dict)
    truths: list[Truth] = field(default_factory=list)
    depths: dict[str, list[tuple[int, float]]] = field(default_factory=dict)
    depth_sigma_m: dict[str, float] = field(default_factory=dict)
    path: TrackPath = field(default_factory=TrackPath)
    light_sigmas_px: array[float] = field(default_factory=lambda: array("d"))
    counts: Counter[str] = field(default_factory=Counter)
    shots: dict[str, JudgedPicture] = field(default_factory=dict)
    infos: dict[str, list[NodeInfo]] = field(default_factory=dict)

    def errors(self) -> PoseErrors:
        """Compare the poses with the truth, if the logs have it."""
        return pose_errors(self.poses, TruthTrack(self.truths), lambda _: None, None)

    def track_figures(self) -> list[TrackFigures]:
        """Compare the track with the truth, at those points that are kept."""
        return tracks_figures(self._samples(), self.poses, TruthTrack(self.truths), triggers_ns=self.asked.values())

    def covered(self) -> float | None:
        """Return the share of the time from the first to the last pose that the track covers.

        Below two poses, it is of the time from the first to the last trigger.
        """
        return covered_share(self._samples(), self.poses, self.asked.values())

    def drawn(self) -> list[Point]:
        """Return B's path: the track, or the poses if there is no track."""
        return self.tracks or self.points

    def _samples(self) -> list[Track]:
        return [point.estimate for point in self.tracks if isinstance(point.estimate, Track)]


def summarize(dive: Dive, pair: Pair | None) -> Summary:
    """Read a dive once, from its first message to its last; pair: whose poses."""
    spacing_ns = max(MIN_SPACING_NS, (dive.end_ns - dive.start_ns) // MAX_POINTS)
    summary = Summary(PairPicture(pair), Coverage(dive.start_ns, dive.end_ns), spacing_ns)
    lit_before_ns: int | None = None
    counted: set[int] = set()
    curves = noted_curves(dive.metadata(), dive.name)
    for envelope in dive.messages(*TOPICS, doing="read"):
        message, at_ns = envelope.message, envelope.time_ns
        # A message is in each recording that was running, and in the node's own log.
        identity = hash((envelope.key, envelope.payload))
        if identity not in counted:
            counted.add(identity)
            summary.counts[envelope.key] += 1
        if isinstance(message, Truth):
            if pair is not None and pair in (envelope.ids, envelope.ids[::-1]):
                truth = message if envelope.ids == pair else inverted(message)
                summary.truths.append(truth_moved(truth, pair, curves))
            continue
        summary.picture.take(envelope)
        if isinstance(message, RelativePose | Rejected):
            if envelope.ids == pair:
                _take_outcome(summary, message, at_ns)
        elif isinstance(message, Track):
            if envelope.ids == pair:
                lit_ns = message.stamp_ns - round(message.age_s * S_NS)
                summary.dark_s = max(summary.dark_s, message.age_s, (lit_ns - (lit_before_ns or lit_ns)) / S_NS)
                lit_before_ns = lit_ns
                if summary.track_coverage is None:
                    summary.track_coverage = Coverage(dive.start_ns, dive.end_ns)
                uncertain = sigma_m(message) >= TRACK_SIGMA_SHARE * message.range_m
                summary.track_coverage.add(at_ns, "uncertain" if uncertain else None)
                _keep(summary, summary.tracks, message, at_ns)
                summary.path.add(message)
        elif isinstance(message, Candidates):
            if pair is not None and message.node in pair:
                summary.asked.setdefault(message.trigger, message.stamp_ns)
        elif isinstance(message, Depth):
            line = summary.depths.setdefault(message.node, [])
            summary.depth_sigma_m[message.node] = message.sigma_m
            if not line or at_ns - line[-1][0] >= max(DEPTH_SPACING_NS, spacing_ns):
                line.append((at_ns, message.depth_m))
        elif isinstance(message, NodeInfo):
            known = summary.infos.setdefault(message.node, [])
            if not known or known[-1].camera != message.camera or known[-1].light_left_m != message.light_left_m:
                known.append(message)
    for coverage in (summary.coverage, summary.track_coverage):
        if coverage is not None:
            coverage.complete = True
    summary.shots = _shots(dive, pair)
    return summary


def _take_outcome(summary: Summary, outcome: RelativePose | Rejected, at_ns: int) -> None:
    if isinstance(outcome, Rejected):
        summary.coverage.add(at_ns, outcome.reason, outcome.stamp_ns)
        summary.rejected.append(outcome)
        return
    summary.coverage.add(at_ns, None, outcome.stamp_ns)
    summary.poses.append(outcome)
    for name, node in summary.picture.nodes.items():
        frame = next((one for one in reversed(node.candidates) if one.trigger == outcome.trigger), None)
        if frame is not None:
            lights = [k for k in chosen_lights(outcome, name) if 0 <= k < len(frame.blobs)]
            summary.light_sigmas_px.extend(frame.blobs[k].sigma_px for k in lights)
    _keep(summary, summary.points, outcome, at_ns)


def _keep(summary: Summary, points: list[Point], estimate: Estimate, at_ns: int) -> None:
    if not points or not 0 <= at_ns - points[-1].at_ns < summary.spacing_ns:
        frame = summary.picture.frame()
        points.append(Point(at_ns, estimate, frame.place(estimate), frame))


def _shots(dive: Dive, pair: Pair | None) -> dict[str, JudgedPicture]:
    """Return a picture of each node near the middle of the dive, if there are pictures."""
    middle_ns = (dive.start_ns + dive.end_ns) // 2
    picture = PairPicture(pair)
    shots: dict[str, JudgedPicture] = {}
    nodes = dive.nodes("image")
    if not nodes:
        return shots
    for envelope in dive.messages("image", "candidates", "pose", "rejected", since_ns=middle_ns):
        if envelope.time_ns > middle_ns + SHOTS_NS or all(node in shots for node in nodes):
            break
        picture.take(envelope)
        for name, node in picture.nodes.items():
            frame = node.shown()
            if name not in shots and node.image is not None and frame is not None and frame.trigger in picture.results:
                shots[name] = JudgedPicture(envelope.time_ns, *judged_picture(picture, node))
    return shots
