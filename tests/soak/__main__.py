"""Run two nodes at 30 Hz, hub, solver, recorder and two viewers for as long as one likes.

python -m tests.soak --minutes 60

Prints a line a minute, then what was published, received, lost and doubled, and memory and open files after a minute
and at the end. Beside the latencies stands the pace of the machine itself: the time that the same piece of work takes
in a process that has nothing to do with Buddyline. Exit status 1 where anything was lost or doubled, or grew beyond
the bounds in tests/soak/system.py.
"""

from __future__ import annotations

import argparse
import signal
import sys
import tempfile
from pathlib import Path

from buddyline.tools.measure.tables import markdown_table

from tests.soak.system import Minute, SoakResult, soak

RATES = ("candidates", "attitude", "imu", "depth", "pose", "rejected")


def show(minute: Minute) -> None:
    rates = " ".join(f"{name} {minute.rates_hz.get(name, 0.0):.1f}" for name in RATES)
    loads = " ".join(f"{name} {load.rss_mib:.1f}/{load.files}" for name, load in minute.loads.items())
    print(
        f"{minute.at_s / 60:5.1f} min: Hz {rates}; ms median {minute.median_ms:.1f} p99 {minute.p99_ms:.1f}; "
        f"missed {minute.missed}; MiB/files {loads}; load average {minute.load_average:.1f}, "
        f"pace ms {minute.pace_ms[0]:.2f} p99 {minute.pace_ms[1]:.2f}",
        flush=True,
    )


def report(result: SoakResult) -> None:
    rows: list[list[object]] = []
    for row in result.rows:
        cells: list[object] = [row.key, "-" if row.published is None else row.published]
        for name in ("viewer", "recorder"):
            cells += [row.seen[name].count, row.lost.get(name, 0), row.seen[name].repeated]
        rows.append(cells)
    head = ("key", "published", "viewer received", "lost", "doubled", "recorder received", "lost", "doubled")
    print(f"\n{markdown_table(head, rows)}")
    first = next((m for m in result.minutes if m.at_s >= 59.0), result.minutes[0])
    last = result.minutes[-1]
    rows = []
    for name, load in last.loads.items():
        early = first.loads[name]
        share = (load.cpu_s - early.cpu_s) / max(last.at_s - first.at_s, 1e-9)
        cpu = "-" if last is first else f"{share:.1%}"
        rows.append([name, f"{early.rss_mib:.1f}", f"{load.rss_mib:.1f}", early.files, load.files, cpu])
    at = f"{first.at_s / 60:.1f} min", f"at {last.at_s / 60:.1f}"
    print(markdown_table(("process", f"MiB at {at[0]}", at[1], "files", "at the end", "CPU"), rows))
    medians, p99s = ([getattr(m, name) for m in result.minutes] for name in ("median_ms", "p99_ms"))
    print(
        f"exposure to pose, ms, of each minute: median {min(medians):.1f} to {max(medians):.1f}, "
        f"p99 {min(p99s):.1f} to {max(p99s):.1f}; {result.triggers} triggers, each with one outcome unless said below"
    )
    print("\n".join(result.failures) if result.failures else "\nnothing lost, nothing doubled, within the bounds")


def main() -> int:
    """Run; 1 where a bound was broken."""
    parser = argparse.ArgumentParser(prog="python -m tests.soak", description=__doc__)
    parser.add_argument("--minutes", type=float, default=60.0, help="default: 60")
    parser.add_argument("--every", type=float, default=60.0, metavar="S", help="between two lines; default: 60")
    args = parser.parse_args()
    # A SIGTERM also ends the processes that were started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with tempfile.TemporaryDirectory() as directory:
        result = soak(Path(directory), 60 * args.minutes, args.every, show)
    report(result)
    return 1 if result.failures else 0


if __name__ == "__main__":
    sys.exit(main())
