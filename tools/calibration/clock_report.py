"""`buddyline calibrate clock`: listen to a running pair, or read a dive's logs, and report the clocks' offset."""

from __future__ import annotations

import json
import logging
import threading
import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Final

from buddyline.protocol.bus import Bus
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import ClockBeacon, Message, NodeStatus
from buddyline.protocol.topics import CLOCK, NODE_STATUS
from buddyline.tools.calibration.clock import (
    LIMIT_S,
    OffsetEstimate,
    OneWayTimes,
    drift_between,
    estimate,
    steps,
    windows,
)
from buddyline.tools.client import ClientConfig
from buddyline.tools.dives import Dive
from buddyline.tools.live import follow, open_bus_within
from buddyline.tools.progress import Progress
from msgspec import UNSET

log = logging.getLogger(__name__)

HUB_WITHIN_S: Final = 5.0
SILENT_S: Final = 2.0


@dataclass
class Heard:
    """The nodes' messages about their clocks. statuses: each node's first and last NodeStatus with chrony's figures.

    last_s: time of each node's last beacon, since the start.
    """

    ways: OneWayTimes = field(default_factory=OneWayTimes)
    statuses: dict[str, tuple[NodeStatus, NodeStatus]] = field(default_factory=dict)
    last_s: dict[str, float] = field(default_factory=dict)

    def add(self, message: Message, now_s: float = 0.0) -> None:
        """Take a beacon or a status; other messages are ignored."""
        if isinstance(message, ClockBeacon):
            self.ways.add(message)
            self.last_s[message.node] = now_s
        elif isinstance(message, NodeStatus) and message.clock_source is not UNSET:
            first, _ = self.statuses.get(message.node, (message, message))
            self.statuses[message.node] = first, message


def listen(config: ClientConfig, seconds: float, connect_within_s: float = HUB_WITHIN_S) -> Heard:
    """Listen to the bus for this time; raise BuddylineError if there is no hub, or a node becomes silent."""
    with open_bus_within(config, connect_within_s) as bus:
        return hear(bus, seconds)


def hear(bus: Bus, seconds: float) -> Heard:
    """Listen to a connected bus for this time; raise BuddylineError if a node becomes silent."""
    heard, began_s = Heard(), time.monotonic()
    refusals = Refusals("calibrate clock")

    def take(envelope: Envelope) -> None:
        heard.add(envelope.message, time.monotonic() - began_s)

    topics = ((CLOCK, False), (NODE_STATUS, True))
    subscriptions = [follow(bus, topic.key_any(), refusals, take, history=history) for topic, history in topics]
    over = threading.Event()
    with Progress("listening to both clocks", seconds) as progress:
        while (passed_s := time.monotonic() - began_s) < seconds:
            progress.show(passed_s)
            over.wait(min(0.2, seconds - passed_s))
    for subscription in subscriptions:
        subscription.close()
    for node, last_s in heard.last_s.items():
        if seconds - last_s > SILENT_S:
            raise BuddylineError(
                f"node {node} became silent {last_s:.1f} s after the start: measure again when it is back"
            )
    return heard


def read(paths: list[str]) -> Heard:
    """Return the messages about clocks of a dive's logs."""
    heard = Heard()
    with Dive(paths) as dive:
        for envelope in dive.messages(CLOCK.name, NODE_STATUS.name):
            heard.add(envelope.message)
    return heard


@dataclass(frozen=True)
class Report:
    """The clocks of a pair: estimates in order of time, and the stamps (A's clock, ns) at which a clock was set."""

    node_a: str
    node_b: str
    offsets: list[OffsetEstimate]
    set_times: list[int]

    def problem(self) -> str:
        """Return why the pair's clocks are not to be trusted; "" if they are."""
        last = self.offsets[-1]
        if self.set_times:
            return f"a clock was set during the measurement ({len(self.set_times)} times): let chrony settle, repeat"
        if last.sigma_s > LIMIT_S:
            return f"the link is too slow to measure: the clocks may differ by {1e3 * last.bound_s:.1f} ms more"
        if abs(last.offset_s) > LIMIT_S:
            return (
                f"the clocks differ by more than {1e3 * LIMIT_S:g} ms: let chrony bring them together before the dive"
            )
        return ""


