"""The state of a running demo of more than two nodes as text: each node in one frame, and its errors."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache
from itertools import combinations
from textwrap import wrap
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.messages import Message, NodePose, Rejected, RelativePose, SolverStatus
from buddyline.protocol.topics import NET_POSE, NET_TRUTH, POSE, REJECTED, SOLVER_STATUS, TRUTH
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.demo.dashboard import LEAST_MAP_ROWS, MAP_COLUMNS, MAP_ROWS, overwritten, slow_words
from buddyline.tools.draw.above import ARROWS, nodes_from_above
from buddyline.tools.evaluation.network import network_figures
from buddyline.tools.health.words import reason_words
from buddyline.tools.live import follow
from buddyline.tools.measure.tables import number, text_table

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
        # Triggers with all four lights of a pair in view, and those of them with a pose.
        self._in_view: Counter[tuple[str, str]] = Counter()
        self._solved_in_view: Counter[tuple[str, str]] = Counter()
        self._reasons: Counter[str] = Counter()
        # The first trigger that each pair answered, and the newest that any answer can be of.
        self._first: dict[tuple[str, str], int] = {}
        self._newest_trigger = 0
        self._seen = lru_cache(maxsize=256)(self._lights_seen)
        self._problems: dict[tuple[str, str], str] = {}

    def subscribe(self, bus: Bus) -> None:
        """Subscribe to poses, rejections and status messages."""
        refusals = Refusals("demo")
        for topic in (NET_POSE, POSE, REJECTED, SOLVER_STATUS):
            follow(bus, topic.key_any(), refusals, self.take)

    @property
    def begun(self) -> bool:
        """Whether both pictures of a trigger have come to the solver, of any pair."""
        with self._lock:
            return any(self._pairs.values()) or bool(self._reasons.keys() - {"unmatched"})

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
                self._first[pair] = min(self._first.get(pair, message.trigger), message.trigger)
                self._newest_trigger = max(self._newest_trigger, envelope.time_ns // self._period_ns)
                self._count(message, pair)
            elif isinstance(message, SolverStatus):
                self._problems[message.node_a, message.node_b] = message.problem

    def _count(self, outcome: RelativePose | Rejected, pair: tuple[str, str]) -> None:
        solved = isinstance(outcome, RelativePose)
        self._pairs[pair] += solved
        if isinstance(outcome, Rejected):
            self._reasons[outcome.reason] += 1
        one, other = pair
        in_view = self._seen(one, outcome.trigger)[other] == self._seen(other, outcome.trigger)[one] == 2
        self._in_view[pair] += in_view
        self._solved_in_view[pair] += in_view and solved

    def _lights_seen(self, node: str, trigger: int) -> Counter[str]:
        """Return how many lights of each other node are in a node's picture, each by itself."""
        lights = self._world.light_truth(node, trigger * self._period_ns, trigger).lights
        return Counter(str(light.node) for light in lights if light.visible and not light.merged)

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
        del coloured
        with self._lock:
            rows = [("node", "north, east, down (m)", "off")]
            rows += [(node, *self._cells(node)) for node in self._world.scenario.nodes]
            said = sorted({problem for problem in self._problems.values() if problem}) or ["solver ok"]
            text = [*text_table(rows).split("\n"), ""]
            for words in (_pair_words(self._pair_figures()), _reasons_words(self._reasons), *said):
                text += wrap(words, max(width - 1, 1))
            text.append("Ctrl-C ends.")
            room = min(height - len(text) - 3, MAP_ROWS)
            above = self._from_above(min(width - 1, MAP_COLUMNS), room, arrows)
        lines = [self._title, "", *above, *text]
        return overwritten(line[: width - 1] for line in lines[: max(height - 1, 1)])

    def _from_above(self, width: int, rows: int, arrows: str) -> list[str]:
        """Return the nodes whose place is known from above; nothing where there is no room."""
        known = [pose for pose, came_s in self._newest.values() if self._now_s() - came_s <= STALE_S]
        if rows < LEAST_MAP_ROWS or not known:
            return []
        places = []
        for pose in sorted(known, key=lambda pose: pose.node):
            north, east, _ = quat_to_matrix(np.array(pose.q_xyzw))[:, 2].tolist()
            places.append((pose.node, pose.p_m[0], pose.p_m[1], math.atan2(east, north)))
        return [*nodes_from_above(width, rows, places, arrows=arrows), ""]

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
            figures = {one.node: one for one in network_figures(poses, self._truths)}
            return {
                "seconds": seconds,
                "poses": sum(self._pairs.values()),
                "network": {
                    node: {
                        "fixed": one.fixed,
                        "samples": one.samples,
                        "position_error_m": one.position_m.median,
                        "worst_position_error_m": one.worst_m,
                        "stated_position_sigma_m": one.sigma_m,
                        "nees6": one.nees6.mean,
                        "wrong": one.wrong,
                    }
                    if (one := figures.get(node)) is not None
                    else {"fixed": node in self._world.scenario.fixed_nodes, "samples": 0}
                    for node in self._world.scenario.nodes
                },
                "pairs": self._pair_figures(),
                "rejected": dict(self._reasons.most_common()),
                "pictured_share": self._pictured_share(),
                "cpu_share": {name: used_s / seconds for name, used_s in cpu_s.items()},
            }

    def _pair_figures(self) -> dict[str, dict[str, int]]:
        return {
            "/".join(pair): {
                "poses": self._pairs[pair],
                "triggers": count,
                "poses_in_view": self._solved_in_view[pair],
                "triggers_in_view": self._in_view[pair],
            }
            for pair, count in sorted(self._triggers.items())
        }

    def _pictured_share(self) -> float | None:
        """Return the share of triggers, of all pairs, that were answered with both nodes' pictures."""
        due = sum(self._newest_trigger - first + 1 for first in self._first.values())
        return (self._triggers.total() - self._reasons["unmatched"]) / due if due > 0 else None


