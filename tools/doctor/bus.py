"""The hub and the nodes on it, as this machine sees them."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Final

from buddyline.protocol.bus import Bus, Received
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NodeInfo, NodeStatus
from buddyline.protocol.security import Tls
from buddyline.protocol.topics import INFO, NODE_STATUS
from buddyline.tools.doctor.finding import Finding

HUB_WITHIN_S: Final = 3.0
# A node says how it is once a second.
LISTEN_S: Final = 1.5


@dataclass
class Seen:
    """Who is on the bus. error: why this machine is not, "" where it is."""

    error: str = ""
    infos: dict[str, NodeInfo] = field(default_factory=dict)
    statuses: dict[str, NodeStatus] = field(default_factory=dict)
    alive: set[str] = field(default_factory=set)
    refusals: Refusals = field(default_factory=lambda: Refusals("doctor"))

    def take(self, received: Received) -> None:
        """Take an info or a status; what is neither is passed over."""
        envelope = self.refusals.open(received)
        if envelope is None:
            return
        if isinstance(envelope.message, NodeInfo):
            self.infos[envelope.node] = envelope.message
        elif isinstance(envelope.message, NodeStatus):
            self.statuses[envelope.node] = envelope.message

    def alive_changed(self, name: str, alive: bool) -> None:
        """Take note of who comes and goes."""
        (self.alive.add if alive else self.alive.discard)(name)


def look(connect_to: str, namespace: str, tls: Tls | None) -> Seen:
    """Connect for a moment and see who is there."""
    from buddyline.protocol.zenoh_bus import connect

    stop = threading.Event()
    timer = threading.Timer(HUB_WITHIN_S, stop.set)
    timer.start()
    try:
        bus = connect(connect_to, namespace=namespace or None, stop=stop, on_wait=lambda _: None, tls=tls)
    except BuddylineError as error:
        return Seen(error=str(error))
    finally:
        timer.cancel()
    if bus is None:
        return Seen(error=f"no hub at {connect_to}")
    with bus:
        return watch(bus, LISTEN_S)


def watch(bus: Bus, seconds: float) -> Seen:
    """See who is on a bus for this long."""
    seen = Seen()
    bus.subscribe(INFO.key_any(), seen.take)
    bus.subscribe(NODE_STATUS.key_any(), seen.take)
    bus.watch_alive(seen.alive_changed)
    threading.Event().wait(seconds)
    return seen


def check_bus(seen: Seen, endpoint: str, own: str | None) -> list[Finding]:
    """Judge hub and nodes. own: this machine's node, None for a laptop."""
    if seen.error:
        level = "warning" if seen.error.startswith("no hub") else "problem"
        advice = (
            "start it: buddyline hub; a node records without it" if level == "warning" else "see README.md, Security"
        )
        nodes = Finding("nodes", "skipped", "nobody is seen without a hub")
        return [Finding("hub", level, seen.error, advice), nodes]  # type: ignore[arg-type]
    findings = [Finding("hub", "ok", f"answers at {endpoint}")]
    present = sorted(name.removeprefix("node/") for name in seen.alive if name.startswith("node/"))
    for node in present:
        findings.append(_node(node, seen))
    if not [node for node in present if node != own]:
        who = "no other node" if own else "no node"
        findings.append(Finding("nodes", "warning", f"{who} is on the bus", "start it: a pose needs two"))
    if not any(name.partition("/")[0] == "solver" for name in seen.alive):
        findings.append(Finding("solver", "warning", "none is on the bus", "for live poses: buddyline solver"))
    return findings


def _node(node: str, seen: Seen) -> Finding:
    name, info, status = f"node {node}", seen.infos.get(node), seen.statuses.get(node)
    if info is None:
        return Finding(name, "problem", "is on the bus, and its calibration is not known", "restart it")
    if status is None:
        return Finding(name, "warning", "is on the bus, and does not say how it is", "look at its log")
    if status.problem:
        return Finding(name, "problem", status.problem, "on that node: buddyline doctor --config ...")
    return Finding(name, "ok", f"runs for {status.uptime_s:.0f} s, {info.width_px}x{info.height_px}, no complaints")
