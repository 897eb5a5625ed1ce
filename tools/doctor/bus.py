"""The hub and the nodes on it, as this machine sees them."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import Final

from buddyline.protocol.bus import Bus
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NodeInfo, NodeStatus
from buddyline.protocol.security import check_identity, node_name
from buddyline.protocol.topics import INFO, NODE_STATUS
from buddyline.tools.client import ClientConfig
from buddyline.tools.health.finding import Finding
from buddyline.tools.health.pair import START_SOLVER, reported
from buddyline.tools.live import NoHubError, follow, open_bus_within

HUB_WITHIN_S: Final = 3.0
# A node sends its status once a second.
LISTEN_S: Final = 1.5


@dataclass
class Seen:
    """The nodes on the bus. error: why this machine cannot connect, "" if it can. no_hub: whether no hub answered."""

    error: str = ""
    no_hub: bool = False
    infos: dict[str, NodeInfo] = field(default_factory=dict)
    statuses: dict[str, NodeStatus] = field(default_factory=dict)
    alive: set[str] = field(default_factory=set)

    def take(self, envelope: Envelope) -> None:
        """Take an info or a status."""
        if isinstance(envelope.message, NodeInfo):
            self.infos[envelope.node] = envelope.message
        elif isinstance(envelope.message, NodeStatus):
            self.statuses[envelope.node] = envelope.message

    def alive_changed(self, name: str, alive: bool) -> None:
        """Note that a process has started or ended."""
        (self.alive.add if alive else self.alive.discard)(name)


def look(client: ClientConfig, own: str | None) -> Seen:
    """Connect and listen for LISTEN_S. own: this machine's node, to which the certificate must belong; None: none."""
    try:
        if client.tls is not None and own is not None:
            check_identity(client.tls, node_name(own))
        with open_bus_within(client, HUB_WITHIN_S) as bus:
            return watch(bus, LISTEN_S)
    except NoHubError as error:
        return Seen(error=str(error), no_hub=True)
    except BuddylineError as error:
        return Seen(error=str(error))


def watch(bus: Bus, seconds: float) -> Seen:
    """Listen to a connected bus for this time."""
    seen, refusals = Seen(), Refusals("doctor")
    for topic in (INFO, NODE_STATUS):
        follow(bus, topic.key_any(), refusals, seen.take)
    bus.watch_alive(seen.alive_changed)
    threading.Event().wait(seconds)
    return seen


def check_bus(seen: Seen, endpoint: str, own: str | None) -> list[Finding]:
    """Judge hub and nodes. own: this machine's node; None for a laptop."""
    if seen.error:
        nodes = Finding("nodes", "skipped", "no node can be seen without a hub")
        if seen.no_hub:
            advice = "start it: buddyline hub; a node records without it"
            return [Finding("hub", "warning", seen.error, advice), nodes]
        advice = "name its files with --config keys/viewer.toml; `buddyline keys` makes them: docs/security.md"
        return [Finding("hub", "problem", seen.error, advice), nodes]
    findings = [Finding("hub", "ok", f"answers at {endpoint}")]
    present = sorted(name.removeprefix("node/") for name in seen.alive if name.startswith("node/"))
    for node in present:
        findings += _node(node, seen)
    if not [node for node in present if node != own]:
        who = "no other node" if own else "no node"
        findings.append(Finding("nodes", "warning", f"{who} is on the bus", "start it: a pose needs two"))
    if not any(name.partition("/")[0] == "solver" for name in seen.alive):
        findings.append(Finding("solver", "warning", "none is on the bus", f"for live poses, {START_SOLVER}"))
    return findings


def _node(node: str, seen: Seen) -> list[Finding]:
    name, info, status = f"node {node}", seen.infos.get(node), seen.statuses.get(node)
    if info is None:
        return [Finding(name, "problem", "is on the bus, but its calibration is not known", "restart it")]
    if status is None:
        return [Finding(name, "warning", "is on the bus, but sends no status", "look at its log")]
    well = f"runs for {status.uptime_s:.0f} s, {info.width_px}x{info.height_px}, no complaints"
    return reported(name, status) or [Finding(name, "ok", well)]
