"""The live service's own part: it tells the core what time it is, and publishes what the core makes."""

from collections import Counter
from types import SimpleNamespace

import pytest
from buddyline.protocol.bus import Received
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Candidates, NodeInfo, Rejected, RelativePose, SolverStatus
from buddyline.protocol.topics import key_of
from buddyline.solver_service import service as service_module
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.resting import CROWD, LOOKS, NO_TIME
from buddyline.solver_service.service import SolverService
from msgspec.structs import replace

from tests.fuzz.targets import Capture


def take(service, message):
    service.receive(Received(key_of(message), encode(message), service.clock.now_ns(), ""))


def test_a_backlog_is_no_standstill(monkeypatch):
    """The thread that ticks waits for the lock for longer than a stuck thread may: it beats while the other goes on."""
    monkeypatch.setattr(service_module, "WAIT_S", 0.001)
    service = SolverService(SolverConfig(), clock=ManualClock(0))
    beats = []

    def beat():
        beats.append(service._handled)
        service._handled += len(beats) < 3
        if len(beats) == 3:
            service._lock.release()

    monkeypatch.setattr(service, "heartbeat", beat)
    service._lock.acquire()
    service.tick(status_due=False)
    assert beats == [0, 1, 2]


def test_a_backlog_waits_for_the_other_node(dive):
    """Four seconds of a's frames come at once after an outage; b's are still on their way."""
    first, *rest = (m for m in dive[0] if m.node == "a" and isinstance(m, Candidates))
    clock = ManualClock(first.stamp_ns)
    service = SolverService(SolverConfig(nodes=["a", "b"]), clock=clock)
    service.attach(Capture())
    clock.set_ns(first.stamp_ns + 6 * S_NS)
    for frame in (first, *rest):
        take(service, frame)
    assert service.core.pending == len(rest) + 1


def test_pairs_form_as_nodes_appear_and_each_has_its_status(dive):
    bus, clock = Capture(), ManualClock()
    service = SolverService(SolverConfig(), clock=clock)
    service.attach(bus)
    frames = [m for m in dive[0] if m.node == "a" and isinstance(m, Candidates)][:3]
    for node in ("a", "c", "b"):
        for frame in frames:
            take(service, replace(frame, node=node))
    service.report()
    said = [m for m in bus.published if isinstance(m, SolverStatus)]
    assert {(one.node_a, one.node_b) for one in said} == {("a", "b"), ("a", "c"), ("b", "c")}
    assert all(one.received_a == one.received_b == len(frames) for one in said)


def test_the_configuration_restricts_and_what_is_not_used_is_named(dive):
    bus = Capture()
    service = SolverService(SolverConfig(pairs=[("c", "a")]), clock=ManualClock())
    service.attach(bus)
    frame = next(m for m in dive[0] if isinstance(m, Candidates))
    for node in ("a", "b", "c", "d"):
        take(service, replace(frame, node=node))
    service.report()
    (said,) = (m for m in bus.published if isinstance(m, SolverStatus))
    assert (said.node_a, said.node_b, said.unused) == ("c", "a", ["b", "d"])


def outcomes_of(bus):
    return [one for one in bus.published if isinstance(one, RelativePose | Rejected)]


def test_messages_that_wait_are_solved_together_and_give_the_same(dive, monkeypatch):
    """One solver has a queue behind each message, the other has not."""
    calls, said = [], []
    handle = service_module.SolverCore.handle_many
    monkeypatch.setattr(
        service_module.SolverCore, "handle_many", lambda core, *args: calls.append(1) or handle(core, *args)
    )
    for waiting in (0, 1):
        bus, clock = Capture(), ManualClock()
        service = SolverService(SolverConfig(nodes=["a", "b"]), clock=clock)
        service.attach(bus)
        service._subscription = SimpleNamespace(waiting=waiting)
        calls.clear()
        for message in dive[0]:
            clock.set_ns(message.stamp_ns)
            take(service, message)
        service._subscription.waiting = 0
        service.tick(status_due=False)
        service._publish(service.core.flush())
        said.append([(one.trigger, getattr(one, "reason", "")) for one in outcomes_of(bus)])
        assert (len(calls) < len(dive[0]) / 50) is bool(waiting)
    assert said[0] == said[1]
    assert len(said[0]) > 20


