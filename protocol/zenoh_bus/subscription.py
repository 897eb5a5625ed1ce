"""A subscription that passes on samples in order, each once, and fetches those that the link has lost."""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import zenoh
from buddyline.protocol.bus import OnArrival, Received, held_order, queue_of
from buddyline.protocol.clock import Clock
from buddyline.protocol.delivery import CLOSE_S, Delivery, FailureLatch, Repeats
from buddyline.protocol.held import open_page
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
# A question about a gap: on a full link it, and its answer, wait in the queues of modems.
FETCH_S: Final = 4.0
# Gaps that are fetched at a time, each in a thread: of one owner of keys (protocol.sequence), and of all. An owner's
# others wait: a link that lost a moment of a solver's outcomes lost those of many pairs.
MAX_OWNER_GAPS: Final = 8
MAX_GAPS: Final = 64
# Of an owner wait at most as many: 16 nodes form 120 pairs, each with four topics or fewer that are fetched.
MAX_OWNER_WAITING: Final = 512
# Queries for one gap.
FETCHES: Final = 16
# Pages of an answer that may wait: more than all that a publisher holds.
PAGES: Final = 8192
_ADV: Final = "/@adv/pub/"


class Arrived(NamedTuple):
    """A message as it has come, or as its publisher held it. number: None if its publisher does not count."""

    source: PublisherId
    number: int | None
    payload: bytes
    attachment: bytes
    encoding: str


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
        on_arrival: OnArrival | None = None,
    ) -> None:
        self._session = session
        self._on_arrival = on_arrival
        self._delivery = delivery
        self._limit = limit
        self._history = history
        self._clock = clock
        self._failures = failures
        self._lock = threading.Lock()
        self._joined = False
        self._sequence = SampleSequence[Arrived](self._deliver)
        self._repeats = Repeats(history=history)
        self._fetching: dict[threading.Thread, str] = {}
        self._unfilled: deque[Gap] = deque()
        self._stop = threading.Event()
        self._asking = zenoh.CancellationToken()
        subscribers = [(key_expr, self._take, self._declare(key_expr)) for key_expr in key_exprs]
        if history:
            beside = [f"{key_expr}/@adv/pub/**" for key_expr in key_exprs]
            subscribers += [(selector, self._take_heartbeat, self._declare(selector)) for selector in beside]
            held: list[Arrived] = []
            for selector in beside:
                oldest, found = self._query(selector)
                held += found
                for source, number in oldest.items():
                    self._sequence.begin(source, number)
            for arrived in sorted(held, key=_held_order):
                self._accept(arrived)
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

    @property
    def waiting(self) -> int:
        """Number of messages that wait for the handler."""
        return self._delivery.waiting

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
            if sample.kind == zenoh.SampleKind.PUT:
                self._accept(_arrived(sample))
            return True
        self._narrowing.watch()
        info = sample.source_info
        if info is not None:
            with self._lock:
                self._sequence.skip(_source(str(sample.key_expr), info), info.source_sn)
        return False

    def _take_heartbeat(self, sample: zenoh.Sample) -> bool:
        if self._limit.admits(str(sample.key_expr), len(sample.payload)):
            self._accept_heartbeat(sample)
            return True
        self._narrowing.watch()
        return False

    def _accept(self, arrived: Arrived) -> None:
        """Deliver a message, or hold it until the publisher's missing earlier messages are fetched."""
        self._note(arrived)
        if arrived.number is None:
            self._deliver(arrived)
            return
        source = arrived.source
        with self._lock:
            if arrived.attachment == COPY:
                self._sequence.accept_copy(source, arrived.number, arrived, size_bytes=len(arrived.payload))
                return
            gap = self._sequence.accept(
                source,
                arrived.number,
                arrived,
                size_bytes=len(arrived.payload),
                recover=self._history,
                newest_only=_newest_only(source.key),
            )
            self._start_filling(gap)

    def _accept_heartbeat(self, sample: zenoh.Sample) -> None:
        """Take a publisher's heartbeat: on its key with `/@adv/pub/ZID/EID/_`, its last number as four bytes."""
        source, payload = _publisher_at(str(sample.key_expr)), sample.payload.to_bytes()
        if sample.kind != zenoh.SampleKind.PUT or len(payload) != 4 or source is None:
            return
        with self._lock:
            last = int.from_bytes(payload, "little")
            self._start_filling(self._sequence.heartbeat(source, last, newest_only=_newest_only(source.key)))

    def _start_filling(self, gap: Gap | None) -> None:
        """Fetch a gap in a thread of its own, or once another of its owner is filled; the lock is held."""
        # By owner: a client that invents publishers with gaps takes no thread and no memory from another's.
        waiting = [one.source.owner for one in self._unfilled]
        while gap is not None and (
            len(self._fetching) >= MAX_GAPS or waiting.count(gap.source.owner) >= MAX_OWNER_WAITING
        ):
            gap = self._sequence.close(gap, [])
        if gap is not None and list(self._fetching.values()).count(gap.source.owner) >= MAX_OWNER_GAPS:
            self._unfilled.append(gap)
        elif gap is not None:
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
                owner = self._fetching.pop(threading.current_thread(), "")
                waiting = next((one for one in self._unfilled if one.source.owner == owner), None)
                if waiting is not None and not self._stop.is_set():
                    self._unfilled.remove(waiting)
                    self._start_filling(waiting)

    def _fetch(self, gap: Gap) -> list[tuple[int, Arrived]]:
        """Return the messages of a gap that its publisher still holds; ask again for some time for what is missing."""
        source = gap.source
        missing, found = set(gap.missing), dict[int, Arrived]()
        for _ in range(FETCHES):
            selector = f"{source.key}{_ADV}{source.zid}/{source.eid}/**?_sn={min(missing)}..{max(missing)}"
            oldest, answer = self._query(selector, FETCH_S)
            # An answer on another's key says nothing of this publisher.
            found.update((one.number, one) for one in answer if one.source == source and one.number is not None)
            missing = {number for number in missing if number not in found and number >= oldest.get(source, 0)}
            if not missing or self._stop.wait(RETRY_S):
                break
        for arrived in found.values():
            self._note(arrived)
        return list(found.items())

    def _note(self, arrived: Arrived) -> None:
        if self._on_arrival is not None:
            self._on_arrival(arrived.source.key, arrived.payload)

    def _query(self, selector: str, timeout_s: float = QUERY_S) -> tuple[dict[PublisherId, int], list[Arrived]]:
        """Return the numbers of the oldest messages that there are, by publisher, and the messages that they answer."""
        oldest: dict[PublisherId, int] = {}
        found: list[Arrived] = []
        for reply in self._session.get(
            selector,
            zenoh.handlers.FifoChannel(PAGES),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout_s,
            cancellation_token=self._asking,
        ):
            source = None if reply.ok is None else _publisher_at(str(reply.ok.key_expr))
            if reply.ok is None or source is None:
                continue
            with contextlib.suppress(ValueError):
                told, messages = open_page(reply.ok.payload.to_bytes())
                oldest[source] = max(told, oldest.get(source, 0))
                encoding = str(reply.ok.encoding)
                found += [
                    Arrived(source, one.number, one.payload, AGAIN if one.again else b"", encoding) for one in messages
                ]
        return oldest, found

    def _deliver(self, arrived: Arrived) -> None:
        key, payload = arrived.source.key, arrived.payload
        parsed, again = parse_key(key), arrived.attachment == AGAIN
        repeated = parsed is not None and parsed[0].repeated
        if repeated and not self._repeats.is_wanted(key, payload, arrived.source, again=again):
            return
        received = Received(key=key, payload=payload, receive_ns=self._clock.now_ns(), encoding=arrived.encoding)
        queue = queue_of(received.key, received.payload, received.receive_ns) if self._joined else ""
        is_last = self._limit.is_ahead(key)
        self._delivery.offer(received, len(received.payload), queue, arrived.source.owner, is_last=is_last)


def _arrived(sample: zenoh.Sample) -> Arrived:
    key, info = str(sample.key_expr), sample.source_info
    return Arrived(
        PublisherId(key, "", 0) if info is None else _source(key, info),
        None if info is None else info.source_sn,
        sample.payload.to_bytes(),
        b"" if sample.attachment is None else sample.attachment.to_bytes(),
        str(sample.encoding),
    )


def _source(key: str, info: zenoh.SourceInfo) -> PublisherId:
    return PublisherId(key, str(info.source_id.zid), info.source_id.eid)


def _publisher_at(key: str) -> PublisherId | None:
    """Return the publisher whose heartbeats and answers have this key; None if it is not such a key."""
    of, _, rest = key.partition(_ADV)
    chunks = rest.split("/")
    return PublisherId(of, chunks[0], int(chunks[1])) if len(chunks) > 1 and chunks[1].isdecimal() else None


def _newest_only(key: str) -> bool:
    """Tell whether of a key only the newest message counts."""
    parsed = parse_key(key)
    return parsed is None or parsed[0].latest_only


def _held_order(arrived: Arrived) -> tuple[bool, int, int]:
    return (*held_order(arrived.source.key, arrived.payload), arrived.number or 0)
