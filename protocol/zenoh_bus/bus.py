"""The connection of one process to the hub: its publishers, subscriptions and liveliness tokens."""

from __future__ import annotations

import atexit
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Final

import zenoh
import zenoh.ext
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
)
from buddyline.protocol.clock import Clock, SystemClock
from buddyline.protocol.delivery import Delivery, RateCap
from buddyline.protocol.endpoint import DEFAULT_ENDPOINT
from buddyline.protocol.held import Held, HeldMessage
from buddyline.protocol.link_budget import LinkBudget
from buddyline.protocol.rate_limit import RateLimit
from buddyline.protocol.security import PLAYER, Tls
from buddyline.protocol.topics import Topic
from buddyline.protocol.zenoh_bus.alive import ALIVE, ZenohWatch
from buddyline.protocol.zenoh_bus.answers import AnswerDesk, ask
from buddyline.protocol.zenoh_bus.held_desk import HeldDesk
from buddyline.protocol.zenoh_bus.link import Bulk, Link
from buddyline.protocol.zenoh_bus.session import SecondLink, config_of, open_client
from buddyline.protocol.zenoh_bus.settings import client_settings
from buddyline.protocol.zenoh_bus.subscription import AGAIN, COPY, QUERY_S, ZenohSubscription
from buddyline.protocol.zenoh_bus.watchdog import Watchdog

HEARTBEAT_S: Final = 2.0
_PRIORITIES: Final = {
    "interactive_high": zenoh.Priority.INTERACTIVE_HIGH,
    "data_high": zenoh.Priority.DATA_HIGH,
    "data": zenoh.Priority.DATA,
    "data_low": zenoh.Priority.DATA_LOW,
    "background": zenoh.Priority.BACKGROUND,
}


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
    """Connect to the hub; wait until there is one. Returns None if stop is set before.

    on_wait is called once, with a text, if it has to wait. cache_s: the longest outage without loss.
    Raises RefusedError if the hub and this client do not accept each other.
    """
    config = config_of(client_settings(endpoint, namespace, tls))
    session = open_client(config, endpoint, tls, stop, on_wait)
    datagrams = config_of(client_settings(endpoint, namespace, tls, datagrams=True))
    return None if session is None else ZenohBus(session, config, datagrams, clock or SystemClock(), cache_s)


class ZenohPublisher(Publisher):
    """A Publisher over Zenoh. declare: declares it in its session; returns None while the session is not open.

    budget: decides what a slow link carries. hurry: is called after each message of a prompt topic, with what its copy
    says of its source.
    desk: answers those that missed a message, from the last `depth` of them (0: images, of which none is held), and
    those that come new, from the last `history_s`.
    answer_in: the session in which a plain `get` is answered with the last message; None: it is not answered here.
    """

    def __init__(
        self,
        declare: Callable[[], zenoh.Publisher | zenoh.ext.AdvancedPublisher | None],
        topic: Topic,
        key: str,
        cap: RateCap,
        budget: LinkBudget,
        hurry: Callable[[bytes, zenoh.SourceInfo], None],
        desk: HeldDesk,
        depth: int,
        history_s: float,
        answer_in: zenoh.Session | None = None,
    ) -> None:
        super().__init__(topic, key, cap)
        self._budget = budget
        self._hurry = hurry
        self._desk = desk
        self._held = Held(depth, history_s) if depth else None
        self._count = 0
        self._declare = declare
        self._last: bytes | None = None
        self._answers = None if answer_in is None else answer_in.declare_queryable(key, self._answer)
        # A publisher cannot be undeclared while another thread, such as a device's, is in its put.
        self._lock = threading.Lock()
        self._publisher = declare()
        self._held_key = ""
        if self._held is not None and self._publisher is not None:
            identity = self._publisher.id
            self._held_key = f"{key}/@adv/pub/{identity.zid}/{identity.eid}/_"
            desk.show(self._held_key, self._held, topic.encoding)

    def _send(self, payload: bytes, *, again: bool = False) -> bool:
        if not self._budget.admits(self.topic, len(payload), time.monotonic()):
            return False
        with self._lock:
            if self._closed:
                return False
            self._publisher = self._publisher or self._declare()
            if self._publisher is None:
                return False
            if self._held is not None:
                self._held.add(HeldMessage(self._count, payload, again), time.monotonic())
            self._publisher.put(payload, attachment=AGAIN if again else None)
            self._last = payload
            if self.topic.prompt:
                self._hurry(payload, zenoh.SourceInfo(self._publisher.id, self._count))
            self._count += 1
        return True

    def _answer(self, query: zenoh.Query) -> None:
        # Without the lock: `close` holds it while it waits for the answers that are under way.
        last = self._last
        if last is not None:
            query.reply(self.key, last, encoding=self.topic.encoding)

    def close(self) -> None:
        """Stop publishing and answering; the cache is dropped."""
        with self._lock:
            if not self._closed:
                self._closed = True
                self._desk.take_away(self._held_key)
                for declared in (self._publisher, self._answers):
                    if declared is not None:
                        declared.undeclare()  # type: ignore[no-untyped-call]


