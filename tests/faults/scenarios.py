"""The faults, each repeated; every scenario yields the time that the system took to recover."""

from __future__ import annotations

import itertools
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader

from tests.faults.jumping import JUMP_S
from tests.faults.observer import Tally
from tests.faults.system import System
from tests.processes import PATIENCE_S

RATE_HZ = 5.0
BACK_S = PATIENCE_S
CUT_S = 15.0
FREEZE_S = 5.0
JUMPS = (signal.SIGUSR1, signal.SIGUSR2)


@dataclass
class FaultRow:
    """One row of the table. recover_s: from the end of the fault to the first trigger matched again."""

    fault: str
    tally: Tally = field(default_factory=Tally)
    recover_s: list[float] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@contextmanager
def running(endpoint: str | None = None, node_module: str = "buddyline") -> Iterator[System]:
    """A whole system at work, observed."""
    with (
        tempfile.TemporaryDirectory() as directory,
        System(Path(directory), RATE_HZ, endpoint, node_module=node_module) as system,
    ):
        system.start("hub")
        observer = system.observe()
        system.start("solver", "a", "b")
        observer.wait_for_match(0, BACK_S)
        yield system


def measure(system: System, report: FaultRow, since_ns: int) -> None:
    """Wait for the first trigger that was exposed, matched and answered since the path was back."""
    assert system.observer is not None
    try:
        matched_ns = system.observer.wait_for_match(since_ns, BACK_S)
    except TimeoutError as error:
        for name, process in system.processes.items():
            print(name, *process.lines[-60:], sep="\n    ", file=sys.stderr, flush=True)
        raise RuntimeError(f"{report.fault}: {error}") from error
    report.recover_s.append((matched_ns - since_ns) / S_NS)


def kill_and_return(name: str, times: int, seed: int) -> FaultRow:
    """kill -9, a pause of 0 to 4 s, and the same process again."""
    report, rng = FaultRow(f"{name} killed (-9) and back"), random.Random(seed)
    with running() as system:
        for _ in range(times):
            time.sleep(rng.uniform(0.5, 2.5))
            system.kill(name)
            time.sleep(rng.uniform(0.0, 4.0))
            system.start(name)
            measure(system, report, time.time_ns())
        report.tally = system.finish()
    return report


def hub(times: int) -> FaultRow:
    return kill_and_return("hub", times, seed=1)


def freeze_and_return(name: str, seconds: float, report: FaultRow, times: int) -> FaultRow:
    """A process is stopped, and then continued."""
    with running() as system:
        for _ in range(times):
            time.sleep(1.0)
            system.freeze(name)
            time.sleep(seconds)
            system.thaw(name)
            measure(system, report, time.time_ns())
        report.tally = system.finish()
    return report


def frozen_hub(times: int) -> FaultRow:
    """The hub is stopped for longer than its clients' time-out."""
    return freeze_and_return("hub", FREEZE_S, FaultRow(f"hub stopped for {FREEZE_S:g} s"), times)


def node(times: int) -> FaultRow:
    return kill_and_return("a", times, seed=2)


def solver(times: int) -> FaultRow:
    return kill_and_return("solver", times, seed=3)


def hub_and_solver(times: int) -> FaultRow:
    """Both are killed at once: nobody but the solver's journal knows what was answered."""
    report, rng = FaultRow("hub and solver killed (-9) and back"), random.Random(5)
    with running() as system:
        for _ in range(times):
            time.sleep(rng.uniform(0.5, 2.5))
            for name in rng.sample(["hub", "solver"], 2):
                system.kill(name)
            time.sleep(rng.uniform(0.0, 2.0))
            system.start("hub", "solver")
            measure(system, report, time.time_ns())
        report.tally = system.finish()
    return report


