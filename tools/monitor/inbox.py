"""Between the bus's threads and the page's: a queue that drops its oldest, and a slot for what only the newest counts.

The bus's threads only put payloads here; the page's thread decodes at its own pace. Nothing that happens here can
slow whoever publishes.
"""

from __future__ import annotations

import threading
from collections import deque
from typing import TYPE_CHECKING, Final

from buddyline.protocol.envelope import Refusals
from buddyline.protocol.topics import (
    ATTITUDE,
    CANDIDATES,
    DEPTH,
    IMAGE,
    INFO,
    NODE_STATUS,
    POSE,
    REJECTED,
    SOLVER_STATUS,
    parse_key,
)
from buddyline.tools.monitor.picture import PairPicture

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, Received
    from buddyline.protocol.clock import Clock

QUEUED: Final = 2048
# Of these the page shows the newest alone; those before it are never decoded.
NEWEST_ONLY: Final = frozenset({ATTITUDE.name, DEPTH.name, IMAGE.name, NODE_STATUS.name, SOLVER_STATUS.name, INFO.name})


class Inbox:
    """What has come off the bus and is not yet in the picture; safe to fill from several threads."""

    def __init__(self, clock: Clock) -> None:
        self.dropped = 0
        self.refusals = Refusals("monitor")
        self._clock = clock
        self._lock = threading.Lock()
        self._queue: deque[Received | tuple[str, bool, int]] = deque()
        self._newest: dict[str, Received] = {}

    def subscribe(self, bus: Bus) -> None:
        """Follow everything that is shown. Only what describes a state is asked for from before: no history is
        drawn from the nodes, which would load the link that the solver needs."""
        for topic in (INFO, NODE_STATUS, SOLVER_STATUS):
            bus.subscribe(topic.key_any(), self.receive, capacity=64)
        for topic in (POSE, REJECTED, CANDIDATES, ATTITUDE, DEPTH):
            bus.subscribe(topic.key_any(), self.receive, capacity=256, history=False)
        bus.subscribe(IMAGE.key_any(), self.receive, capacity=4, history=False)
        bus.watch_alive(self.presence)

    def receive(self, received: Received) -> None:
        """Keep one payload; only for the bus."""
        parsed = parse_key(received.key)
        if parsed is None:
            return
        with self._lock:
            if parsed[0].name in NEWEST_ONLY:
                self._newest[received.key] = received
            else:
                self._put(received)

    def presence(self, name: str, alive: bool) -> None:
        """Keep that someone came or left; only for the bus."""
        with self._lock:
            self._put((name, alive, self._clock.now_ns()))

    def _put(self, item: Received | tuple[str, bool, int]) -> None:
        self._queue.append(item)
        if len(self._queue) > QUEUED:
            self._queue.popleft()
            self.dropped += 1

    def empty_into(self, picture: PairPicture) -> int:
        """Decode all that is here into the picture; return how many messages that were.

        A message that is not sound is counted and named; it changes nothing.
        """
        with self._lock:
            items = list(self._newest.values()) + list(self._queue)
            self._newest.clear()
            self._queue.clear()
        for item in items:
            if isinstance(item, tuple):
                picture.alive(*item)
            elif envelope := self.refusals.open(item):
                picture.take(envelope.message, envelope.node, envelope.time_ns)
        return len(items)
