"""The bus over Zenoh: one hub that listens, everyone else its client. The only module that imports zenoh.

Nothing but the hub listens, and nothing is found by multicast: a client speaks to the endpoint it was given.
Streams are recovered by their publishers' caches, never blocked for: one frozen viewer must not stall the rest.
"""

from __future__ import annotations

import json
import logging
import re
import threading
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Final, Literal, Self

import zenoh
import zenoh.ext

from protocol.bus import CACHE_S, Bus, Publisher, Received, Subscription, cache_depth, check_alive_name
from protocol.clock import Clock, SystemClock
from protocol.delivery import Delivery, FailureLatch, RateCap
from protocol.errors import BuddylineError
from protocol.messages import MAX_MESSAGE_BYTES
from protocol.topics import Topic, parse_key

DEFAULT_ENDPOINT: Final = "tcp/127.0.0.1:7447"

# `**` does not match chunks that begin with @: nobody takes a token for a message.
ALIVE: Final = "buddyline/@alive"

HEARTBEAT_S: Final = 0.25
LEASE_MS: Final = 3000
RETRY_S: Final = 0.25
QUERY_S: Final = 2.0
INTAKE: Final = 8192

_PRIORITIES: Final = {
    "interactive_high": zenoh.Priority.INTERACTIVE_HIGH,
    "data_high": zenoh.Priority.DATA_HIGH,
    "data": zenoh.Priority.DATA,
    "data_low": zenoh.Priority.DATA_LOW,
    "background": zenoh.Priority.BACKGROUND,
}

_ENDPOINT = re.compile(r"(tcp|tls)/(\[[0-9a-fA-F:.]+\]|[A-Za-z0-9_.-]+):([0-9]{1,5})\Z")

log = logging.getLogger(__name__)


def check_endpoint(endpoint: str) -> str:
    """Return endpoint; raise BuddylineError where it is not `tcp/<host>:<port>`."""
    match = _ENDPOINT.match(endpoint)
    if match is None or not 0 < int(match.group(3)) < 65536:
        raise BuddylineError(f"endpoint {endpoint!r}: write it as tcp/<host>:<port>, like {DEFAULT_ENDPOINT}")
    return endpoint


def _config(mode: Literal["router", "client"], endpoint: str, namespace: str | None = None) -> zenoh.Config:
    """Return a configuration that opens no socket but the one asked for."""
    entries: dict[str, object] = {
        "mode": mode,
        "listen/endpoints": [endpoint] if mode == "router" else [],
        "connect/endpoints": [] if mode == "router" else [endpoint],
        "connect/timeout_ms": 0,
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "transport/link/tx/lease": LEASE_MS,
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES + 65536,
        "transport/shared_memory/enabled": False,
    }
    if namespace is not None:
        entries["namespace"] = namespace
    config = zenoh.Config()
    for key, value in entries.items():
        config.insert_json5(key, json.dumps(value))
    return config


class Hub:
    """The one process that listens; closing it sends everyone else waiting for it."""

    def __init__(self, session: zenoh.Session, endpoint: str) -> None:
        self.endpoint = endpoint
        self._session = session

    def close(self) -> None:
        """Stop listening."""
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        """Return the hub."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()


def open_hub(endpoint: str = DEFAULT_ENDPOINT) -> Hub:
    """Listen on endpoint; raise BuddylineError where the port is taken or the address is not this machine's."""
    check_endpoint(endpoint)
    try:
        return Hub(zenoh.open(_config("router", endpoint)), endpoint)
    except zenoh.ZError as error:
        if "Address already in use" in str(error):
            raise BuddylineError(
                f"{endpoint} is in use: a hub runs there already (use that one), or give this one another port"
            ) from error
        raise BuddylineError(f"hub at {endpoint}: cannot listen: {str(error).split(' at /')[0]}") from error


def connect(
    endpoint: str = DEFAULT_ENDPOINT,
    *,
    namespace: str | None = None,
    stop: threading.Event,
    on_wait: Callable[[str], None],
    clock: Clock | None = None,
    cache_s: float = CACHE_S,
) -> ZenohBus | None:
    """Connect to the hub, waiting for it where it is not there yet; None where stop was set before.

    on_wait is called once, with what is being waited for. cache_s: how long an outage may last without loss.
    """
    check_endpoint(endpoint)
    config = _config("client", endpoint, namespace)
    waiting = False
    while not stop.is_set():
        session = _try_open(config, stop)
        if session is not None:
            return ZenohBus(session, config, clock or SystemClock(), cache_s)
        if not waiting and not stop.is_set():
            on_wait(f"no hub at {endpoint} yet, waiting for it (start one with `buddyline hub`)")
            waiting = True
        stop.wait(RETRY_S)
    return None