def reports(heard: Heard, nodes: list[str] | None, logs: Sequence[str] = ()) -> list[Report]:
    """Compare the clocks of each pair; raise BuddylineError if there is none.

    nodes: one pair; None: all. logs: where it was heard; none: on the bus.
    """
    pairs = heard.ways.pairs() if nodes is None else [(nodes[0], nodes[1])]
    found = []
    for a, b in pairs:
        exchanges = heard.ways.exchanges(a, b)
        offsets = [estimate(part) for part in windows(exchanges)]
        if offsets:
            found.append(Report(a, b, offsets, [int(exchanges.stamp_ns[i]) for i in steps(exchanges)]))
    if found:
        return found
    present = sorted(heard.last_s)
    where = f"{', '.join(logs)}: " if logs else ""
    both = "name the logs that both nodes wrote" if logs else "start both nodes"
    itself = "after a dive in which they moved, `buddyline align` finds the offset from the dive itself"
    if not present:
        raise BuddylineError(f"{where}no node's clock was heard: {both}; {itself}")
    if len(present) == 1:
        raise BuddylineError(f"{where}only node {present[0]}'s clock was heard: {both}; {itself}")
    if nodes is not None and (unknown := [node for node in nodes if node not in present]):
        raise BuddylineError(
            f"{where}--nodes {' '.join(nodes)}: the clock of node {unknown[0]} was not heard, but those of nodes "
            f"{', '.join(present)}"
        )
    raise BuddylineError(
        f"{where}nodes {', '.join(present)} did not hear each other long enough to compare their clocks; {itself}"
    )


def as_json(found: Iterable[Report], heard: Heard) -> str:
    """Return all figures as one JSON object."""
    pairs = [
        {
            "node_a": one.node_a,
            "node_b": one.node_b,
            "problem": one.problem(),
            "set_times_ns": one.set_times,
            "offsets": [asdict(offset) for offset in one.offsets],
        }
        for one in found
    ]
    chrony = {node: [_chrony(status) for status in both] for node, both in heard.statuses.items()}
    return json.dumps({"pairs": pairs, "chrony": chrony})


def as_text(found: Iterable[Report], heard: Heard) -> str:
    """Return the figures for a person: first and last comparison, the drift between them, and chrony's figures."""
    lines = []
    for one in found:
        first, last = one.offsets[0], one.offsets[-1]
        said = [f": {_offset(last)}"]
        if first is not last:
            drift, sigma = drift_between(first, last)
            passed_s = (last.stamp_ns - first.stamp_ns) / S_NS
            said = [
                f", before: {_offset(first)}",
                f", after:  {_offset(last)}",
                f": {1e6 * drift:+.3f} ppm +- {1e6 * sigma:.3f} over {passed_s:.0f} s;"
                " `solve` goes from one to the other",
            ]
        elif last.drift is not None and last.drift_sigma is not None:
            said.append(f": {1e6 * last.drift:+.1f} ppm +- {1e6 * last.drift_sigma:.1f}")
        said += [f": {problem}"] if (problem := one.problem()) else []
        lines += [f"{one.node_b} minus {one.node_a}{text}" for text in said]
    for node, both in sorted(heard.statuses.items()):
        lines += [f"{node}: {text}" for text in dict.fromkeys(_chrony_text(status) for status in both)]
    if not heard.statuses:
        lines.append("no node has chrony's figures: install chrony on both (node/README.md)")
    return "\n".join(lines)


def _at(stamp_ns: int) -> str:
    return time.strftime("at %H:%M:%S UTC", time.gmtime(stamp_ns / S_NS))


def _offset(offset: OffsetEstimate) -> str:
    return (
        f"{1e3 * offset.offset_s:+.3f} ms (1 sd {1e3 * offset.sigma_s:.3f}, at most {1e3 * offset.bound_s:.3f} from "
        f"unequal ways) {_at(offset.stamp_ns)}, {offset.exchanges} exchanges"
    )


def _chrony(status: NodeStatus) -> dict[str, Any]:
    figures = {name: getattr(status, name) for name in status.__struct_fields__ if name.startswith("clock_")}
    return {"stamp_ns": status.stamp_ns, **{name: value for name, value in figures.items() if value is not UNSET}}


def _chrony_text(status: NodeStatus) -> str:
    at = _at(status.stamp_ns)
    if not status.clock_source:
        return f"chrony is not synchronised {at}"
    if status.clock_offset_s is UNSET:
        return f"chrony serves this clock as it stands, {at}"
    figures = f"off by {1e3 * status.clock_offset_s:+.3f} ms"
    for words, value_s in (("RMS", status.clock_rms_s), ("at most", status.clock_bound_s)):
        figures += "" if value_s is UNSET else f", {words} {1e3 * value_s:.3f} ms"
    return f"chrony follows {status.clock_source}: {figures}, {at}"
