"""What a person wants to see of a running pair, as text; with the truth beside it where the dive is simulated."""

from __future__ import annotations

import math
import statistics
import threading
import time
from collections import Counter, deque
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
from buddyline.node.sim.scenario import Environment, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.messages import NodeStatus, Rejected, RelativePose, SolverStatus
from buddyline.protocol.topics import NODE_STATUS, POSE, REJECTED, SOLVER_STATUS
from buddyline.solver_service.geometry.rotation import matrix_of
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Received

RECENT_S: Final = 5.0
STALE_S: Final = 1.0
# B's body beside A's: camera x right, y down, z forward are the body's y, z, x.
R_BODY_CAMERA: Final = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


class Dashboard:
    """Keeps the newest of everything; safe to feed from the bus's threads."""

    def __init__(self, environment: str, seed: int, start_ns: int, rate_hz: float) -> None:
        self._title = f"Buddyline demo: {environment}, seed {seed}, {rate_hz:g} Hz"
        self._world = World(Scenario(environment=cast(Environment, environment), seed=seed, start_ns=start_ns))
        self.refusals = Refusals("demo")
        self._lock = threading.Lock()
        self._began_s = time.monotonic()
        self._pose: RelativePose | None = None
        self._pose_s = -math.inf
        self._truth_error: tuple[float, float, float] | None = None
        self._errors: list[tuple[float, float, float, float]] = []
        self._latencies_s: list[float] = []
        self._recent: deque[float] = deque()
        self._rejected: Counter[str] = Counter()
        self._last_rejected: Rejected | None = None
        self._nodes: dict[str, NodeStatus] = {}
        self._solver: SolverStatus | None = None

    def subscribe(self, bus: Bus) -> None:
        """Follow poses, rejections and everyone's health."""
        for topic in (POSE, REJECTED, SOLVER_STATUS, NODE_STATUS):
            bus.subscribe(topic.key_any(), self.receive)

    def receive(self, received: Received) -> None:
        """Take one message off the bus."""
        envelope = self.refusals.open(received)
        if envelope is None:
            return
        message = envelope.message
        with self._lock:
            if isinstance(message, RelativePose):
                self._take_pose(message, received.receive_ns)
            elif isinstance(message, Rejected):
                self._rejected[message.reason] += 1
                self._last_rejected = message
            elif isinstance(message, SolverStatus):
                self._solver = message
            elif isinstance(message, NodeStatus):
                self._nodes[message.node] = message

    def _take_pose(self, pose: RelativePose, receive_ns: int) -> None:
        truth = self._world.truth(pose.stamp_ns, pose.trigger)
        t_true_m = np.array(truth.t_a_b_m)
        off_m = float(np.linalg.norm(np.array(pose.t_a_b_m) - t_true_m))
        range_m = float(np.linalg.norm(t_true_m))
        R_error = matrix_of(np.array(pose.q_a_b_xyzw)) @ matrix_of(np.array(truth.q_a_b_xyzw)).T
        turned_rad = math.acos(min(max((float(np.trace(R_error)) - 1) / 2, -1.0), 1.0))
        self._truth_error = (off_m, pose.range_m - range_m, math.degrees(turned_rad))
        self._errors.append((off_m, abs(pose.range_m - range_m), math.degrees(turned_rad), range_m))
        self._latencies_s.append((receive_ns - pose.stamp_ns) / S_NS)
        self._pose, self._pose_s = pose, time.monotonic()
        self._recent.append(self._pose_s)
        while self._recent and self._recent[0] < self._pose_s - RECENT_S:
            self._recent.popleft()

    def line(self) -> str:
        """Return the present state in one line, for a log."""
        with self._lock:
            pose, error = self._pose, self._truth_error
            if pose is None or error is None:
                return f"{self._passed_s():6.1f} s  no pose yet  rejected {sum(self._rejected.values())}"
            return (
                f"{self._passed_s():6.1f} s  range {pose.range_m:6.3f} m  {_direction(pose)}  "
                f"off {error[0] * 1e3:6.1f} mm "
                f"{error[2]:5.2f} deg  {self._rate_hz():4.1f} poses/s  rejected {sum(self._rejected.values())}"
            )

    def screen(self) -> str:
        """Return the present state as a screenful, which overwrites the last."""
        with self._lock:
            lines = [self._title, "", *self._pose_lines(), "", *self._health_lines(), "", "Ctrl-C ends."]
        return "\x1b[H\x1b[2J" + "\n".join(lines)

    def _pose_lines(self) -> list[str]:
        pose, error = self._pose, self._truth_error
        if pose is None or error is None:
            return ["no pose yet"]
        age_s = time.monotonic() - self._pose_s
        stale = f"   (STALE: {age_s:.1f} s old)" if age_s > STALE_S else ""
        sigma_m = math.sqrt(max(np.trace(np.array(pose.covariance).reshape(6, 6)[:3, :3]), 0.0))
        R_bodies = R_BODY_CAMERA @ matrix_of(np.array(pose.q_a_b_xyzw)) @ R_BODY_CAMERA.T
        roll, pitch, yaw = np.degrees(_roll_pitch_yaw(R_bodies))
        return [
            f"range        {pose.range_m:8.3f} m   (1 sd of the position: {sigma_m * 1e3:.1f} mm){stale}",
            f"direction    {_direction(pose)}",
            f"B beside A   roll {roll:+7.2f}  pitch {pitch:+7.2f}  yaw {yaw:+7.2f} deg",
            f"against truth {error[0] * 1e3:7.1f} mm off, range {error[1] * 1e3:+.1f} mm, turned {error[2]:.2f} deg",
            f"checks       {', '.join(pose.checks)}   ({pose.method}, {pose.hypotheses} hypotheses)",
        ]

    def _health_lines(self) -> list[str]:
        lines = [f"poses        {len(self._errors)} so far, {self._rate_hz():.1f} a second"]
        if self._latencies_s:
            lines.append(
                f"latency      {statistics.median(self._latencies_s[-200:]) * 1e3:.1f} ms from exposure to here"
            )
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
            errors = np.array(self._errors).reshape(-1, 4)
            latencies_ms = np.array(self._latencies_s) * 1e3
            wrong = errors[:, 0] > 0.1 * errors[:, 3]
            solver = self._solver
            return {
                "seconds": self._passed_s(),
                "poses": len(errors),
                "rejected": dict(self._rejected),
                "wrong_poses": int(wrong.sum()),
                "position_error_m": _middle(errors[:, 0]),
                "range_error_m": _middle(errors[:, 1]),
                "rotation_error_deg": _middle(errors[:, 2]),
                "latency_ms": _middle(latencies_ms),
                "latency_p99_ms": float(np.percentile(latencies_ms, 99)) if len(latencies_ms) else None,
                "cpu_share": {name: used_s / self._passed_s() for name, used_s in cpu_s.items()},
                "frames": {
                    "a": solver.received_a if solver else 0,
                    "b": solver.received_b if solver else 0,
                    "unmatched": self._rejected["unmatched"],
                    "late": solver.late if solver else 0,
                },
            }

    def summary_text(self, summary: dict[str, Any]) -> str:
        """Return the figures of the whole run for a person."""
        if not summary["poses"]:
            return f"no pose in {summary['seconds']:.0f} s; rejected: {summary['rejected'] or 'nothing'}"
        rejected = ", ".join(f"{reason} {count}" for reason, count in summary["rejected"].items()) or "none"
        cpu = ", ".join(f"{name} {share:.0%}" for name, share in summary["cpu_share"].items())
        return "\n".join(
            [
                f"{summary['poses']} poses in {summary['seconds']:.0f} s; without a pose: {rejected}",
                f"median error: position {summary['position_error_m'] * 1e3:.1f} mm, range "
                f"{summary['range_error_m'] * 1e3:.1f} mm, rotation {summary['rotation_error_deg']:.2f} deg; "
                f"{summary['wrong_poses']} wrong (off by more than a tenth of the range)",
                f"exposure to pose: median {summary['latency_ms']:.0f} ms, p99 {summary['latency_p99_ms']:.0f} ms",
                f"processor: {cpu}",
            ]
        )


def _middle(values: np.ndarray[Any, np.dtype[np.float64]]) -> float | None:
    return float(np.median(values)) if len(values) else None


def _direction(pose: RelativePose) -> str:
    if pose.azimuth_rad is UNSET or pose.inclination_rad is UNSET:
        return "azimuth unknown"
    return (
        f"azimuth {math.degrees(pose.azimuth_rad):6.2f} deg  inclination {math.degrees(pose.inclination_rad):+6.2f} deg"
    )


def _roll_pitch_yaw(R: np.ndarray[Any, np.dtype[np.float64]]) -> tuple[float, float, float]:
    return (
        math.atan2(R[2, 1], R[2, 2]),
        math.asin(min(max(-R[2, 0], -1.0), 1.0)),
        math.atan2(R[1, 0], R[0, 0]),
    )
