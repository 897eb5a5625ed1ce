"""The bus over Zenoh: one hub that listens, everyone else its client. The only module that imports zenoh.

Nothing but the hub listens, and nothing is found by multicast: a client speaks to the endpoint it was given.
Streams are recovered by their publishers' caches, never blocked for: one frozen viewer must not stall the rest.
"""

from __future__ import annotations

import atexit
import json
import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from types import TracebackType
from typing import Any, Final, Self, TypeAlias

import zenoh
import zenoh.ext

from protocol.bus import CACHE_S, Bus, Publisher, Received, Subscription, cache_depth, check_alive_name, held_order
from protocol.clock import Clock, SystemClock
from protocol.connection import cut_connection
from protocol.delivery import CLOSE_S, Delivery, FailureLatch, RateCap
from protocol.endpoint import DEFAULT_ENDPOINT, client_settings, hub_settings
from protocol.errors import BuddylineError
from protocol.security import RefusedError, Tls, refusal
from protocol.sequence import Gap, Sequence, Source
from protocol.topics import Topic, parse_key

# `**` does not match chunks that begin with @: nobody takes a token for a message.
ALIVE: Final = "buddyline/@alive"

HEARTBEAT_S: Final = 0.25
RETRY_S: Final = 0.25
QUERY_S: Final = 2.0
# Longer than the lease: a link that fell silent ends by that, and its questions with it. Then once more, for a
# machine that was too busy.
PROBE_S: Final = 4.0
PROBE_AGAIN_S: Final = 1.0
PROBE_EVERY_S: Final = 2.0
INTAKE: Final = 8192
MAX_FETCHING: Final = 16
FETCHES: Final = 16

_PRIORITIES: Final = {
    "interactive_high": zenoh.Priority.INTERACTIVE_HIGH,
    "data_high": zenoh.Priority.DATA_HIGH,
    "data": zenoh.Priority.DATA,
    "data_low": zenoh.Priority.DATA_LOW,
    "background": zenoh.Priority.BACKGROUND,
}

AnySubscriber: TypeAlias = (
    zenoh.Subscriber[zenoh.Handler[zenoh.Sample]] | zenoh.ext.AdvancedSubscriber[zenoh.Handler[zenoh.Sample]]
)


log = logging.getLogger(__name__)


def _config(settings: Mapping[str, object]) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in settings.items():
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


def open_hub(
    endpoint: str = DEFAULT_ENDPOINT, *, tls: Tls | None = None, access: dict[str, object] | None = None
) -> Hub:
    """Listen on endpoint; raise BuddylineError where the port is taken or the address is not this machine's."""
    config = _config(hub_settings(endpoint, tls, access))
    try:
        return Hub(zenoh.open(config), endpoint)
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
    tls: Tls | None = None,
) -> ZenohBus | None:
    """Connect to the hub, waiting for it where it is not there yet; None where stop was set before.

    on_wait is called once, with what is being waited for. cache_s: how long an outage may last without loss.
    Raises RefusedError where a hub is there and the two do not accept each other.
    """
    config = _config(client_settings(endpoint, namespace, tls))
    session = _session(config, endpoint, tls, stop, on_wait)
    return None if session is None else ZenohBus(session, config, clock or SystemClock(), cache_s)


def open_session(
    endpoint: str, *, stop: threading.Event, on_wait: Callable[[str], None], tls: Tls | None = None
) -> zenoh.Session | None:
    """Connect as `connect` does, for what speaks keys and payloads that are not ours; the caller closes it."""
    return _session(_config(client_settings(endpoint, None, tls)), endpoint, tls, stop, on_wait)


def _session(
    config: zenoh.Config, endpoint: str, tls: Tls | None, stop: threading.Event, on_wait: Callable[[str], None]
) -> zenoh.Session | None:
    return _open_when_there(
        config,
        stop,
        lambda: on_wait(
            f"no hub{' with TLS' if tls else ''} at {endpoint} yet, waiting for it (start one with `buddyline hub`)"
        ),
        lambda: refusal(endpoint, tls),
    )