def frozen_viewer(times: int) -> FaultRow:
    """A recorder of everything is stopped for 5 s; the others are not affected, and it misses nothing."""
    report = FaultRow(f"viewer frozen for {FREEZE_S:g} s")
    with running() as system:
        assert system.observer is not None
        system.start("recorder")
        for _ in range(times):
            time.sleep(1.0)
            system.freeze("recorder")
            frozen_ns = time.time_ns()
            time.sleep(FREEZE_S)
            system.thaw("recorder")
            thawed_ns = time.time_ns()
            measure(system, report, thawed_ns)
            arrivals = sorted(r for _, r in system.observer.outcomes if frozen_ns <= r <= thawed_ns)
            gap_s = max((b - a for a, b in itertools.pairwise(arrivals)), default=thawed_ns - frozen_ns) / S_NS
            report.notes.append(f"longest time without an outcome meanwhile {gap_s:.2f} s")
        report.tally = system.finish()
        seen = len({(m.node, m.boot, m.seq) for m, _ in system.observer.frames})
        system.processes.pop("recorder").end()
        with DiveLogReader(system.directory / "recorder.mcap") as reader:
            recorded = sum(1 for _ in reader.records(lambda key: key.endswith("/candidates")))
        report.notes.append(f"the viewer itself recorded {recorded} of {seen} frames")
    return report


def frozen_node(times: int) -> FaultRow:
    """A node's process is stopped for 15 s, as a link that is cut: its lease runs out and it comes back."""
    return freeze_and_return("b", CUT_S, FaultRow(f"node stopped for {CUT_S:g} s"), times)


def cut_link(times: int) -> FaultRow:
    """One node lives in a network namespace of its own, and its cable is pulled for 15 s. Needs root."""
    report = FaultRow(f"link of one node cut for {CUT_S:g} s")
    with namespace() as (name, host), running(f"tcp/{host}:17447") as system:
        assert system.observer is not None
        system.processes.pop("b").end()
        system.spawn("b", namespace=name).wait_for("connected")
        measure(system, FaultRow(""), time.time_ns())
        for _ in range(times):
            time.sleep(1.0)
            ip("link", "set", f"{name}h", "down")
            time.sleep(CUT_S)
            ip("link", "set", f"{name}h", "up")
            measure(system, report, time.time_ns())
        report.tally = system.finish()
    return report


def set_clock(times: int) -> FaultRow:
    """One node's clock is set ahead for some seconds, then back for some: it comes to many triggers twice."""
    report = FaultRow(f"clock of one node set by {JUMP_S} s and back")
    with running(node_module="tests.faults.jumping") as system:
        for _, (there, back) in zip(range(times), itertools.cycle((JUMPS, JUMPS[::-1])), strict=False):
            time.sleep(1.0)
            system.processes["b"].send(there)
            time.sleep(FREEZE_S)
            system.processes["b"].send(back)
            measure(system, report, time.time_ns())
        report.tally = system.finish()
    return report


def start_orders(times: int) -> FaultRow:
    """Hub, nodes and solver in each of the six orders, 1.5 s apart."""
    report = FaultRow("six start orders")
    orders = itertools.cycle(itertools.permutations(("hub", "nodes", "solver")))
    for _, order in zip(range(max(times, 6)), orders, strict=False):
        with tempfile.TemporaryDirectory() as directory, System(Path(directory), RATE_HZ) as system:
            for part in order:
                for name in ("a", "b") if part == "nodes" else (part,):
                    system.spawn(name)
                if part == "hub":
                    system.processes["hub"].wait_for("listens")
                    system.observe()
                time.sleep(1.5)
            measure(system, report, time.time_ns() - round(1.5 * S_NS))
            time.sleep(3.0)
            tally = system.finish()
            report.tally += tally
            report.notes.append(f"{' '.join(order)}: {tally.reasons['pose']} poses of {tally.triggers}")
    return report


@contextmanager
def namespace() -> Iterator[tuple[str, str]]:
    """A network namespace with a cable to this one; yields its name and this end's address."""
    name = f"bl{os.getpid() % 100000}"
    ip("netns", "add", name)
    try:
        ip("link", "add", f"{name}h", "type", "veth", "peer", "name", f"{name}n", "netns", name)
        ip("address", "add", "10.249.77.1/30", "dev", f"{name}h")
        ip("link", "set", f"{name}h", "up")
        ip("-n", name, "address", "add", "10.249.77.2/30", "dev", f"{name}n")
        ip("-n", name, "link", "set", f"{name}n", "up")
        yield name, "10.249.77.1"
    finally:
        ip("netns", "delete", name)


def ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, capture_output=True)


SCENARIOS: dict[str, Callable[[int], FaultRow]] = {
    "hub": hub,
    "frozen_hub": frozen_hub,
    "node": node,
    "solver": solver,
    "hub_and_solver": hub_and_solver,
    "viewer": frozen_viewer,
    "stopped": frozen_node,
    "link": cut_link,
    "clock": set_clock,
    "orders": start_orders,
}
