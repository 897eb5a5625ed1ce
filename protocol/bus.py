"""The bus: publish, subscribe, see which processes are alive. This is the interface of its two implementations.

protocol.zenoh_bus connects processes; protocol.local_bus works within one process.
"""

from __future__ import annotations

import logging
import math
import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Protocol, Self, TypeAlias

from buddyline.protocol.clock import S_NS, Clock
from buddyline.protocol.codec import encode, payload_stamp_ns
from buddyline.protocol.delivery import FailureLatch, RateCap, ThreadDiedError
from buddyline.protocol.envelope import Envelope, open_envelope
from buddyline.protocol.messages import Message
from buddyline.protocol.sequence import owner_of
from buddyline.protocol.topics import Topic, parse_key

CACHE_S: Final = 60.0
MAX_TRIGGER_HZ: Final = 30.0
# Stamps of a live dive are this near to now.
LIVE_NS: Final = 60 * S_NS
# Of larger messages, which are pictures, the stamp is not looked at.
STAMPED_BYTES: Final = 65536

KeyExprs: TypeAlias = str | tuple[str, ...]
OnArrival: TypeAlias = Callable[[str, bytes], None]

log = logging.getLogger(__name__)

_ALIVE_NAME = re.compile(r"[a-z0-9_]{1,64}(/[a-z0-9_]{1,64})*\Z")


@dataclass(frozen=True)
class Received:
    """One message from the bus, not yet decoded. receive_ns: receive time by this process's clock."""

    key: str
    payload: bytes
    receive_ns: int
    encoding: str

    def open(self) -> Envelope:
        """Decode and check the message; raise MessageError."""
        return open_envelope(self.key, self.payload, self.receive_ns)


class Publisher(ABC):
    """Publishes one topic of one node or pair. Safe to use from several threads."""

    def __init__(self, topic: Topic, key: str, cap: RateCap) -> None:
        self.topic = topic
        self.key = key
        self._cap = cap
        self._closed = False
        self._warned = False

    def put(self, message: Message) -> bool:
        """Encode and send a message; return False as put_bytes does. Raises MessageError."""
        if not isinstance(message, self.topic.schema):
            raise TypeError(f"topic {self.topic.name} carries {self.topic.schema.__name__}")
        return self.put_bytes(encode(message))

    def put_bytes(self, payload: bytes) -> bool:
        """Send an encoded message; return False if its size, the rate cap, a slow link or a closed bus prevents it."""
        if len(payload) > self.topic.max_bytes:
            if not self._warned:
                log.warning("%s: %d bytes, at most %d: not sent", self.key, len(payload), self.topic.max_bytes)
            self._warned = True
            return False
        return not self._closed and self._cap.passes() and self._send(payload)

    def repeat(self, payload: bytes) -> bool:
        """Send again what an earlier publisher of this key has sent.

        Subscribers with history drop it if they have it, those without in any case.
        """
        if not self.topic.repeated:
            raise ValueError(f"topic {self.topic.name} is not repeated")
        return not self._closed and self._send(payload, again=True)

    @abstractmethod
    def _send(self, payload: bytes, *, again: bool = False) -> bool: ...

    @abstractmethod
    def close(self) -> None:
        """Stop publishing; the cache is dropped."""


class Subscription(Protocol):
    """Passes the messages that match its key expressions to one handler, in a thread of its own."""

    @property
    def dropped(self) -> int:
        """Number of messages dropped, oldest first, because the handler was too slow."""
        ...

    @property
    def missed(self) -> int:
        """Number of messages that were lost on the way (of topics that keep more than the latest message)."""
        ...

    @property
    def waiting(self) -> int:
        """Number of messages that have come, and that the handler has not been given yet."""
        ...

    def close(self) -> None:
        """Let the handler finish the queued messages, for one second at most, and end its thread."""
        ...