def _open_when_there(
    config: zenoh.Config,
    stop: threading.Event,
    on_wait: Callable[[], None] = lambda: None,
    why_refused: Callable[[], str | None] = lambda: None,
) -> zenoh.Session | None:
    """Open a session, trying again until stop is set; on_wait is called once, after the first failure.

    Raises RefusedError where why_refused finds, after a failure, that trying again is of no use.
    """
    waiting = False
    while not stop.is_set():
        session = _try_open(config, stop)
        if session is not None:
            return session
        reason = None if stop.is_set() else why_refused()
        if reason is not None:
            raise RefusedError(reason)
        if not waiting and not stop.is_set():
            on_wait()
            waiting = True
        stop.wait(RETRY_S)
    return None


def _try_open(config: zenoh.Config, stop: threading.Event) -> zenoh.Session | None:
    """Open a session within a thread of its own: a listener that does not answer holds it for seconds."""
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


class Watchdog:
    """Ends a connection on which nothing comes in, so that Zenoh makes a new one.

    Zenoh (1.10) gives up a connection that takes too long to open. Where that falls between its sending and its
    receiving being started, half of it is left: the hub is content, and this end hears nothing, for good.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bus watchdog", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Look no longer; join() waits for the end of a look that has begun, once the session is closed."""
        self._stop.set()

    def join(self) -> None:
        """Wait for the thread's end."""
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        answered = just_cut = False
        while not self._stop.wait(PROBE_EVERY_S):
            try:
                # Cutting one half may leave another: what was just made anew needs no long proof.
                patience_s = PROBE_AGAIN_S if just_cut else PROBE_S
                deaf = self._times_out(patience_s) and self._times_out(PROBE_AGAIN_S)
            except zenoh.ZError:
                continue
            # A hub that answers nobody's question is not judged by it.
            answered = answered or not deaf
            if deaf and answered:
                self._cut(patience_s + PROBE_AGAIN_S)
            just_cut = deaf and not just_cut

    def _times_out(self, timeout_s: float) -> bool:
        """Ask the hub for nothing; return whether the answer, which is that there is nothing, did not come.

        Where there is no hub, or its lease runs out meanwhile, that is the answer.
        """
        replies = self._session.liveliness().get(f"{ALIVE}/probe", timeout=timeout_s)
        return any(reply.err is not None for reply in list(replies))

    def _cut(self, unheard_s: float) -> None:
        for link in self._session.info.links():
            host, _, port = str(link.src).partition("/")[2].rpartition(":")
            if cut_connection(host.strip("[]"), int(port)):
                log.warning("the hub was not heard for %g s: the connection is made anew", unheard_s)