def test_what_waits_when_the_solver_ends_is_solved(dive):
    bus, clock = Capture(), ManualClock()
    service = SolverService(SolverConfig(nodes=["a", "b"]), clock=clock)
    service.attach(bus)
    service._subscription = SimpleNamespace(waiting=1)
    for message in dive[0][:200]:
        clock.set_ns(message.stamp_ns)
        take(service, message)
    assert service._came
    service.finish()
    triggers = {m.trigger for m in dive[0][:200] if isinstance(m, Candidates)}
    assert {one.trigger for one in outcomes_of(bus)} == triggers


def test_a_node_without_lamps_whose_frames_came_first_ends_no_solver(dive):
    """Frames of a and b form a pair; what says that b has a camera alone waits behind them."""
    bus, clock = Capture(), ManualClock()
    service = SolverService(SolverConfig(), clock=clock)
    service.attach(bus)
    service._subscription = SimpleNamespace(waiting=1)
    infos = {m.node: m for m in dive[0] if isinstance(m, NodeInfo)}
    frames = [m for m in dive[0] if isinstance(m, Candidates)]
    for message in [infos["a"], *frames, replace(infos["b"], role="camera")]:
        clock.set_ns(frames[-1].stamp_ns)
        take(service, message)
    service._subscription.waiting = 0
    service.tick(status_due=True)
    assert not service.core.pairs
    take(service, infos["b"])
    assert list(service.core.pairs) == [("a", "b")], "a node that has lamps after all"


@pytest.mark.parametrize("nodes", [2, CROWD])
def test_a_solver_that_cannot_keep_up_says_so_and_in_a_crowd_solves_less(dive, nodes):
    """The frames of each node wait for four seconds in it, until the queue is empty."""
    bus, clock = Capture(), ManualClock()
    service = SolverService(SolverConfig(), clock=clock)
    service.attach(bus)
    service._subscription = SimpleNamespace(waiting=1)
    frames = [m for m in dive[0] if m.node == "a" and isinstance(m, Candidates)]
    infos = [m for m in dive[0] if m.node == "a" and isinstance(m, NodeInfo)]
    slow, after = frames[: len(frames) // 2], frames[len(frames) // 2 :]
    names = "abcdefgh"[:nodes]

    def receive(message, late_ns):
        for node in names:
            one = replace(message, node=node)
            clock.set_ns(one.stamp_ns + late_ns)
            service.receive(Received(key_of(one), encode(one), one.stamp_ns, ""))

    for message in infos + slow:
        receive(message, 4 * S_NS)
        service._take_all()
    service.report()
    (problem,) = {m.problem for m in bus.published if isinstance(m, SolverStatus)}
    assert "the solver is 4 s behind" in problem
    service._subscription.waiting = 0
    service.tick(status_due=False)
    for message in after:
        receive(message, 0)
    bus.published, seen = [], bus.published
    service.report()
    assert not any("behind" in m.problem for m in bus.published if isinstance(m, SolverStatus))
    service._publish(service.core.flush())
    bus.published = seen + bus.published
    told = outcomes_of(bus)
    pairs = nodes * (nodes - 1) // 2
    assert Counter(one.trigger for one in told) == {frame.trigger: pairs for frame in frames}
    left_out = {one.trigger for one in told if isinstance(one, Rejected) and one.detail == NO_TIME}
    assert left_out <= {frame.trigger for frame in slow if frame.trigger % (LOOKS * LOOKS)}
    assert bool(left_out) is (nodes == CROWD)
