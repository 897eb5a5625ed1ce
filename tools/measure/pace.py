"""Show the machine's present speed: do the same work ten times a second, and print the ms it took, a line each.

Runs as `python -m buddyline.tools.measure.pace` beside the measured processes; its lines go to stderr.
"""

import sys
import time
from typing import Final

EVERY_S: Final = 0.1
TERMS: Final = 10_000


def main() -> None:
    """Work and print the times until the reader of the lines has gone."""
    while True:
        began_s = time.perf_counter()
        sum(i * i for i in range(TERMS))
        print(f"{1e3 * (time.perf_counter() - began_s):.3f}", file=sys.stderr, flush=True)
        time.sleep(EVERY_S)


if __name__ == "__main__":
    main()
