"""The state of a running demo of more than two nodes as text: each node in one frame, and its errors."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.messages import Message, NodePose, Rejected, RelativePose, SolverStatus
from buddyline.protocol.topics import NET_POSE, NET_TRUTH, POSE, REJECTED, SOLVER_STATUS, TRUTH
from buddyline.tools.demo.dashboard import overwritten
from buddyline.tools.draw.above import ARROWS
from buddyline.tools.evaluation.network import network_figures
from buddyline.tools.live import follow
from buddyline.tools.measure.tables import text_table

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus

# A node that was not told for so long is shown as lost.
STALE_S: Final = 1.0
# Interval at which a node's poses are kept for the figures of the whole run.
SPACING_NS: Final = S_NS // 5
NET: Final = "main"


class TeamDashboard:
    """Keeps the newest messages; `take` may be called from the bus's threads."""

    def __init__(self, scenario: Scenario, rate_hz: float, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s = now_s
        fixed = f", fixed: {', '.join(scenario.fixed_nodes)}" if scenario.fixed_nodes else ""
        self._title = f"Buddyline demo: {scenario.environment}, seed {scenario.seed}, {rate_hz:g} Hz{fixed}"
        self._period_ns = round(S_NS / rate_hz)
        self._world = World(scenario)
        self._lock = threading.Lock()
        self._began_s = self._now_s()
        self._newest: dict[str, tuple[NodePose, float]] = {}
        self._kept: dict[str, list[NodePose]] = {}
        self._truths: list[NodePose] = []
        self._pairs: Counter[tuple[str, str]] = Counter()
        self._triggers: Counter[tuple[str, str]] = Counter()
        self._problems: dict[tuple[str, str], str] = {}

    def subscribe(self, bus: Bus) -> None:
        """Subscribe to poses, rejections and status messages."""
        refusals = Refusals("demo")
        for topic in (NET_POSE, POSE, REJECTED, SOLVER_STATUS):
            follow(bus, topic.key_any(), refusals, self.take)

    def take(self, envelope: Envelope) -> None:
        """Take one message off the bus."""
        message = envelope.message
        with self._lock:
            if isinstance(message, NodePose):
                self._newest[message.node] = message, self._now_s()
                kept = self._kept.setdefault(message.node, [])
                if not kept or message.stamp_ns - kept[-1].stamp_ns >= SPACING_NS:
                    kept.append(message)
                    # Where a node is the origin, all places count from its true one.
                    for node in self._world.scenario.nodes:
                        self._truths.append(self._world.node_truth(node, message.stamp_ns, NET))
            elif isinstance(message, RelativePose | Rejected):
                pair = message.node_a, message.node_b
                self._triggers[pair] += 1
                self._pairs[pair] += isinstance(message, RelativePose)
            elif isinstance(message, SolverStatus):
                self._problems[message.node_a, message.node_b] = message.problem

    def truth(self, end_ns: int) -> Iterator[tuple[int, str, Message]]:
        """Yield the truth of each trigger up to end_ns: stamp, key, message."""
        scenario = self._world.scenario
        for trigger in range(-(-scenario.start_ns // self._period_ns), end_ns // self._period_ns):
            stamp_ns = trigger * self._period_ns
            for pair in combinations(scenario.nodes, 2):
                yield stamp_ns, TRUTH.key(*pair), self._world.truth(stamp_ns, trigger, pair)
            for node in scenario.nodes:
                yield stamp_ns, NET_TRUTH.key(NET, node), self._world.node_truth(node, stamp_ns, NET)

    def line(self) -> str:
        """Return the present state in one line, for a log."""
        with self._lock:
            words = [f"{node} {self._place(node)}" for node in self._world.scenario.nodes]
            return f"{self._now_s() - self._began_s:6.1f} s  " + "   ".join(words)

    def screen(self, width: int, height: int, *, coloured: bool = False, arrows: str = ARROWS) -> str:
        """Return the present state as a screen of text that overwrites the last one, cut to the terminal's size."""
        del coloured, arrows
        with self._lock:
            rows = [("node", "north, east, down (m)", "off")]
            rows += [(node, *self._cells(node)) for node in self._world.scenario.nodes]
            pairs = [("pair", "poses", "triggers")]
            pairs += [("/".join(pair), str(self._pairs[pair]), str(n)) for pair, n in sorted(self._triggers.items())]
            said = sorted({problem for problem in self._problems.values() if problem})
            text = [
                self._title,
                "",
                text_table(rows),
                "",
                text_table(pairs),
                "",
                *(said or ["solver ok"]),
                "Ctrl-C ends.",
            ]
        lines = "\n".join(text).split("\n")
        return overwritten(line[:width] for line in lines[: max(height - 1, 1)])

    def _place(self, node: str) -> str:
        place, off = self._cells(node)
        return f"({place}) off {off}" if off else place

    def _cells(self, node: str) -> tuple[str, str]:
        found = self._newest.get(node)
        if found is None or self._now_s() - found[1] > STALE_S:
            return "not known" if found is None else "lost", ""
        pose = found[0]
        zero = np.zeros(3)
        origin = next((one for one, _ in self._newest.values() if one.p_m == (0.0, 0.0, 0.0)), None)
        if origin is not None and not self._world.scenario.fixed_nodes:
            zero = np.array(self._world.node_truth(origin.node, pose.stamp_ns, NET).p_m)
        true_m = np.array(self._world.node_truth(node, pose.stamp_ns, NET).p_m) - zero
        off_m = float(np.linalg.norm(true_m - pose.p_m))
        return ", ".join(f"{value:.2f}" for value in pose.p_m), f"{1e3 * off_m:.0f} mm"

    def summary(self, cpu_s: dict[str, float]) -> dict[str, Any]:
        """Return the figures of the whole run; cpu_s: processor time by process."""
        with self._lock:
            seconds = self._now_s() - self._began_s
            poses = [pose for kept in self._kept.values() for pose in kept]
            return {
                "seconds": seconds,
                "poses": sum(self._pairs.values()),
                "network": {
                    one.node: {
                        "fixed": one.fixed,
                        "samples": one.samples,
                        "position_error_m": one.position_m.median,
                        "worst_position_error_m": one.worst_m,
                        "nees6": one.nees6.mean,
                        "wrong": one.wrong,
                    }
                    for one in network_figures(poses, self._truths)
                },
                "pairs": {
                    "/".join(pair): {"poses": self._pairs[pair], "triggers": count}
                    for pair, count in sorted(self._triggers.items())
                },
                "cpu_share": {name: used_s / seconds for name, used_s in cpu_s.items()},
            }


def team_summary_text(summary: dict[str, Any]) -> str:
    """Return the figures of a whole run for a person."""
    rows = [("node", "samples", "off, median mm", "worst mm", "wrong")]
    rows += [
        (
            f"{node} (fixed)" if one["fixed"] else node,
            str(one["samples"]),
            f"{1e3 * (one['position_error_m'] or 0.0):.1f}",
            f"{1e3 * one['worst_position_error_m']:.0f}",
            str(one["wrong"]),
        )
        for node, one in summary["network"].items()
    ]
    cpu = ", ".join(f"{name} {share:.0%}" for name, share in summary["cpu_share"].items())
    pairs = ", ".join(f"{pair} {one['poses']} of {one['triggers']}" for pair, one in summary["pairs"].items())
    return f"{text_table(rows)}\nposes of triggers: {pairs or 'none'}\nprocessor: {cpu}"
