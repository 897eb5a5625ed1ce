"""Two nodes behind one poor tether: what of their logs arrives topside, and when. Needs root.

python -m tests.faults.poor --seconds 60
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import payload_stamp_ns
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.log_pages import GrowingLog
from buddyline.protocol.topics import parse_key
from buddyline.tools.measure.tables import markdown_table
from numpy.typing import NDArray

from tests.faults.shaper import PoorLink, Tether, poor_link
from tests.faults.system import System

RATE_HZ = 5.0
IN_TIME_S = 1.0
# The link and the estimates of it need this long to settle, and the last messages to arrive.
SETTLE_S = 8.0
ARRIVE_S = 3.0
QUANTILES = (0.05, 0.5, 0.9, 0.99)
HEAD = ("node", "topic", "logged", "arrived", f"within {IN_TIME_S:g} s", "delay 5 % s", "median", "90 %", "99 %")

Times = dict[str, dict[int, int]]  # by topic: receive time (ns) by stamp (ns)


def times(paths: Iterable[Path]) -> dict[str, Times]:
    """Return each node's messages in these logs."""
    found: dict[str, Times] = defaultdict(lambda: defaultdict(dict))
    for path in paths:
        with DiveLogReader(path) as reader:
            for record in reader.records():
                parsed = parse_key(record.key)
                if parsed is not None and len(parsed[1]) == 1:
                    found[parsed[1][0]][parsed[0].name].setdefault(record.publish_time_ns, record.log_time_ns)
    return found


def arrived(directory: Path) -> dict[str, Times]:
    """Return what is in the recording, which is still being written."""
    found: dict[str, Times] = defaultdict(lambda: defaultdict(dict))
    for logged in GrowingLog(directory / "recorder.mcap").messages(0, 2**63, lambda _: True):
        parsed, stamp_ns = parse_key(logged.key), payload_stamp_ns(logged.payload)
        if parsed is not None and len(parsed[1]) == 1 and stamp_ns is not None:
            found[parsed[1][0]][parsed[0].name].setdefault(stamp_ns, logged.time_ns)
    return found


def missing(nodes: dict[str, Times], topside: dict[str, Times]) -> int:
    """Return how many of the nodes' messages are not topside."""
    return sum(
        len(logged.keys() - topside[node][name].keys())
        for node, topics in nodes.items()
        for name, logged in topics.items()
    )


def rest(system: System, tether: Tether, nodes: dict[str, Times], seconds: float, leave: int = 0) -> float:
    """Start the nodes again as they lie on deck, without sensors; return how long it took to fill the recording, s.

    leave: so many messages may still be missing.
    """
    system.node |= {"rate_hz": 1.0, "sensors": "none"}
    for name in ("a", "b"):
        system.spawn(name, namespace=tether.namespace)
    begin_s = time.monotonic()
    while (left := missing(nodes, arrived(system.directory))) > leave and time.monotonic() - begin_s < seconds:
        print(f"{time.monotonic() - begin_s:.0f} s: {left} are missing", file=sys.stderr)
        time.sleep(2.0)
    return time.monotonic() - begin_s


@dataclass(frozen=True)
class TopicArrivals:
    """What of a node's messages of a topic has arrived. delays_s: of those that have."""

    node: str
    topic: str
    logged: int
    delays_s: NDArray[np.float64]

    @property
    def arrived(self) -> float:
        """The share that has arrived."""
        return len(self.delays_s) / self.logged

    @property
    def in_time(self) -> float:
        """The share that has arrived within IN_TIME_S."""
        return float(np.count_nonzero(self.delays_s <= IN_TIME_S)) / self.logged

    def cells(self) -> list[object]:
        """Return the row of the table."""
        quantiles = [f"{np.quantile(self.delays_s, q):.2f}" if len(self.delays_s) else "-" for q in QUANTILES]
        return [self.node, self.topic, self.logged, f"{self.arrived:.1%}", f"{self.in_time:.1%}", *quantiles]


def rows(nodes: dict[str, Times], topside: dict[str, Times]) -> list[TopicArrivals]:
    """Compare the logs, each node's and topic's, without the edges."""
    since_ns = max(min(at for logged in topics.values() for at in logged.values()) for topics in nodes.values())
    until_ns = min(max(at for logged in topics.values() for at in logged.values()) for topics in nodes.values())
    since_ns, until_ns = since_ns + round(SETTLE_S * S_NS), until_ns - round(ARRIVE_S * S_NS)
    found = []
    for node, topics in sorted(nodes.items()):
        for name, logged in sorted(topics.items()):
            sent = [stamp_ns for stamp_ns, at_ns in logged.items() if since_ns <= at_ns < until_ns]
            came = topside[node][name]
            delays_s = np.array([(came[one] - logged[one]) / S_NS for one in sent if one in came])
            if sent:
                found.append(TopicArrivals(node, name, len(sent), delays_s))
    return found


def carried() -> int:
    """Return how many bytes have come up the link."""
    return int(Path("/sys/class/net/buddyline0/statistics/rx_bytes").read_text())


@contextmanager
def tethered(directory: Path, tether: Tether) -> Iterator[System]:
    """Hub, solver and recorder here, and two nodes that have connected from the namespace."""
    endpoint = f"tcp/{tether.host}:17448"
    with System(directory, RATE_HZ, endpoint, devices="repeating", node_module="tests.soak.node") as system:
        system.start("hub", "solver", "recorder")
        for name in ("a", "b"):
            system.spawn(name, namespace=tether.namespace)
        for name in ("a", "b"):
            system.processes[name].wait_for("connected")
        yield system


def main() -> int:
    """Run; print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.poor", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--after", type=float, default=120.0, help="longest time to fill the recording afterwards")
    parser.add_argument("--rate-bps", type=float, default=PoorLink.rate_bps)
    parser.add_argument("--congestion", help="the nodes' TCP congestion control; default: the system's")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="where the logs stay")
    args = parser.parse_args()
    # A SIGTERM also ends the processes that were started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with tempfile.TemporaryDirectory() as temporary, poor_link(PoorLink(rate_bps=args.rate_bps)) as tether:
        if args.congestion:
            words = ["sysctl", "-q", "-w", f"net.ipv4.tcp_congestion_control={args.congestion}"]
            subprocess.run(["ip", "netns", "exec", tether.namespace, *words], check=True)
        directory = args.keep or Path(temporary)
        directory.mkdir(parents=True, exist_ok=True)
        with tethered(directory, tether) as system:
            before = carried()
            time.sleep(args.seconds)
            print(f"{(carried() - before) / args.seconds / 1000:.1f} kB/s came up the link", file=sys.stderr)
            for name in ("a", "b"):
                process = system.processes.pop(name)
                process.end()
                print("\n".join(f"{name}: {line}" for line in process.lines[-12:]), file=sys.stderr)
            nodes = times(sorted(directory.glob("[ab]-*.mcap")))
            live = arrived(directory)
            filled_s = rest(system, tether, nodes, args.after)
            for name in ("a", "b", "recorder", "solver"):
                process = system.processes.pop(name)
                process.end()
                print("\n".join(f"{name}: {line}" for line in process.lines[-12:]), file=sys.stderr)
        later = times([directory / "recorder.mcap"])
    print(f"the machine passed {tether.late:.1%} of the packets late", file=sys.stderr)
    print(markdown_table(HEAD, [row.cells() for row in rows(nodes, live)]))
    print(
        f"filled after {filled_s:.0f} s: "
        + ("all" if not missing(nodes, later) else f"{missing(nodes, later)} missing")
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
