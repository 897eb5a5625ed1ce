"""What the tests of the bus's contract send, and how they connect."""

from __future__ import annotations

import threading
from collections.abc import Callable

from buddyline.protocol.bus import Bus
from buddyline.protocol.codec import decode
from buddyline.protocol.messages import Depth, NodeStatus, Rejected
from buddyline.protocol.zenoh_bus import connect

from tests.protocol.inbox import Inbox

NOW_NS = 1_700_000_000_000_000_000

Connect = Callable[[], Bus]


def run_client(endpoint: str, **more: object) -> Bus:
    bus = connect(endpoint, stop=threading.Event(), on_wait=lambda _: None, **more)  # type: ignore[arg-type]
    assert bus is not None
    return bus


def numbers(inbox: Inbox, count: int) -> list[int]:
    """Wait for so many messages; return the numbers in all."""
    return [int(received.payload) for received in inbox.wait_for(count)]


def wait_until_heard(bus: Bus, keys: str, count: int) -> None:
    """Wait until a client has so many messages: then the hub knows their publishers, and where their history is."""
    inbox = Inbox()
    bus.subscribe(keys, inbox)
    inbox.wait_for(count)


def rejected(trigger: int) -> Rejected:
    return Rejected(node_a="a", node_b="b", stamp_ns=trigger, trigger=trigger, reason="late")


def triggers(inbox: Inbox) -> list[int]:
    return [decode(received.payload, Rejected).trigger for received in inbox.received]


def status(node: str, uptime_s: float) -> NodeStatus:
    return NodeStatus(
        node=node,
        stamp_ns=0,
        boot="x",
        software="",
        uptime_s=uptime_s,
        rates_hz={},
        drops={},
        ages_s={},
    )


def depth(stamp_ns: int, node: str = "a") -> Depth:
    return Depth(node=node, stamp_ns=stamp_ns, depth_m=1.0, sigma_m=0.1)
