"""Random schedules of deaths, gaps, jumps of clocks, backlogs and reordering: every trigger has its outcome in time.

The core is told the receive time as the live service tells it. True time runs on by itself; a node's stamps are on its
own clock.

`python -m tests.solver_service.test_schedules 100000 7` plays as many by seeds from 7 on, three times as fast as
Hypothesis tries them: a hundred a second. A seed that fails is named, and its schedule printed.
"""

import random
import sys
from collections import Counter, defaultdict
from functools import cache
from itertools import combinations

import hypothesis.strategies as st
import pytest
from buddyline.protocol.clock import MS_NS, S_NS, trigger_index
from buddyline.protocol.messages import Attitude, Blob, Candidates, Depth, Imu
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import NoFix, Settings
from buddyline.solver_service.matcher import MAX_PENDING, MAX_PENDING_BYTES, MAX_RESOLVED_MEMORY
from buddyline.solver_service.sensors import MAX_SAMPLES
from buddyline.solver_service.streams import MAX_FRAME_BYTES, MAX_SEQUENCE_MEMORY, size_bytes
from hypothesis import HealthCheck, settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from msgspec.structs import replace

from tests.solver_service.conftest import START_NS, dive_messages

NODES = ("a", "b", "c")
PAIRS = list(combinations(NODES, 2))
TICK_NS = 250 * MS_NS
STEP_NS = 50 * MS_NS
OUTCOME_WITHIN_NS = 3500 * MS_NS
EXAMPLES = 40
BLOB = Blob(u_px=1.0, v_px=2.0, sigma_px=0.5, area_px=9.0, peak=255.0, elongation=1.0)

PERIODS_MS = 33, 100, 200, 1000, 2500, 10_000
JUMPS_S = -86_400, -3600, -30, -2, -0.4, 0.4, 2, 4, 30, 3600
SOLVER_JUMPS_S = -3600, -5, 5, 3600
MOST_BACK = 200
SIZES = 0, 5, 64
MOST_STEPS = 40

nodes = st.sampled_from(NODES)


@cache
def info():
    return next(m for m in dive_messages(seconds=0.3, sensors=False)[0] if type(m).__name__ == "NodeInfo")


class NoSolver:
    """Takes the geometry's place: what it is given is what was matched."""

    def __init__(self):
        self.given = []

    def solve(self, matched):
        self.given += matched
        return [NoFix("ambiguous", "")] * len(matched)

    def forget(self):
        """There is nothing to forget."""

    def heading(self, _):
        return None


class ScheduledNode:
    """One node: its clock, its link, and what it has not delivered yet."""

    def __init__(self, name, period_ns):
        self.name = name
        self.period_ns = period_ns
        self.ahead_ns = 0
        self.epoch = 0
        self.epochs = {}
        self.boots = 0
        self.seq = 0
        self.alive = self.linked = self.sensing = True
        self.trigger = None
        self.blobs = []
        self.backlog = []

    def messages(self, true_ns):
        """What it makes in a step that ends at true_ns."""
        if not self.alive:
            return
        now_ns = true_ns + self.ahead_ns
        if self.sensing:
            yield Attitude(node=self.name, stamp_ns=now_ns, q_ned_body_xyzw=(0.0, 0.0, 0.0, 1.0), sigma_rad=(0.1,) * 3)
            yield Depth(node=self.name, stamp_ns=now_ns, depth_m=5.0, sigma_m=0.02)
            yield Imu(node=self.name, stamp_ns=now_ns, accel_mps2=(0.0, 0.0, 9.8), gyro_radps=(0.0, 0.0, 0.0))
        trigger = trigger_index(now_ns, self.period_ns)
        if trigger == self.trigger:
            return
        self.trigger = trigger
        self.seq += 1
        self.epochs[str(self.boots), self.seq] = self.epoch
        yield Candidates(
            node=self.name,
            stamp_ns=now_ns,
            trigger=trigger,
            seq=self.seq,
            boot=str(self.boots),
            width_px=820,
            height_px=616,
            blobs=self.blobs,
        )


