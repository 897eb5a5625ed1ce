"""Random kills, stops and cuts of up to five processes at once, for a time: what is lost, and what comes twice.

python -m tests.faults.chaos --seconds 3600 --seed 1. Needs root.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from statistics import median

from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Rejected

from tests.faults.observer import Observer, Tally
from tests.faults.scenarios import RATE_HZ, ip, namespace
from tests.faults.system import System
from tests.processes import PATIENCE_S

NAMES = ("hub", "solver", "a", "b", "recorder")
LONGEST_S = 8.0
PAUSE_S = 6.0
RECOVER_S = PATIENCE_S
LOOK_S = 2.0

Undo = Callable[[], object]


class Chaos:
    """Does things to the processes of a system; each returns what undoes it. b lives behind a cable that can be cut."""

    def __init__(self, system: System, namespace: str) -> None:
        self._system = system
        self._namespace = namespace
        # When the solver ended or was stopped, and when it was started or went on.
        self.away_ns: list[tuple[int, int]] = []

    def spawn(self, name: str) -> None:
        """Start a process, and wait for nothing: there may be no hub."""
        self._system.spawn(name, namespace=self._namespace if name == "b" else None)

    def kill(self, name: str) -> Undo:
        """Kill with SIGKILL."""
        ended_ns = time.time_ns()
        self._system.kill(name)
        return self._spawner(name, ended_ns)

    def stop(self, name: str) -> Undo:
        """Stop it where it stands, for longer or shorter than the leases."""
        stopped_ns = time.time_ns()
        self._system.freeze(name)

        def thaw() -> None:
            self._system.thaw(name)
            if name == "solver":
                self.away_ns.append((stopped_ns, time.time_ns()))

        return thaw

    def end(self, name: str) -> Undo:
        """End it in order."""
        # From then on it takes nothing more.
        ended_ns = time.time_ns()
        self._system.processes.pop(name).end()
        return self._spawner(name, ended_ns)

    def _spawner(self, name: str, ended_ns: int) -> Undo:
        def spawn() -> None:
            self.spawn(name)
            if name == "solver":
                self.away_ns.append((ended_ns, time.time_ns()))

        return spawn

    def cut(self, name: str) -> Undo:
        """Pull its cable; where it has none, stop it."""
        if name != "b":
            return self.stop(name)
        ip("link", "set", f"{self._namespace}h", "down")
        return lambda: ip("link", "set", f"{self._namespace}h", "up")

    def restart(self) -> int:
        """Start those processes again that have ended by themselves, as systemd does; return how many."""
        ended = [name for name, process in self._system.processes.items() if process.ended]
        for name in ended:
            print(name, "ended", *self._system.processes[name].lines[-6:], sep="\n    ", file=sys.stderr, flush=True)
            self._system.processes.pop(name).end()
            self.spawn(name)
        return len(ended)

    def recovers(self, since_ns: int, faults: Counter[str]) -> bool:
        """Wait for a match; return whether there was one."""
        assert self._system.observer is not None
        ends_s = time.monotonic() + RECOVER_S
        while time.monotonic() < ends_s:
            faults["ended by themselves"] += self.restart()
            try:
                self._system.observer.wait_for_match(since_ns, LOOK_S)
            except TimeoutError:
                continue
            return True
        for name, process in self._system.processes.items():
            print(name, *process.lines[-6:], sep="\n    ", file=sys.stderr, flush=True)
        return False

    def do(self, seconds: float, rng: random.Random) -> tuple[Counter[str], list[float]]:
        """Let faults happen; return how often each did, and how long a match took after each round."""
        faults: Counter[str] = Counter()
        recovered_s: list[float] = []
        ends_s = time.monotonic() + seconds
        while time.monotonic() < ends_s:
            undone: list[tuple[float, Undo]] = []
            struck = rng.sample(NAMES, rng.randint(1, len(NAMES)))
            for name in struck:
                action = rng.choice((self.kill, self.kill, self.stop, self.end, self.cut))
                faults[f"{action.__name__} {name}"] += 1
                print(f"{time.time() % 10_000:.3f} {action.__name__} {name}", file=sys.stderr, flush=True)
                undone.append((time.monotonic() + rng.uniform(0.0, LONGEST_S), action(name)))
                time.sleep(rng.choice((0.0, rng.uniform(0.0, 1.0))))
            faults[f"{len(struck)} at once"] += 1
            for at_s, undo in sorted(undone, key=lambda one: one[0]):
                time.sleep(max(at_s - time.monotonic(), 0.0))
                undo()
            print(f"{time.time() % 10_000:.3f} all are back", file=sys.stderr, flush=True)
            since_ns = time.time_ns()
            if not self.recovers(since_ns, faults):
                faults["not recovered"] += 1
                continue
            recovered_s.append((time.time_ns() - since_ns) / S_NS)
            time.sleep(rng.uniform(0.0, PAUSE_S))
        return faults, recovered_s


def doubled(observer: Observer) -> list[str]:
    """Return a line for each trigger with two outcomes: what they were, when they were received, and how old."""
    by_trigger: dict[int, list[str]] = defaultdict(list)
    for outcome, receive_ns in observer.outcomes:
        word = outcome.reason if isinstance(outcome, Rejected) else "pose"
        at_s, age_s = receive_ns / S_NS % 10_000, (receive_ns - outcome.stamp_ns) / S_NS
        by_trigger[outcome.trigger].append(f"{word} at {at_s:.3f} s, {age_s:.2f} s old")
    return [f"{trigger}: {'; '.join(words)}" for trigger, words in sorted(by_trigger.items()) if len(words) > 1]


def unreached(observer: Observer, away_ns: list[tuple[int, int]]) -> set[int]:
    """Return the triggers whose frames all came while no solver took any: their nodes may have ended before one did.

    away_ns: when a solver ended or was stopped, and when one was started or went on; its first outcome shows it.
    """
    back_ns = sorted(receive_ns for _, receive_ns in observer.outcomes)
    spans = [(from_ns, next((at_ns for at_ns in back_ns if at_ns > to_ns), to_ns)) for from_ns, to_ns in away_ns]
    reached = {
        frame.trigger
        for frame, receive_ns in observer.frames
        if not any(from_ns <= receive_ns <= to_ns for from_ns, to_ns in spans)
    }
    return {frame.trigger for frame, _ in observer.frames} - reached


def unanswered(observer: Observer) -> dict[int, str]:
    """Return the triggers without an outcome, with their frames, when they were received, and how old."""
    answered = {outcome.trigger for outcome, _ in observer.outcomes}
    by_trigger: dict[int, list[str]] = defaultdict(list)
    for frame, receive_ns in observer.frames:
        at_s, age_s = receive_ns / S_NS % 10_000, (receive_ns - frame.stamp_ns) / S_NS
        by_trigger[frame.trigger].append(f"{frame.node} {frame.boot} {frame.seq} at {at_s:.3f} s, {age_s:.2f} s old")
    return {trigger: "; ".join(words) for trigger, words in sorted(by_trigger.items()) if trigger not in answered}


def main() -> int:
    """Run; print the counts as JSON."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.chaos", description=__doc__)
    parser.add_argument("--seconds", type=float, default=1200.0)
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    # A SIGTERM also ends the processes that were started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    rng = random.Random(args.seed)
    with (
        namespace() as (name, host),
        tempfile.TemporaryDirectory() as directory,
        System(Path(directory), RATE_HZ, f"tcp/{host}:17449") as system,
    ):
        chaos = Chaos(system, name)
        system.start("hub")
        observer = system.observe()
        for one in NAMES[1:]:
            chaos.spawn(one)
        observer.wait_for_match(0, RECOVER_S)
        faults, recovered_s = chaos.do(args.seconds, rng)
        tally: Tally = system.finish()
        without, away = unanswered(observer), unreached(observer, chaos.away_ns)
        for line in [*doubled(observer), "without an outcome:"]:
            print(line, file=sys.stderr)
        for trigger, words in without.items():
            print(trigger, "(no solver then)" if trigger in away else "", words, file=sys.stderr)
    found = {
        "rounds": len(recovered_s),
        "faults": dict(sorted(faults.items())),
        "recovery_s": {"median": median(recovered_s), "worst": max(recovered_s)} if recovered_s else {},
        **vars(tally),
        "without_outcome_though_reached": len(without.keys() - away),
    }
    print(json.dumps(found, indent=2))
    broken = faults["not recovered"], tally.outcomes_doubled, tally.duplicated, tally.disordered, without.keys() - away
    return 1 if any(broken) else 0


if __name__ == "__main__":
    sys.exit(main())