def _try_open(config: zenoh.Config, stop: threading.Event) -> zenoh.Session | None:
    """Open a session within a thread of its own: a listener that does not answer holds it for 10 s."""
    opened: list[zenoh.Session] = []
    errors: list[Exception] = []
    ended = threading.Event()
    lock = threading.Lock()
    abandoned = False

    def attempt() -> None:
        try:
            session = zenoh.open(config)
        except Exception as error:
            errors.append(error)
        else:
            with lock:
                if abandoned:
                    session.close()  # type: ignore[no-untyped-call]
                else:
                    opened.append(session)
        ended.set()

    threading.Thread(target=attempt, name="bus connect", daemon=True).start()
    while not ended.wait(0.05):
        if stop.is_set():
            with lock:
                abandoned = True
            break
    if errors and not isinstance(errors[0], zenoh.ZError):
        raise errors[0]
    return opened[0] if opened else None


class ZenohPublisher(Publisher):
    """A Publisher over Zenoh."""

    def __init__(
        self,
        publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher,
        topic: Topic,
        key: str,
        cap: RateCap,
    ) -> None:
        super().__init__(topic, key, cap)
        self._publisher = publisher

    def _send(self, payload: bytes) -> bool:
        try:
            self._publisher.put(payload)
        except zenoh.ZError:
            # The session may close under a device thread that is about to publish.
            if self._closed:
                return False
            raise
        return True

    def close(self) -> None:
        """Publish no longer; what the cache held is gone."""
        if not self._closed:
            self._closed = True
            self._publisher.undeclare()  # type: ignore[no-untyped-call]


class ZenohSubscription:
    """A Subscription over Zenoh: an intake thread puts samples in order, fetches gaps, and never waits.

    Zenoh's own recovery does most of it. What it leaves: a publisher first heard of in the middle of its
    numbers, and a gap whose query was lost with the link.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key_expr: str,
        delivery: Delivery[Received],
        *,
        history: bool,
        clock: Clock,
        failures: FailureLatch,
    ) -> None:
        self.missed = 0
        self._session = session
        self._key_expr = key_expr
        self._delivery = delivery
        self._history = history
        self._clock = clock
        self._failures = failures
        self._last: dict[tuple[str, int], int] = {}
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(INTAKE)
        self._subscriber = (
            zenoh.ext.declare_advanced_subscriber(
                session,
                key_expr,
                ring,
                recovery=zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None),
            )
            if history
            else session.declare_subscriber(key_expr, ring)
        )
        # The subscriber's own recv cannot be undeclared while another thread waits in it; its handler's can.
        self._samples = self._subscriber.handler
        if history:
            for sample in self._held():
                self._accept(sample)
        self._thread = threading.Thread(target=self._run, name=f"bus intake {key_expr}", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """How many were dropped because the handler was too slow."""
        return self._delivery.dropped

    def close(self) -> None:
        """Let the handler finish what is queued, one second at most, and end the threads."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._delivery.close()
        self._thread.join(1.0)

    def _run(self) -> None:
        try:
            while True:
                try:
                    sample = self._samples.recv()
                except zenoh.ZError:
                    return
                self._accept(sample)
        except Exception as error:
            self._failures.report(self._thread.name, error)

    def _accept(self, sample: zenoh.Sample) -> None:
        """Deliver a sample, after those of its publisher that should have come before it."""
        if sample.kind != zenoh.SampleKind.PUT:
            return
        info = sample.source_info
        if info is None:
            self._deliver(sample)
            return
        source = (str(info.source_id.zid), info.source_id.eid)
        sn, last = info.source_sn, self._last.get(source)
        if last is not None and sn <= last:
            return
        first_due = 0 if last is None else last + 1
        self._last[source] = sn
        if sn > first_due:
            self._fill(sample, source, range(first_due, sn), known=last is not None)
        self._deliver(sample)

    def _fill(self, sample: zenoh.Sample, source: tuple[str, int], gap: range, *, known: bool) -> None:
        """Fetch and deliver what is missing before a sample; what nobody holds any more is counted."""
        key = str(sample.key_expr)
        parsed = parse_key(key)
        if parsed is None or parsed[0].latest_only:
            return
        found = 0
        if self._history:
            zid, eid = source
            selector = f"{key}/@adv/pub/{zid}/{eid}/**?_sn={gap[0]}..{gap[-1]}"
            for earlier in sorted(self._query(selector), key=_number):
                if _number(earlier) in gap:
                    self._deliver(earlier)
                    found += 1
        if known:
            self.missed += len(gap) - found

    def _held(self) -> list[zenoh.Sample]:
        """Return what publishers hold, in order, topics with only a latest message first."""

        def order(sample: zenoh.Sample) -> tuple[bool, str, int]:
            parsed = parse_key(str(sample.key_expr))
            return parsed is None or not parsed[0].latest_only, str(sample.key_expr), _number(sample)

        return sorted(self._query(f"{self._key_expr}/@adv/pub/**"), key=order)

    def _query(self, selector: str) -> Iterator[zenoh.Sample]:
        for reply in self._session.get(
            selector,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=QUERY_S,
        ):
            if reply.ok is not None and reply.ok.source_info is not None:
                yield reply.ok

    def _deliver(self, sample: zenoh.Sample) -> None:
        received = Received(
            key=str(sample.key_expr),
            payload=bytes(sample.payload),
            receive_ns=self._clock.now_ns(),
            encoding=str(sample.encoding),
        )
        self._delivery.offer(received, len(received.payload))


