"""Count the messages of the bus and the load of the processes, in memory that is bounded except for the triggers."""

from __future__ import annotations

import threading
from array import array
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.messages import Candidates, Rejected, RelativePose
from buddyline.protocol.topics import ATTITUDE, CANDIDATES, DEPTH, IMU, NODE_STATUS, POSE, REJECTED, parse_key
from buddyline.tools.client import ClientConfig
from buddyline.tools.live import follow, open_bus_within

COUNTED = (CANDIDATES, ATTITUDE, IMU, DEPTH, NODE_STATUS, POSE, REJECTED)
CONNECT_S = 20.0


@dataclass
class Stream:
    """One key's messages, told apart by their stamps, which its publisher makes in order; frames by seq, too."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = -1
    repeated: int = 0
    disordered: int = 0
    seq_gaps: int = 0
    next_seq: int | None = None

    def take(self, stamp_ns: int, seq: int | None = None) -> None:
        if stamp_ns <= self.last_ns:
            self.repeated += stamp_ns == self.last_ns
            self.disordered += stamp_ns < self.last_ns
            return
        self.first_ns = self.first_ns if self.count else stamp_ns
        self.last_ns = stamp_ns
        self.count += 1
        if seq is not None:
            self.seq_gaps += seq - (seq if self.next_seq is None else self.next_seq)
            self.next_seq = seq + 1


class Streams:
    """All keys' streams, and which triggers have an outcome."""

    def __init__(self) -> None:
        self.by_key: dict[str, Stream] = {}
        self.outcomes = array("q")
        self.triggers = array("q")

    def take(self, envelope: Envelope) -> None:
        message, seq = envelope.message, None
        if isinstance(message, Candidates):
            seq = message.seq
            self.triggers.append(message.trigger)
        elif isinstance(message, RelativePose | Rejected):
            self.outcomes.append(message.trigger)
        self.by_key.setdefault(envelope.key, Stream()).take(int(getattr(message, "stamp_ns")), seq)  # noqa: B009


class CountingViewer:
    """A client of the bus that counts all that it is sent; latencies: from exposure to pose, this minute's."""

    def __init__(self, endpoint: str) -> None:
        self.bus = open_bus_within(ClientConfig(connect=endpoint), CONNECT_S)
        self.streams = Streams()
        self.refusals = Refusals("viewer")
        self._latencies_ms: list[float] = []
        self._lock = threading.Lock()
        self._subscriptions = [
            follow(self.bus, topic.key_any(), self.refusals, self._take, capacity=65536) for topic in COUNTED
        ]

    @property
    def missed(self) -> int:
        return sum(subscription.missed + subscription.dropped for subscription in self._subscriptions)

    def _take(self, envelope: Envelope) -> None:
        with self._lock:
            self.streams.take(envelope)
            if isinstance(envelope.message, RelativePose):
                self._latencies_ms.append((envelope.time_ns - envelope.message.stamp_ns) / S_NS * 1e3)

    def counts(self) -> Counter[str]:
        with self._lock:
            return Counter({key: stream.count for key, stream in self.streams.by_key.items()})

    def latencies_ms(self) -> list[float]:
        """Return, and forget, what came since the last call, sorted."""
        with self._lock:
            taken, self._latencies_ms = sorted(self._latencies_ms), []
        return taken


def streams_of(log: Path) -> Streams:
    """Return what a log holds, in the order in which it was written."""
    streams = Streams()
    with DiveLogReader(log) as reader:
        for record in reader.records(lambda key: (p := parse_key(key)) is not None and p[0] in COUNTED):
            streams.take(record.open())
    return streams


def stamps_of(log: Path) -> dict[str, array[int]]:
    """Return the stamps of what a log holds, by key, sorted."""
    stamps: dict[str, array[int]] = {}
    with DiveLogReader(log) as reader:
        for record in reader.records():
            stamps.setdefault(record.key, array("q")).append(record.publish_time_ns)
    return {key: array("q", sorted(found)) for key, found in stamps.items()}