class ZenohBus(Bus):
    """A Bus over Zenoh; get one from connect()."""

    def __init__(
        self, session: zenoh.Session, config: zenoh.Config, datagrams: zenoh.Config, clock: Clock, cache_s: float
    ) -> None:
        super().__init__(clock)
        self._session = session
        self._bulk = SecondLink(config)
        self._datagrams = SecondLink(datagrams)
        self._cache_s = cache_s
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._answers: list[AnswerDesk] = []
        self._limits: list[RateLimit] = []
        # Processes that play stored dives, which may be faster than live ones.
        self._players: set[str] = set()
        session.liveliness().declare_subscriber(f"{ALIVE}/{PLAYER}/*", self._note_player, history=True)
        self._asking = zenoh.CancellationToken()
        self._budget = LinkBudget()
        self._link = Link(session, self._budget, Bulk(self._bulk))
        self._held = HeldDesk(session, lambda: self._budget if self._link.is_long else None, self._failures)
        self._watchdog = Watchdog(session, self._link)
        # A thread inside Zenoh at the interpreter's end aborts the process, so the bus closes before that.
        atexit.register(self.close)

    def publisher(self, topic: Topic, *ids: str, max_rate_hz: float | None = None) -> Publisher:
        """Return a publisher on topic.key(*ids). max_rate_hz: messages above this rate are skipped."""
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
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None),
                **settings,
            )

        # A lost copy would hold up those after it, so each goes a second time, in one datagram with the next.
        twice: deque[tuple[bytes, zenoh.SourceInfo]] = deque(maxlen=2)

        def hurry(payload: bytes, source: zenoh.SourceInfo) -> None:
            self._link.flush()
            twice.append((payload, source))
            size_bytes = sum(len(one) for one, _ in twice)
            if not self._link.is_long:
                return
            # Before there is need for it: on a full link that would take long.
            self._datagrams.open()
            datagrams = self._datagrams.session
            if datagrams is not None and self._budget.admits_copy(size_bytes, time.monotonic()):
                for one, of in twice:
                    datagrams.put(key, one, source_info=of, attachment=COPY, **settings | {"express": one is payload})

        # What the hub retains is answered by the hub.
        answer_in = self._session if topic.latest_only and not topic.retained else None
        cap = RateCap(max_rate_hz, self.clock)
        history_s = math.inf if topic.latest_only else self._cache_s
        wrapped = ZenohPublisher(declare, topic, key, cap, self._budget, hurry, self._held, depth, history_s, answer_in)
        with self._lock:
            self._publishers.append(wrapped)
        return wrapped

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
        key_exprs = each_of(keys)
        delivery = Delivery(f"bus {' '.join(key_exprs)}", handle, capacity, self._failures)
        limit = RateLimit(is_off=lambda: bool(self._players))
        subscription = ZenohSubscription(
            self._session,
            key_exprs,
            delivery,
            limit,
            history=history,
            clock=self.clock,
            failures=self._failures,
            on_arrival=on_arrival,
        )
        with self._lock:
            self._subscriptions.append(subscription)
            self._limits.append(limit)
        return subscription

    def newest(self, topic: Topic) -> list[Received]:
        """Return the newest message of each key of a retained topic."""
        replies = self._session.get(
            topic.key_any(),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=QUERY_S,
        )
        samples = [reply.ok for reply in replies if reply.ok is not None]
        now_ns = self.clock.now_ns()
        return [Received(str(s.key_expr), bytes(s.payload), now_ns, str(s.encoding)) for s in samples]

    def answer(self, key: str, reply: Callable[[str], Iterable[bytes]]) -> None:
        """Answer questions on key until the bus closes, with what the link has to spare."""
        answers = AnswerDesk(self._bulk, key, reply, self._budget, self._link.bulk.is_sent, self._failures)
        with self._lock:
            self._answers.append(answers)

    def ask(self, key: str, text: str, timeout_s: float) -> list[bytes]:
        """Ask a question on key; return what has come of the answer within this time, in its order."""
        return ask(self._session, key, text, timeout_s, self._asking)

    def declare_alive(self, name: str) -> None:
        """Show others that this process is alive, until it closes the bus or dies."""
        key = f"{ALIVE}/{check_alive_name(name)}/{self._session.zid()}"
        token = self._session.liveliness().declare_token(key)
        with self._lock:
            self._tokens[name] = token

    def withdraw_alive(self, name: str) -> None:
        """Take a declared name back."""
        with self._lock:
            token = self._tokens.pop(name)
        token.undeclare()  # type: ignore[no-untyped-call]

    @property
    def hub(self) -> str | None:
        """An id of the hub's process, to which this one is connected; None while it is cut off."""
        return next((str(router) for router in self._session.info.routers_zid()), None)

    def watch_alive(self, handle: Callable[[str, bool], None]) -> Subscription:
        """Call handle(name, alive) for every name that is alive now, and at every change."""
        delivery = Delivery[tuple[str, bool]]("bus alive", lambda item: handle(*item), 1024, self._failures)
        watch = ZenohWatch(self._session, delivery, self._failures)
        with self._lock:
            self._subscriptions.append(watch)
            self._limits.append(watch.limit)
        return watch

    def others_alive(self, name: str = "**") -> set[str]:
        """Return the names, all or this one, that other processes have declared, as the hub knows them now."""
        tokens_of = f"{ALIVE}/**" if name == "**" else f"{ALIVE}/{check_alive_name(name)}/*"
        replies = self._session.liveliness().get(tokens_of, timeout=QUERY_S)
        tokens = [str(reply.ok.key_expr).removeprefix(f"{ALIVE}/") for reply in replies if reply.ok is not None]
        own = str(self._session.zid())
        return {alive for alive, _, process in (token.rpartition("/") for token in tokens) if process != own}

    def close(self) -> None:
        """Close publishers and subscriptions and leave the bus; a second call does nothing."""
        self._asking.cancel()  # type: ignore[no-untyped-call]
        super().close()

    @property
    def shed(self) -> dict[str, int]:
        """How many messages of each topic a slow link has left out."""
        return dict(self._budget.shed)

    def link_problem(self) -> str:
        """Return what the link leaves out, for people; "" if nothing."""
        return self._budget.words(time.monotonic())

    def flood_problem(self) -> str:
        """Return who sends more than this process takes, for people; "" if nobody."""
        return max((limit.problem() for limit in list(self._limits)), key=len, default="")

    def _note_player(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            self._players.add(str(sample.key_expr))
        else:
            self._players.discard(str(sample.key_expr))

    def _leave(self) -> None:
        atexit.unregister(self.close)
        for answers in self._answers:
            answers.close()
        self._held.close()
        self._link.stop()
        self._watchdog.stop()
        self._session.close()  # type: ignore[no-untyped-call]
        self._watchdog.join()
        self._link.join()
        self._bulk.close()
        self._datagrams.close()