class Bus(ABC):
    """One process's connection; a context manager that closes it."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._failures = FailureLatch()
        self._lock = threading.Lock()
        self._publishers: list[Publisher] = []
        self._subscriptions: list[Subscription] = []
        self._closed = False

    @property
    def failure(self) -> ThreadDiedError | None:
        """The failure of the first thread that died; None if none has died."""
        return self._failures.failure

    def on_failure(self, handle: Callable[[ThreadDiedError], None]) -> None:
        """Call handle, from the dying thread, when a thread of the bus dies; at once if one has died already."""
        self._failures.on_failure(handle)

    @abstractmethod
    def publisher(self, topic: Topic, *ids: str, max_rate_hz: float | None = None) -> Publisher:
        """Return a publisher on topic.key(*ids). max_rate_hz: messages above this rate are skipped."""

    @abstractmethod
    def subscribe(
        self,
        keys: KeyExprs,
        handle: Callable[[Received], None],
        *,
        capacity: int = 1024,
        history: bool = True,
        on_arrival: OnArrival | None = None,
    ) -> Subscription:
        """Pass every message on these keys (`*`: one chunk, `**`: any number) to handle, one at a time.

        With history, the messages that publishers still hold are queued before this returns: first the newest
        message of each latest-only topic, then the last minute of the other topics, sorted by stamp over all
        publishers and keys. Messages lost in an outage of the link are fetched afterwards. Each publisher's messages
        come in order and once. Images are never held.
        Without history, only messages sent from now on are passed, as they arrive.
        Beyond `capacity` the oldest message is dropped and counted. An exception in handle ends the subscription's
        thread and becomes the bus's failure.
        on_arrival is called with key and payload of each message as it comes, before it waits for the handler or for an
        earlier message: by several threads, more than once for one that comes more than once. It must not wait.
        """

    @abstractmethod
    def newest(self, topic: Topic) -> list[Received]:
        """Return the newest message of each key of a retained topic, also if its sender is gone.

        The hub holds them: a hub that has restarted since, or that is not Buddyline's, returns an empty list.
        """

    @abstractmethod
    def declare_alive(self, name: str) -> None:
        """Show others that this process is alive, until it closes the bus or dies. name: `node/<id>`, ..."""

    @abstractmethod
    def watch_alive(self, handle: Callable[[str, bool], None]) -> Subscription:
        """Call handle(name, alive) for every name that is alive now, and at every change.

        Without a connection to the hub no name counts as alive.
        """

    def is_alive(self, name: str) -> bool:
        """Return whether another process on this bus has declared name."""
        return check_alive_name(name) in self.others_alive(name)

    @abstractmethod
    def others_alive(self, name: str = "**") -> set[str]:
        """Return the names, all or this one, that other processes have declared, as the hub knows them now."""

    @abstractmethod
    def withdraw_alive(self, name: str) -> None:
        """Take a declared name back."""

    @property
    @abstractmethod
    def hub(self) -> str | None:
        """An id of the hub's process, to which this one is connected; None while it is cut off."""

    @abstractmethod
    def answer(self, key: str, reply: Callable[[str], Iterable[bytes]]) -> None:
        """Answer questions on key until the bus closes: reply returns the payloads of an answer to a question's text.

        In a thread of its own, one question at a time, and with what the link has to spare: a payload may wait, and the
        rest of an answer that waits too long is left out. An exception in reply becomes the bus's failure.
        """

    @abstractmethod
    def ask(self, key: str, text: str, timeout_s: float) -> list[bytes]:
        """Ask a question on key; return what has come of the answer within this time, in its order."""

    @property
    def shed(self) -> dict[str, int]:
        """How many messages of each topic a slow link has left out."""
        return {}

    def link_problem(self) -> str:
        """Return what a slow link leaves out, for people; "" if nothing."""
        return ""

    def flood_problem(self) -> str:
        """Return who sends more than this process takes, for people; "" if nobody."""
        return ""

    def close(self) -> None:
        """Close publishers and subscriptions and leave the bus; a second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        for publisher in self._publishers:
            publisher.close()
        for subscription in self._subscriptions:
            subscription.close()
        self._leave()

    @abstractmethod
    def _leave(self) -> None: ...

    def __enter__(self) -> Self:
        """Return the bus."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()


def cache_depth(topic: Topic, cache_s: float) -> int:
    """Return how many messages a publisher keeps for subscribers that missed them; 0 for none.

    Topics of a trigger may run faster than nominal, so every cache has room for at least 30 Hz. Images are not kept:
    they are large, and useless when late.
    """
    if topic.priority == "background":
        return 0
    if topic.latest_only:
        return 1
    return max(math.ceil(max(topic.rate_hz, MAX_TRIGGER_HZ) * cache_s), 1)


def each_of(keys: KeyExprs) -> tuple[str, ...]:
    """Return the key expressions as a tuple. No two of them may match the same key."""
    return (keys,) if isinstance(keys, str) else keys


def held_order(key: str, payload: bytes) -> tuple[bool, int]:
    """Return the sort key of a held message for a late subscriber: latest-only topics first, then by stamp.

    Without the order by stamp a solver would get all frames of one node before the first of the other.
    """
    parsed = parse_key(key)
    return parsed is None or not parsed[0].latest_only, payload_stamp_ns(payload) or 0


def queue_of(key: str, payload: bytes, now_ns: int) -> str:
    """Return the name of the queue (`Delivery`) of a message: its owner's.

    All messages of stored dives, whose stamps are not of now, share one: there the order of the nodes counts.
    """
    stamp_ns = payload_stamp_ns(payload) if len(payload) <= STAMPED_BYTES else None
    return "stored" if stamp_ns is not None and abs(stamp_ns - now_ns) > LIVE_NS else owner_of(key)


def check_alive_name(name: str) -> str:
    """Return name; raise ValueError if it cannot be part of a key."""
    if not _ALIVE_NAME.match(name):
        raise ValueError(f"alive name {name!r}: chunks of a-z, 0-9 and _, separated by /")
    return name
