"""Several solvers that share the work: killed again and again, or with many nodes.

    .venv/bin/python -m tests.soak.shared --kills 20 --track 0 --rate 5 --again 2      # in seven minutes
    .venv/bin/python -m tests.soak.shared --kills 0 --seconds 60 --nodes 12 --teams 3 --solvers 1
    .venv/bin/python -m tests.soak.shared --kills 0 --seconds 60 --nodes 12 --teams 3 --solvers 3 --track 0

Prints how many outcomes were missing or doubled, for how long pairs had none after each kill, how long after its frames
an outcome came, and what each process took of a core. Exit status 1 where any outcome was missing or doubled.
"""

from __future__ import annotations

import argparse
import itertools
import os
import random
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.scenario import DivePlan, Scenario, more_nodes
from buddyline.node.sim.world import World
from buddyline.protocol.bus import Bus, Received
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, Message, NodePose, Rejected, RelativePose
from buddyline.protocol.topics import NET_POSE, POSE, REJECTED, topic_of
from buddyline.protocol.zenoh_bus import connect
from buddyline.tools.measure.load import load_of
from msgspec.structs import replace

from tests.processes import Process, free_endpoint, until

START_NS = 1_764_000_000_000_000_000
# From the last frame on, at most: on a busy machine outcomes come late, and late is not missing.
REST_S = 60.0
# From a kill to the start of another solver.
TAKEN_UP_S = 3.0
# For how long a dive goes on beside what is measured in it: until the first solvers have told of all pairs, and until
# one that was started after a kill is there.
BEGUN_S = 20.0
JOINED_S = 6.0


def simulated(nodes: int, rate_hz: float, seconds: float, *, imu: bool, teams: int = 1) -> list[Message]:
    """Return what nodes tell in a dive, in order of time. Teams of as many nodes each do not see each other."""
    names = ("a", "b", *more_nodes(nodes))
    size, told = nodes // teams, []
    for team in range(teams):
        of_team = names[team * size : (team + 1) * size]
        fixed = of_team[:1] if team == 0 else ()
        world = World(
            Scenario(
                seed=3 + team,
                start_ns=START_NS,
                node_a=of_team[0],
                node_b=of_team[1],
                more_nodes=of_team[2:],
                fixed_nodes=fixed,
            )
        )
        plan = DivePlan(seconds=seconds, rate_hz=rate_hz, imu=imu)
        told += [one for _, _, one in simulation.messages(world, plan)]
    kept = [one for one in told if hasattr(one, "node") and not isinstance(one, NodePose)]
    return sorted(kept, key=lambda one: one.stamp_ns)


def moved(message: Message, by_triggers: int, period_ns: int) -> Message:
    """Return a message as it would be so many triggers later."""
    later = replace(message, stamp_ns=message.stamp_ns + by_triggers * period_ns)
    return replace(later, trigger=later.trigger + by_triggers) if isinstance(later, Candidates) else later


@dataclass
class SolversTold:
    """What the solvers have told: by pair and trigger, when each outcome came; when each node of the net was told.

    late_s: how long after its stamp each pose, rejection and node of the net came.
    """

    outcomes: dict[tuple[str, str, int], list[float]] = field(default_factory=lambda: defaultdict(list))
    poses: int = 0
    net: list[float] = field(default_factory=list)
    late_s: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))

    def take(self, received: Received) -> None:
        """Take one message from the bus."""
        message = received.open().message
        assert isinstance(message, RelativePose | Rejected | NodePose)
        self.late_s[type(message).__name__].append((time.time_ns() - message.stamp_ns) / S_NS)
        if isinstance(message, RelativePose | Rejected):
            self.poses += isinstance(message, RelativePose)
            self.outcomes[message.node_a, message.node_b, message.trigger].append(time.monotonic())
        else:
            self.net.append(time.monotonic())

    def longest_gap_s(self, start_s: float, end_s: float) -> float:
        """Return the longest time without an outcome of some pair, and without the network, in a span."""
        of_pair = defaultdict(list)
        for (a, b, _), came in list(self.outcomes.items()):
            of_pair[a, b] += came
        return max(_longest(sorted(came), start_s, end_s) for came in of_pair.values())


def _longest(came: list[float], start_s: float, end_s: float) -> float:
    within = [start_s, *(at_s for at_s in came if start_s <= at_s <= end_s), end_s]
    return max(after - before for before, after in itertools.pairwise(within))


