"""What a person wants to see of a running pair, as text; with the truth beside it, as the dive is simulated."""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections import Counter, deque
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from buddyline.node.sim.rig import R_BODY_CAMERA
from buddyline.node.sim.scenario import Environment, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.health import stale_after_s
from buddyline.protocol.messages import NodeStatus, Rejected, RelativePose, SolverStatus, Truth
from buddyline.protocol.topics import NODE_STATUS, POSE, REJECTED, SOLVER_STATUS
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.evaluation.poses import PoseErrors, pose_errors
from buddyline.tools.evaluation.truth import TruthTrack
from buddyline.tools.live import follow
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus

RECENT_S: Final = 5.0


class Dashboard:
    """Keeps the newest of everything; safe to feed from the bus's threads."""

    def __init__(self, environment: str, seed: int, start_ns: int, rate_hz: float) -> None:
        self._title = f"Buddyline demo: {environment}, seed {seed}, {rate_hz:g} Hz"
        self._period_s = 1.0 / rate_hz
        self._world = World(Scenario(environment=cast(Environment, environment), seed=seed, start_ns=start_ns))
        self._lock = threading.Lock()
        self._began_s = time.monotonic()
        self._poses: list[RelativePose] = []
        self._truths: list[Truth] = []
        self._latencies_s: list[float] = []
        self._recent: deque[float] = deque()
        self._rejected: Counter[str] = Counter()
        self._last_rejected: Rejected | None = None
        self._nodes: dict[str, NodeStatus] = {}
        self._solver: SolverStatus | None = None

    def subscribe(self, bus: Bus) -> None:
        """Follow poses, rejections and everyone's health."""
        refusals = Refusals("demo")
        for topic in (POSE, REJECTED, SOLVER_STATUS, NODE_STATUS):
            follow(bus, topic.key_any(), refusals, self.take)

    def take(self, envelope: Envelope) -> None:
        """Take one message off the bus."""
        message = envelope.message
        with self._lock:
            if isinstance(message, RelativePose):
                self._poses.append(message)
                self._truths.append(self._world.truth(message.stamp_ns, message.trigger))
                self._latencies_s.append((envelope.time_ns - message.stamp_ns) / S_NS)
                self._recent.append(time.monotonic())
                while self._recent[0] < self._recent[-1] - RECENT_S:
                    self._recent.popleft()
            elif isinstance(message, Rejected):
                self._rejected[message.reason] += 1
                self._last_rejected = message
            elif isinstance(message, SolverStatus):
                self._solver = message
            elif isinstance(message, NodeStatus):
                self._nodes[message.node] = message

    def line(self) -> str:
        """Return the present state in one line, for a log."""
        with self._lock:
            start, end = f"{self._passed_s():6.1f} s", f"rejected {sum(self._rejected.values())}"
            if not self._poses:
                return f"{start}  no pose yet  {end}"
            pose, off_m, _, turned_deg = self._newest()
            return (
                f"{start}  range {pose.range_m:6.3f} m  {_direction(pose)}  off {off_m * 1e3:6.1f} mm "
                f"{turned_deg:5.2f} deg  {self._rate_hz():4.1f} poses/s  {end}"
            )

    def screen(self) -> str:
        """Return the present state as a screenful, which overwrites the last."""
        with self._lock:
            lines = [self._title, "", *self._pose_lines(), "", *self._health_lines(), "", "Ctrl-C ends."]
        return "\x1b[H\x1b[2J" + "\n".join(lines)

    def _errors(self, newest: int = 0) -> PoseErrors:
        """Return the errors of the newest poses (0: of all)."""
        poses, track = self._poses[-newest:], TruthTrack(self._truths[-newest:])
        return pose_errors(poses, track, lambda _: None, None)

    def _newest(self) -> tuple[RelativePose, float, float, float]:
        """Return the newest pose, how far it is off, m, its range's error, m, and how far it is turned, deg."""
        errors = self._errors(newest=1)
        turned_deg = math.degrees(errors.rotation_rad[0])
        return self._poses[-1], float(errors.translation_m[0]), float(errors.range_m[0]), turned_deg

    def _pose_lines(self) -> list[str]:
        if not self._poses:
            return ["no pose yet"]
        pose, off_m, off_range_m, turned_deg = self._newest()
        age_s = time.monotonic() - self._recent[-1]
        stale = f"   (STALE: {age_s:.1f} s old)" if age_s >= stale_after_s(POSE, self._period_s) else ""
        sigma_m = math.sqrt(max(np.trace(np.array(pose.covariance).reshape(6, 6)[:3, :3]), 0.0))
        R = R_BODY_CAMERA @ quat_to_matrix(np.array(pose.q_a_b_xyzw)) @ R_BODY_CAMERA.T
        roll, yaw = math.atan2(R[2, 1], R[2, 2]), math.atan2(R[1, 0], R[0, 0])
        pitch = math.asin(min(max(-R[2, 0], -1.0), 1.0))
        roll_deg, pitch_deg, yaw_deg = map(math.degrees, (roll, pitch, yaw))
        return [
            f"range        {pose.range_m:8.3f} m   (1 sd of the position: {sigma_m * 1e3:.1f} mm){stale}",
            f"direction    {_direction(pose)}",
            f"B beside A   roll {roll_deg:+7.2f}  pitch {pitch_deg:+7.2f}  yaw {yaw_deg:+7.2f} deg",
            f"against truth {off_m * 1e3:7.1f} mm off, range {off_range_m * 1e3:+.1f} mm, turned {turned_deg:.2f} deg",
            f"checks       {', '.join(pose.checks)}   ({pose.method}, {pose.hypotheses} hypotheses)",
        ]

    def _health_lines(self) -> list[str]:
        lines = [f"poses        {len(self._poses)} so far, {self._rate_hz():.1f} a second"]
        if self._latencies_s:
            median_ms = statistics.median(self._latencies_s[-200:]) * 1e3
            lines.append(f"latency      {median_ms:.1f} ms from exposure to here")
        rejected = "  ".join(f"{reason} {count}" for reason, count in self._rejected.most_common())
        lines.append(f"no pose      {rejected or 'none'}")
        if self._last_rejected is not None:
            lines.append(f"  last       {self._last_rejected.reason}: {self._last_rejected.detail}"[:110])
        for name, status in sorted(self._nodes.items()):
            rates = "  ".join(f"{topic} {rate:.0f}/s" for topic, rate in status.rates_hz.items() if rate >= 0.5)
            lines.append(f"node {name}       {rates}   {status.problem or 'ok'}")
        if self._solver is not None:
            lines.append(f"solver       {self._solver.problem or 'ok'}")
        return lines

    def _passed_s(self) -> float:
        return time.monotonic() - self._began_s

    def _rate_hz(self) -> float:
        now_s = time.monotonic()
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
                "wrong_poses": int(errors.wrong.sum()),
                "position_error_m": _median(errors.translation_m),
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


