"""The live service's own part: it tells the core when each message has come."""

from buddyline.protocol.bus import Received
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode
from buddyline.protocol.messages import Candidates
from buddyline.protocol.topics import key_of
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.service import SolverService

from tests.fuzz.targets import Capture


def test_frames_that_were_held_up_wait_for_the_other_node(dive):
    service = SolverService(SolverConfig(nodes=["a", "b"]))
    service.attach(Capture())
    first, *rest = (m for m in dive[0] if m.node == "a" and isinstance(m, Candidates))
    service.receive(Received(key_of(first), encode(first), first.stamp_ns, ""))
    for frame in rest:
        service.receive(Received(key_of(frame), encode(frame), first.stamp_ns + 6 * S_NS, ""))
    assert service._core.pending == len(rest) + 1
