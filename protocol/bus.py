"""The bus as everyone but its two implementations sees it: publish, subscribe, know who is alive.

protocol.zenoh_bus carries it between processes, protocol.local_bus within one; both keep one contract, and
share what is here: a bounded queue with a thread of its own for each subscription.
"""

from __future__ import annotations

import logging
import math
import re
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Generic, Protocol, Self, TypeVar

from protocol.clock import S_NS, Clock
from protocol.messages import Message
from protocol.topics import Topic

CACHE_S: Final = 60.0
MAX_TRIGGER_HZ: Final = 30.0
MAX_QUEUED_BYTES: Final = 64 * 1024 * 1024
CLOSE_S: Final = 1.0

log = logging.getLogger(__name__)

_ALIVE_NAME = re.compile(r"[a-z0-9_]{1,64}(/[a-z0-9_]{1,64})*\Z")


@dataclass(frozen=True)
class Received:
    """One message off the bus, not yet decoded; receive_ns is this process's clock."""

    key: str
    payload: bytes
    receive_ns: int
    encoding: str


class ThreadDiedError(RuntimeError):
    """A thread of the bus died; the text names it, __cause__ is what killed it."""


class Publisher(Protocol):
    """One topic of one node or pair, declared once. Safe to use from several threads."""

    def put(self, message: Message) -> bool:
        """Encode and send; False where the rate cap or a closed bus held it back. Raises MessageError."""
        ...

    def put_bytes(self, payload: bytes) -> bool:
        """Send what is encoded already; False where the rate cap or a closed bus held it back."""
        ...

    def close(self) -> None:
        """Publish no longer; what the cache held is gone."""
        ...


class Subscription(Protocol):
    """Messages that match one key expression, handed to one handler in a thread of its own."""

    @property
    def dropped(self) -> int:
        """How many were dropped, oldest first, because the handler was too slow."""
        ...

    @property
    def missed(self) -> int:
        """How many of its publishers' samples never came (of topics that keep more than the latest)."""
        ...

    def close(self) -> None:
        """Let the handler finish what is queued, one second at most, and end its thread."""
        ...


