"""What comes over the bus and what the processes take, counted as it goes, in bounded memory but for the triggers."""

from __future__ import annotations

import os
import threading
from array import array
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from buddyline.protocol.bus import Received
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import decode, payload_stamp_ns
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.messages import Candidates, RelativePose
from buddyline.protocol.topics import ATTITUDE, CANDIDATES, DEPTH, IMU, NODE_STATUS, POSE, REJECTED, Topic, parse_key
from buddyline.protocol.zenoh_bus import connect

COUNTED = (CANDIDATES, ATTITUDE, IMU, DEPTH, NODE_STATUS, POSE, REJECTED)
PAGE = os.sysconf("SC_PAGE_SIZE")
TICKS = os.sysconf("SC_CLK_TCK")


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

    def take(self, key: str, topic: Topic, payload: bytes) -> None:
        stamp_ns, seq = payload_stamp_ns(payload) or 0, None
        if topic is CANDIDATES:
            frame = decode(payload, Candidates)
            seq = frame.seq
            self.triggers.append(frame.trigger)
        elif topic in (POSE, REJECTED):
            self.outcomes.append(decode(payload, topic.schema).trigger)
        self.by_key.setdefault(key, Stream()).take(stamp_ns, seq)


class Viewer:
    """A client of the bus that counts all that it is sent; latencies: from exposure to pose, this minute's."""

    def __init__(self, endpoint: str) -> None:
        bus = connect(endpoint, stop=threading.Event(), on_wait=lambda _: None)
        assert bus is not None
        self.bus = bus
        self.streams = Streams()
        self._latencies_ms: list[float] = []
        self._lock = threading.Lock()
        self._subscriptions = [bus.subscribe(topic.key_any(), self._receive, capacity=65536) for topic in COUNTED]

    @property
    def missed(self) -> int:
        return sum(subscription.missed + subscription.dropped for subscription in self._subscriptions)

    def _receive(self, received: Received) -> None:
        parsed = parse_key(received.key)
        assert parsed is not None
        with self._lock:
            self.streams.take(received.key, parsed[0], received.payload)
            if parsed[0] is POSE:
                pose = decode(received.payload, RelativePose)
                self._latencies_ms.append((received.receive_ns - pose.stamp_ns) / S_NS * 1e3)

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
    topics = {topic.name for topic in COUNTED}
    with DiveLogReader(log) as reader:
        for record in reader.records(lambda key: (p := parse_key(key)) is not None and p[0].name in topics):
            parsed = parse_key(record.key)
            assert parsed is not None
            streams.take(record.key, parsed[0], record.payload)
    return streams


def stamps_of(log: Path) -> dict[str, array[int]]:
    """Return the stamps of what a log holds, by key, sorted."""
    stamps: dict[str, array[int]] = {}
    with DiveLogReader(log) as reader:
        for record in reader.records():
            stamps.setdefault(record.key, array("q")).append(record.publish_time_ns)
    return {key: array("q", sorted(found)) for key, found in stamps.items()}


@dataclass(frozen=True)
class Load:
    """What a process takes: resident memory, open files, processor time since its start."""

    rss_mb: float
    fds: int
    cpu_s: float


def load_of(pid: int) -> Load:
    process = Path(f"/proc/{pid}")
    fields = (process / "stat").read_text().rpartition(")")[2].split()
    return Load(
        rss_mb=int((process / "statm").read_text().split()[1]) * PAGE / 1e6,
        fds=len(os.listdir(process / "fd")),
        cpu_s=(int(fields[11]) + int(fields[12])) / TICKS,
    )
