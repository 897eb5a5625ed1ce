"""`buddyline record`: record the bus into a dive log."""

from __future__ import annotations

import argparse
import logging
import shutil
import sys
import threading
import time
from collections import Counter, deque
from typing import TYPE_CHECKING, Final

from buddyline.protocol.digest import end_of
from buddyline.protocol.digest_check import Discrepancy
from buddyline.protocol.recorder import Recorder, RecordError
from buddyline.protocol.topics import DIGEST, EVERYTHING, parse_key
from buddyline.tools.authenticity import digest_check, report
from buddyline.tools.client import client_config
from buddyline.tools.filling import Filler
from buddyline.tools.live import LiveClient, follow
from buddyline.tools.newfile import check_new
from buddyline.tools.progress import terminal_size

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus
    from buddyline.protocol.envelope import Envelope

log = logging.getLogger(__name__)

# What is said at the end; a flood of it must not fill the memory.
MAX_FOUND: Final = 10_000
# How often what is recorded is said, on a terminal, and over how many of these looks rates are measured.
LOOK_S: Final = 0.5
RATE_LOOKS: Final = 8


def free_words(recorder: Recorder) -> str:
    """Return what the log's disk still takes, or why it takes nothing."""
    if recorder.error is not None:
        return f"not written: {recorder.error}"
    try:
        return f"{shutil.disk_usage(recorder.path.absolute().parent).free / 1e9:.1f} GB free"
    except OSError as error:
        return f"its disk cannot be reached: {error.strerror}"


def progress_words(then: Counter[str], now: Counter[str], seconds: float, free: str, width: int) -> str:
    """Return what has been recorded, what the disk still takes, and each topic's rate: as many as fit into width.

    then, now: messages of each topic, seconds apart. free: what the disk takes, in words.
    """
    total = f"{(now.total() - then.total()) / seconds:.0f} a second"
    words = f"{now.total()} messages, {free}, {total}"[: max(width - 1, 0)]
    for k, (name, count) in enumerate(now.most_common()):
        more = f"{', ' if k else ': '}{name} {(count - then[name]) / seconds:.0f}"
        if len(words + more) >= width:
            break
        words += more
    return words


def run(args: argparse.Namespace) -> int:
    """Record until stopped."""
    config = client_config(args)
    client = LiveClient("record", config, args.seconds)
    new = check_new(args.output, "a log is never overwritten, name another or remove it first")
    recorder = Recorder(new, metadata={"command": "record"})
    recording = Recording(recorder, None if config.tls is None else config.tls.ca)

    def record(bus: Bus) -> None:
        filler = Filler(bus, recording.fill, bus.clock.now_ns(), client.stop)
        recording.filler = filler
        subscription = follow(bus, EVERYTHING, client.refusals, recording.take, capacity=65536)
        filling = client.spawn("fill", filler.run)
        log.info("record: %s into %s; Ctrl-C ends", client.config.connect, args.output)
        looks = deque([(time.monotonic(), recording.counted())], RATE_LOOKS)
        while not client.stop.wait(LOOK_S):
            if recorder.ended and recorder.error is not None:
                client.fail("recorder", recorder.error)
            if sys.stderr.isatty():
                looks.append((time.monotonic(), recording.counted()))
                (then_s, then), (now_s, now) = looks[0], looks[-1]
                words = progress_words(then, now, now_s - then_s, free_words(recorder), terminal_size().columns)
                print(f"\r{words}\x1b[K", end="", file=sys.stderr, flush=True)
        if sys.stderr.isatty():
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
        bus.close()
        # The bus has taken its question back.
        filling.join()
        recording.dropped = subscription.dropped + subscription.missed

    try:
        status = client.run(record)
    finally:
        written = _close(recorder, client)
        if not recording.counts:
            # There is nothing in it, and the next recording may have its name.
            recorder.path.unlink(missing_ok=True)
    recording.report(args.output)
    dropped = recording.dropped + recorder.dropped
    nothing = "" if recording.counts else "; nothing came, so no log is left"
    print(
        f"{args.output}: {recording.counts.total()} messages, {dropped} dropped, {client.refusals.count} bad{nothing}",
        file=sys.stderr,
    )
    for name, count in sorted(recording.counts.items()):
        print(f"  {count:8d} {name}", file=sys.stderr)
    if not written:
        return 2
    return status if recording.counts else status or 1


def _close(recorder: Recorder, client: LiveClient) -> bool:
    """Write the log's end; return whether all of the log is on the disk, and say why if not."""
    try:
        recorder.close()
    except RecordError as error:
        if client.failure is None or client.failure[1] is not error:
            log.error("record: %s", error)
        return False
    return True


class Recording:
    """Writes messages, and compares them with the nodes' digests. Safe in the bus's thread and the filler's.

    authority: PEM file, whose nodes' signatures count; None: any. filler: asks for what is missing.
    """

    def __init__(self, recorder: Recorder, authority: str | None) -> None:
        self.counts: Counter[str] = Counter()
        self.dropped = 0
        self.filler: Filler | None = None
        self._recorder = recorder
        self._check = digest_check(authority, own=False)
        self._found: list[Discrepancy] = []
        self._lock = threading.Lock()

    def counted(self) -> Counter[str]:
        """Return how many messages of each topic have been recorded."""
        with self._lock:
            return self.counts.copy()

    def take(self, envelope: Envelope) -> None:
        """Record a message from the bus."""
        self.write(envelope.key, envelope.payload, envelope.time_ns)

    def fill(self, key: str, payload: bytes, time_ns: int) -> None:
        """Record what has come later: a digest, to be compared, or messages, of which the filler has done that."""
        if key.rpartition("/")[2] == end_of(DIGEST):
            self.write(key, payload, time_ns)
        else:
            self._record(key, payload, time_ns)

    def write(self, key: str, payload: bytes, time_ns: int) -> None:
        """Record a message, and compare it."""
        self._record(key, payload, time_ns)
        with self._lock:
            for one in self._check.add(key, payload, time_ns):
                if one.kind == "missing" and self.filler is not None:
                    self.filler.want(one)
                elif len(self._found) < MAX_FOUND:
                    self._found.append(one)
                    if one.kind == "altered":
                        log.warning("node %s: %s", one.node, one.words)

    def _record(self, key: str, payload: bytes, time_ns: int) -> None:
        parsed = parse_key(key)
        with self._lock:
            self.counts["" if parsed is None else parsed[0].name] += 1
        self._recorder.write(key, payload, time_ns)

    def report(self, name: str) -> None:
        """Say whether the recording is what the nodes wrote, and what was filled."""
        with self._lock:
            self._found += self._check.finish()
        if self.filler is not None:
            self._found += self.filler.open
            for node, count in sorted(self.filler.filled.items()):
                log.info("%s: node %s: %d messages came later, from its own log", name, node, count)
        report(name, self._check, self._found)
