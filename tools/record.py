"""`buddyline record`: the bus into a dive log."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections import Counter
from typing import TYPE_CHECKING

from buddyline.protocol.envelope import Refusals
from buddyline.protocol.recorder import Recorder
from buddyline.protocol.service import Service
from buddyline.protocol.topics import EVERYTHING
from buddyline.tools.client import add_client_arguments, client_config

if TYPE_CHECKING:
    from buddyline.protocol.bus import Received

log = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("output", metavar="OUT.mcap")
    add_client_arguments(parser)
    parser.add_argument("--seconds", type=float, metavar="S", help="stop after this long; default: at Ctrl-C")


class BusRecorder:
    """Writes every sound message of ours that it is handed; counts them by topic."""

    def __init__(self, recorder: Recorder) -> None:
        self.counts: Counter[str] = Counter()
        self.refusals = Refusals("record")
        self._recorder = recorder

    def receive(self, received: Received) -> None:
        """Record one message; one that is not sound is counted, and said."""
        envelope = self.refusals.open(received)
        if envelope is None:
            return
        self.counts[envelope.topic.name] += 1
        self._recorder.write(received.key, received.payload, received.receive_ns)


def run(args: argparse.Namespace) -> int:
    """Record until stopped."""
    from buddyline.protocol.zenoh_bus import connect

    config = client_config(args)
    service = Service("record")
    service.handle_signals()
    with Recorder(args.output, metadata={"command": "record"}) as recorder:
        sink = BusRecorder(recorder)
        bus = connect(
            config.connect,
            namespace=config.namespace or None,
            stop=service.stop,
            on_wait=lambda text: log.info("record: %s", text),
            tls=config.tls,
        )
        if bus is None:
            return service.join()
        with bus:
            bus.on_failure(lambda error: service.fail("bus", error))
            subscriber = bus.subscribe(EVERYTHING, sink.receive, capacity=65536)
            log.info("record: %s into %s; Ctrl-C ends", config.connect, args.output)
            began_s = time.monotonic()
            while not service.stop.wait(0.5):
                if args.seconds is not None and time.monotonic() - began_s >= args.seconds:
                    break
                if recorder.error is not None:
                    service.fail("recorder", recorder.error)
                if sys.stderr.isatty():
                    print(f"\r{sum(sink.counts.values())} messages", end="\x1b[K", file=sys.stderr, flush=True)
        lost = subscriber.dropped + recorder.dropped
    total = sum(sink.counts.values())
    print(f"{args.output}: {total} messages, {lost} dropped, {sink.refusals.count} bad", file=sys.stderr)
    for name, count in sorted(sink.counts.items()):
        print(f"  {count:8d} {name}", file=sys.stderr)
    return service.join()
