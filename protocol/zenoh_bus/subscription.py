"""A subscription that passes on samples in order, each once, and fetches those that the link has lost."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from typing import Final

import zenoh
import zenoh.ext
from buddyline.protocol.bus import Received, held_order
from buddyline.protocol.clock import Clock
from buddyline.protocol.delivery import CLOSE_S, Delivery, FailureLatch
from buddyline.protocol.sequence import Gap, Source
from buddyline.protocol.sequence import Sequence as Numbers
from buddyline.protocol.topics import parse_key
from buddyline.protocol.zenoh_bus.intake import INTAKE, AnySubscriber, Intake
from buddyline.protocol.zenoh_bus.session import RETRY_S

QUERY_S: Final = 2.0
MAX_FETCHING: Final = 16
FETCHES: Final = 16


class ZenohSubscription:
    """A Subscription over Zenoh: samples in order, each once; missing ones are fetched if their publisher has them.

    Zenoh's own recovery does most of this. It does not cover a publisher whose first samples were missed, or a gap
    whose query was lost with the link, for example when the hub was frozen for longer than the lease.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key_exprs: Sequence[str],
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
        self._sequence = Numbers(self._deliver)
        self._fetching: set[threading.Thread] = set()
        self._stop = threading.Event()
        subscribers = [self._declare(key_expr) for key_expr in key_exprs]
        if history:
            held = [sample for key_expr in key_exprs for sample in self._query(f"{key_expr}/@adv/pub/**")]
            for sample in sorted(held, key=_number):
                self._sequence.begin(_source(sample), _number(sample))
            for sample in sorted(held, key=_held_order):
                self._accept(sample)
        self._intakes = [
            Intake(key_expr, subscriber, self._accept, failures)
            for key_expr, subscriber in zip(key_exprs, subscribers, strict=True)
        ]

    def _declare(self, key_expr: str) -> AnySubscriber:
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(INTAKE)
        if not self._history:
            return self._session.declare_subscriber(key_expr, ring)
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True, periodic_queries=None)
        return zenoh.ext.declare_advanced_subscriber(self._session, key_expr, ring, recovery=recovery)

    @property
    def dropped(self) -> int:
        """Number of messages dropped because the handler was too slow."""
        return self._delivery.dropped

    @property
    def missed(self) -> int:
        """Number of messages that were lost on the way."""
        return self._sequence.missed

    def close(self) -> None:
        """Let the handler finish the queued messages, for one second at most, and end the threads."""
        self._stop.set()
        for intake in self._intakes:
            intake.close()
        self._delivery.close()
        with self._lock:
            threads = list(self._fetching)
        for thread in threads:
            thread.join(CLOSE_S)

    def _accept(self, sample: zenoh.Sample) -> None:
        """Deliver a sample, or hold it until the publisher's missing earlier samples are fetched."""
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
            # Limited, so that a client that invents publishers with gaps does not cost a thread for each.
            while gap is not None and len(self._fetching) >= MAX_FETCHING:
                gap = self._sequence.close(gap, [])
            if gap is not None:
                thread = threading.Thread(target=self._fill, args=(gap,), name=f"bus fetch {key}", daemon=True)
                self._fetching.add(thread)
                thread.start()

    def _fill(self, gap: Gap) -> None:
        """Fetch the missing samples and continue; runs in its own thread, so that other publishers do not wait."""
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
        """Return the samples of a gap that its publisher still holds; ask again for some time if it does not answer."""
        zid, eid = gap.source
        # The sample after the gap has arrived, so the publisher has it: an answer that contains it is complete.
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
