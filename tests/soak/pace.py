"""How fast the machine is just now: the same piece of work ten times a second, the ms it took in a line each.

For `python -m tests.soak`, which ends it; it ends by itself where nobody reads its lines any more.
"""

import sys
import time

EVERY_S = 0.1
TERMS = 10_000


def main() -> None:
    while True:
        began_s = time.perf_counter()
        sum(i * i for i in range(TERMS))
        print(f"{1e3 * (time.perf_counter() - began_s):.3f}", file=sys.stderr, flush=True)
        time.sleep(EVERY_S)


if __name__ == "__main__":
    main()
