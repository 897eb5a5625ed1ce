"""The bus: publish, subscribe, know who is alive. This is the contract of its two implementations.

protocol.zenoh_bus works between processes, protocol.local_bus within one.
"""

from __future__ import annotations

import math
import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Final, Protocol, Self, TypeAlias

from buddyline.protocol.clock import Clock
from buddyline.protocol.codec import encode, payload_stamp_ns
from buddyline.protocol.delivery import FailureLatch, RateCap, ThreadDiedError
from buddyline.protocol.envelope import Envelope, open_envelope
from buddyline.protocol.messages import Message
from buddyline.protocol.topics import Topic, parse_key

CACHE_S: Final = 60.0
MAX_TRIGGER_HZ: Final = 30.0

KeyExprs: TypeAlias = str | tuple[str, ...]

_ALIVE_NAME = re.compile(r"[a-z0-9_]{1,64}(/[a-z0-9_]{1,64})*\Z")


@dataclass(frozen=True)
class Received:
    """One message off the bus, not yet opened; receive_ns is this process's clock."""

    key: str
    payload: bytes
    receive_ns: int
    encoding: str

    def open(self) -> Envelope:
        """Return its sound message; raise MessageError."""
        return open_envelope(self.key, self.payload, self.receive_ns)


class Publisher(ABC):
    """One topic of one node or pair, declared once. Safe to use from several threads."""

    def __init__(self, topic: Topic, key: str, cap: RateCap) -> None:
        self.topic = topic
        self.key = key
        self._cap = cap
        self._closed = False

    def put(self, message: Message) -> bool:
        """Encode and send; False where the rate cap or a closed bus held it back. Raises MessageError."""
        if not isinstance(message, self.topic.schema):
            raise TypeError(f"topic {self.topic.name} carries {self.topic.schema.__name__}")
        return self.put_bytes(encode(message))

    def put_bytes(self, payload: bytes) -> bool:
        """Send what is encoded already; False where the rate cap or a closed bus held it back."""
        return not self._closed and self._cap.passes() and self._send(payload)

    @abstractmethod
    def _send(self, payload: bytes) -> bool: ...

    @abstractmethod
    def close(self) -> None:
        """Publish no longer; what the cache held is gone."""


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
        """The first thread that died, for the service to raise; None while all is well."""
        return self._failures.failure

    def on_failure(self, handle: Callable[[ThreadDiedError], None]) -> None:
        """Call handle, from the dying thread, when a thread of the bus dies (at once where one did already)."""
        self._failures.on_failure(handle)

    @abstractmethod
    def publisher(self, topic: Topic, *ids: str, max_rate_hz: float | None = None) -> Publisher:
        """Declare what is published on topic.key(*ids); max_rate_hz skips what comes sooner."""

    @abstractmethod
    def subscribe(
        self, keys: KeyExprs, handle: Callable[[Received], None], *, capacity: int = 1024, history: bool = True
    ) -> Subscription:
        """Hand every message on these keys (`*`: one chunk, `**`: any number) to handle, one at a time.

        With history, nothing that publishers still hold is missed: what they sent before is queued before this
        returns, first the newest of each topic with latest_only, then the last minute of the others, all
        publishers' and keys' in order of their stamps; and what a fault of the link took is fetched when it is back.
        Each publisher's samples come in order and once. Images are never kept.
        Without history: only what comes from now on, as it comes.
        Past capacity the oldest is dropped and counted. An exception in handle ends the subscription's
        thread and is the bus's failure.
        """

    @abstractmethod
    def newest(self, topic: Topic) -> list[Received]:
        """Return the newest message of each key of a retained topic, whether who sent it is still there or not.

        The list is empty where the hub was started since, or is another program than ours.
        """

    @abstractmethod
    def declare_alive(self, name: str) -> None:
        """Let others see that this process lives, until it closes the bus or dies. name: `node/<id>`, ..."""

    @abstractmethod
    def watch_alive(self, handle: Callable[[str, bool], None]) -> Subscription:
        """Call handle(name, alive) for everyone who is alive now, and at every change.

        While the hub is away nobody is alive.
        """

    @abstractmethod
    def is_alive(self, name: str) -> bool:
        """Return whether another process on this bus has declared name."""

    def close(self) -> None:
        """Close publishers and subscriptions and leave the bus; twice does no harm."""
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
    """Return how many samples a publisher of topic keeps for those that missed them; 0: none.

    A trigger's topics may run faster than nominal, so none is sized for less than 30 Hz. Images are neither
    small enough to keep nor worth sending late.
    """
    if topic.priority == "background":
        return 0
    if topic.latest_only:
        return 1
    return max(math.ceil(max(topic.rate_hz, MAX_TRIGGER_HZ) * cache_s), 1)


def each_of(keys: KeyExprs) -> tuple[str, ...]:
    """Return the key expressions, of which no two may match the same key."""
    return (keys,) if isinstance(keys, str) else keys


def held_order(key: str, payload: bytes) -> tuple[bool, int]:
    """Order what publishers hold for a late joiner: the topics with only a latest message, then by time.

    By time, because a solver would otherwise get all frames of one node before the first of the other.
    """
    parsed = parse_key(key)
    return parsed is None or not parsed[0].latest_only, payload_stamp_ns(payload) or 0


def check_alive_name(name: str) -> str:
    """Return name; raise ValueError where it cannot be part of a key."""
    if not _ALIVE_NAME.match(name):
        raise ValueError(f"alive name {name!r}: chunks of a-z, 0-9 and _, separated by /")
    return name