class Bus(Protocol):
    """One process's connection."""

    @property
    def failure(self) -> ThreadDiedError | None:
        """The first thread that died, for the service to raise; None while all is well."""
        ...

    def on_failure(self, handle: Callable[[ThreadDiedError], None]) -> None:
        """Call handle, from the dying thread, when a thread of the bus dies (at once where one did already)."""
        ...

    def publisher(self, topic: Topic, *ids: str, max_rate_hz: float | None = None) -> Publisher:
        """Declare what is published on topic.key(*ids); max_rate_hz skips what comes sooner."""
        ...

    def subscribe(
        self, key_expr: str, handle: Callable[[Received], None], *, capacity: int = 1024, history: bool = True
    ) -> Subscription:
        """Hand every message on key_expr (`*`: one chunk, `**`: any number) to handle, one at a time.

        With history, nothing that publishers still hold is missed: what they sent before (the newest of a topic
        with latest_only, else the last minute) is queued before this returns, the newest-only topics first,
        and what a fault of the link took is fetched when it is back. Each publisher's samples come in order
        and once. Without: only what comes from now on, as it comes.
        Past capacity the oldest is dropped and counted. An exception in handle ends the subscription's
        thread and is the bus's failure.
        """
        ...

    def declare_alive(self, name: str) -> None:
        """Let others see that this process lives, until it closes the bus or dies. name: `node/<id>`, ..."""
        ...

    def watch_alive(self, handle: Callable[[str, bool], None]) -> Subscription:
        """Call handle(name, alive) for everyone who is alive now, and at every change."""
        ...

    def is_alive(self, name: str) -> bool:
        """Return whether another process on this bus has declared name."""
        ...

    def close(self) -> None:
        """Close publishers and subscriptions and leave the bus; twice does no harm."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class FailureLatch:
    """Keeps the first thread that died and tells whom it concerns."""

    def __init__(self) -> None:
        self.failure: ThreadDiedError | None = None
        self._lock = threading.Lock()
        self._handlers: list[Callable[[ThreadDiedError], None]] = []

    def on_failure(self, handle: Callable[[ThreadDiedError], None]) -> None:
        """Call handle at the first failure, or now where it was."""
        with self._lock:
            self._handlers.append(handle)
            failure = self.failure
        if failure is not None:
            handle(failure)

    def report(self, thread_name: str, error: Exception) -> None:
        """Record that a thread died."""
        failure = ThreadDiedError(f"thread {thread_name!r} died: {type(error).__name__}: {error}")
        failure.__cause__ = error
        with self._lock:
            if self.failure is not None:
                return
            self.failure = failure
            handlers = list(self._handlers)
        log.error("%s", failure)
        for handle in handlers:
            handle(failure)


T = TypeVar("T")


class Delivery(Generic[T]):
    """A bounded queue that drops its oldest, and the thread that hands its items to one handler in order."""

    def __init__(self, name: str, handle: Callable[[T], None], capacity: int, failures: FailureLatch) -> None:
        if capacity < 1:
            raise ValueError(f"capacity {capacity}: at least 1")
        self.dropped = 0
        self._handle = handle
        self._capacity = capacity
        self._failures = failures
        self._items: deque[tuple[T, int]] = deque()
        self._bytes = 0
        self._changed = threading.Condition()
        self._deadline_passed = False
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def offer(self, item: T, size_bytes: int = 0) -> None:
        """Queue an item; never waits."""
        with self._changed:
            if self._closing:
                return
            self._items.append((item, size_bytes))
            self._bytes += size_bytes
            while len(self._items) > self._capacity or (self._bytes > MAX_QUEUED_BYTES and len(self._items) > 1):
                self._bytes -= self._items.popleft()[1]
                self.dropped += 1
            self._changed.notify()

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Take no more, hand over what is queued within timeout_s, end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is threading.current_thread():
            return
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            with self._changed:
                self._items.clear()
            log.warning("thread %r is still busy after %g s", self._thread.name, timeout_s)

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    while not self._items and not self._closing:
                        self._changed.wait()
                    if not self._items:
                        return
                    item, size_bytes = self._items.popleft()
                    self._bytes -= size_bytes
                self._handle(item)
        except Exception as error:
            with self._changed:
                self._closing = True
                self._items.clear()
            self._failures.report(self._thread.name, error)


class RateCap:
    """Lets at most max_rate_hz through, on average; None lets all through."""

    def __init__(self, max_rate_hz: float | None, clock: Clock) -> None:
        if max_rate_hz is not None and not max_rate_hz > 0:
            raise ValueError(f"max_rate_hz {max_rate_hz}: must be positive")
        self._period_ns = None if max_rate_hz is None else round(S_NS / max_rate_hz)
        self._clock = clock
        self._lock = threading.Lock()
        self._next_ns: int | None = None

    def passes(self) -> bool:
        """Return whether one may go out now, and count it as gone."""
        if self._period_ns is None:
            return True
        now_ns = self._clock.now_ns()
        with self._lock:
            next_ns = self._next_ns
            # A clock that was set back must not silence the topic for as long.
            if next_ns is not None and next_ns - self._period_ns <= now_ns < next_ns:
                return False
            late = next_ns is None or not 0 <= now_ns - next_ns < self._period_ns
            self._next_ns = (now_ns if late or next_ns is None else next_ns) + self._period_ns
            return True


def cache_depth(topic: Topic, cache_s: float) -> int:
    """Return how many samples a publisher of topic keeps for those that missed them.

    A trigger's topics may run faster than nominal, so none is sized for less than 30 Hz.
    """
    if topic.latest_only:
        return 1
    return max(math.ceil(max(topic.rate_hz, MAX_TRIGGER_HZ) * cache_s), 1)


def check_alive_name(name: str) -> str:
    """Return name; raise ValueError where it cannot be part of a key."""
    if not _ALIVE_NAME.match(name):
        raise ValueError(f"alive name {name!r}: chunks of a-z, 0-9 and _, separated by /")
    return name
