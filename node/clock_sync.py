"""Compare a node's clock with others: chrony's figures, and the beacons that nodes exchange."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from buddyline.node.chrony import ChronyError, Tracking, read_tracking
from buddyline.node.time_base import NodeClock
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.messages import MAX_HEARD, ClockBeacon, ClockSet, HeardClock
from buddyline.protocol.topics import CLOCK

if TYPE_CHECKING:
    from buddyline.node.outlet import Outlet
    from buddyline.protocol.bus import Bus, Received

log = logging.getLogger(__name__)

CHRONY_EVERY_S: Final = 10.0
# After a longer silence a node has left, or its beacons are delayed: its last beacon is then left out.
HEARD_FOR_S: Final = 2.0


class Beacons:
    """Keeps the newest beacon of each other node, and makes this node's next one. Safe to use from several threads.

    now_s: monotonic time, so that setting the wall clock does not make any node look silent.
    """

    def __init__(self, node: str, boot: str) -> None:
        self.refusals = Refusals("clock")
        self._node = node
        self._boot = boot
        self._lock = threading.Lock()
        self._heard: dict[str, tuple[float, HeardClock]] = {}

    def hear(self, received: Received, now_s: float) -> None:
        """Take another node's beacon; invalid messages are refused and counted."""
        envelope = self.refusals.open(received)
        beacon = envelope.message if envelope else None
        if not isinstance(beacon, ClockBeacon) or beacon.node == self._node:
            return
        heard = HeardClock(node=beacon.node, boot=beacon.boot, sent_ns=beacon.stamp_ns, received_ns=received.receive_ns)
        with self._lock:
            self._heard.pop(beacon.node, None)
            self._heard[beacon.node] = now_s, heard
            while len(self._heard) > MAX_HEARD:
                self._heard.pop(next(iter(self._heard)))

    def beacon(self, clock: NodeClock, now_s: float) -> ClockBeacon:
        """Return the next beacon, stamped now; send it at once."""
        with self._lock:
            heard = [one for heard_s, one in self._heard.values() if now_s - heard_s <= HEARD_FOR_S]
        stamp_ns, raw_ns = clock.reading()
        return ClockBeacon(node=self._node, stamp_ns=stamp_ns, boot=self._boot, heard=heard, raw_ns=raw_ns)


class ClockSync:
    """Keeps chrony's figures for the node's status, sends beacons, and follows a clock that is set."""

    def __init__(
        self, node: str, boot: str, clock: NodeClock, read: Callable[[], Tracking | None] = read_tracking
    ) -> None:
        self.problem = ""
        self._node, self._boot = node, boot
        self._beacons = Beacons(node, boot)
        self._clock = clock
        self._read = read
        self._fields: dict[str, Any] = {}

    def status_fields(self) -> dict[str, Any]:
        """Return the fields of the node's status that describe its clock."""
        return self._fields

    def follow_chrony(self, stop: threading.Event) -> None:
        """Ask chrony repeatedly, in a thread of its own. Without chrony the status has no figures."""
        while not stop.is_set():
            try:
                tracking = self._read()
            except ChronyError as error:
                fields, problem = {}, str(error)
            else:
                fields = {} if tracking is None else tracking.status_fields()
                problem = "" if tracking is None or tracking.synchronised else "not synchronised: chrony has no source"
            if problem != self.problem:
                log.log(logging.WARNING if problem else logging.INFO, "clock: %s", problem or "synchronised")
            self._fields, self.problem = fields, problem
            stop.wait(CHRONY_EVERY_S)

    def listen(self, bus: Bus) -> None:
        """Receive the others' beacons from now on; the bus closes the subscription when it is closed."""
        # Without history: the travel time of an old beacon is not known.
        bus.subscribe(CLOCK.key_any(), lambda received: self._beacons.hear(received, time.monotonic()), history=False)

    def send_beacons(self, outlet: Outlet, stop: threading.Event) -> None:
        """Send beacons until stop is set; without a bus they are in the log only, and tell how the clock was slewed."""
        while not stop.wait(1.0 / CLOCK.rate_hz):
            moved_ns = self._clock.follow()
            if moved_ns:
                outlet.send(
                    ClockSet(node=self._node, stamp_ns=self._clock.now_ns(), boot=self._boot, moved_ns=moved_ns)
                )
            outlet.send(self._beacons.beacon(self._clock, time.monotonic()))
