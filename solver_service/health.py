"""What is wrong with the two nodes, as the solver sees it: gone, stale, or of a clock that disagrees."""

from __future__ import annotations

from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import FRAMES_APART_S, stale_after_s
from buddyline.protocol.topics import CANDIDATES


class NodeHealth:
    """Of two nodes; whoever else sends is not kept. now_s: monotonic."""

    def __init__(self, node_a: str, node_b: str) -> None:
        self._nodes = (node_a, node_b)
        self._frames: dict[str, tuple[float, int]] = {}
        self._period_s: dict[str, float] = {}
        self._alive: dict[str, bool] = {}

    def saw_frame(self, node: str, stamp_ns: int, now_s: float) -> None:
        """Take note of a frame."""
        if node in self._nodes:
            self._frames[node] = (now_s, stamp_ns)

    def saw_period(self, node: str, trigger_period_ns: int) -> None:
        """Take note of how often a node's frames are due."""
        if node in self._nodes:
            self._period_s[node] = trigger_period_ns / S_NS

    def saw_process(self, name: str, alive: bool) -> None:
        """Take note of a process that came or went; name: as it was declared alive."""
        node = name.removeprefix("node/")
        if name != node and node in self._nodes:
            self._alive[node] = alive

    def newest_frame_s(self) -> float | None:
        """When the newest frame came; None before any."""
        return max((seen_s for seen_s, _ in self._frames.values()), default=None)

    def problems(self, now_s: float) -> list[str]:
        """Say what is wrong, a phrase each."""
        found = [text for node in self._nodes if (text := self._problem_of(node, now_s))]
        if not found and len(self._frames) == 2:
            node_a, node_b = self._nodes
            ahead_ns = self._frames[node_b][1] - self._frames[node_a][1]
            if abs(ahead_ns) > FRAMES_APART_S * S_NS:
                first, second = (node_b, node_a) if ahead_ns > 0 else (node_a, node_b)
                found.append(
                    f"frames of {first} are {abs(ahead_ns) / S_NS:.1f} s ahead of those of {second}: "
                    "do their clocks agree?"
                )
        return found

    def _problem_of(self, node: str, now_s: float) -> str | None:
        if self._alive.get(node) is False:
            return f"node {node} is gone: its process ended, or its link"
        seen = self._frames.get(node)
        if seen is None:
            return f"no frame of node {node} yet"
        silent_s = now_s - seen[0]
        if silent_s > stale_after_s(CANDIDATES, self._period_s.get(node, 0.0)):
            return f"no frame of node {node} for {silent_s:.0f} s"
        return None
