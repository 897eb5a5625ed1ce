"""The contract of every bus: which messages come, in which order, and what is refused."""

from __future__ import annotations

import math
import threading
import time

import pytest
from buddyline.protocol import topics
from buddyline.protocol.bus import Received
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.codec import decode, encode, payload_stamp_ns
from buddyline.protocol.errors import MessageError
from buddyline.protocol.local_bus import key_matches
from buddyline.protocol.messages import CompressedImage, Depth, FoxgloveTime, NodeStatus, Rejected

from tests.processes import PATIENCE_S, until
from tests.protocol.buses import NOW_NS, Connect, depth, rejected, status, triggers, wait_until_heard
from tests.protocol.inbox import Inbox


def test_a_message_arrives_as_it_was_sent(client: Connect) -> None:
    inbox = Inbox()
    client().subscribe("buddyline/pair/*/*/rejected", inbox)
    client().publisher(topics.REJECTED, "a", "b").put(rejected(7))
    (received,) = inbox.wait_for(1)
    assert received.key == "buddyline/pair/a/b/rejected"
    assert received.encoding == "application/json;buddyline.Rejected"
    assert received.receive_ns == NOW_NS
    assert decode(received.payload, Rejected) == rejected(7)


def test_payloads_are_sent_unchanged(client: Connect) -> None:
    inbox = Inbox()
    client().subscribe(topics.EVERYTHING, inbox)
    client().publisher(topics.IMU, "a").put_bytes(b'{"from": "a log"}')
    assert inbox.wait_for(1)[0].payload == b'{"from": "a log"}'


def test_a_publishers_messages_come_in_order_and_once(client: Connect) -> None:
    inbox = Inbox()
    client().subscribe("buddyline/pair/a/b/rejected", inbox)
    publisher = client().publisher(topics.REJECTED, "a", "b")
    for trigger in range(500):
        publisher.put(rejected(trigger))
    inbox.wait_for(500)
    assert triggers(inbox) == list(range(500))


def test_what_was_held_up_for_more_than_a_minute_comes_before_what_is_newer(client: Connect) -> None:
    """Else a node whose link was cut for so long would seem to set its clock back and forth."""
    begun, go_on, inbox = threading.Event(), threading.Event(), Inbox()

    def handle(received: Received) -> None:
        begun.set()
        assert go_on.wait(PATIENCE_S)
        inbox(received)

    client().subscribe(topics.DEPTH.key_any(), handle)
    publisher = client().publisher(topics.DEPTH, "a")
    stamps_ns = [NOW_NS - seconds * S_NS for seconds in range(120, 0, -1)]
    for stamp_ns in stamps_ns:
        publisher.put(depth(stamp_ns))
    assert begun.wait(PATIENCE_S)
    wait_until_heard(client(), topics.DEPTH.key_any(), len(stamps_ns))
    go_on.set()
    assert [decode(received.payload, Depth).stamp_ns for received in inbox.wait_for(len(stamps_ns))] == stamps_ns


def test_a_late_joiner_gets_the_history_before_new_messages(client: Connect) -> None:
    publisher, inbox = client().publisher(topics.REJECTED, "a", "b"), Inbox()
    for trigger in range(100):
        publisher.put(rejected(trigger))
    wait_until_heard(client(), "buddyline/pair/*/*/rejected", 100)
    subscription = client().subscribe("buddyline/pair/*/*/rejected", inbox)
    for trigger in range(100, 150):
        publisher.put(rejected(trigger))
    inbox.wait_for(150)
    assert triggers(inbox) == list(range(150))
    assert subscription.missed == 0


def test_a_late_joiner_gets_the_latest_state_before_any_stream(client: Connect) -> None:
    node, inbox = client(), Inbox()
    depths = node.publisher(topics.DEPTH, "a")
    states = node.publisher(topics.NODE_STATUS, "a")
    for i in range(3):
        depths.put(depth(i))
        states.put(status("a", float(i)))
    wait_until_heard(client(), topics.DEPTH.key_any(), 3)
    wait_until_heard(client(), topics.NODE_STATUS.key_any(), 1)
    client().subscribe(topics.EVERYTHING, inbox)
    received = inbox.wait_for(4)
    assert [topics.parse_key(r.key) for r in received] == [
        (topics.NODE_STATUS, ("a",)),
        *[(topics.DEPTH, ("a",))] * 3,
    ]
    assert decode(received[0].payload, NodeStatus).uptime_s == 2.0


def test_a_late_joiner_gets_two_nodes_messages_by_their_stamps(client: Connect) -> None:
    node, inbox = client(), Inbox()
    for name, first in (("b", 1), ("a", 0)):
        publisher = node.publisher(topics.DEPTH, name)
        for i in range(first, 100, 2):
            publisher.put(depth(i, name))
    wait_until_heard(client(), "buddyline/node/*/depth", 100)
    client().subscribe("buddyline/node/*/depth", inbox)
    assert [decode(r.payload, Depth).stamp_ns for r in inbox.wait_for(100)] == list(range(100))


