"""Cut what the page's green stands on, again and again, and time until the screen is green no longer.

    python -m tests.cuts --times 20 [monitor solver b hub network tab]

Two simulated nodes at 2 Hz, solver, hub and monitor run as processes, the page in a headless Chromium (playwright). A
process is stopped, not killed: its connections stay open, and only its silence tells. The network is a line that
carries nothing any more. A tab is frozen by holding its thread. The screen is filmed from outside the page.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from pathlib import Path

from buddyline.tools.measure.tables import markdown_head, markdown_row

from tests.tools.browsed import (
    CuttableLine,
    Film,
    Processes,
    chromium_browser,
    free_port,
    hold,
    looking,
)

CUTS = ("monitor", "solver", "b", "hub", "network", "tab")
# Longer than green may stay.
HELD_S = 6.0


def time_cuts(cuts: list[str], times: int) -> dict[str, list[tuple[float, float]]]:
    """Return the seconds from each cut to the end of green, and the machine's load (of a minute) then."""
    endpoint, port = f"tcp/127.0.0.1:{free_port()}", free_port()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        processes = Processes()
        stack.callback(processes.end)
        processes.start_pair(folder, endpoint)
        processes.start_monitor(endpoint, port)
        line = stack.enter_context(closing(CuttableLine(port)))
        chromium = stack.enter_context(chromium_browser())
        seen = stack.enter_context(looking(chromium, "cuts"))
        film = stack.enter_context(closing(Film(chromium, seen)))
        seen.page.goto(f"http://127.0.0.1:{line.port}")

        def stop_and_go(name: str) -> tuple[Callable[[], None], Callable[[], None]]:
            child = processes.running[name]
            return lambda: child.send(signal.SIGSTOP), lambda: child.send(signal.SIGCONT)

        ways: dict[str, tuple[Callable[[], None], Callable[[], None]]] = {
            **{name: stop_and_go(name) for name in ("monitor", "solver", "b", "hub")},
            "network": (line.cut, line.mend),
            "tab": (lambda: hold(seen, HELD_S), lambda: None),
        }
        taken: dict[str, list[tuple[float, float]]] = {name: [] for name in cuts}
        for _ in range(times):
            for name in cuts:
                cut, mend = ways[name]
                film.wait_for_green()
                began_s = time.time()
                cut()
                taken[name].append((film.wait_for_green(False) - began_s, os.getloadavg()[0]))
                mend()
        return taken


def main() -> int:
    """Print a row for each cut; 1 where green has stayed for more than two seconds."""
    parser = argparse.ArgumentParser(prog="python -m tests.cuts", description=__doc__)
    parser.add_argument("cuts", nargs="*", choices=[*CUTS, []], help="default: all")
    parser.add_argument("--times", type=int, default=20)
    args = parser.parse_args()
    # A SIGTERM also ends the processes that were started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    taken = time_cuts(args.cuts or list(CUTS), args.times)
    print(markdown_head(("cut", "times", "green for, median s", "longest s", "load then", "load, median")))
    for name, each in taken.items():
        (longest_s, load), (median_s, median_load) = max(each), map(statistics.median, zip(*each, strict=True))
        print(
            markdown_row([name, len(each), f"{median_s:.2f}", f"{longest_s:.2f}", f"{load:.0f}", f"{median_load:.0f}"])
        )
    return int(max(map(max, taken.values()))[0] > 2.0)


if __name__ == "__main__":
    sys.exit(main())
