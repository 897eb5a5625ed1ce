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
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.topics import parse_key
from buddyline.tools.measure.tables import markdown_table

from tests.faults.shaper import PoorLink, poor_link
from tests.faults.system import System

RATE_HZ = 5.0
IN_TIME_S = 1.0
# The link and the estimates of it need this long to settle, and the last messages as long to arrive.
EDGE_S = 10.0

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


def rows(nodes: dict[str, Times], topside: dict[str, Times], since_ns: int, until_ns: int) -> list[list[object]]:
    """Return for each node and topic: sent, arrived, arrived in time, and its delays."""
    table: list[list[object]] = []
    for node, topics in sorted(nodes.items()):
        for name, logged in sorted(topics.items()):
            sent = [stamp_ns for stamp_ns, at_ns in logged.items() if since_ns <= at_ns < until_ns]
            arrived = topside[node][name]
            delay_s = np.array([(arrived[one] - logged[one]) / S_NS for one in sent if one in arrived])
            if sent:
                in_time = float(np.count_nonzero(delay_s <= IN_TIME_S)) / len(sent)
                delays = (
                    [f"{np.quantile(delay_s, q):.2f}" for q in (0.05, 0.5, 0.9, 0.99)] if len(delay_s) else ["-"] * 4
                )
                share = len(delay_s) / len(sent)
                table.append([node, name, len(sent), f"{share:.1%}", f"{in_time:.1%}", *delays])
    return table


def carried() -> int:
    """Return how many bytes have come up the link."""
    return int(Path("/sys/class/net/buddyline0/statistics/rx_bytes").read_text())


def main() -> int:
    """Run; print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.poor", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate-bps", type=float, default=PoorLink.rate_bps)
    parser.add_argument("--congestion", help="the nodes' TCP congestion control; default: the system's")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="where the logs stay")
    args = parser.parse_args()
    # A SIGTERM also ends the processes that were started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with tempfile.TemporaryDirectory() as temporary, poor_link(PoorLink(rate_bps=args.rate_bps)) as (namespace, host):
        if args.congestion:
            words = ["sysctl", "-q", "-w", f"net.ipv4.tcp_congestion_control={args.congestion}"]
            subprocess.run(["ip", "netns", "exec", namespace, *words], check=True)
        directory = args.keep or Path(temporary)
        directory.mkdir(parents=True, exist_ok=True)
        endpoint = f"tcp/{host}:17448"
        with System(directory, RATE_HZ, endpoint, devices="repeating", node_module="tests.soak.node") as system:
            system.start("hub", "solver", "recorder")
            for name in ("a", "b"):
                system.spawn(name, namespace=namespace)
            for name in ("a", "b"):
                system.processes[name].wait_for("connected", timeout=60.0)
            before = carried()
            time.sleep(args.seconds)
            print(f"{(carried() - before) / args.seconds / 1000:.1f} kB/s came up the link", file=sys.stderr)
            for name in ("a", "b", "recorder", "solver"):
                process = system.processes.pop(name)
                process.end()
                print("\n".join(f"{name}: {line}" for line in process.lines[-12:]), file=sys.stderr)
        nodes = times(sorted(directory.glob("[ab]-*.mcap")))
        topside = times([directory / "recorder.mcap"])
    first_ns = max(min(at for logged in topics.values() for at in logged.values()) for topics in nodes.values())
    last_ns = min(max(at for logged in topics.values() for at in logged.values()) for topics in nodes.values())
    edge_ns = round(EDGE_S * S_NS)
    head = ("node", "topic", "logged", "arrived", f"within {IN_TIME_S:g} s", "delay 5 % s", "median", "90 %", "99 %")
    print(markdown_table(head, rows(nodes, topside, first_ns + edge_ns, last_ns - edge_ns)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
