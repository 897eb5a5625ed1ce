"""Stamps from before a node's clock was set, as the same clock would have given them afterwards.

A node says ClockSet when it follows a step of its machine's clock, so that a dive does not fall to pieces because a
cable was plugged in after it. Everything before that in the node's own log is moved onto the clock that the log ends
with; so are the messages of the node in other logs of the dive.
"""

from __future__ import annotations

import heapq
from bisect import bisect_right
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from buddyline.protocol.clock import S_NS, trigger_index
from buddyline.protocol.codec import encode
from buddyline.protocol.divelog import DiveLogReader, Record
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import (
    Candidates,
    ClockBeacon,
    ClockSet,
    CompressedImage,
    FoxgloveTime,
    Message,
    NodeInfo,
)
from buddyline.protocol.topics import CLOCK_SET, INFO, parse_key
from msgspec.structs import replace


@dataclass(frozen=True)
class Era:
    """The time from one setting of a clock to the next, by the stamps of then. shift_ns: to be added to them.

    first: sequence number, in the log that holds the settings, of the era's first message.
    """

    start_ns: int
    end_ns: int
    shift_ns: int
    first: int


@dataclass(frozen=True)
class _Log:
    """What is known of one log. node: whose own it is, so that its log times are of that clock; "" if of several.

    eras: of the nodes whose clock was set in it.
    """

    reader: DiveLogReader
    node: str
    eras: dict[str, list[Era]]


class ClockSets:
    """The eras of all nodes' clocks in some logs; none where no clock was set."""

    def __init__(self, readers: Iterable[DiveLogReader]) -> None:
        self._logs = {id(reader): _log_of(reader) for reader in readers}
        self._everyone: dict[str, list[Era]] = {}
        for one in self._logs.values():
            for node, eras in one.eras.items():
                self._everyone.setdefault(node, []).extend(eras)
        self._periods_ns = _periods_ns(self._logs.values()) if self._everyone else {}

    def span_ns(self, reader: DiveLogReader) -> tuple[int | None, int | None]:
        """Return the log times of a log's first and last message."""
        one, start_ns, end_ns = self._logs[id(reader)], reader.start_ns, reader.end_ns
        eras = one.eras.get(one.node) or self._everyone.get(one.node)
        if start_ns is None or end_ns is None or not eras:
            return start_ns, end_ns
        # Pictures are beside the log that has the eras, and are of a part of its time.
        within = [era for era in eras if era.start_ns <= end_ns and start_ns <= era.end_ns] or eras[-1:]
        return (
            min(max(start_ns, era.start_ns) + era.shift_ns for era in within),
            max(min(end_ns, era.end_ns) + era.shift_ns for era in within),
        )

    def envelopes(
        self,
        reader: DiveLogReader,
        wanted: Callable[[str], bool],
        since_ns: int | None,
        refuse: Callable[[str, MessageError], None],
    ) -> Iterator[Envelope]:
        """Yield a log's sound messages of the wanted keys by log time, on the clocks that the logs end with."""
        if not self._everyone:
            yield from (envelope for _, envelope in _opened(reader.records(wanted, since_ns), refuse))
            return
        one = self._logs[id(reader)]
        eras = self._everyone.get(one.node, [])
        # A clock that was set back says the same times twice: each era is read by itself.
        parts = [self._moved(one, wanted, refuse, era) for era in eras] or [self._moved(one, wanted, refuse)]
        for envelope in heapq.merge(*parts, key=lambda envelope: envelope.time_ns):
            if since_ns is None or envelope.time_ns >= since_ns:
                yield envelope

    def _moved(
        self,
        one: _Log,
        wanted: Callable[[str], bool],
        refuse: Callable[[str, MessageError], None],
        only: Era | None = None,
    ) -> Iterator[Envelope]:
        """Yield the messages, of one era of the log's own node alone or of all, with the stamps moved."""
        for record, envelope in _opened(one.reader.records(wanted), refuse):
            message = envelope.message
            if isinstance(message, ClockSet):
                continue
            node = envelope.node
            era = self._era(one, node, record.sequence, envelope.stamp_ns)
            if only is not None and era is not only:
                continue
            shift_ns = era.shift_ns if era else 0
            moved = self._with_beacon(moved_message(message, shift_ns, self._periods_ns.get(node)))
            time_ns = envelope.time_ns + (shift_ns if one.node else 0)
            if moved is message and time_ns == envelope.time_ns:
                yield envelope
            else:
                yield Envelope(envelope.key, envelope.topic, envelope.ids, moved, encode(moved), time_ns)

    def _era(self, one: _Log, node: str, sequence: int, stamp_ns: int) -> Era | None:
        own = one.eras.get(node)
        if own is not None:
            return next((era for era in reversed(own) if era.first <= sequence), own[0])
        return self._era_at(node, stamp_ns)

    def _era_at(self, node: str, stamp_ns: int) -> Era | None:
        """Return a node's era by a stamp alone, the later one where two have it; the nearest where none has."""
        eras = self._everyone.get(node)
        if not eras:
            return None
        return min(reversed(eras), key=lambda era: max(era.start_ns - stamp_ns, stamp_ns - era.end_ns, 0))

    def _with_beacon(self, message: Message) -> Message:
        """Return a beacon with the times at which the others sent theirs on their clocks' last eras."""
        if not isinstance(message, ClockBeacon):
            return message
        heard = []
        for one in message.heard:
            era = self._era_at(one.node, one.sent_ns)
            heard.append(replace(one, sent_ns=max(one.sent_ns + era.shift_ns, 0)) if era else one)
        return replace(message, heard=heard)


