"""`buddyline record`: record the bus into a dive log."""

from __future__ import annotations

import argparse
import logging
import shutil
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.protocol.recorder import Recorder
from buddyline.protocol.topics import EVERYTHING
from buddyline.tools.client import client_config
from buddyline.tools.live import LiveClient, follow

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus
    from buddyline.protocol.envelope import Envelope

log = logging.getLogger(__name__)

# How often what is recorded is said, on a terminal.
LOOK_S: Final = 0.5


def progress_words(total: int, new: int, output: Path) -> str:
    """Return what has been recorded, how fast (new: since the last look), and what the disk still takes."""
    free = shutil.disk_usage(output.absolute().parent).free
    return f"{total} messages, {new / LOOK_S:.0f} a second, {free / 1e9:.1f} GB free"


def run(args: argparse.Namespace) -> int:
    """Record until stopped."""
    client = LiveClient("record", client_config(args), args.seconds)
    counts: Counter[str] = Counter()
    dropped = 0
    with Recorder(args.output, metadata={"command": "record"}) as recorder:

        def write(envelope: Envelope) -> None:
            counts[envelope.topic.name] += 1
            recorder.write(envelope.key, envelope.payload, envelope.time_ns)

        def record(bus: Bus) -> None:
            nonlocal dropped
            subscription = follow(bus, EVERYTHING, client.refusals, write, capacity=65536)
            log.info("record: %s into %s; Ctrl-C ends", client.config.connect, args.output)
            before = 0
            while not client.stop.wait(LOOK_S):
                if recorder.error is not None:
                    client.fail("recorder", recorder.error)
                if sys.stderr.isatty():
                    total = counts.total()
                    words = progress_words(total, total - before, Path(args.output))
                    print(f"\r{words}", end="\x1b[K", file=sys.stderr, flush=True)
                    before = total
            bus.close()
            dropped = subscription.dropped

        status = client.run(record)
    dropped += recorder.dropped
    print(
        f"{args.output}: {sum(counts.values())} messages, {dropped} dropped, {client.refusals.count} bad",
        file=sys.stderr,
    )
    for name, count in sorted(counts.items()):
        print(f"  {count:8d} {name}", file=sys.stderr)
    return status
