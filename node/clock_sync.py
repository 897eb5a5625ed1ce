"""A node's clock beside others: what chrony says of it, and the beacons by which two nodes' clocks are compared."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from buddyline.node.chrony import ChronyError, Tracking, read_tracking
from buddyline.protocol.clock import Clock
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.messages import MAX_HEARD, ClockBeacon, HeardClock
from buddyline.protocol.topics import CLOCK

if TYPE_CHECKING:
    from buddyline.node.outlet import Outlet
    from buddyline.protocol.bus import Bus, Received

log = logging.getLogger(__name__)

CHRONY_EVERY_S: Final = 10.0
# A node that has been silent for longer has left, or its beacons are stuck somewhere: no measure of now.
HEARD_FOR_S: Final = 2.0


class Beacons:
    """Which other nodes were heard, and what to say next. Safe to use from several threads.

    now_s: monotonic, so that a clock that is set forgets nobody.
    """

    def __init__(self, node: str, boot: str) -> None:
        self.refusals = Refusals("clock")
        self._node = node
        self._boot = boot
        self._lock = threading.Lock()
        self._heard: dict[str, tuple[float, HeardClock]] = {}

    def hear(self, received: Received, now_s: float) -> None:
        """Take another node's beacon; what is none, or from whom nobody can know, is counted."""
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

    def beacon(self, clock: Clock, now_s: float) -> ClockBeacon:
        """Return what to send at once: its stamp is now."""
        with self._lock:
            heard = [one for heard_s, one in self._heard.values() if now_s - heard_s <= HEARD_FOR_S]
        return ClockBeacon(node=self._node, stamp_ns=clock.now_ns(), boot=self._boot, heard=heard)


class ClockSync:
    """Keeps chrony's figures for the node's status, and exchanges beacons while there is a bus."""

    def __init__(self, node: str, boot: str, clock: Clock, read: Callable[[], Tracking | None] = read_tracking) -> None:
        self.problem = ""
        self._beacons = Beacons(node, boot)
        self._clock = clock
        self._read = read
        self._fields: dict[str, Any] = {}

    def status_fields(self) -> dict[str, Any]:
        """Return what the node's status says of its clock."""
        return self._fields

    def follow_chrony(self, stop: threading.Event) -> None:
        """Ask chrony again and again; for a thread of its own. Where chrony is not installed, nothing is said."""
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

    def exchange(self, bus: Bus, outlet: Outlet, stop: threading.Event) -> None:
        """Send beacons and hear the others' until stop is set."""
        # Without history: an old beacon says nothing of how long one takes.
        subscription = bus.subscribe(
            CLOCK.key_any(), lambda received: self._beacons.hear(received, time.monotonic()), history=False
        )
        try:
            while not stop.wait(1.0 / CLOCK.rate_hz):
                outlet.send(self._beacons.beacon(self._clock, time.monotonic()))
        finally:
            subscription.close()
