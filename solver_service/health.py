"""Problems of the nodes that the solver sees: one is gone or silent, or two have one id, one code, or other clocks."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

from buddyline.protocol import __version__
from buddyline.protocol.clock import S_NS
from buddyline.protocol.health import FRAMES_APART_S, stale_after_s
from buddyline.protocol.messages import Blink, Candidates
from buddyline.protocol.topics import CANDIDATES

MAX_PROCESSES: Final = 256
# Frames of two runs of a node, or of two counts in one run, that come by turns so often are two nodes' of one id; it is
# said for TWINS_NS after that.
TWINS: Final = 3
TWINS_NS: Final = 10 * S_NS
_RELEASE: Final = re.compile(r"buddyline (\d{1,4}\.\d{1,4})(?!\d)")


@dataclass
class Runs:
    """The run (boot) that a node's newest frame is of, its stamp, the number that came last, and the run before.

    returns: how often the run before, or an earlier number of this one, was back, later by stamp. now_ns: when it was
    last. twins: whether it ever was so often that there were two nodes.
    """

    boot: str
    stamp_ns: int
    seq: int
    before: str | None = None
    returns: int = 0
    now_ns: int = 0
    twins: bool = False


class Health:
    """Keeps each node's last frame, and whether its process is alive. now_ns: receive time that never goes back."""

    def __init__(self) -> None:
        self._frames: dict[str, tuple[int, int]] = {}
        self._period_s: dict[str, float] = {}
        self._alive: dict[str, bool] = {}
        self._releases: dict[str, str] = {}
        self._runs: dict[str, Runs] = {}
        self._blinks: dict[str, Blink] = {}
        # By node, how its pictures' size differs from its calibration's: of the newest picture, and of the last such.
        self._size: dict[str, str] = {}
        self._sizes: dict[str, str] = {}

    def saw_frame(self, node: str, stamp_ns: int, now_ns: int) -> None:
        """Note a frame of a node."""
        self._frames[node] = (now_ns, stamp_ns)

    def saw_period(self, node: str, trigger_period_ns: int) -> None:
        """Note a node's trigger period."""
        self._period_s[node] = trigger_period_ns / S_NS

    def saw_run(self, frame: Candidates, now_ns: int, *, is_second: bool = False) -> None:
        """Note which run of a node a frame is of. A node that starts again leaves its run before for good.

        is_second: whether another frame of this node has its trigger. A node whose clock is set back counts on.
        """
        boot, stamp_ns, seq = frame.boot, frame.stamp_ns, frame.seq
        runs = self._runs.setdefault(frame.node, Runs(boot, stamp_ns, seq))
        is_newer = stamp_ns >= runs.stamp_ns
        counts_back = boot == runs.boot and (seq <= runs.seq if is_second else is_newer and seq < runs.seq)
        if counts_back or (is_newer and boot == runs.before):
            runs.returns, runs.now_ns = runs.returns + 1, now_ns
            runs.twins |= runs.returns >= TWINS
        if boot == runs.boot:
            runs.seq = seq
        elif is_newer:
            if boot != runs.before:
                runs.returns = 0
            runs.boot, runs.before, runs.seq = boot, runs.boot, seq
        runs.stamp_ns = max(stamp_ns, runs.stamp_ns)

    def saw_blink(self, node: str, blink: Blink | None) -> None:
        """Note how a node's lamp blinks, None where it does not."""
        if blink is None:
            self._blinks.pop(node, None)
        else:
            self._blinks[node] = blink

    def saw_software(self, node: str, software: str) -> None:
        """Note which release of Buddyline a node runs; other programs that send its messages have none."""
        release = release_of(software)
        if release is None:
            self._releases.pop(node, None)
        else:
            self._releases[node] = release

    def saw_size(self, node: str, wrong: str) -> None:
        """Note how a picture's size differs from its calibration's, "" where it does not."""
        self._size[node] = wrong
        if wrong:
            self._sizes[node] = wrong

    def saw_process(self, name: str, alive: bool) -> bool:
        """Note that a process has started or ended; name: as declared alive on the bus. Return whether that is news."""
        node = name.removeprefix("node/")
        if name == node or self._alive.get(node) == alive:
            return False
        if node not in self._alive and len(self._alive) >= MAX_PROCESSES:
            return False
        self._alive[node] = alive
        return True

    def problems(self, nodes: tuple[str, str], now_ns: int) -> list[str]:
        """Return the problems of a pair of nodes, one phrase each."""
        found = [text for node in nodes if (text := self._problem_of(node, now_ns))]
        own, releases = self._other_releases(nodes)
        others = [f"node {node} runs Buddyline {its}, this solver {own}: update the older" for node, its in releases]
        if not found:
            node_a, node_b = nodes
            ahead_ns = self._frames[node_b][1] - self._frames[node_a][1]
            if abs(ahead_ns) > FRAMES_APART_S * S_NS:
                first, second = (node_b, node_a) if ahead_ns > 0 else (node_a, node_b)
                found.append(
                    f"frames of {first} are {abs(ahead_ns) / S_NS:.1f} s ahead of those of {second}: "
                    "do their clocks agree?"
                )
        twins = [_twins_text(node) for node in nodes if self._twins(node, now_ns)]
        sizes = [_size_text(node, wrong) for node in nodes if (wrong := self._size.get(node, ""))]
        return found + others + twins + sizes + self._two_rates(nodes) + self._one_code(nodes)

    def of_dive(self, nodes: tuple[str, str]) -> list[str]:
        """Return what a dive that is over told of a pair: one id, one code, two rates, another release, wrong sizes."""
        twins = [node for node in nodes if (runs := self._runs.get(node)) is not None and runs.twins]
        own, releases = self._other_releases(nodes)
        others = [f"node {node} ran Buddyline {its}, this is {own}" for node, its in releases]
        rates = self._two_rates(nodes)
        return [*map(_twins_text, twins), *rates, *self._one_code(nodes), *others, *self.sizes_of_dive(nodes)]

    def sizes_of_dive(self, nodes: Iterable[str]) -> list[str]:
        """Return which nodes had pictures of another size than their calibration."""
        return [_size_text(node, self._sizes[node]) for node in nodes if node in self._sizes]

    def _other_releases(self, nodes: tuple[str, str]) -> tuple[str | None, list[tuple[str, str]]]:
        """Return the release of this program, and which nodes run another."""
        own = release_of(f"buddyline {__version__}")
        found = [(node, self._releases[node]) for node in nodes if node in self._releases and own is not None]
        return own, [(node, its) for node, its in found if its != own]

    def _twins(self, node: str, now_ns: int) -> bool:
        runs = self._runs.get(node)
        return runs is not None and runs.returns >= TWINS and now_ns - runs.now_ns < TWINS_NS

    def _two_rates(self, nodes: tuple[str, str]) -> list[str]:
        """Say that two nodes' triggers count other instants, so that none is of both."""
        periods_s = [self._period_s[node] for node in nodes if node in self._period_s]
        if len(set(periods_s)) < len(nodes):
            return []
        a, b = nodes
        rates = [f"{1.0 / period_s:.9g}" for period_s in periods_s]
        return [f"nodes {a} and {b} take {rates[0]} and {rates[1]} pictures a second: give both one `rate_hz`"]

    def _one_code(self, nodes: tuple[str, str]) -> list[str]:
        """Name the nodes whose lamps blink as those of one of these do."""
        found = []
        for node in nodes:
            blink = self._blinks.get(node)
            same = sorted(other for other, its in self._blinks.items() if blink is not None and _alike(its, blink))
            if len(same) > 1:
                found.append(f"nodes {' and '.join(same)} blink by one code: give each another `blink.code`")
        return list(dict.fromkeys(found))

    def _problem_of(self, node: str, now_ns: int) -> str | None:
        if self._alive.get(node) is False:
            return f"node {node} is gone: its process ended, or its link"
        seen = self._frames.get(node)
        if seen is None:
            return f"no frame of node {node} yet"
        silent_s = (now_ns - seen[0]) / S_NS
        if silent_s > stale_after_s(CANDIDATES, self._period_s.get(node, 0.0)):
            return f"no frame of node {node} for {silent_s:.0f} s"
        return None


def _twins_text(node: str) -> str:
    return f"two nodes have the id {node}: give each its own"


def _size_text(node: str, wrong: str) -> str:
    return f"pictures of node {node} are {wrong}: they are not used"


def _alike(one: Blink, other: Blink) -> bool:
    """Whether lamps are dark in the same slots."""
    return (one.code, one.slot_ns) == (other.code, other.slot_ns)


def release_of(software: str) -> str | None:
    """Return the release, major and minor, that NodeInfo.software names; None if it names none."""
    found = _RELEASE.match(software)
    return None if found is None else found[1]
