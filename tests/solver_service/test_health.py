"""Which node is gone, silent, or of another time; and the live solver says so within two seconds."""

import threading
import time

import pytest
from buddyline.protocol.codec import decode, encode
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import Blink, Candidates, NodeInfo
from buddyline.protocol.topics import INFO, SOLVER_STATUS
from buddyline.solver_service.config import SolverConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.health import Health
from buddyline.solver_service.service import SolverService
from msgspec.structs import replace

from tests.processes import PATIENCE_S
from tests.solver_service.conftest import dive_messages

S_NS = 1_000_000_000
AB = ("a", "b")
TWINS_OF_B = "two nodes have the id b: give each its own"


@pytest.fixture
def health():
    health = Health()
    for node in ("a", "b"):
        health.saw_process(f"node/{node}", True)
        health.saw_period(node, S_NS // 10)
        health.saw_frame(node, 100 * S_NS, now_ns=50 * S_NS)
    assert health.problems(AB, 50500 * S_NS // 1000) == []
    return health


def test_nothing_has_come_yet():
    assert Health().problems(AB, 0) == ["no frame of node a yet", "no frame of node b yet"]


def test_a_node_that_is_gone_is_named_until_it_is_back(health):
    health.saw_process("node/b", False)
    health.saw_process("node/c", False)
    health.saw_process("b", False)
    assert health.problems(AB, 50500 * S_NS // 1000) == ["node b is gone: its process ended, or its link"]
    health.saw_process("node/b", True)
    assert health.problems(AB, 50500 * S_NS // 1000) == []


def test_a_silent_node_is_named_within_two_seconds_with_the_status_interval(health):
    health.saw_frame("a", 101 * S_NS, now_ns=51 * S_NS)
    assert health.problems(AB, 51010 * S_NS // 1000) == ["no frame of node b for 1 s"]


def test_a_node_with_rare_triggers_is_not_called_silent_between_them(health):
    health.saw_period("b", 2 * S_NS)
    health.saw_frame("a", 103 * S_NS, now_ns=55 * S_NS)
    assert "no frame" not in "".join(health.problems(AB, 55500 * S_NS // 1000))
    silent = ["no frame of node a for 2 s", "no frame of node b for 6 s"]
    assert health.problems(AB, 56500 * S_NS // 1000)[:2] == silent


@pytest.mark.parametrize(("ahead_s", "first", "second"), [(3600, "b", "a"), (-3600, "a", "b"), (1.5, "b", "a")])
def test_clocks_that_disagree_are_named_with_their_difference(health, ahead_s, first, second):
    health.saw_frame("a", 101 * S_NS, now_ns=51 * S_NS)
    health.saw_frame("b", 101 * S_NS + round(ahead_s * S_NS), now_ns=51 * S_NS)
    (said,) = health.problems(AB, 51200 * S_NS // 1000)
    assert said.startswith(f"frames of {first} are {abs(ahead_s):.1f} s ahead of those of {second}")


def frame(node, boot, seq, seconds):
    stamp_ns = round(seconds * S_NS)
    trigger = round(seconds * 10)
    return Candidates(
        node=node, boot=boot, seq=seq, stamp_ns=stamp_ns, trigger=trigger, width_px=820, height_px=616, blobs=[]
    )


def test_two_nodes_of_one_id_are_named_while_both_send(health):
    """A node that starts again, and whose earlier frames come late, is one node."""
    for k in range(8):
        health.saw_run(frame("a", "first", k, 100 + k), now_ns=50 * S_NS)
    for k in range(8):
        health.saw_run(frame("a", "second", k, 110 + k), now_ns=50 * S_NS)
        health.saw_run(frame("a", "first", 9 - k, 109 - k), now_ns=50 * S_NS)
    assert health.problems(AB, 50500 * S_NS // 1000) == []
    for k in range(6):
        health.saw_run(frame("b", ("first", "second")[k % 2], k, 100 + k), now_ns=50 * S_NS)
    assert health.problems(AB, 50500 * S_NS // 1000) == [TWINS_OF_B]
    assert "two nodes" not in "".join(health.problems(AB, 70 * S_NS))
    # A dive that is over is judged as a whole.
    assert health.of_dive(AB) == [TWINS_OF_B]


@pytest.mark.parametrize(("other_seq", "later_s"), [(500, 0.01), (500, -0.01), (5, 0.01), (5, -0.01), (40, 0.01)])
def test_two_nodes_of_one_id_and_one_boot_are_named(other_seq, later_s):
    """Whichever counts farther, and whichever is exposed first. One whose clock is set back is no second one."""
    core = SolverCore(Settings())
    for node in AB:
        for k in range(20):
            core.handle(frame(node, "boot", 40 + k, 100 + k / 10), (100 + k // 10) * S_NS)
    for k in range(10):
        core.handle(frame("a", "boot", 60 + k, 101 + k / 10), 102 * S_NS)
    assert core.health.of_dive(AB) == []
    for k in range(6):
        for seq, at_s in ((40 + k, 104), (other_seq + k, 104 + later_s)):
            core.handle(frame("b", "boot", 20 + seq, at_s + k / 10), 104 * S_NS)
    assert core.health.of_dive(AB) == [TWINS_OF_B]
    assert TWINS_OF_B in core.health.problems(AB, 105 * S_NS)


def test_a_node_with_pictures_of_another_size_than_its_calibration_is_named_while_they_come():
    messages, _ = dive_messages(seconds=2.0, sensors=False)
    core = SolverCore(Settings(), [AB])
    for one in messages:
        early = isinstance(one, Candidates) and one.node == "b" and one.stamp_ns < messages[0].stamp_ns + S_NS
        core.handle(replace(one, width_px=1640, height_px=1232) if early else one, one.stamp_ns)
        if early:
            said = core.health.problems(AB, one.stamp_ns)
    expected = "pictures of node b are 1640x1232 px, its calibration 820x616: they are not used"
    assert said == [expected]
    assert core.health.problems(AB, messages[-1].stamp_ns) == []
    # A dive that is over is judged as a whole.
    assert core.health.of_dive(AB) == [expected]


def test_nodes_that_blink_by_one_code_are_named(health):
    blink = Blink(code=3, lamp="left", slot_ns=S_NS // 10)
    health.saw_blink("a", blink)
    health.saw_blink("b", replace(blink, code=4))
    health.saw_blink("c", replace(blink, slot_ns=S_NS // 5))
    assert health.problems(AB, 50500 * S_NS // 1000) == []
    health.saw_blink("b", replace(blink, lamp="right"))
    said = "nodes a and b blink by one code: give each another `blink.code`"
    assert health.problems(AB, 50500 * S_NS // 1000) == [said]
    health.saw_blink("b", None)
    assert health.problems(AB, 50500 * S_NS // 1000) == []


def test_nodes_of_two_rates_are_named(health):
    """No trigger is of both: all would be `unmatched` or `late`."""
    health.saw_period("a", S_NS // 10)
    health.saw_period("b", S_NS // 10)
    assert health.problems(AB, 50500 * S_NS // 1000) == health.of_dive(AB) == []
    health.saw_period("b", S_NS // 5)
    said = ["nodes a and b take 10 and 5 pictures a second: give both one `rate_hz`"]
    assert health.problems(AB, 50500 * S_NS // 1000) == health.of_dive(AB) == said


def test_the_latency_of_a_link_is_no_disagreement(health):
    health.saw_frame("a", 101 * S_NS, now_ns=51 * S_NS)
    health.saw_frame("b", 100 * S_NS + S_NS // 5, now_ns=51 * S_NS)
    assert health.problems(AB, 51200 * S_NS // 1000) == []


def test_the_solver_says_at_once_that_a_nodes_process_is_gone():
    network = LocalNetwork()
    said = threading.Condition()
    problems = []

    def hear(received):
        with said:
            problems.append(decode(received.payload, SOLVER_STATUS.schema).problem)
            said.notify_all()

    def heard(words):
        return any(words in problem for problem in problems)

    messages, _ = dive_messages(seconds=0.3)
    service = SolverService(SolverConfig())
    with network.connect() as viewer, network.connect() as own, network.connect() as node:
        viewer.subscribe(SOLVER_STATUS.key("a", "b"), hear)
        node.declare_alive("node/b")
        service.attach(own)
        own.watch_alive(service.watch)
        for message in messages:
            if isinstance(message, NodeInfo):
                node.publisher(INFO, message.node).put_bytes(encode(message))
        deadline_s = time.monotonic() + PATIENCE_S
        while not service.core.pairs and time.monotonic() < deadline_s:
            service.stop.wait(0.01)
        node.close()
        deadline_s = time.monotonic() + PATIENCE_S
        while not heard("node b is gone") and time.monotonic() < deadline_s:
            service.tick(status_due=False)
            with said:
                said.wait(0.01)
        assert heard("node b is gone"), problems


def test_a_process_is_news_once_and_only_a_node_is():
    health = Health()
    assert health.saw_process("node/a", True)
    assert not health.saw_process("node/a", True)
    assert not health.saw_process("viewer/x", True)
    assert health.saw_process("node/a", False)
    many = [health.saw_process(f"node/n{k}", True) for k in range(10_000)]
    assert sum(many) < 300


def test_a_node_of_another_release_is_named(health, monkeypatch):
    monkeypatch.setattr("buddyline.solver_service.health.__version__", "0.2.1.dev14+g3c71112")
    health.saw_software("a", "buddyline 0.2.0")
    health.saw_software("b", "another program 0.1")
    assert health.problems(AB, 50 * S_NS) == []
    health.saw_software("b", "buddyline 0.1.9")
    assert health.problems(AB, 50 * S_NS) == ["node b runs Buddyline 0.1, this solver 0.2: update the older"]
    # Out of the logs, too.
    assert health.of_dive(AB) == ["node b ran Buddyline 0.1, this is 0.2"]
