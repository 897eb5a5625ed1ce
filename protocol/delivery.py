"""Parts of both buses: a bounded queue with its own thread, a rate cap, a memory of what has come, a failure latch."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from typing import Final, Generic, TypeVar

from buddyline.protocol.clock import S_NS, Clock

MAX_QUEUED_BYTES: Final = 64 * 1024 * 1024
CLOSE_S: Final = 1.0
# Of so many owners it is known in which queue their last item is.
MAX_OWNERS: Final = 256
# Of each key, the messages of a minute at 30 Hz.
MAX_KNOWN: Final = 2048
MAX_KNOWN_KEYS: Final = 512

log = logging.getLogger(__name__)


class ThreadDiedError(RuntimeError):
    """A thread of the bus died. The text names the thread; __cause__ is its exception."""


class FailureLatch:
    """Keeps the first failure of a thread and passes it to the handlers."""

    def __init__(self) -> None:
        self.failure: ThreadDiedError | None = None
        self._lock = threading.Lock()
        self._handlers: list[Callable[[ThreadDiedError], None]] = []

    def on_failure(self, handle: Callable[[ThreadDiedError], None]) -> None:
        """Call handle at the first failure; at once if it has happened already."""
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


class _Queue(Generic[T]):
    """Items with their sizes in bytes. is_last: all others come before it."""

    def __init__(self) -> None:
        self.is_last = False
        self.items: deque[tuple[T, int]] = deque()
        self.bytes = 0


class Delivery(Generic[T]):
    """Bounded queues, and the thread that passes their items to one handler.

    Queues take turns: a sender of more than can be handled delays and loses what is in its own queue. Items of a queue
    come in order, and so do those of an owner: while its last item may wait in another queue, the next waits there too.
    The queue "" comes before all others, and one that is last after them. Of a queue that is full (`capacity` items)
    the oldest item is dropped; of all together beyond MAX_QUEUED_BYTES, that of the largest. `dropped` counts them;
    `waiting` those that the handler will get.
    """

    def __init__(self, name: str, handle: Callable[[T], None], capacity: int, failures: FailureLatch) -> None:
        if capacity < 1:
            raise ValueError(f"capacity {capacity}: at least 1")
        self.dropped = 0
        self.waiting = 0
        self._handle = handle
        self._capacity = capacity
        self._failures = failures
        # By name; the one whose turn is next is first. None is empty.
        self._queues: OrderedDict[str, _Queue[T]] = OrderedDict()
        # By owner, the queue of its last item.
        self._queue_of: OrderedDict[str, str] = OrderedDict()
        self._bytes = 0
        self._closing = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def offer(self, item: T, size_bytes: int = 0, queue: str = "", owner: str = "", *, is_last: bool = False) -> None:
        """Queue an item; never waits. owner: "" for none. is_last: from now on all other queues come before this."""
        with self._changed:
            if self._closing:
                return
            if owner:
                queue = self._behind_others(queue, owner)
            into = self._queues.setdefault(queue, _Queue())
            into.items.append((item, size_bytes))
            into.bytes += size_bytes
            into.is_last = is_last
            self._bytes += size_bytes
            self.waiting += 1
            if len(into.items) > self._capacity:
                self._take(queue)
                self.dropped += 1
            while self._bytes > MAX_QUEUED_BYTES:
                largest = max(self._queues, key=lambda name: self._queues[name].bytes)
                # A single item may exceed the bound, or it could never be delivered.
                if len(self._queues[largest].items) == 1:
                    break
                self._take(largest)
                self.dropped += 1
            self._changed.notify()

    def close(self, timeout_s: float = CLOSE_S) -> None:
        """Accept no more items, pass on the queued ones within timeout_s, and end the thread."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        if self._thread is threading.current_thread():
            return
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            with self._changed:
                self._clear()
            log.warning("thread %r is still busy after %g s", self._thread.name, timeout_s)

    def _run(self) -> None:
        try:
            while True:
                with self._changed:
                    while not self._queues and not self._closing:
                        self._changed.wait()
                    if not self._queues:
                        return
                    item = self._next()
                self._handle(item)
        except Exception as error:
            with self._changed:
                self._closing = True
                self._clear()
            self._failures.report(self._thread.name, error)

    def _clear(self) -> None:
        self._queues.clear()
        self.waiting = 0

    def _next(self) -> T:
        """Take an item of the queue whose turn it is."""
        in_turn = (name for name, queue in self._queues.items() if not queue.is_last)
        name = "" if "" in self._queues else next(in_turn, None) or next(iter(self._queues))
        item = self._take(name)
        if name in self._queues:
            self._queues.move_to_end(name)
        return item

    def _behind_others(self, queue: str, owner: str) -> str:
        """Return the queue where an owner's next item comes after its others; those in "" come first anyway."""
        before = self._queue_of.pop(owner, "")
        self._queue_of[owner] = queue = before if before and before in self._queues else queue
        if len(self._queue_of) > MAX_OWNERS:
            self._queue_of.popitem(last=False)
        return queue

    def _take(self, name: str) -> T:
        """Take the oldest item of a queue; a queue without items is forgotten."""
        queue = self._queues[name]
        item, size_bytes = queue.items.popleft()
        queue.bytes -= size_bytes
        self._bytes -= size_bytes
        self.waiting -= 1
        if not queue.items:
            del self._queues[name]
        return item


