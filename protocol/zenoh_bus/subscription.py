"""A subscription that passes on samples in order, each once, and fetches those that the link has lost."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Final

import zenoh
from buddyline.protocol.bus import Received, held_order, queue_of
from buddyline.protocol.clock import Clock
from buddyline.protocol.delivery import CLOSE_S, Delivery, FailureLatch, Repeats
from buddyline.protocol.rate_limit import RateLimit
from buddyline.protocol.sequence import Gap, PublisherId, SampleSequence
from buddyline.protocol.topics import parse_key
from buddyline.protocol.zenoh_bus.alive import ALIVE
from buddyline.protocol.zenoh_bus.intake import INTAKE, Intake, RingSubscriber
from buddyline.protocol.zenoh_bus.narrowing import Narrowing
from buddyline.protocol.zenoh_bus.session import RETRY_S

# Attachments of a sample. Of a copy the original comes by the reliable connection; what is sent again was sent by an
# earlier publisher of its key.
COPY: Final = b"copy"
AGAIN: Final = b"again"
QUERY_S: Final = 2.0
# Gaps that are fetched at a time, each in a thread: of one owner of keys (protocol.sequence), and of all.
MAX_OWNER_GAPS: Final = 8
MAX_GAPS: Final = 64
# Queries for one gap.
FETCHES: Final = 16


class ZenohSubscription:
    """A Subscription over Zenoh: samples in order, each once; missing ones are fetched if their publisher has them.

    A gap shows by a later sample, or by the publisher's heartbeat, which tells its last number. Zenoh's own advanced
    subscriber is not used: it knows a publisher by the id that a sample states, which any client may state, and it does
    not cover a publisher whose first samples were missed, or a gap whose query was lost with the link.
    """

    def __init__(
        self,
        session: zenoh.Session,
        key_exprs: Sequence[str],
        delivery: Delivery[Received],
        limit: RateLimit,
        *,
        history: bool,
        clock: Clock,
        failures: FailureLatch,
    ) -> None:
        self._session = session
        self._delivery = delivery
        self._limit = limit
        self._history = history
        self._clock = clock
        self._failures = failures
        self._lock = threading.Lock()
        self._joined = False
        self._sequence = SampleSequence(self._deliver)
        self._repeats = Repeats(history=history)
        self._fetching: dict[threading.Thread, str] = {}
        self._stop = threading.Event()
        self._asking = zenoh.CancellationToken()
        subscribers = [(key_expr, self._take, self._declare(key_expr)) for key_expr in key_exprs]
        if history:
            beside = [f"{key_expr}/@adv/pub/**" for key_expr in key_exprs]
            subscribers += [(selector, self._take_heartbeat, self._declare(selector)) for selector in beside]
            held = [sample for selector in beside for sample in self._query(selector)]
            for sample in sorted(held, key=_number):
                self._sequence.begin(_source(sample), _number(sample))
            for sample in sorted(held, key=_held_order):
                self._accept(sample)
        wanted = [(key_expr, accept) for key_expr, accept, _ in subscribers]
        self._narrowing = Narrowing(wanted, self._intake, limit, self._present, failures)
        # What was held goes first, in its own order.
        self._joined = True
        self._narrowing.begin(
            [Intake(key_expr, subscriber, accept, failures) for key_expr, accept, subscriber in subscribers]
        )

    def _intake(self, key_expr: str, accept: Callable[[zenoh.Sample], bool]) -> Intake:
        return Intake(key_expr, self._declare(key_expr), accept, self._failures)

    def _present(self) -> set[str]:
        """Return the owners of the keys of the nodes on the bus."""
        try:
            asked = self._session.liveliness().get(
                f"{ALIVE}/node/*/*", timeout=QUERY_S, cancellation_token=self._asking
            )
            replies = list(asked)
        except zenoh.ZError:
            return set()
        tokens = [str(reply.ok.key_expr).split("/") for reply in replies if reply.ok is not None]
        return {f"buddyline/node/{token[-2]}" for token in tokens}

    def _declare(self, key_expr: str) -> RingSubscriber:
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(INTAKE)
        return self._session.declare_subscriber(key_expr, ring)

    @property
    def dropped(self) -> int:
        """Number of messages dropped because the handler was too slow, or that were more than their topic's rate."""
        return self._delivery.dropped + sum(self._limit.dropped.values())

    @property
    def missed(self) -> int:
        """Number of messages that were lost on the way."""
        return self._sequence.missed

    def close(self) -> None:
        """Let the handler finish the queued messages, for one second at most, and end the threads."""
        self._stop.set()
        # A hub that stands still answers nothing.
        self._asking.cancel()  # type: ignore[no-untyped-call]
        self._narrowing.close()
        self._delivery.close()
        with self._lock:
            threads = list(self._fetching)
        for thread in threads:
            thread.join(CLOSE_S)

    def _take(self, sample: zenoh.Sample) -> bool:
        """Accept a sample that has come just now; return False if there are too many of its key."""
        if self._limit.admits(str(sample.key_expr), len(sample.payload)):
            self._accept(sample)
            return True
        self._narrowing.watch()
        if sample.source_info is not None:
            with self._lock:
                self._sequence.skip(_source(sample), _number(sample))
        return False

    def _take_heartbeat(self, sample: zenoh.Sample) -> bool:
        if self._limit.admits(str(sample.key_expr), len(sample.payload)):
            self._accept_heartbeat(sample)
            return True
        self._narrowing.watch()
        return False

    def _accept(self, sample: zenoh.Sample) -> None:
        """Deliver a sample, or hold it until the publisher's missing earlier samples are fetched."""
        if sample.kind != zenoh.SampleKind.PUT:
            return
        if sample.source_info is None:
            self._deliver(sample)
            return
        source = _source(sample)
        with self._lock:
            if _attachment(sample) == COPY:
                self._sequence.accept_copy(source, _number(sample), sample)
                return
            gap = self._sequence.accept(
                source,
                _number(sample),
                sample,
                size_bytes=len(sample.payload),
                recover=self._history,
                newest_only=_newest_only(source.key),
            )
            self._start_filling(gap)

    def _accept_heartbeat(self, sample: zenoh.Sample) -> None:
        """Take a publisher's heartbeat: on its key with `/@adv/pub/ZID/EID/_`, its last number as four bytes."""
        key, _, rest = str(sample.key_expr).partition("/@adv/pub/")
        chunks, payload = rest.split("/"), sample.payload.to_bytes()
        if sample.kind != zenoh.SampleKind.PUT or len(payload) != 4 or len(chunks) < 2 or not chunks[1].isdecimal():
            return
        source = PublisherId(key, chunks[0], int(chunks[1]))
        with self._lock:
            last = int.from_bytes(payload, "little")
            self._start_filling(self._sequence.heartbeat(source, last, newest_only=_newest_only(key)))

    def _start_filling(self, gap: Gap | None) -> None:
        """Fetch a gap in a thread of its own; the lock is held."""
        # Limited by owner: a client that invents publishers with gaps takes no thread from another's.
        while gap is not None and (
            list(self._fetching.values()).count(gap.source.owner) >= MAX_OWNER_GAPS or len(self._fetching) >= MAX_GAPS
        ):
            gap = self._sequence.close(gap, [])
        if gap is not None:
            thread = threading.Thread(target=self._fill, args=(gap,), name=f"bus fetch {gap.source.key}", daemon=True)
            self._fetching[thread] = gap.source.owner
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
                self._failures.report(f"bus fetch {gap.source.key}", error)
        finally:
            with self._lock:
                self._fetching.pop(threading.current_thread(), None)

    def _fetch(self, gap: Gap) -> list[tuple[int, zenoh.Sample]]:
        """Return the samples of a gap that its publisher still holds; ask again for some time if it does not answer."""
        # The gap's last sample, or the one after it, has been heard of: an answer that contains one is complete.
        last = gap.missing[-1]
        source = gap.source
        selector = f"{source.key}/@adv/pub/{source.zid}/{source.eid}/**?_sn={gap.missing[0]}..{last + 1}"
        found: dict[int, zenoh.Sample] = {}
        for _ in range(FETCHES):
            # An answer may come from anybody who may answer on this key, and say any source.
            found.update((_number(sample), sample) for sample in self._query(selector) if _source(sample) == source)
            if last in found or last + 1 in found or self._stop.wait(RETRY_S):
                break
        return list(found.items())

    def _query(self, selector: str) -> Iterator[zenoh.Sample]:
        for reply in self._session.get(
            selector,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=QUERY_S,
            cancellation_token=self._asking,
        ):
            if reply.ok is not None and reply.ok.source_info is not None:
                yield reply.ok

    def _deliver(self, sample: zenoh.Sample) -> None:
        key, payload = str(sample.key_expr), bytes(sample.payload)
        parsed, again = parse_key(key), _attachment(sample) == AGAIN
        repeated = parsed is not None and parsed[0].repeated
        if repeated and not self._repeats.is_wanted(key, payload, _source(sample), again=again):
            return
        received = Received(
            key=key,
            payload=payload,
            receive_ns=self._clock.now_ns(),
            encoding=str(sample.encoding),
        )
        queue = queue_of(received.key, received.payload, received.receive_ns) if self._joined else ""
        self._delivery.offer(received, len(received.payload), queue)


def _source(sample: zenoh.Sample) -> PublisherId:
    key, info = str(sample.key_expr), sample.source_info
    return PublisherId(key, "", 0) if info is None else PublisherId(key, str(info.source_id.zid), info.source_id.eid)


def _attachment(sample: zenoh.Sample) -> bytes:
    return b"" if sample.attachment is None else sample.attachment.to_bytes()


def _newest_only(key: str) -> bool:
    """Tell whether of a key only the newest message counts."""
    parsed = parse_key(key)
    return parsed is None or parsed[0].latest_only


def _number(sample: zenoh.Sample) -> int:
    info = sample.source_info
    return -1 if info is None else info.source_sn


def _held_order(sample: zenoh.Sample) -> tuple[bool, int, int]:
    return (*held_order(str(sample.key_expr), bytes(sample.payload)), _number(sample))
