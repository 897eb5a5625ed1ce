"""The bus within one process: for tests, and for programs that run a whole system."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence

from buddyline.protocol.bus import (
    CACHE_S,
    Bus,
    KeyExprs,
    OnArrival,
    Publisher,
    Received,
    Subscription,
    cache_depth,
    check_alive_name,
    each_of,
    held_order,
    queue_of,
)
from buddyline.protocol.clock import Clock, SystemClock
from buddyline.protocol.delivery import Delivery, RateCap, Repeats
from buddyline.protocol.sequence import owner_of
from buddyline.protocol.topics import Topic


def key_matches(key_expr: str, key: str) -> bool:
    """Return whether key_expr matches key: `*` stands for one chunk, `**` for any number of chunks.

    Neither matches a chunk that begins with @.
    """
    return _chunks_match(key_expr.split("/"), key.split("/"))


def _chunks_match(pattern: list[str], chunks: list[str]) -> bool:
    if not pattern:
        return not chunks
    head, rest = pattern[0], pattern[1:]
    if head == "**":
        if _chunks_match(rest, chunks):
            return True
        return bool(chunks) and not chunks[0].startswith("@") and _chunks_match(pattern, chunks[1:])
    if not chunks or not (head == chunks[0] or (head == "*" and not chunks[0].startswith("@"))):
        return False
    return _chunks_match(rest, chunks[1:])


class LocalNetwork:
    """Connects several LocalBus clients, as the hub connects processes."""

    def __init__(self, clock: Clock | None = None, cache_s: float = CACHE_S) -> None:
        self.clock = clock or SystemClock()
        self.cache_s = cache_s
        # Held while a message is distributed, so that all subscribers see the same order.
        self.lock = threading.RLock()
        self.publishers: list[LocalPublisher] = []
        self.subscriptions: list[LocalSubscription] = []
        self.watches: list[LocalWatch] = []
        self.alive: list[tuple[str, LocalBus]] = []
        self.newest: dict[str, tuple[Topic, bytes]] = {}
        self.answers: dict[str, tuple[LocalBus, Callable[[str], Iterable[bytes]]]] = {}

    def connect(self) -> LocalBus:
        """Return a new client."""
        return LocalBus(self)

    def notify(self, name: str, alive: bool) -> None:
        """Tell all watches of a change."""
        for watch in self.watches:
            watch.offer(name, alive)


class LocalPublisher(Publisher):
    """A Publisher within one process."""

    def __init__(self, network: LocalNetwork, topic: Topic, key: str, cap: RateCap) -> None:
        super().__init__(topic, key, cap)
        self.cache: deque[bytes] = deque(maxlen=cache_depth(topic, network.cache_s))
        self._network = network

    def _send(self, payload: bytes, *, again: bool = False) -> bool:
        with self._network.lock:
            self.cache.append(payload)
            if self.topic.retained:
                self._network.newest[self.key] = self.topic, payload
            for subscription in self._network.subscriptions:
                if subscription.takes(self.key):
                    subscription.offer(self, payload, again=again)
        return True

    def close(self) -> None:
        """Stop publishing; the cache is dropped."""
        with self._network.lock:
            if not self._closed:
                self._closed = True
                self._network.publishers.remove(self)


class LocalSubscription:
    """A Subscription within one process, where no message is lost on the way. joined: what was held is queued."""

    missed = 0

    def __init__(
        self,
        network: LocalNetwork,
        key_exprs: Sequence[str],
        delivery: Delivery[Received],
        *,
        history: bool,
        on_arrival: OnArrival | None,
    ) -> None:
        self.joined = False
        self._on_arrival = on_arrival
        self._key_exprs = key_exprs
        self._network = network
        self._delivery = delivery
        self._repeats = Repeats(history=history)

    @property
    def dropped(self) -> int:
        """Number of messages dropped because the handler was too slow."""
        return self._delivery.dropped

    @property
    def waiting(self) -> int:
        """Number of messages that wait for the handler."""
        return self._delivery.waiting

    def takes(self, key: str) -> bool:
        """Return whether the subscription matches key."""
        return any(key_matches(key_expr, key) for key_expr in self._key_exprs)

    def offer(self, publisher: LocalPublisher, payload: bytes, *, again: bool = False) -> None:
        """Queue a message of publisher; again: if it is wanted."""
        if self._on_arrival is not None:
            self._on_arrival(publisher.key, payload)
        if publisher.topic.repeated and not self._repeats.is_wanted(publisher.key, payload, publisher, again=again):
            return
        now_ns = self._network.clock.now_ns()
        received = Received(publisher.key, payload, now_ns, publisher.topic.encoding)
        queue = queue_of(publisher.key, payload, now_ns) if self.joined else ""
        self._delivery.offer(received, len(payload), queue, owner_of(publisher.key))

    def close(self) -> None:
        """Let the handler finish the queued messages, for one second at most, and end its thread."""
        with self._network.lock:
            if self in self._network.subscriptions:
                self._network.subscriptions.remove(self)
        self._delivery.close()


class LocalWatch:
    """Tells one handler which names are alive."""

    missed = 0

    def __init__(self, network: LocalNetwork, delivery: Delivery[tuple[str, bool]]) -> None:
        self._network = network
        self._delivery = delivery

    @property
    def dropped(self) -> int:
        """Number of changes dropped because the handler was too slow."""
        return self._delivery.dropped

    @property
    def waiting(self) -> int:
        """Number of changes that wait for the handler."""
        return self._delivery.waiting

    def offer(self, name: str, alive: bool) -> None:
        """Queue one change."""
        self._delivery.offer((name, alive))

    def close(self) -> None:
        """End the thread."""
        with self._network.lock:
            if self in self._network.watches:
                self._network.watches.remove(self)
        self._delivery.close()


class LocalBus(Bus):
    """A Bus within one process; get one from LocalNetwork.connect()."""

    def __init__(self, network: LocalNetwork) -> None:
        super().__init__(network.clock)
        self._network = network

    def publisher(self, topic: Topic, *ids: str, max_rate_hz: float | None = None) -> Publisher:
        """Return a publisher on topic.key(*ids). max_rate_hz: messages above this rate are skipped."""
        publisher = LocalPublisher(self._network, topic, topic.key(*ids), RateCap(max_rate_hz, self.clock))
        with self._network.lock:
            self._network.publishers.append(publisher)
            self._publishers.append(publisher)
        return publisher

    def subscribe(
        self,
        keys: KeyExprs,
        handle: Callable[[Received], None],
        *,
        capacity: int = 1024,
        history: bool = True,
        on_arrival: OnArrival | None = None,
    ) -> Subscription:
        """Pass every message on these keys to handle, one at a time; see protocol.bus.Bus.subscribe."""
        delivery = Delivery(f"bus {' '.join(each_of(keys))}", handle, capacity, self._failures)
        subscription = LocalSubscription(self._network, each_of(keys), delivery, history=history, on_arrival=on_arrival)
        with self._network.lock:
            if history:
                publishers = [p for p in self._network.publishers if subscription.takes(p.key)]
                held = [(publisher, payload) for publisher in publishers for payload in publisher.cache]
                for publisher, payload in sorted(held, key=lambda item: held_order(item[0].key, item[1])):
                    subscription.offer(publisher, payload)
            subscription.joined = True
            self._network.subscriptions.append(subscription)
            self._subscriptions.append(subscription)
        return subscription

    def newest(self, topic: Topic) -> list[Received]:
        """Return the newest message of each key of a retained topic."""
        with self._network.lock:
            held = list(self._network.newest.items())
        now_ns = self.clock.now_ns()
        return [Received(key, payload, now_ns, of.encoding) for key, (of, payload) in held if of is topic]

    def answer(self, key: str, reply: Callable[[str], Iterable[bytes]]) -> None:
        """Answer questions on key until the bus closes."""
        with self._network.lock:
            self._network.answers[key] = self, reply

    def ask(self, key: str, text: str, timeout_s: float) -> list[bytes]:
        """Ask a question on key; return the answer."""
        with self._network.lock:
            found = self._network.answers.get(key)
        return [] if found is None else list(found[1](text))

    def declare_alive(self, name: str) -> None:
        """Show others that this process is alive, until it closes the bus."""
        check_alive_name(name)
        with self._network.lock:
            known = any(name == other for other, _ in self._network.alive)
            self._network.alive.append((name, self))
            if not known:
                self._network.notify(name, True)

    def withdraw_alive(self, name: str) -> None:
        """Take a declared name back."""
        with self._network.lock:
            self._network.alive.remove((name, self))
            if not any(name == other for other, _ in self._network.alive):
                self._network.notify(name, False)

    @property
    def hub(self) -> str | None:
        """An id of the hub's process; None while this one is cut off."""
        return "local"

    def watch_alive(self, handle: Callable[[str, bool], None]) -> Subscription:
        """Call handle(name, alive) for every name that is alive now, and at every change."""
        delivery = Delivery[tuple[str, bool]]("bus alive", lambda item: handle(*item), 1024, self._failures)
        watch = LocalWatch(self._network, delivery)
        with self._network.lock:
            for name in sorted({name for name, _ in self._network.alive}):
                watch.offer(name, True)
            self._network.watches.append(watch)
            self._subscriptions.append(watch)
        return watch

    def others_alive(self, name: str = "**") -> set[str]:
        """Return the names, all or this one, that other clients of this network have declared."""
        with self._network.lock:
            return {other for other, bus in self._network.alive if name in ("**", other) and bus is not self}

    def _leave(self) -> None:
        with self._network.lock:
            self._network.answers = {key: one for key, one in self._network.answers.items() if one[0] is not self}
            own = {name for name, bus in self._network.alive if bus is self}
            self._network.alive = [entry for entry in self._network.alive if entry[1] is not self]
            for name in own - {name for name, _ in self._network.alive}:
                self._network.notify(name, False)
