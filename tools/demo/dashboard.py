"""The state of a running simulated pair as text, with its errors against the truth."""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from buddyline.node.sim.rig import R_BODY_CAMERA
from buddyline.node.sim.scenario import Environment, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.health import NO_LIGHT_S, stale_after_s
from buddyline.protocol.messages import (
    Message,
    NodeStatus,
    Rejected,
    RelativePose,
    SolverStatus,
    Track,
    TrackMode,
    Truth,
)
from buddyline.protocol.topics import NET_TRUTH, NODE_STATUS, POSE, REJECTED, SOLVER_STATUS, TRACK, TRACK_LAG, TRUTH
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.draw.above import ARROWS, from_above
from buddyline.tools.estimate import Estimate, known, range_sigma_m, sigma_m
from buddyline.tools.evaluation.poses import PoseErrors, differences, pose_errors
from buddyline.tools.evaluation.tracks import TrackFigures, covered_share, tracks_figures
from buddyline.tools.evaluation.truth import TruthTrack
from buddyline.tools.health.words import REASONS
from buddyline.tools.live import follow
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus

RECENT_S: Final = 5.0
# Interval at which the track is kept for the figures of the whole run; its errors change more slowly.
TRACK_SPACING_NS: Final = S_NS // 5
SHARE_SAMPLES: Final = 500
# Share of triggers with pictures of both nodes; a machine that renders fast enough has nearly all.
ENOUGH_PICTURES: Final = 0.9
# The view from above, and from which height of the terminal on the health of all is shown as well.
LEAST_MAP_ROWS, MAP_ROWS, MAP_COLUMNS, MORE_ROWS = 4, 16, 72, 18
CYAN, MAGENTA, YELLOW, PLAIN = "\x1b[36m", "\x1b[35m", "\x1b[33m", "\x1b[0m"


