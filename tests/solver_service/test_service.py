"""The live service's own part: it tells the core what time it is, and publishes what the core makes."""

from buddyline.protocol.bus import Received
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Candidates, SolverStatus
from buddyline.protocol.topics import key_of
from buddyline.solver_service import service as service_module
from buddyline.solver_service.config import SolverConfig
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