class Repeats:
    """Knows the newest messages of each key, by their bytes, to leave out one that is sent again.

    The first sending, by another, may come after the second: it may have waited for a lost message before it. A stored
    dive that is played twice sends the same bytes twice, and neither is again. history: whether the subscriber wants
    what was sent before it came.
    """

    def __init__(self, *, history: bool) -> None:
        self._history = history
        # By key, and of each message who sent it again, if its first sending has not come.
        self._known: OrderedDict[str, OrderedDict[int, Hashable]] = OrderedDict()

    def is_wanted(self, key: str, payload: bytes, source: Hashable, *, again: bool) -> bool:
        """Note a message; return whether to deliver it. again: its publisher says that it is sent again."""
        if again and not self._history:
            return False
        known = self._known.setdefault(key, OrderedDict())
        # Of too many keys, those that have been silent longest are forgotten.
        self._known.move_to_end(key)
        number = hash(payload)
        if number in known and (again or known[number] not in {None, source}):
            known[number] = known[number] if again else None
            return False
        known[number] = source if again else None
        if len(known) > MAX_KNOWN:
            known.popitem(last=False)
        if len(self._known) > MAX_KNOWN_KEYS:
            self._known.popitem(last=False)
        return True


class RateCap:
    """Lets at most max_rate_hz messages pass, on average; None: all of them."""

    def __init__(self, max_rate_hz: float | None, clock: Clock) -> None:
        if max_rate_hz is not None and not max_rate_hz > 0:
            raise ValueError(f"max_rate_hz {max_rate_hz}: must be positive")
        self._period_ns = None if max_rate_hz is None else round(S_NS / max_rate_hz)
        self._clock = clock
        self._lock = threading.Lock()
        self._due_ns: int | None = None

    def passes(self) -> bool:
        """Return whether a message may be sent now; if so, count it as sent."""
        if self._period_ns is None:
            return True
        now_ns = self._clock.now_ns()
        with self._lock:
            late_ns = 0 if self._due_ns is None else now_ns - self._due_ns
            # A clock that was set back by more than a period must not silence the topic until it has caught up.
            if -self._period_ns <= late_ns < 0:
                return False
            # In a steady stream the next message is due one period after this one was due; after a pause, one period
            # from now.
            self._due_ns = now_ns + self._period_ns - (late_ns if 0 <= late_ns < self._period_ns else 0)
            return True