class Dashboard:
    """Keeps the newest messages; `take` may be called from the bus's threads."""

    def __init__(
        self,
        environment: str,
        seed: int,
        start_ns: int,
        rate_hz: float,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self._now_s = now_s
        self._title = f"Buddyline demo: {environment}, seed {seed}, {rate_hz:g} Hz"
        self._period_s = 1.0 / rate_hz
        self._world = World(Scenario(environment=cast(Environment, environment), seed=seed, start_ns=start_ns))
        self._lock = threading.Lock()
        self._began_s = self._now_s()
        self._poses: list[RelativePose] = []
        self._truths: list[Truth] = []
        self._track: Track | None = None
        self._track_came_s = 0.0
        self._tracks: dict[TrackMode, list[Track]] = {}
        self._track_truths: list[Truth] = []
        self._latencies_s: list[float] = []
        self._recent: deque[float] = deque()
        self._rejected: Counter[str] = Counter()
        # Triggers with all four lights in view, and those of them with a pose.
        self._in_view, self._solved_in_view = 0, 0
        self._last_rejected: Rejected | None = None
        # The first and the newest trigger that was answered.
        self._first_trigger, self._newest_trigger = math.inf, -math.inf
        self._nodes: dict[str, NodeStatus] = {}
        self._solver: SolverStatus | None = None

    def subscribe(self, bus: Bus) -> None:
        """Subscribe to poses, tracks, rejections and status messages."""
        refusals = Refusals("demo")
        for topic in (POSE, TRACK, TRACK_LAG, REJECTED, SOLVER_STATUS, NODE_STATUS):
            follow(bus, topic.key_any(), refusals, self.take)

    @property
    def begun(self) -> bool:
        """Whether both pictures of a trigger have come to the solver."""
        with self._lock:
            return bool(self._poses or self._rejected.keys() - {"unmatched"})

    def take(self, envelope: Envelope) -> None:
        """Take one message off the bus."""
        message = envelope.message
        with self._lock:
            if isinstance(message, RelativePose | Rejected):
                self._first_trigger = min(self._first_trigger, message.trigger)
                self._newest_trigger = max(self._newest_trigger, message.trigger)
            if isinstance(message, RelativePose):
                self._poses.append(message)
                self._truths.append(self._world.truth(message.stamp_ns, message.trigger))
                self._solved_in_view += self._count_in_view(message)
                self._latencies_s.append((envelope.time_ns - message.stamp_ns) / S_NS)
                self._recent.append(self._now_s())
                while self._recent[0] < self._recent[-1] - RECENT_S:
                    self._recent.popleft()
            elif isinstance(message, Track):
                self._take_track(message)
            elif isinstance(message, Rejected):
                self._rejected[message.reason] += 1
                self._count_in_view(message)
                self._last_rejected = message
            elif isinstance(message, SolverStatus):
                self._solver = message
            elif isinstance(message, NodeStatus):
                self._nodes[message.node] = message

    def truth(self, end_ns: int) -> Iterator[tuple[int, str, Message]]:
        """Yield the truth of every trigger up to end_ns: stamp_ns, key, message."""
        period_ns = round(self._period_s * S_NS)
        start_ns = self._world.scenario.start_ns
        for trigger in range(-(-start_ns // period_ns), end_ns // period_ns):
            stamp_ns = trigger * period_ns
            yield stamp_ns, TRUTH.key("a", "b"), self._world.truth(stamp_ns, trigger)
            for node in ("a", "b"):
                yield stamp_ns, NET_TRUTH.key("main", node), self._world.node_truth(node, stamp_ns, "main")

    def line(self) -> str:
        """Return the present state in one line, for a log."""
        with self._lock:
            start = f"{self._passed_s():6.1f} s"
            end = f"rejected {sum(self._rejected.values())}"
            shown = self._shown()
            if shown is None:
                return f"{start}  no pose yet  {end}"
            off_m, _, turned_deg = self._off(shown)
            return (
                f"{start}  range {shown.range_m:6.3f} m ± {range_sigma_m(shown) * 1e3:.1f} mm  {_direction(shown)}  "
                f"off {off_m * 1e3:6.1f} mm {turned_deg:5.2f} deg  {self._age(shown)}{self._shares()}  {end}"
            )

    def screen(self, width: int, height: int, *, coloured: bool = False, arrows: str = ARROWS) -> str:
        """Return the present state as a screen of text that overwrites the last one; whole from 60 x 14 characters."""
        with self._lock:
            shown = self._shown()
            told = self._pose_lines(shown)
            for text in (self._shares(), self._reason_line()):
                told += wrap(text, max(width - 1, 1))
            room = height - len(told) - 2
            more = ["", *self._health_lines(), ""] if room >= MORE_ROWS else []
            room -= len(more)
            above = [] if shown is None else _from_above(shown, width, min(room, MAP_ROWS), arrows, coloured)
            lines = [line[: width - 1].rstrip() for line in (*told, *more, "Ctrl-C ends.")]
            troubled = coloured and shown is not None and self._age(shown)
        if troubled:
            lines[0] = f"{YELLOW}{lines[0]}{PLAIN}"
        # A terminal with more lines than it has room for would move all of them up.
        return overwritten([self._title[: width - 1], *above, *lines][: max(height, 1)])

    def _count_in_view(self, outcome: RelativePose | Rejected) -> bool:
        """Count a trigger's lights; return whether all four were in view, each by itself."""
        seen = [
            light
            for node in ("a", "b")
            for light in self._world.light_truth(node, outcome.stamp_ns, outcome.trigger).lights
            if light.visible and not light.merged
        ]
        self._in_view += len(seen) == 4
        return len(seen) == 4

    def _reason_line(self) -> str:
        """Return why the last trigger without a pose had none, and what to do, in words."""
        if self._last_rejected is None:
            return "no trigger without a pose so far"
        meaning, advice = REASONS[self._last_rejected.reason]
        if self._solver is not None and self._solver.advice is not UNSET:
            advice = ", ".join(self._solver.advice)
        return f"last without a pose: {meaning}" + (f"; {advice}" if advice else "")

    def _errors(self) -> PoseErrors:
        return pose_errors(self._poses, TruthTrack(self._truths), lambda _: None, None)

    def _track_figures(self) -> list[TrackFigures]:
        tracks = [track for kept in self._tracks.values() for track in kept]
        return tracks_figures(tracks, self._poses, TruthTrack(self._track_truths))

    def _take_track(self, track: Track) -> None:
        if track.mode == "filter":
            self._track, self._track_came_s = track, self._now_s()
        kept = self._tracks.setdefault(track.mode, [])
        if not kept or track.stamp_ns - kept[-1].stamp_ns >= TRACK_SPACING_NS:
            kept.append(track)
            self._track_truths.append(self._world.truth(track.stamp_ns, 0))

    def _shown(self) -> Estimate | None:
        """Return the track, or the newest pose if the track is missing or stale."""
        stale_s = stale_after_s(TRACK, self._period_s)
        if self._track is not None and self._now_s() - self._track_came_s < stale_s:
            return self._track
        return self._poses[-1] if self._poses else self._track

    def _age(self, shown: Estimate) -> str:
        """Return the age of what is shown, in words; "" if it is fresh."""
        if isinstance(shown, Track):
            dark_s = shown.age_s + self._now_s() - self._track_came_s
            return f"no light for {dark_s:.1f} s  " if dark_s > NO_LIGHT_S else ""
        age_s = self._now_s() - self._recent[-1]
        stale = f", STALE: {age_s:.1f} s old" if age_s >= stale_after_s(POSE, self._period_s) else ""
        return f"no track, the last pose{stale}  "

    def _shares(self) -> str:
        """Return the shares of time with a track and of triggers with a pose."""
        tracks = self._tracks.get("filter", [])
        # A long run keeps only a part of its samples, which is enough for a share.
        covered = covered_share(tracks[:: 1 + len(tracks) // SHARE_SAMPLES], self._poses)
        said = f"track {covered or 0.0:.0%} of the time, poses {self._solved_share() or 0.0:.0%} of triggers"
        share = self._solved_share_in_view()
        return said if share is None else f"{said}, {share:.0%} with all lights in view"

    def _solved_share_in_view(self) -> float | None:
        return self._solved_in_view / self._in_view if self._in_view else None

    def _solved_share(self) -> float | None:
        total = len(self._poses) + sum(self._rejected.values())
        return len(self._poses) / total if total else None

    def _pictured_share(self) -> float | None:
        """Return the share of triggers of which both nodes' pictures came, from the first answer on."""
        total = len(self._poses) + sum(self._rejected.values())
        if not total:
            return None
        return (total - self._rejected["unmatched"]) / (self._newest_trigger - self._first_trigger + 1)

    def _off(self, shown: Estimate) -> tuple[float, float, float]:
        """Return how far an estimate is off, m, its range's error, m, and how far it is turned, deg."""
        true = TruthTrack([self._world.truth(shown.stamp_ns, 0)]).interpolated(shown.stamp_ns)
        off = differences([(shown, true)] if true is not None else [])
        return (
            float(off.translation_m[0]),
            shown.range_m - float(off.true_range_m[0]),
            math.degrees(float(off.rotation_rad[0])),
        )

    def _pose_lines(self, shown: Estimate | None) -> list[str]:
        if shown is None:
            return ["no pose yet"]
        off_m, off_range_m, turned_deg = self._off(shown)
        roll_deg, pitch_deg, yaw_deg = (math.degrees(angle_rad) for angle_rad in _turned(shown))
        seen = ", ".join(
            f"{name} {status.lights_seen}"
            for name, status in sorted(self._nodes.items())
            if status.lights_seen is not UNSET
        )
        turned = f"roll {roll_deg:+.0f} pitch {pitch_deg:+.0f} yaw {yaw_deg:+.0f} deg"
        return [
            f"range {shown.range_m:.3f} m, 1 sd {sigma_m(shown) * 1e3:.1f} mm   {self._age(shown)}",
            _direction(shown),
            f"B from A: {turned}  lights: {seen or 'none yet'}",
            f"truth: {off_m * 1e3:.1f} mm off, range {off_range_m * 1e3:+.1f} mm, turned {turned_deg:.2f} deg",
        ]

    def _health_lines(self) -> list[str]:
        lines = [f"poses        {len(self._poses)} so far, {self._rate_hz():.1f} a second"]
        if self._latencies_s:
            median_ms = statistics.median(self._latencies_s[-200:]) * 1e3
            lines.append(f"latency      {median_ms:.1f} ms from exposure to here")
        rejected = "  ".join(f"{reason} {count}" for reason, count in self._rejected.most_common())
        lines.append(f"no pose      {rejected or 'none'}")
        if self._last_rejected is not None:
            lines.append(f"  last       {self._last_rejected.reason}: {self._last_rejected.detail}")
        for name, status in sorted(self._nodes.items()):
            rates = "  ".join(f"{topic} {rate:.0f}/s" for topic, rate in status.rates_hz.items() if rate >= 0.5)
            lines.append(f"node {name}       {rates}   {status.problem or 'ok'}")
        if self._solver is not None:
            lines.append(f"solver       {self._solver.problem or 'ok'}")
        return lines

    def _passed_s(self) -> float:
        return self._now_s() - self._began_s

    def _rate_hz(self) -> float:
        now_s = self._now_s()
        return sum(1 for s in self._recent if s > now_s - RECENT_S) / min(RECENT_S, max(self._passed_s(), 1.0))

    def summary(self, cpu_s: dict[str, float]) -> dict[str, Any]:
        """Return the figures of the whole run; cpu_s: processor time by process."""
        with self._lock:
            errors, solver = self._errors(), self._solver
            latencies_ms = np.array(self._latencies_s) * 1e3
            return {
                "seconds": self._passed_s(),
                "poses": len(errors),
                "rejected": dict(self._rejected),
                "solved_share": self._solved_share(),
                "solved_share_in_view": self._solved_share_in_view(),
                "pictured_share": self._pictured_share(),
                "wrong_poses": int(errors.wrong.sum()),
                "tracks": {
                    figures.mode: {
                        "samples": figures.samples,
                        "covered_share": figures.covered,
                        "wrong_samples": figures.wrong,
                        "position_error_m": figures.position_m.median,
                        "worst_position_error_m": figures.worst_m,
                        "rotation_error_deg": _degrees(figures.rotation_rad.median),
                    }
                    for figures in self._track_figures()
                },
                "position_error_m": _median(errors.translation_m),
                "worst_position_error_m": float(errors.translation_m.max()) if len(errors) else None,
                "range_error_m": _median(np.abs(errors.range_m)),
                "rotation_error_deg": _median(np.degrees(errors.rotation_rad)),
                "latency_ms": _median(latencies_ms),
                "latency_p99_ms": float(np.percentile(latencies_ms, 99)) if len(latencies_ms) else None,
                "cpu_share": {name: used_s / self._passed_s() for name, used_s in cpu_s.items()},
                "frames": {
                    "a": solver.received_a if solver else 0,
                    "b": solver.received_b if solver else 0,
                    "unmatched": self._rejected["unmatched"],
                    "late": solver.late if solver else 0,
                },
            }


def overwritten(lines: Iterable[str]) -> str:
    """Return lines that overwrite the last screen, line by line: a screen that is cleared first flickers."""
    return "\x1b[H" + "\x1b[K\n".join(lines) + "\x1b[K\x1b[J"


def summary_text(summary: dict[str, Any]) -> str:
    """Return the figures of a whole run for a person."""
    slow = slow_words(summary["pictured_share"])
    if not summary["poses"]:
        return "\n".join(
            [f"no pose in {summary['seconds']:.0f} s; rejected: {summary['rejected'] or 'nothing'}", *slow]
        )
    rejected = ", ".join(f"{reason} {count}" for reason, count in summary["rejected"].items()) or "none"
    cpu = ", ".join(f"{name} {used:.0%}" for name, used in summary["cpu_share"].items())
    share = summary["solved_share_in_view"]
    lines = [
        f"{summary['poses']} poses in {summary['seconds']:.0f} s, of {summary['solved_share']:.0%} of the triggers"
        + (f" ({share:.0%} of those with all four lights in view)" if share is not None else "")
        + f"; without a pose: {rejected}",
        f"median error: position {summary['position_error_m'] * 1e3:.1f} mm, range "
        f"{summary['range_error_m'] * 1e3:.1f} mm, rotation {summary['rotation_error_deg']:.2f} deg; worst position "
        f"{summary['worst_position_error_m'] * 1e3:.0f} mm; "
        f"{summary['wrong_poses']} wrong (off by more than a tenth of the range)",
        *(_track_words(mode, track) for mode, track in summary["tracks"].items() if track["samples"]),
        f"exposure to pose: median {summary['latency_ms']:.0f} ms, p99 {summary['latency_p99_ms']:.0f} ms",
        f"processor: {cpu}",
        *slow,
    ]
    return "\n".join(lines)


def slow_words(share: float | None) -> list[str]:
    """Return a line where too few triggers had both pictures."""
    if share is None or share >= ENOUGH_PICTURES:
        return []
    said = f"both pictures came for {share:.0%} of the triggers: this machine is busy, or too slow for the demo"
    return [f"{said}; a lower --rate takes fewer"]


def _track_words(mode: str, track: dict[str, Any]) -> str:
    name = {"filter": "track", "lag": "track with a second of delay (lag)"}.get(mode, mode)
    return (
        f"{name}: covers {track['covered_share'] or 0.0:.0%} of the time; median error: position "
        f"{track['position_error_m'] * 1e3:.1f} mm, rotation {track['rotation_error_deg']:.2f} deg; worst position "
        f"{track['worst_position_error_m'] * 1e3:.0f} mm; {track['wrong_samples']} of {track['samples']} samples wrong"
    )


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)


def _median(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _turned(shown: Estimate) -> tuple[float, float, float]:
    """Return roll, pitch and yaw of B's body in A's, rad."""
    R = R_BODY_CAMERA @ quat_to_matrix(np.array(shown.q_a_b_xyzw)) @ R_BODY_CAMERA.T
    pitch_rad = math.asin(min(max(-R[2, 0], -1.0), 1.0))
    return math.atan2(R[2, 1], R[2, 2]), pitch_rad, math.atan2(R[1, 0], R[0, 0])


def _from_above(shown: Estimate, width: int, rows: int, arrows: str, coloured: bool) -> list[str]:
    """Return both divers from above, as A sees it; nothing where there is no room."""
    if rows < LEAST_MAP_ROWS:
        return []
    right_m, _, forward_m = shown.t_a_b_m
    names = (f"{CYAN}A{PLAIN}", f"{MAGENTA}B{PLAIN}") if coloured else ("A", "B")
    columns = min(width - 1, MAP_COLUMNS)
    return from_above(columns, rows, right_m, forward_m, _turned(shown)[2], arrows=arrows, names=names)


def _direction(shown: Estimate) -> str:
    said = []
    for name, digits in (("azimuth", "6.2f"), ("inclination", "+6.2f")):
        angle_rad, sigma_rad = known(shown, f"{name}_rad"), known(shown, f"sigma_{name}_rad")
        if angle_rad is None:
            return "azimuth unknown"
        sigma = "" if sigma_rad is None else f" ± {math.degrees(sigma_rad):.2f}"
        said.append(f"{name} {math.degrees(angle_rad):{digits}}{sigma} deg")
    return "  ".join(said)
