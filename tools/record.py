"""`buddyline record`: record the bus into a dive log."""

from __future__ import annotations

import argparse
import logging
import sys
from collections import Counter
from typing import TYPE_CHECKING

from buddyline.protocol.recorder import Recorder
from buddyline.protocol.topics import EVERYTHING
from buddyline.tools.client import client_config
from buddyline.tools.live import LiveClient, follow

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus
    from buddyline.protocol.envelope import Envelope

log = logging.getLogger(__name__)


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
            while not client.stop.wait(0.5):
                if recorder.error is not None:
                    client.fail("recorder", recorder.error)
                if sys.stderr.isatty():
                    print(f"\r{sum(counts.values())} messages", end="\x1b[K", file=sys.stderr, flush=True)
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