def test_a_late_joiner_gets_several_keys_messages_by_their_stamps_and_then_both(client: Connect) -> None:
    node, inbox = client(), Inbox()
    depths, answers = node.publisher(topics.DEPTH, "a"), node.publisher(topics.REJECTED, "a", "b")
    for i in range(0, 100, 2):
        depths.put(depth(i))
    for i in range(1, 100, 2):
        answers.put(rejected(i))
    for topic in (topics.DEPTH, topics.REJECTED):
        wait_until_heard(client(), topic.key_any(), 50)
    client().subscribe((topics.DEPTH.key_any(), topics.REJECTED.key_any()), inbox)
    assert [payload_stamp_ns(r.payload) for r in inbox.wait_for(100)] == list(range(100))
    depths.put(depth(100))
    inbox.wait_for(101)
    answers.put(rejected(101))
    inbox.wait_for(102)
    assert [payload_stamp_ns(r.payload) for r in inbox.received] == list(range(102))


def test_the_newest_message_is_known_after_its_publisher_is_gone(client: Connect) -> None:
    solver, reader = client(), client()

    def known() -> list[tuple[str, int]]:
        newest = reader.newest(topics.REJECTED)
        return sorted((r.key, decode(r.payload, Rejected).trigger) for r in newest if "/gone/" in r.key)

    assert known() == []
    publishers = [solver.publisher(topics.REJECTED, "gone", end) for end in "hi"]
    # The hub may miss a publisher's first message; subscribers recover it, but the hub's retained copy does not.
    numbers = iter(range(10_000))

    def all_known() -> bool:
        trigger = next(numbers)
        for publisher in publishers:
            publisher.put(rejected(trigger))
        return [trigger for _, trigger in known()] == [trigger, trigger]

    until(all_known)
    solver.close()
    newest = known()
    assert [key for key, _ in newest] == [topics.REJECTED.key("gone", end) for end in "hi"]
    assert newest[0][1] == newest[1][1] == next(numbers) - 1
    assert reader.newest(topics.POSE) == []


def test_without_history_only_new_messages_come(client: Connect) -> None:
    publisher, inbox = client().publisher(topics.REJECTED, "a", "b"), Inbox()
    for trigger in range(10):
        publisher.put(rejected(trigger))
    wait_until_heard(client(), "buddyline/pair/a/b/rejected", 10)
    subscription = client().subscribe("buddyline/pair/a/b/rejected", inbox, history=False)
    trigger = 10
    while not inbox.received:
        publisher.put(rejected(trigger))
        trigger += 1
        time.sleep(0.002)
    assert min(triggers(inbox)) >= 10
    assert subscription.missed == 0


def test_what_is_sent_again_comes_to_those_who_have_missed_it(client: Connect) -> None:
    """A publisher that takes another's place says its last messages again."""
    first, second, known, without = client(), client(), Inbox(), Inbox()
    viewer = client()
    viewer.subscribe("buddyline/pair/a/b/rejected", known)
    viewer.subscribe("buddyline/pair/a/b/rejected", without, history=False)
    publisher = first.publisher(topics.REJECTED, "a", "b")
    for trigger in (1, 2, 4):
        publisher.put(rejected(trigger))
    known.wait_for(3)
    first.close()
    publisher = second.publisher(topics.REJECTED, "a", "b")
    for trigger in (1, 2, 3, 4):
        assert publisher.repeat(encode(rejected(trigger)))
    publisher.put(rejected(5))
    known.wait_for(5)
    # What is said anew, as in a dive that is played twice, is not said again.
    publisher.put(rejected(4))
    known.wait_for(6)
    assert triggers(known) == [1, 2, 4, 3, 5, 4]
    late = Inbox()
    client().subscribe("buddyline/pair/a/b/rejected", late)
    late.wait_for(6)
    assert sorted(triggers(late)) == [1, 2, 3, 4, 4, 5]
    assert 3 not in triggers(without)
    with pytest.raises(ValueError, match="depth is not repeated"):
        second.publisher(topics.DEPTH, "a").repeat(b"{}")


def test_the_first_sending_that_comes_after_the_second_is_left_out(client: Connect) -> None:
    """What a killed publisher had sent may wait for a lost message before it, and its successor is heard first."""
    first, second, known = client(), client(), Inbox()
    client().subscribe("buddyline/pair/a/b/rejected", known)
    after = second.publisher(topics.REJECTED, "a", "b")
    assert after.repeat(encode(rejected(1)))
    known.wait_for(1)
    publisher = first.publisher(topics.REJECTED, "a", "b")
    publisher.put(rejected(1))
    publisher.put(rejected(2))
    known.wait_for(2)
    assert triggers(known) == [1, 2]
    # The next time it is a dive that is played twice.
    publisher.put(rejected(1))
    known.wait_for(3)
    assert triggers(known) == [1, 2, 1]