def moved_message(message: Message, shift_ns: int, trigger_period_ns: int | None = None) -> Message:
    """Return a message with its stamp moved, and what follows from the stamp."""
    if not shift_ns:
        return message
    if isinstance(message, CompressedImage):
        seconds, left_ns = divmod(max(message.stamp_ns + shift_ns, 0), S_NS)
        return replace(message, timestamp=FoxgloveTime(sec=seconds, nsec=left_ns))
    stamp_ns = max(getattr(message, "stamp_ns", 0) + shift_ns, 0)
    if isinstance(message, Candidates) and trigger_period_ns:
        return replace(message, stamp_ns=stamp_ns, trigger=trigger_index(stamp_ns, trigger_period_ns))
    if isinstance(message, ClockBeacon):
        heard = [replace(one, received_ns=max(one.received_ns + shift_ns, 0)) for one in message.heard]
        return replace(message, stamp_ns=stamp_ns, heard=heard)
    return replace(message, stamp_ns=stamp_ns)


def _log_of(reader: DiveLogReader) -> _Log:
    nodes = {ids[0] for topic, ids in filter(None, map(parse_key, reader.keys)) if topic.id_fields == ("node",)}
    node = reader.metadata().get("node", "")
    return _Log(reader, node if nodes == {node} else "", _eras(reader))


def _is_clock_set(key: str) -> bool:
    parsed = parse_key(key)
    return parsed is not None and parsed[0] is CLOCK_SET


def _eras(reader: DiveLogReader) -> dict[str, list[Era]]:
    """Return the eras of the clocks that were set in a log, by node."""
    if not any(map(_is_clock_set, reader.keys)):
        return {}
    found: dict[str, list[tuple[int, ClockSet]]] = {}
    for record, envelope in _opened(reader.records(_is_clock_set), lambda key, error: None):
        if isinstance(envelope.message, ClockSet):
            found.setdefault(envelope.message.node, []).append((record.sequence, envelope.message))
    return {node: _eras_of(reader, node, sorted(sets, key=lambda one: one[0])) for node, sets in found.items()}


def _eras_of(reader: DiveLogReader, node: str, sets: list[tuple[int, ClockSet]]) -> list[Era]:
    firsts = [0, *(sequence for sequence, _ in sets)]
    spans_ns: list[list[int]] = [[] for _ in firsts]
    for record in reader.records(lambda key: (parsed := parse_key(key)) is not None and node in parsed[1]):
        if record.sequence not in firsts[1:]:
            span_ns = spans_ns[bisect_right(firsts, record.sequence) - 1]
            stamps_ns = [*span_ns, record.publish_time_ns]
            span_ns[:] = min(stamps_ns), max(stamps_ns)
    eras, left_ns = [], sum(one.moved_ns for _, one in sets)
    for number, (first, span_ns) in enumerate(zip(firsts, spans_ns, strict=True)):
        if number:
            left_ns -= sets[number - 1][1].moved_ns
        if span_ns:
            eras.append(Era(span_ns[0], span_ns[1], left_ns, first))
    return eras


def _periods_ns(logs: Iterable[_Log]) -> dict[str, int]:
    found: dict[str, int] = {}
    for one in logs:
        records = one.reader.records(lambda key: (parsed := parse_key(key)) is not None and parsed[0] is INFO)
        for _, envelope in _opened(records, lambda key, error: None):
            if isinstance(envelope.message, NodeInfo):
                found.setdefault(envelope.message.node, envelope.message.trigger_period_ns)
    return found


def _opened(
    records: Iterable[Record], refuse: Callable[[str, MessageError], None]
) -> Iterator[tuple[Record, Envelope]]:
    for record in records:
        try:
            yield record, record.open()
        except MessageError as error:
            refuse(record.key, error)
