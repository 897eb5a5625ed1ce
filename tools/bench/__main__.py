"""`python -m buddyline.tools.bench BENCHMARK`: run one benchmark. Only its own module is imported.

A benchmark is a module with add_arguments(parser), measure(args) and table(figures).
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module
from typing import Final

from buddyline.protocol.errors import BuddylineError
from buddyline.tools.measure.tables import write

PROGRAM: Final = "python -m buddyline.tools.bench"
BENCHMARKS: Final = {
    "solve": "the solver: time per trigger and per hypothesis, beside Eq. 1 alone in compiled C",
    "accuracy": "the solver: errors over the Cramer-Rao bound, and the right lights among false ones",
    "detect": "the detector: time per picture beside other finders, memory",
    "instructions": "the detector: machine instructions per picture, and what they may take on a Pi 3",
    "lights": "the detector: lights found in rendered pictures, and the truth of sigma and score",
    "monitor": "the monitor: processor and memory with viewers, latency beside it, weight of the page",
    "coach": "the coach: fixes within 5 s, where its words are followed",
    "node": "a whole node: capture to candidates published, processor, memory",
}


def main(argv: list[str] | None = None) -> int:
    """Run one benchmark and print its figures; return the exit status."""
    listing = "\n".join(f"  {name:12} {does}" for name, does in BENCHMARKS.items())
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description=f"benchmarks:\n{listing}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("benchmark", choices=list(BENCHMARKS), metavar="BENCHMARK")
    parser.add_argument("arguments", nargs=argparse.REMAINDER, help="its own; see BENCHMARK --help")
    chosen = parser.parse_args(argv)
    benchmark = import_module(f"buddyline.tools.bench.{chosen.benchmark}")
    own = argparse.ArgumentParser(prog=f"{PROGRAM} {chosen.benchmark}", description=benchmark.__doc__)
    benchmark.add_arguments(own)
    own.add_argument("--json", action="store_true", help="print the figures as JSON")
    args = own.parse_args(chosen.arguments)
    try:
        write(benchmark.measure(args), benchmark.table, as_json=args.json)
    except BuddylineError as error:
        print(f"bench: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