def test_only_the_subscribed_keys_come(client: Connect) -> None:
    node, asked, all_of_b = client(), Inbox(), Inbox()
    bus = client()
    bus.subscribe("buddyline/node/*/depth", asked)
    bus.subscribe("buddyline/node/b/**", all_of_b)
    node.publisher(topics.NODE_STATUS, "a").put(status("a", 1.0))
    node.publisher(topics.NODE_STATUS, "b").put(status("b", 1.0))
    node.publisher(topics.DEPTH, "a").put(depth(1))
    assert [r.key for r in asked.wait_for(1)] == ["buddyline/node/a/depth"]
    assert [r.key for r in all_of_b.wait_for(1)] == ["buddyline/node/b/status"]


def test_an_invalid_message_and_one_of_another_topic_are_refused(client: Connect) -> None:
    publisher = client().publisher(topics.DEPTH, "a")
    with pytest.raises(MessageError, match="depth_m"):
        publisher.put(Depth(node="a", stamp_ns=1, depth_m=math.nan, sigma_m=0.1))
    with pytest.raises(TypeError, match="Depth"):
        publisher.put(rejected(1))


def test_an_invalid_node_id_is_refused(client: Connect) -> None:
    with pytest.raises(topics.BuddylineError, match="a/b"):
        client().publisher(topics.DEPTH, "a/b")


def test_previews_are_capped_and_never_kept(client: Connect) -> None:
    node, inbox, late = client(), Inbox(), Inbox()
    image = CompressedImage(timestamp=FoxgloveTime(sec=1, nsec=0), frame_id="a_camera", data=b"jpeg", format="jpeg")
    client().subscribe("buddyline/node/*/image", inbox)
    publisher = node.publisher(topics.IMAGE, "a", max_rate_hz=10.0)
    clock = node.clock
    assert isinstance(clock, ManualClock)

    def sent() -> bool:
        clock.set_ns(clock.now_ns() + 100_000_000)
        return publisher.put(image)

    # Over Zenoh they have a session of their own, which comes up meanwhile; what is sent before the hub knows of the
    # publisher may be lost.
    until(lambda: sent() and inbox.received)
    clock.set_ns(clock.now_ns() + 99_000_000)
    assert not publisher.put(image)
    bus = client()
    bus.subscribe(topics.EVERYTHING, late)
    node.publisher(topics.DEPTH, "a").put(depth(1))
    assert [r.key for r in late.wait_for(1)] == ["buddyline/node/a/depth"]


@pytest.mark.parametrize(
    ("key_expr", "key", "matches"),
    [
        ("a/b", "a/b", True),
        ("a/b", "a", False),
        ("a", "a/b", False),
        ("a/*", "a/b", True),
        ("a/*", "a", False),
        ("a/*", "a/b/c", False),
        ("a/**", "a", True),
        ("a/**", "a/b/c", True),
        ("**/c", "a/b/c", True),
        ("a/**/c", "a/c", True),
        ("a/**/c", "a/b/d", False),
        ("a/**", "a/@alive/b", False),
        ("a/*/b", "a/@alive/b", False),
        ("a/@alive/**", "a/@alive/b", True),
    ],
)
def test_key_expressions_match_chunks(key_expr: str, key: str, matches: bool) -> None:
    assert key_matches(key_expr, key) is matches


def test_a_payload_above_its_topics_limit_is_not_sent_and_said_once(
    client: Connect, caplog: pytest.LogCaptureFixture
) -> None:
    inbox, sender, receiver = Inbox(), client(), client()
    receiver.subscribe(topics.DEPTH.key_any(), inbox)
    publisher = sender.publisher(topics.DEPTH, "a")
    assert not publisher.put_bytes(bytes(topics.DEPTH.max_bytes + 1))
    assert not publisher.put_bytes(bytes(topics.DEPTH.max_bytes + 1))
    assert publisher.put_bytes(bytes(topics.DEPTH.max_bytes))
    assert [len(received.payload) for received in inbox.wait_for(1)] == [topics.DEPTH.max_bytes]
    assert len([record for record in caplog.records if "not sent" in record.message]) == 1


def test_questions_are_answered_in_order(client: Connect) -> None:
    desk, asker = client(), client()
    desk.answer("buddyline/node/a/log", lambda text: [text.encode(), b"second", b"third" * 1000])
    until(lambda: asker.ask("buddyline/node/a/log", "since=1;until=2", 5.0))
    assert asker.ask("buddyline/node/a/log", "since=1;until=2", 5.0) == [b"since=1;until=2", b"second", b"third" * 1000]
    assert asker.ask("buddyline/node/b/log", "since=1;until=2", 5.0) == []
    desk.close()
    assert asker.ask("buddyline/node/a/log", "since=1;until=2", 5.0) == []