def summary_text(summary: dict[str, Any]) -> str:
    """Return the figures of a whole run for a person."""
    if not summary["poses"]:
        return f"no pose in {summary['seconds']:.0f} s; rejected: {summary['rejected'] or 'nothing'}"
    rejected = ", ".join(f"{reason} {count}" for reason, count in summary["rejected"].items()) or "none"
    cpu = ", ".join(f"{name} {share:.0%}" for name, share in summary["cpu_share"].items())
    return (
        f"{summary['poses']} poses in {summary['seconds']:.0f} s; without a pose: {rejected}\n"
        f"median error: position {summary['position_error_m'] * 1e3:.1f} mm, range "
        f"{summary['range_error_m'] * 1e3:.1f} mm, rotation {summary['rotation_error_deg']:.2f} deg; "
        f"{summary['wrong_poses']} wrong (off by more than a tenth of the range)\n"
        f"exposure to pose: median {summary['latency_ms']:.0f} ms, p99 {summary['latency_p99_ms']:.0f} ms\n"
        f"processor: {cpu}"
    )


def _median(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _direction(pose: RelativePose) -> str:
    if pose.azimuth_rad is UNSET or pose.inclination_rad is UNSET:
        return "azimuth unknown"
    azimuth_deg, inclination_deg = math.degrees(pose.azimuth_rad), math.degrees(pose.inclination_rad)
    return f"azimuth {azimuth_deg:6.2f} deg  inclination {inclination_deg:+6.2f} deg"