class Schedules(RuleBasedStateMachine):
    @initialize(period_ms=st.sampled_from(PERIODS_MS), chosen=st.booleans())
    def begin(self, period_ms, chosen):
        self.true_ns = self.tick_ns = START_NS
        self.host_ahead_ns = 0
        self.nodes = {name: ScheduledNode(name, period_ms * MS_NS) for name in NODES}
        self.core = SolverCore(Settings(), PAIRS if chosen else None)
        self.outcomes = Counter()
        self.ended = defaultdict(list)
        self.due = {}
        self.epochs = defaultdict(set)
        self.arrivals = {}
        self.sent = []
        self.swap = False
        for name in NODES:
            self.deliver(replace(info(), node=name))
        self.solvers = {}
        for nodes, pair in self.core.pairs.items():
            pair.solver = self.solvers[nodes] = NoSolver()

    def deliver(self, message):
        if isinstance(message, Candidates):
            epoch = self.nodes[message.node].epochs[message.boot, message.seq]
            self.sent.append((message, epoch))
            self.arrivals.setdefault((message.node, message.boot, message.seq), self.true_ns)
            for pair in PAIRS:
                if message.node in pair:
                    key = pair, message.trigger
                    self.epochs[key].add((message.node, epoch))
                    if not self.outcomes[key]:
                        self.due.setdefault(key, self.true_ns + OUTCOME_WITHIN_NS)
        self.take(self.core.handle(message, self.true_ns + self.host_ahead_ns))

    def take(self, outcomes):
        for outcome in outcomes:
            key = (outcome.node_a, outcome.node_b), outcome.trigger
            self.outcomes[key] += 1
            self.ended[key].append((outcome.reason, outcome.detail, (self.true_ns - START_NS) / S_NS))
            self.due.pop(key, None)

    @rule(seconds=st.floats(0.1, 4.0))
    def go_on(self, seconds):
        for _ in range(round(seconds * S_NS / STEP_NS)):
            self.true_ns += STEP_NS
            fresh = []
            for node in self.nodes.values():
                (fresh if node.linked else node.backlog).extend(node.messages(self.true_ns))
            if self.swap and fresh:
                fresh.reverse()
                self.swap = False
            for message in fresh:
                self.deliver(message)
            if self.true_ns - self.tick_ns >= TICK_NS:
                self.tick_ns = self.true_ns
                self.take(self.core.advance(self.true_ns + self.host_ahead_ns))
                assert not [key for key, due_ns in self.due.items() if due_ns < self.true_ns]

    @rule(name=nodes)
    def die_or_come_back(self, name):
        node = self.nodes[name]
        node.alive = not node.alive
        node.boots += 1
        node.seq = 0

    @rule(name=nodes)
    def cut_the_link(self, name):
        self.nodes[name].linked = False

    @rule(name=nodes, frames_first=st.booleans())
    def mend_the_link(self, name, frames_first):
        node = self.nodes[name]
        if frames_first:
            node.backlog.sort(key=lambda message: not isinstance(message, Candidates))
        node.linked, backlog, node.backlog = True, node.backlog, []
        for message in backlog:
            self.deliver(message)

    @rule(name=nodes)
    def stop_or_start_the_sensors(self, name):
        self.nodes[name].sensing = not self.nodes[name].sensing

    @rule(name=nodes, seconds=st.sampled_from(JUMPS_S))
    def set_the_clock_of_a_node(self, name, seconds):
        node = self.nodes[name]
        node.ahead_ns += round(seconds * S_NS)
        node.epoch += 1

    @rule(seconds=st.sampled_from(SOLVER_JUMPS_S))
    def set_the_clock_of_the_solver(self, seconds):
        self.host_ahead_ns += seconds * S_NS

    @rule(back=st.integers(1, MOST_BACK))
    def deliver_again(self, back):
        """A node's clock that was set makes a new time line: there, an old frame is a new one."""
        if len(self.sent) >= back and self.sent[-back][1] == self.nodes[self.sent[-back][0].node].epoch:
            self.take(self.core.handle(self.sent[-back][0], self.true_ns + self.host_ahead_ns))

    @rule(name=nodes, size=st.sampled_from(SIZES))
    def see_more_or_less(self, name, size):
        self.nodes[name].blobs = [BLOB] * size

    @rule()
    def reorder(self):
        self.swap = True

    @rule(name=nodes)
    def claim_the_id_of_another(self, name):
        frames = [m for m, epoch in self.sent[-10:] if m.node == name and epoch == self.nodes[name].epoch]
        if frames:
            other = replace(frames[-1], boot="other", blobs=[])
            self.nodes[name].epochs["other", other.seq] = self.nodes[name].epoch
            self.deliver(other)

    @invariant()
    def each_trigger_ends_once(self):
        for (pair, trigger), count in getattr(self, "outcomes", {}).items():
            if count <= 1:
                continue
            # A trigger may come again only where a node's clock was set, once for each time line.
            lines = Counter(node for node, _ in self.epochs[pair, trigger])
            assert count <= 1 + sum(n - 1 for n in lines.values()), (pair, trigger, self.ended[pair, trigger])

    @invariant()
    def memory_is_bounded(self):
        if not hasattr(self, "core"):
            return
        for stream in self.core.streams.values():
            assert stream.frames.bytes <= MAX_FRAME_BYTES
            assert stream.frames.bytes == sum(size_bytes(frame) for frame in stream.frames.between(0, 2**63))
            assert max(len(stream.imu), len(stream.attitude._stamps), len(stream.depth._stamps)) <= MAX_SAMPLES
            assert len(stream._sequence) <= MAX_SEQUENCE_MEMORY
        for pair in self.core.pairs.values():
            matcher = pair.matcher
            held = [frame for one in matcher._waiting.values() for frame in one.frames if frame is not None]
            assert matcher.pending_bytes == sum(map(size_bytes, held)) <= MAX_PENDING_BYTES
            assert matcher.pending <= MAX_PENDING
            assert len(matcher._arrivals) <= 2 * MAX_PENDING + 1
            assert len(matcher._resolved) <= MAX_RESOLVED_MEMORY

    @invariant()
    def what_is_matched_came_together(self):
        for solver in getattr(self, "solvers", {}).values():
            for matched in solver.given:
                received_ns = [self.arrivals[f.node, f.boot, f.seq] for f in (matched.frame_a, matched.frame_b)]
                assert abs(received_ns[0] - received_ns[1]) <= OUTCOME_WITHIN_NS
                assert matched.frame_a.trigger == matched.frame_b.trigger == matched.trigger
            solver.given.clear()

    def teardown(self):
        if hasattr(self, "core"):
            self.take(self.core.flush())
            assert not self.due
            assert self.core.pending == 0