class BulkLink:
    """A session for big messages alone, opened at the first that asks for it.

    In a session with others, a big message holds up what is queued behind it in the same connection.
    """

    def __init__(self, config: zenoh.Config) -> None:
        self.session: zenoh.Session | None = None
        self._config = config
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """See to it that session is set once the hub is there; does not wait for that."""
        with self._lock:
            if self._thread is None and not self._stop.is_set():
                self._thread = threading.Thread(target=self._run, name="bus bulk", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Close the session."""
        with self._lock:
            self._stop.set()
        if self._thread is not None:
            self._thread.join(1.0)
        if self.session is not None:
            self.session.close()  # type: ignore[no-untyped-call]

    def _run(self) -> None:
        self.session = _open_when_there(self._config, self._stop)


class ZenohPublisher(Publisher):
    """A Publisher over Zenoh. declare: returns None while its session is not there yet."""

    def __init__(
        self,
        declare: Callable[[], zenoh.Publisher | zenoh.ext.AdvancedPublisher | None],
        topic: Topic,
        key: str,
        cap: RateCap,
    ) -> None:
        super().__init__(topic, key, cap)
        self._declare = declare
        self._declare_lock = threading.Lock()
        self._publisher = declare()

    def _send(self, payload: bytes) -> bool:
        if self._publisher is None:
            with self._declare_lock:
                self._publisher = self._publisher or self._declare()
        if self._publisher is None:
            return False
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
            if self._publisher is not None:
                self._publisher.undeclare()  # type: ignore[no-untyped-call]


class Intake:
    """A thread that takes samples out of Zenoh as they come, so that its own ring never overflows.

    name tells the thread from others; accept gets each sample, and must not wait for its consumer.
    """

    def __init__(
        self,
        name: str,
        subscriber: AnySubscriber,
        accept: Callable[[zenoh.Sample], None],
        failures: FailureLatch,
    ) -> None:
        self._subscriber = subscriber
        # The subscriber's own recv cannot be undeclared while another thread waits in it; its handler's can.
        self._samples = subscriber.handler
        self._accept = accept
        self._failures = failures
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=f"bus intake {name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Undeclare the subscriber, take in what has come, end the thread."""
        if not self._closed:
            self._closed = True
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        if self._thread is not threading.current_thread():
            self._thread.join(CLOSE_S)

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


class ZenohSubscription:
    """A Subscription over Zenoh: samples in order, each once, with what can be fetched of those that are missing.

    Zenoh's own recovery does most of it. What it leaves: a publisher first heard of in the middle of its
    numbers, and gaps whose query was lost with the link, as when the hub stood still for longer than the lease.
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
        self._session = session
        self._delivery = delivery
        self._history = history
        self._clock = clock
        self._failures = failures
        self._lock = threading.Lock()
        self._sequence = Sequence(self._deliver)
        self._fetching: set[threading.Thread] = set()
        self._stop = threading.Event()
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(INTAKE)
        subscriber: AnySubscriber
        if history:
            recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
            subscriber = zenoh.ext.declare_advanced_subscriber(session, key_expr, ring, recovery=recovery)
            held = list(self._query(f"{key_expr}/@adv/pub/**"))
            for sample in sorted(held, key=_number):
                self._sequence.begin(_source(sample), _number(sample))
            for sample in sorted(held, key=_held_order):
                self._accept(sample)
        else:
            subscriber = session.declare_subscriber(key_expr, ring)
        self._intake = Intake(key_expr, subscriber, self._accept, failures)

    @property
    def dropped(self) -> int:
        """How many were dropped because the handler was too slow."""
        return self._delivery.dropped

    @property
    def missed(self) -> int:
        """How many of its publishers' samples never came."""
        return self._sequence.missed

    def close(self) -> None:
        """Let the handler finish what is queued, one second at most, and end the threads."""
        self._stop.set()
        self._intake.close()
        self._delivery.close()
        with self._lock:
            threads = list(self._fetching)
        for thread in threads:
            thread.join(CLOSE_S)

    def _accept(self, sample: zenoh.Sample) -> None:
        """Deliver a sample, or hold it until those of its publisher that should have come before are fetched."""
        if sample.kind != zenoh.SampleKind.PUT:
            return
        if sample.source_info is None:
            self._deliver(sample)
            return
        key = str(sample.key_expr)
        parsed = parse_key(key)
        newest_only = parsed is None or parsed[0].latest_only
        with self._lock:
            gap = self._sequence.accept(
                _source(sample), _number(sample), key, sample, recover=self._history, newest_only=newest_only
            )
            # Whoever invents publishers with gaps must not have a thread for each.
            while gap is not None and len(self._fetching) >= MAX_FETCHING:
                gap = self._sequence.close(gap, [])
            if gap is not None:
                thread = threading.Thread(target=self._fill, args=(gap,), name=f"bus fetch {key}", daemon=True)
                self._fetching.add(thread)
                thread.start()

    def _fill(self, gap: Gap) -> None:
        """Fetch what is missing and go on, in a thread of its own: other publishers' samples do not wait for it."""
        try:
            due: Gap | None = gap
            while due is not None:
                found = self._fetch(due)
                with self._lock:
                    due = self._sequence.close(due, found)
        except Exception as error:
            if not self._stop.is_set():
                self._failures.report(f"bus fetch {gap.key}", error)
        finally:
            with self._lock:
                self._fetching.discard(threading.current_thread())

    def _fetch(self, gap: Gap) -> list[tuple[int, zenoh.Sample]]:
        """Return what its publisher still holds of a gap; what does not answer is asked again for a while."""
        zid, eid = gap.source
        # The number after the gap has come, so whoever answers holds it: with it, all there is has been said.
        after = gap.missing[-1] + 1
        selector = f"{gap.key}/@adv/pub/{zid}/{eid}/**?_sn={gap.missing[0]}..{after}"
        found: dict[int, zenoh.Sample] = {}
        for _ in range(FETCHES):
            found.update((_number(sample), sample) for sample in self._query(selector))
            if after in found or self._stop.wait(RETRY_S):
                break
        return list(found.items())

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


def _source(sample: zenoh.Sample) -> Source:
    info = sample.source_info
    return ("", 0) if info is None else (str(info.source_id.zid), info.source_id.eid)


def _number(sample: zenoh.Sample) -> int:
    info = sample.source_info
    return -1 if info is None else info.source_sn


def _held_order(sample: zenoh.Sample) -> tuple[bool, int, int]:
    return (*held_order(str(sample.key_expr), bytes(sample.payload)), _number(sample))


class ZenohWatch:
    """Who is alive, told to one handler. A process counts once, however often its token is reported."""

    missed = 0

    def __init__(self, session: zenoh.Session, delivery: Delivery[tuple[str, bool]], failures: FailureLatch) -> None:
        self._delivery = delivery
        self._processes: dict[str, set[str]] = {}
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(INTAKE)
        subscriber = session.liveliness().declare_subscriber(f"{ALIVE}/**", ring, history=True)
        self._intake = Intake("alive", subscriber, self._accept, failures)

    @property
    def dropped(self) -> int:
        """How many changes were dropped because the handler was too slow."""
        return self._delivery.dropped

    def close(self) -> None:
        """End the threads."""
        self._intake.close()
        self._delivery.close()

    def _accept(self, sample: zenoh.Sample) -> None:
        token = str(sample.key_expr).removeprefix(f"{ALIVE}/")
        name, _, process = token.rpartition("/")
        processes = self._processes.setdefault(name, set())
        before = bool(processes)
        if sample.kind == zenoh.SampleKind.PUT:
            processes.add(process)
        else:
            processes.discard(process)
        if not processes:
            del self._processes[name]
        if before != bool(processes):
            self._delivery.offer((name, bool(processes)))


class ZenohBus(Bus):
    """A Bus over Zenoh; get one from connect()."""

    def __init__(self, session: zenoh.Session, config: zenoh.Config, clock: Clock, cache_s: float) -> None:
        super().__init__(clock)
        self._session = session
        self._bulk = BulkLink(config)
        self._cache_s = cache_s
        self._tokens: list[zenoh.LivelinessToken] = []
        self._watchdog = Watchdog(session)
        # A thread that is still inside Zenoh when the interpreter ends aborts the process.
        atexit.register(self.close)

    def publisher(self, topic: Topic, *ids: str, max_rate_hz: float | None = None) -> Publisher:
        """Declare what is published on topic.key(*ids); max_rate_hz skips what comes sooner."""
        key, depth = topic.key(*ids), cache_depth(topic, self._cache_s)
        settings: dict[str, Any] = {
            "encoding": topic.encoding,
            "congestion_control": zenoh.CongestionControl.DROP,
            "priority": _PRIORITIES[topic.priority],
            "express": topic.express,
        }
        if not depth:
            self._bulk.open()

        def declare() -> zenoh.Publisher | zenoh.ext.AdvancedPublisher | None:
            if not depth:
                bulk = self._bulk.session
                return None if bulk is None else bulk.declare_publisher(key, **settings)
            return zenoh.ext.declare_advanced_publisher(
                self._session,
                key,
                cache=zenoh.ext.CacheConfig(depth),
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
                **settings,
            )

        wrapped = ZenohPublisher(declare, topic, key, RateCap(max_rate_hz, self.clock))
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
        atexit.unregister(self.close)
        self._watchdog.stop()
        self._session.close()  # type: ignore[no-untyped-call]
        self._watchdog.join()
        self._bulk.close()
