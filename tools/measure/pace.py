"""How fast the machine is just now: the same piece of work ten times a second, the ms it took in a line each.

A process of its own, `python -m buddyline.tools.measure.pace`, beside what is measured; its lines go to stderr.
"""

import sys
import time
from typing import Final

EVERY_S: Final = 0.1
TERMS: Final = 10_000


def main() -> None:
    """Work and say how long it took, until nobody reads the lines any more."""
    while True:
        began_s = time.perf_counter()
        sum(i * i for i in range(TERMS))
        print(f"{1e3 * (time.perf_counter() - began_s):.3f}", file=sys.stderr, flush=True)
        time.sleep(EVERY_S)


if __name__ == "__main__":
    main()
