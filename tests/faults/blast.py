"""One client sends as fast as it can: what that does to the poses and the memory of the others.

By turns, a time without and a time with the attack, and between them one with a process that takes as much of this
machine's processors and sends nothing: what that costs is no attack over a network.
python -m tests.faults.blast --seconds 10 --turns 3; on a busy machine, as root: nice -n -18 ... --nice 8.
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
from statistics import median

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.tools.measure.tables import markdown_head, markdown_row

from tests.faults.attacks import ATTACKS, burn
from tests.faults.observer import Observer
from tests.faults.system import System
from tests.processes import PATIENCE_S

RATE_HZ = 10.0
VICTIMS = ("hub", "solver", "recorder", "a", "b")
ATTACKER = "attacker"
HOW = ("quiet", "burning", "attacked")
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


class Span:
    """What happened in a part of a run: outcomes, their ages at arrival, and the shares of a core that were used."""

    def __init__(
        self, system: System, observer: Observer, seconds: float, most_mb: dict[str, float], attacker: int | None = None
    ) -> None:
        pids = {name: system.processes[name].pid for name in VICTIMS} | ({ATTACKER: attacker} if attacker else {})
        begin_ns, used_s = time.time_ns(), {name: cpu_s(pid) for name, pid in pids.items()}
        while time.time_ns() - begin_ns < seconds * S_NS:
            for name in VICTIMS:
                most_mb[name] = max(most_mb[name], resident_mb(pids[name]))
            time.sleep(0.2)
        count, self.late_s = poses(observer, begin_ns)
        self.rate_hz = count / seconds
        self.shares = {name: (cpu_s(pid) - used_s[name]) / seconds for name, pid in pids.items()}


def main() -> int:
    """Run; print a row for each attack."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.blast", description=__doc__)
    parser.add_argument("attacks", nargs="*", choices=[*ATTACKS, []], help="default: all")
    parser.add_argument("--seconds", type=float, default=10.0, help="of each turn")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--nice", type=int, default=19, help="by how much the attacker's priority is lower")
    args = parser.parse_args()
    # A SIGTERM also ends the processes that were started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    head = ("attack", *(f"{what}, {how}" for what in ("outcomes/s", "90 % within s") for how in HOW))
    print(markdown_head((*head, *(f"{name} MB" for name in VICTIMS), "CPU attacker, " + ", ".join(VICTIMS))))
    for attack in args.attacks or ATTACKS:
        with (
            tempfile.TemporaryDirectory() as directory,
            System(Path(directory), RATE_HZ, devices="repeating", node_module="tests.soak.node") as system,
        ):
            system.start("hub")
            observer = system.observe()
            system.start("solver", "recorder", "a", "b")
            observer.wait_for_match(0, PATIENCE_S)
            time.sleep(SETTLE_S)
            most_mb = dict.fromkeys(VICTIMS, 0.0)
            spans: dict[str, list[Span]] = {how: [] for how in HOW}
            for _ in range(args.turns):
                spans["quiet"].append(Span(system, observer, args.seconds, most_mb))
                for how, what in (("burning", burn.__name__), ("attacked", attack)):
                    # The attacker's processor is not this machine's: it gets what the others leave.
                    words = ["nice", "-n", str(args.nice), sys.executable, "-m", "tests.faults.attacks", what]
                    with subprocess.Popen([*words, system.endpoint]) as attacker:
                        try:
                            spans[how].append(Span(system, observer, args.seconds, most_mb, attacker.pid))
                        finally:
                            attacker.kill()
                    time.sleep(SETTLE_S)
            cells = [attack]
            cells += [f"{median([span.rate_hz for span in spans[how]]):.1f}" for how in HOW]
            cells += [f"{median([span.late_s for span in spans[how]]):.2f}" for how in HOW]
            cells += [f"{most_mb[name]:.0f}" for name in VICTIMS]
            shares = [median([span.shares[name] for span in spans["attacked"]]) for name in (ATTACKER, *VICTIMS)]
            print(markdown_row([*cells, ", ".join(f"{share:.0%}" for share in shares)]), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
