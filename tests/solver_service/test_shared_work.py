"""Solvers that share the work: one ends or stands still, and every trigger still has one outcome."""

import tempfile
from collections import Counter
from pathlib import Path
from types import SimpleNamespace

import pytest
from buddyline.protocol.clock import ManualClock
from buddyline.protocol.codec import decode
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import Candidates
from buddyline.protocol.topics import key_of, parse_key
from buddyline.solver_service import shared_work
from buddyline.solver_service.config import SolverConfig, TrackConfig
from buddyline.solver_service.service import SolverService
from buddyline.solver_service.shared_work import FROZEN_S, TWICE
from msgspec.structs import replace

from tests.processes import until
from tests.soak.shared import soak
from tests.solver_service.conftest import START_NS, dive_messages

PAIRS = {("a", "b"), ("a", "c"), ("b", "c")}


class Team:
    """A bus in this process, three nodes, and solvers whose time the test tells."""

    def __init__(self, monkeypatch):
        self.clock, self.now_s = ManualClock(START_NS), 0.0
        monkeypatch.setattr(shared_work.SharedWork.__init__, "__defaults__", (lambda: self.now_s,))
        self.network = LocalNetwork(self.clock)
        self.solvers, self.outcomes = {}, []
        told, _ = dive_messages(seconds=6.0, sensors=False)
        told += [replace(one, node="c") for one in told if one.node == "b"]
        self.messages = sorted(told, key=lambda one: one.stamp_ns)
        self.triggers = {one.trigger for one in told if isinstance(one, Candidates)}
        self.nodes = self.network.connect()
        topics = {key: parse_key(key) for key in map(key_of, told)}
        self.publishers = {key: self.nodes.publisher(topic, *ids) for key, (topic, ids) in topics.items()}
        self.nodes.subscribe(("buddyline/pair/*/*/pose", "buddyline/pair/*/*/rejected"), self.take, capacity=10_000)

    def take(self, received):
        one = decode(received.payload, parse_key(received.key)[0].schema)
        self.outcomes.append((one.node_a, one.node_b, one.trigger))

    def join(self):
        bus = self.network.connect()
        service = SolverService(SolverConfig(share=True, track=TrackConfig(rate_hz=0.0)), clock=self.clock)
        service.attach(bus)
        bus.watch_alive(service.watch)
        self.solvers[service] = bus
        return service

    def play(self, count):
        """Send so many messages; wait until each solver has taken them all."""
        part, self.messages = self.messages[:count], self.messages[count:]
        for message in part:
            self.clock.set_ns(max(self.clock.now_ns() + 1, message.stamp_ns))
            self.publishers[key_of(message)].put(message)
            if isinstance(message, Candidates):
                for service in self.solvers:
                    until(lambda of=service, one=message: newest_ns(of, one.node) >= one.stamp_ns)

    def tick(self, times=4):
        """Let time pass; each tick, every solver sees what all others show."""
        for _ in range(times):
            self.now_s += 0.6
            for service in self.solvers:
                service._work.pulse()
            for service in self.solvers:
                service.tick(False)
                for other in self.solvers:
                    until(lambda of=service, by=other: of is by or seen(by, of) == of._shown)

    def doing(self):
        return sorted(pair for service in self.solvers for pair in service.core.pairs)

    def check(self):
        """Every trigger has one outcome of each pair."""
        until(lambda: len(self.outcomes) >= len(PAIRS) * len(self.triggers))
        counts = Counter(self.outcomes)
        assert set(counts) == {(*pair, trigger) for pair in PAIRS for trigger in self.triggers}
        assert set(counts.values()) == {1}

    def finish(self):
        """Play the rest, and let every pair answer what still waits."""
        self.play(len(self.messages))
        for service in self.solvers:
            with service._lock:
                service._publish(service.core.flush())

    def close(self):
        for bus in self.solvers.values():
            bus.close()
        self.nodes.close()


def newest_ns(service, node):
    stream = service.core.streams.get(node)
    return (stream.newest_ns or 0) if stream is not None else 0


def seen(by, of):
    """What one solver sees of another."""
    sharing, other = by._work.sharing, of._work.sharing
    names = {other.name} if other.instance in sharing._others else set()
    return names | {other.task_name(task) for task, holders in sharing._held.items() if other.instance in holders}


@pytest.fixture
def team(monkeypatch):
    one = Team(monkeypatch)
    yield one
    one.close()


def test_the_pairs_of_one_that_is_gone_go_on_and_nothing_is_answered_twice(team):
    one, two = team.join(), team.join()
    team.play(60)
    team.tick()
    assert team.doing() == sorted(PAIRS)
    team.play(100)
    gone = one if one.core.pairs else two
    team.solvers.pop(gone).close()
    team.play(40)
    team.tick()
    assert team.doing() == sorted(PAIRS)
    team.finish()
    team.check()


def test_one_that_joins_claims_nothing_before_what_the_nodes_held_is_in(team):
    one = team.join()
    team.play(60)
    team.tick()
    assert team.doing() == sorted(PAIRS)
    two = SolverService(SolverConfig(share=True, track=TrackConfig(rate_hz=0.0)), clock=team.clock)
    bus = team.network.connect()
    two.attach(bus)
    bus.watch_alive(two.watch)
    until(lambda: one._work.sharing.name in two._work.sharing._alive)
    subscription, two._subscription = two._subscription, SimpleNamespace(waiting=1)
    for _ in range(4):
        team.now_s += 0.6
        two.tick(False)
    assert not two._shown
    two._subscription = subscription
    team.solvers[two] = bus
    team.tick()
    assert two._shown
    assert team.doing() == sorted(PAIRS)
    team.finish()
    team.check()


def test_one_that_stood_still_says_nothing_more_of_what_it_held(team):
    one = team.join()
    team.play(60)
    team.tick()
    assert team.doing() == sorted(PAIRS)
    until(lambda: len(team.outcomes) == one.core.counts.total() > 0)
    count = len(team.outcomes)
    team.now_s += FROZEN_S + 0.1
    team.play(30)
    assert len(team.outcomes) == count
    # It has let go of everything, and takes it up again as another would.
    team.tick(1)
    assert not one.core.pairs
    team.tick()
    assert team.doing() == sorted(PAIRS)
    team.finish()
    team.check()


def test_a_solver_that_does_not_share_is_said(team):
    one = team.join()
    team.nodes.declare_alive("solver/any")
    until(lambda: one._work.problems == [TWICE])


@pytest.mark.slow
def test_killed_ones_leave_no_trigger_without_an_answer_nor_with_two():
    """Real processes over a real hub."""
    with tempfile.TemporaryDirectory() as folder:
        found = soak(Path(folder), 2, solvers=2, nodes=3, rate_hz=2.0, track_hz=0.0, again_s=1.0)
    assert found.triggers > 30
    assert (found.missing, found.doubled) == (0, 0)