def limits(examples, *, derandomize):
    return settings(
        max_examples=examples,
        stateful_step_count=MOST_STEPS,
        deadline=None,
        derandomize=derandomize,
        suppress_health_check=list(HealthCheck),
    )


TestSchedules = Schedules.TestCase
TestSchedules.settings = limits(EXAMPLES, derandomize=True)


@pytest.mark.slow
def test_many_more_schedules():
    """The same ones each time: what ends green on a commit does so again."""
    run_state_machine_as_test(Schedules, settings=limits(20 * EXAMPLES, derandomize=True))


def play(period_ms, *steps, chosen=True):
    schedule = Schedules()
    schedule.begin(period_ms=period_ms, chosen=chosen)
    for rule_name, *arguments in steps:
        getattr(schedule, rule_name)(*arguments)
        schedule.each_trigger_ends_once()
        schedule.what_is_matched_came_together()
        schedule.memory_is_bounded()
    schedule.teardown()
    schedule.each_trigger_ends_once()
    return schedule


def of_seed(seed):
    """A schedule: its period, whether pairs are chosen, and its steps."""
    rng = random.Random(seed)
    steps = {
        "go_on": lambda: (rng.uniform(0.1, 4.0),),
        "die_or_come_back": lambda: (rng.choice(NODES),),
        "cut_the_link": lambda: (rng.choice(NODES),),
        "mend_the_link": lambda: (rng.choice(NODES), rng.random() < 0.5),
        "stop_or_start_the_sensors": lambda: (rng.choice(NODES),),
        "set_the_clock_of_a_node": lambda: (rng.choice(NODES), rng.choice(JUMPS_S)),
        "set_the_clock_of_the_solver": lambda: (rng.choice(SOLVER_JUMPS_S),),
        "deliver_again": lambda: (rng.randint(1, MOST_BACK),),
        "see_more_or_less": lambda: (rng.choice(NODES), rng.choice(SIZES)),
        "reorder": lambda: (),
        "claim_the_id_of_another": lambda: (rng.choice(NODES),),
    }
    chosen = [rng.choice(list(steps)) for _ in range(rng.randint(1, MOST_STEPS))]
    return rng.choice(PERIODS_MS), rng.random() < 0.5, [(name, *steps[name]()) for name in chosen]


