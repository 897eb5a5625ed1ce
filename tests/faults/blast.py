"""One client sends as fast as it can: what that does to the poses and the memory of the others.

python -m tests.faults.blast --seconds 15
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.measure.tables import markdown_head, markdown_row

from tests.faults.attacks import ATTACKS
from tests.faults.observer import Observer
from tests.faults.system import System

RATE_HZ = 10.0
VICTIMS = ("hub", "solver", "recorder", "a", "b")
SETTLE_S = 5.0


def poses(observer: Observer, since_ns: int) -> tuple[int, float]:
    """Return how many outcomes have come since then, and the 90 % quantile of their ages at arrival, s."""
    ages_s = [
        (at_ns - o.stamp_ns) / S_NS for o, at_ns in list(observer.outcomes) if at_ns >= since_ns and o.node_b == "b"
    ]
    return len(ages_s), float(np.quantile(ages_s, 0.9)) if ages_s else float("inf")


def resident_mb(pid: int) -> float:
    """Return the memory that a process holds, MB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def cpu_s(pid: int) -> float:
    """Return the processor time that a process has used, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> int:
    """Run; print a row for each attack."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.blast", description=__doc__)
    parser.add_argument("attacks", nargs="*", choices=[*ATTACKS, []], help="default: all")
    parser.add_argument("--seconds", type=float, default=15.0)
    args = parser.parse_args()
    # A SIGTERM also ends the processes that were started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    head = ("attack", "outcomes/s", "90 % of them within s", *(f"{name} MB" for name in VICTIMS), "hub, solver CPU")
    print(markdown_head(head))
    for attack in ("none", *(args.attacks or ATTACKS)):
        with (
            tempfile.TemporaryDirectory() as directory,
            System(Path(directory), RATE_HZ, devices="repeating", node_module="tests.soak.node") as system,
        ):
            system.start("hub")
            observer = system.observe()
            system.start("solver", "recorder", "a", "b")
            observer.wait_for_match(0, 60.0)
            time.sleep(SETTLE_S)
            words = [sys.executable, "-m", "tests.faults.attacks", attack, system.endpoint]
            with subprocess.Popen(words) as attacker:
                try:
                    most = dict.fromkeys(VICTIMS, 0.0)
                    begin_ns = time.time_ns()
                    used_s = {name: cpu_s(system.processes[name].pid) for name in ("hub", "solver")}
                    while time.time_ns() - begin_ns < args.seconds * S_NS:
                        for name in VICTIMS:
                            most[name] = max(most[name], resident_mb(system.processes[name].pid))
                        time.sleep(0.2)
                    count, late_s = poses(observer, begin_ns)
                    share = [
                        f"{(cpu_s(system.processes[name].pid) - used_s[name]) / args.seconds:.0%}" for name in used_s
                    ]
                finally:
                    attacker.kill()
            row = [attack, f"{count / args.seconds:.1f}", f"{late_s:.2f}", *(f"{most[name]:.0f}" for name in VICTIMS)]
            print(markdown_row([*row, ", ".join(share)]), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
