"""The live service's own part: what it tells the core of the time."""

import pytest

from protocol.bus import Received
from protocol.clock import S_NS, ManualClock
from protocol.codec import encode
from protocol.messages import Candidates
from protocol.topics import key_of
from solver_service.config import SolverConfig
from solver_service.service import SolverService
from tests.fuzz.targets import Capture
from tests.solver_service.conftest import START_NS


@pytest.mark.parametrize(("age_s", "given_up"), [(6, False), (86_400, True)], ids=["live", "stored"])
def test_frames_of_a_live_dive_that_were_held_up_wait_for_the_other_node(dive, age_s, given_up, monkeypatch):
    service = SolverService(SolverConfig(nodes=["a", "b"]), clock=ManualClock(START_NS + age_s * S_NS))
    service.attach(Capture())
    frames = [m for m in dive[0] if m.node == "a" and isinstance(m, Candidates)]
    now_s = [100.0]
    monkeypatch.setattr("solver_service.service.time.monotonic", lambda: now_s[0])
    service.receive(Received(key_of(frames[0]), encode(frames[0]), 0, ""))
    now_s[0] += 5.0
    for frame in frames[1:]:
        service.receive(Received(key_of(frame), encode(frame), 0, ""))
    assert (service._core.counts["unmatched"] > 0) is given_up