class LiveDive:
    """Sends a dive as if it happened now, again and again, and takes what solvers tell.

    expected: by pair, all triggers so far. again: how often it has begun again. All nodes are then elsewhere at once,
    and all tracks break: what is measured over such a jump is of no dive.
    """

    def __init__(self, bus: Bus, messages: list[Message], rate_hz: float) -> None:
        self.told = SolversTold()
        self.expected: set[tuple[str, str, int]] = set()
        self.again = 0
        self._messages, self._period_ns = messages, round(S_NS / rate_hz)
        self._nodes = sorted({one.node for one in messages})
        said = {(topic_of(one), one.node) for one in messages}
        self._publishers = {(topic, node): bus.publisher(topic, node) for topic, node in said}
        bus.subscribe((POSE.key_any(), REJECTED.key_any(), NET_POSE.key_any()), self.told.take, capacity=100_000)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> LiveDive:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def end(self) -> None:
        """Send no more."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        first_ns = self._messages[0].stamp_ns
        span = -(-(self._messages[-1].stamp_ns - first_ns) // self._period_ns) + 1
        later = (time.time_ns() - first_ns) // self._period_ns + 2
        seq: dict[str, int] = defaultdict(int)
        while True:
            for message in self._messages:
                one = moved(message, later, self._period_ns)
                if self._stop.wait(max(one.stamp_ns - time.time_ns(), 0) / S_NS):
                    return
                if isinstance(one, Candidates):
                    seq[one.node] += 1
                    one = replace(one, seq=seq[one.node])
                    others = (node for node in self._nodes if node != one.node)
                    self.expected |= {(*sorted((one.node, other)), one.trigger) for other in others}
                self._publishers[topic_of(one), one.node].put(one)
            later += span
            self.again += 1


@dataclass
class SharedSoak:
    """How it went. gaps_s: longest time without an outcome after each kill; joined_s: as another solver joins.

    jumps: how often the dive began again, with all nodes elsewhere.
    """

    triggers: int
    missing: int
    doubled: int
    poses: int
    gaps_s: list[float]
    joined_s: list[float]
    net_rows: int
    late_s: dict[str, tuple[float, float, float]]
    cores: dict[str, float]
    jumps: int


def soak(
    work: Path,
    kills: int,
    *,
    solvers: int,
    nodes: int,
    rate_hz: float,
    track_hz: float,
    again_s: float,
    seed: int = 1,
    teams: int = 1,
    seconds: float = 0.0,
) -> SharedSoak:
    """Run the solvers for some seconds, then kill one after another with -9, and start it again.

    track_hz: 0 for neither tracks nor net. How late things come and what processes take is of those seconds.
    """
    lasts_s = BEGUN_S + again_s + seconds + kills * (1.0 + TAKEN_UP_S + JOINED_S + again_s)
    messages = simulated(nodes, rate_hz, lasts_s, imu=track_hz > 0, teams=teams)
    config = work / "solver.toml"
    config.write_text(f'share = true\njournal = "{work / "answered"}"\n[track]\nrate_hz = {track_hz}\n')
    pick = random.Random(seed)
    endpoint = free_endpoint()
    words = ("solver", "--config", config, "--connect", endpoint)
    running: list[Process] = []
    stop = threading.Event()
    with Process("hub", "--listen", endpoint) as hub:
        hub.wait_for("listens")
        bus = connect(endpoint, stop=stop, on_wait=lambda _: None)
        assert bus is not None
        try:
            with bus, LiveDive(bus, messages, rate_hz) as dive:
                running += [Process(*words) for _ in range(solvers)]
                for one in running:
                    one.wait_for("shares the work")
                pairs = nodes * (nodes - 1) // 2
                until(lambda: len({key[:2] for key in list(dive.told.outcomes)}) == pairs, 0.05)
                until(lambda: dive.told.net or not track_hz, 0.05)
                time.sleep(again_s)
                cores = watch(
                    dive.told, {"hub": hub, **{f"solver {i + 1}": one for i, one in enumerate(running)}}, seconds
                )
                late_s = {of: _spread(found) for of, found in dive.told.late_s.items() if found}
                gaps_s, joined_s = [], []
                for _ in range(kills):
                    killed = running.pop(pick.randrange(len(running)))
                    time.sleep(pick.random())
                    killed_s = time.monotonic()
                    killed.end(signal.SIGKILL)
                    time.sleep(TAKEN_UP_S)
                    # Another one begins later: it fetches a minute of all nodes, which are one process here.
                    gaps_s.append(dive.told.longest_gap_s(killed_s, time.monotonic()))
                    again = time.monotonic()
                    running.append(Process(*words))
                    running[-1].wait_for("shares the work")
                    time.sleep(again_s)
                    joined_s.append(dive.told.longest_gap_s(again, time.monotonic()))
                dive.end()
                jumps = dive.again
                due = set(dive.expected)
                ends_s = time.monotonic() + REST_S
                while not due <= dive.told.outcomes.keys() and time.monotonic() < ends_s:
                    time.sleep(0.1)
                came = {key: len(at_s) for key, at_s in list(dive.told.outcomes.items())}
        finally:
            for one in running:
                one.end()
    return SharedSoak(
        triggers=len(due),
        missing=len(due - came.keys()),
        doubled=sum(count > 1 for count in came.values()),
        poses=dive.told.poses,
        gaps_s=gaps_s,
        joined_s=joined_s,
        net_rows=len(dive.told.net),
        late_s=late_s,
        cores=cores,
        jumps=jumps,
    )


def watch(told: SolversTold, processes: Mapping[str, Process], seconds: float) -> dict[str, float]:
    """Let some seconds pass; give what each process took of a core, that which plays the nodes too.

    told begins anew to count how late things come.
    """
    if not seconds:
        return {}
    pids = {name: one.pid for name, one in processes.items()} | {"nodes": os.getpid()}
    told.late_s.clear()
    before, began_s = {name: load_of(pid) for name, pid in pids.items()}, time.monotonic()
    time.sleep(seconds)
    span_s = time.monotonic() - began_s
    return {name: (load_of(pid).cpu_s - before[name].cpu_s) / span_s for name, pid in pids.items()}


def _spread(values: list[float]) -> tuple[float, float, float]:
    """Give the median, the 95th percentile and the worst."""
    found = sorted(values)
    return found[len(found) // 2], found[min(round(0.95 * len(found)), len(found) - 1)], found[-1]


def main() -> int:
    """Run as a program."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--solvers", type=int, default=3)
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--again", type=float, default=3.0, help="s from a new solver's first task to the next kill")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--track", type=float, default=20.0, help="Hz; 0: neither tracks nor the network")
    parser.add_argument("--teams", type=int, default=1, help="of as many nodes each, which do not see each other")
    parser.add_argument("--seconds", type=float, default=0.0, help="before the first kill, to measure in")
    args = parser.parse_args()
    # A SIGTERM also ends the processes that were started.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))
    with tempfile.TemporaryDirectory() as folder:
        found = soak(
            Path(folder),
            args.kills,
            solvers=args.solvers,
            nodes=args.nodes,
            rate_hz=args.rate,
            track_hz=args.track,
            again_s=args.again,
            seed=args.seed,
            teams=args.teams,
            seconds=args.seconds,
        )
    print(msgspec.json.encode(found).decode())
    print(
        f"{len(found.gaps_s)} kills among {args.solvers}: of {found.triggers} outcomes {found.missing} missing, "
        f"{found.doubled} doubled"
    )
    if found.jumps:
        print(f"the dive was too short: {found.jumps} times all nodes jumped back to its beginning")
    if found.gaps_s:
        gaps, joined = (
            f"median {statistics.median(of):.2f} s, worst {max(of):.2f} s" for of in (found.gaps_s, found.joined_s)
        )
        print(f"longest time without one, of each kill: {gaps}; while another one joins: {joined}")
    if args.seconds:
        for of, (median_s, most_s, worst_s) in found.late_s.items():
            print(f"{of} after its stamp: median {median_s:.3f} s, 95 % {most_s:.3f} s, worst {worst_s:.3f} s")
        print("of a core: " + ", ".join(f"{name} {share:.2f}" for name, share in found.cores.items()))
        print(f"tasks that wanted a core in the last minute: {os.getloadavg()[0]:.1f} on {os.cpu_count()}")
    return 1 if found.missing or found.doubled else 0


if __name__ == "__main__":
    sys.exit(main())
