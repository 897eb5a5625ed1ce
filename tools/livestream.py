"""Live messages for other programs: a loop over the messages of a topic, until it is stopped."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Iterator
from types import TracebackType
from typing import Final, Generic, Self, TypeVar

from buddyline.protocol.bus import Received
from buddyline.protocol.delivery import ThreadDiedError
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.messages import Message
from buddyline.protocol.topics import Topic
from buddyline.tools.client import ClientConfig
from buddyline.tools.live import open_bus_within

M = TypeVar("M", bound=Message)

CAPACITY: Final = 1024
LOOK_S: Final = 1.0


class LiveStream(Generic[M]):
    """Iterates over the messages of a topic as they arrive; a context manager that leaves the bus.

    ids: of a node or pair; None: all. Ends after `seconds`, if given. Beyond a thousand waiting messages the oldest
    is dropped, and counted in `dropped`. Raises NoHubError, a BuddylineError, if no hub answers within connect_s.
    """

    def __init__(
        self,
        topic: Topic,
        schema: type[M],
        config: ClientConfig,
        *,
        ids: tuple[str, ...] | None = None,
        seconds: float | None = None,
        connect_s: float = 5.0,
    ) -> None:
        self._schema = schema
        self._refusals = Refusals("live")
        self._changed = threading.Condition()
        self._waiting: deque[M] = deque()
        self._dropped = 0
        self._stopped = False
        self._failure: ThreadDiedError | None = None
        self._bus = open_bus_within(config, connect_s)
        self._end_s = math.inf if seconds is None else time.monotonic() + seconds
        self._bus.on_failure(self._fail)
        self._bus.subscribe(topic.key(*ids) if ids else topic.key_any(), self._receive, history=False)

    @property
    def dropped(self) -> int:
        """How many messages were dropped because the loop was too slow."""
        return self._dropped

    @property
    def refused(self) -> int:
        """How many invalid messages were refused."""
        return self._refusals.count

    def stop(self) -> None:
        """End the loop after its present message; may be called from any thread."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()

    def close(self) -> None:
        """Stop, and leave the bus; a second call does nothing."""
        self.stop()
        self._bus.close()

    def __iter__(self) -> Iterator[M]:
        """Yield each message as it comes; raise if a thread of the bus has died."""
        while (message := self._next()) is not None:
            yield message

    def _next(self) -> M | None:
        """Wait for the next message; None at the end."""
        with self._changed:
            left_s = self._end_s - time.monotonic()
            # With a time limit, because on some platforms Ctrl-C does not interrupt a wait without one.
            while not (self._waiting or self._stopped or self._failure or left_s <= 0):
                self._changed.wait(min(left_s, LOOK_S))
                left_s = self._end_s - time.monotonic()
            if self._stopped or left_s <= 0:
                return None
            if self._waiting:
                return self._waiting.popleft()
            assert self._failure is not None
            raise self._failure

    def _receive(self, received: Received) -> None:
        envelope = self._refusals.open(received)
        if envelope is None or not isinstance(envelope.message, self._schema):
            return
        with self._changed:
            if len(self._waiting) == CAPACITY:
                self._waiting.popleft()
                self._dropped += 1
            self._waiting.append(envelope.message)
            self._changed.notify_all()

    def _fail(self, error: ThreadDiedError) -> None:
        with self._changed:
            self._failure = error
            self._changed.notify_all()

    def __enter__(self) -> Self:
        """Return the stream."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Leave the bus."""
        self.close()
