"""Fuzz for as long as one likes: `python -m tests.fuzz --minutes 10 [ros digests ...]`, of the targets named.

Prints a line a target: how many cases, and how many different failures; each failure once, with its input.
"""

from __future__ import annotations

import argparse
import logging
import sys
import time
import traceback

from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from tests.fuzz.clients import ALL_TARGETS

BATCH = 200
# Shrinking a failing case takes longer than finding it; its seed finds it again.
PHASES = (Phase.generate,)


def fuzz(name: str, seconds: float, first_seed: int) -> tuple[int, set[str]]:
    """Run one target with seed after seed; return the number of cases and the places of its failures."""
    cases = 0
    failures: set[str] = set()

    def target(data: st.DataObject) -> None:
        nonlocal cases
        cases += 1
        ALL_TARGETS[name](data)

    ends_s = time.monotonic() + seconds
    number = first_seed
    while time.monotonic() < ends_s:
        run = settings(
            max_examples=BATCH, deadline=None, database=None, phases=PHASES, suppress_health_check=HealthCheck
        )(seed(number)(given(data=st.data())(target)))
        number += 1
        try:
            run()
        except Exception as error:  # any other error is what the fuzzer looks for
            place = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{type(error).__name__} at {place.filename}:{place.lineno}"
            if where not in failures:
                failures.add(where)
                print(f"{name}: {where} (seed {number - 1})", file=sys.stderr)
                traceback.print_exception(error)
    return cases, failures


def main() -> int:
    """Run; 1 where anything failed."""
    parser = argparse.ArgumentParser(prog="tests.fuzz", description=__doc__)
    parser.add_argument("targets", nargs="*", choices=[*ALL_TARGETS, []], help="all, where none is named")
    parser.add_argument("--minutes", type=float, default=10.0, help="in all; default: 10")
    parser.add_argument("--seed", type=int, default=0, help="of the first batch; default: 0")
    args = parser.parse_args()
    logging.disable(logging.WARNING)
    names = args.targets or list(ALL_TARGETS)
    failed = 0
    for name in names:
        cases, failures = fuzz(name, 60 * args.minutes / len(names), args.seed)
        print(f"{name}: {cases} cases, {len(failures)} failures")
        failed += len(failures)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
