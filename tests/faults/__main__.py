"""Inject faults into the real system and count what happened to every frame and every trigger.

python -m tests.faults --times 20 [hub frozen_hub node solver hub_and_solver viewer stopped link clock orders]
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import signal
import statistics
import sys

from buddyline.tools.measure.tables import markdown_head, markdown_row

from tests.faults.observer import Tally
from tests.faults.scenarios import SCENARIOS, FaultRow

HEAD = (
    "fault",
    "times",
    "published",
    "received",
    "lost",
    "duplicated",
    "out of order",
    "triggers",
    "without outcome",
    "outcome twice",
    "poses",
    "recovery median s",
    "worst s",
)


def row(report: FaultRow) -> str:
    tally = report.tally
    counts = [getattr(tally, field.name) for field in dataclasses.fields(tally) if field.name != "reasons"]
    recovered = [f"{statistics.median(report.recover_s):.2f}", f"{max(report.recover_s):.2f}"]
    return markdown_row([report.fault, len(report.recover_s), *counts, tally.reasons["pose"], *recovered])


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.faults", description=__doc__)
    parser.add_argument("faults", nargs="*", choices=[*SCENARIOS, []], help="default: all")
    parser.add_argument("--times", type=int, default=20)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    # A SIGTERM also ends the processes that were started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    reports = []
    if not args.json:
        print(markdown_head(HEAD))
    for name in args.faults or SCENARIOS:
        report = SCENARIOS[name](args.times)
        reports.append(report)
        if args.json:
            continue
        print(row(report), flush=True)
        print(f"  {dict(report.tally.reasons.most_common())}", file=sys.stderr)
        for note in report.notes:
            print(f"  {note}", file=sys.stderr)
    if args.json:
        print(json.dumps([dataclasses.asdict(report) for report in reports], indent=2))
    return 1 if any(failed(report.tally) for report in reports) else 0


def failed(tally: Tally) -> bool:
    """Whether anything was lost, came twice or out of order, or a trigger has no outcome, or two."""
    return any((tally.lost, tally.duplicated, tally.disordered, tally.without_outcome, tally.outcomes_doubled))


if __name__ == "__main__":
    sys.exit(main())