def test_a_seed_gives_each_rule():
    named = {name for seed in range(20) for name, *_ in of_seed(seed)[2]}
    assert named == {rule.function.__name__ for rule in Schedules().rules}


def test_a_node_that_reaches_what_the_other_had_alone_gives_no_second_outcome():
    """B's clock goes back by half a minute, then a's by a day: b reaches triggers that a had without it."""
    away = [("set_the_clock_of_a_node", "a", -86_400), ("go_on", 16.0), ("set_the_clock_of_a_node", "b", 4)]
    play(2500, ("go_on", 0.5), ("set_the_clock_of_a_node", "b", -30), ("go_on", 7.2), *away, ("go_on", 3.75))


def test_a_clock_of_the_solver_that_is_set_back_again_and_again_prolongs_no_waiting():
    back = ("set_the_clock_of_the_solver", -3600)
    alone = [("cut_the_link", "a"), ("cut_the_link", "c"), back, ("go_on", 1.0), ("cut_the_link", "b")]
    play(33, *alone, *[back, ("go_on", 0.45)] * 8)


def test_an_old_frame_that_comes_again_and_again_is_no_new_time():
    again = [("deliver_again", 10)] * 6
    played = play(2500, ("go_on", 20.0), *again, ("go_on", 8.0))
    assert all(stream.newest_ns > START_NS + 25 * S_NS for stream in played.core.streams.values())


def test_a_node_that_comes_back_has_no_second_outcome_for_its_old_frames():
    """B is away for longer than a gap, and a's clock goes back meanwhile: nothing near b's stamps confirms them."""
    away = [("die_or_come_back", "b"), ("go_on", 4.0), ("set_the_clock_of_a_node", "a", -86_400), ("go_on", 2.0)]
    again = [("deliver_again", back) for back in range(1, 70)]
    play(200, ("cut_the_link", "c"), ("go_on", 1.0), *away, ("die_or_come_back", "b"), ("go_on", 2.0), *again)


if __name__ == "__main__":
    count, first = (int(word) for word in (*sys.argv[1:], "0")[:2])
    for seed in range(first, first + count):
        period_ms, chosen, steps = of_seed(seed)
        try:
            play(period_ms, *steps, chosen=chosen)
        except Exception:
            print(f"seed {seed} fails: play({period_ms}, *{steps}, chosen={chosen})", flush=True)
            raise
        if (seed + 1 - first) % 1000 == 0:
            print(f"{seed + 1 - first} schedules, no failure", flush=True)