def team_summary_text(summary: dict[str, Any]) -> str:
    """Return the figures of a whole run for a person."""
    rows = [("node", "samples", "off, median mm", "worst mm", "stated mm", "wrong")]
    rows += [
        (
            f"{node} (fixed)" if one["fixed"] else node,
            str(one["samples"]),
            *(
                (
                    number(1e3 * one["position_error_m"], 1),
                    number(1e3 * one["worst_position_error_m"], 0),
                    number(1e3 * one["stated_position_sigma_m"], 1),
                    str(one["wrong"]),
                )
                if one["samples"]
                else ("-",) * 4
            ),
        )
        for node, one in summary["network"].items()
    ]
    cpu = ", ".join(f"{name} {share:.0%}" for name, share in summary["cpu_share"].items())
    of_compasses = not any(one["fixed"] for one in summary["network"].values())
    lines = [
        text_table(rows),
        *(
            ["no node is fixed, so the compasses say where north is: one degree is 87 mm at 5 m"]
            if of_compasses
            else []
        ),
        _pair_words(summary["pairs"]),
        _reasons_words(summary["rejected"]),
        f"processor: {cpu}",
        *slow_words(summary["pictured_share"]),
    ]
    return "\n".join(lines)


def _pair_words(pairs: Mapping[str, Mapping[str, int]]) -> str:
    """Return how many triggers of each pair have a pose, and of those with all four lights in view."""
    said = []
    for pair, one in pairs.items():
        share = one["poses"] / one["triggers"]
        in_view = (
            f"{one['poses_in_view'] / one['triggers_in_view']:.0%} in view"
            if one["triggers_in_view"]
            else "never in view"
        )
        said.append(f"{pair} {one['poses']} of {one['triggers']} ({share:.0%}; {in_view})")
    return f"poses of triggers: {', '.join(said) or 'none'}"


def _reasons_words(reasons: Mapping[str, int]) -> str:
    """Return the commonest reasons of triggers without a pose, in words."""
    total = sum(reasons.values())
    commonest = sorted(reasons.items(), key=lambda item: -item[1])[:3]
    said = ", ".join(f"{reason_words(reason)} {count / total:.0%}" for reason, count in commonest)
    return f"without a pose: {said or 'none'}"