def _number(sample: zenoh.Sample) -> int:
    info = sample.source_info
    return -1 if info is None else info.source_sn


class ZenohWatch:
    """Who is alive, told to one handler. A process counts once, however often its token is reported."""

    missed = 0

    def __init__(self, session: zenoh.Session, delivery: Delivery[tuple[str, bool]], failures: FailureLatch) -> None:
        self._delivery = delivery
        self._failures = failures
        self._tokens: dict[str, set[str]] = {}
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(INTAKE)
        self._subscriber = session.liveliness().declare_subscriber(f"{ALIVE}/**", ring, history=True)
        self._samples = self._subscriber.handler
        self._thread = threading.Thread(target=self._run, name="bus intake alive", daemon=True)
        self._thread.start()

    @property
    def dropped(self) -> int:
        """How many changes were dropped because the handler was too slow."""
        return self._delivery.dropped

    def close(self) -> None:
        """End the threads."""
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        self._delivery.close()
        self._thread.join(1.0)

    def _run(self) -> None:
        try:
            while True:
                try:
                    sample = self._samples.recv()
                except zenoh.ZError:
                    return
                self._accept(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)
        except Exception as error:
            self._failures.report(self._thread.name, error)

    def _accept(self, key: str, alive: bool) -> None:
        name, _, process = key.removeprefix(f"{ALIVE}/").rpartition("/")
        processes = self._tokens.setdefault(name, set())
        before = bool(processes)
        if alive:
            processes.add(process)
        else:
            processes.discard(process)
        if not processes:
            del self._tokens[name]
        if before != bool(processes):
            self._delivery.offer((name, bool(processes)))


class ZenohBus(Bus):
    """A Bus over Zenoh; get one from connect()."""

    def __init__(self, session: zenoh.Session, config: zenoh.Config, clock: Clock, cache_s: float) -> None:
        super().__init__(clock)
        self._session = session
        self._config = config
        self._cache_s = cache_s
        self._bulk_session: zenoh.Session | None = None
        self._tokens: list[zenoh.LivelinessToken] = []

    def publisher(self, topic: Topic, *ids: str, max_rate_hz: float | None = None) -> Publisher:
        """Declare what is published on topic.key(*ids); max_rate_hz skips what comes sooner."""
        key, depth = topic.key(*ids), cache_depth(topic, self._cache_s)
        publisher: zenoh.Publisher | zenoh.ext.AdvancedPublisher
        settings: dict[str, Any] = {
            "encoding": topic.encoding,
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": _PRIORITIES[topic.priority],
            "express": topic.express,
        }
        if depth:
            publisher = zenoh.ext.declare_advanced_publisher(
                self._session,
                key,
                cache=zenoh.ext.CacheConfig(depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
                **settings,
            )
        else:
            # A big message holds up whatever is queued behind it in the same connection.
            publisher = self._bulk().declare_publisher(key, **settings)
        wrapped = ZenohPublisher(publisher, topic, key, RateCap(max_rate_hz, self.clock))
        with self._lock:
            self._publishers.append(wrapped)
        return wrapped

    def subscribe(
        self, key_expr: str, handle: Callable[[Received], None], *, capacity: int = 1024, history: bool = True
    ) -> Subscription:
        """Hand every message on key_expr to handle, one at a time (protocol.bus.Bus has the contract)."""
        delivery = Delivery(f"bus {key_expr}", handle, capacity, self._failures)
        subscription = ZenohSubscription(
            self._session, key_expr, delivery, history=history, clock=self.clock, failures=self._failures
        )
        with self._lock:
            self._subscriptions.append(subscription)
        return subscription

    def declare_alive(self, name: str) -> None:
        """Let others see that this process lives, until it closes the bus or dies."""
        key = f"{ALIVE}/{check_alive_name(name)}/{self._session.zid()}"
        token = self._session.liveliness().declare_token(key)
        with self._lock:
            self._tokens.append(token)

    def watch_alive(self, handle: Callable[[str, bool], None]) -> Subscription:
        """Call handle(name, alive) for everyone who is alive now, and at every change."""
        delivery = Delivery[tuple[str, bool]]("bus alive", lambda item: handle(*item), 1024, self._failures)
        watch = ZenohWatch(self._session, delivery, self._failures)
        with self._lock:
            self._subscriptions.append(watch)
        return watch

    def is_alive(self, name: str) -> bool:
        """Return whether another process on this bus has declared name."""
        replies = self._session.liveliness().get(f"{ALIVE}/{check_alive_name(name)}/*", timeout=QUERY_S)
        own = str(self._session.zid())
        keys = [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]
        return any(not key.endswith(f"/{own}") for key in keys)

    def _leave(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]
        if self._bulk_session is not None:
            self._bulk_session.close()  # type: ignore[no-untyped-call]

    def _bulk(self) -> zenoh.Session:
        with self._lock:
            if self._bulk_session is None:
                self._bulk_session = zenoh.open(self._config)
            return self._bulk_session
