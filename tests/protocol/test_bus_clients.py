"""The contract of every bus: its handlers, how it closes, and who is alive."""

from __future__ import annotations

import threading

import pytest
from buddyline.protocol import topics
from buddyline.protocol.bus import Received
from buddyline.protocol.codec import decode, encode
from buddyline.protocol.messages import Candidates, Depth

from tests.processes import PATIENCE_S, until
from tests.protocol.buses import Connect, depth, rejected, triggers, wait_until_heard
from tests.protocol.inbox import Inbox


def test_a_slow_handler_loses_the_oldest_messages_and_they_are_counted(client: Connect) -> None:
    publisher, inbox = client().publisher(topics.REJECTED, "a", "b"), Inbox()
    begun, go_on = threading.Event(), threading.Event()

    def slow(received: Received) -> None:
        begun.set()
        assert go_on.wait(PATIENCE_S)
        inbox(received)

    subscription = client().subscribe("buddyline/pair/a/b/rejected", slow, capacity=5)
    publisher.put(rejected(0))
    assert begun.wait(PATIENCE_S)
    for trigger in range(1, 31):
        publisher.put(rejected(trigger))
    until(lambda: subscription.dropped >= 25)
    go_on.set()
    inbox.wait_for(6)
    assert triggers(inbox) == [0, 26, 27, 28, 29, 30]
    assert (subscription.dropped, subscription.missed) == (25, 0)


def test_a_blocked_handler_does_not_starve_another(client: Connect) -> None:
    bus, node, inbox = client(), client(), Inbox()
    go_on = threading.Event()
    bus.subscribe("buddyline/pair/*/*/rejected", lambda _: go_on.wait(PATIENCE_S) and None, capacity=2)
    bus.subscribe("buddyline/node/*/depth", inbox)
    stuck, depths = node.publisher(topics.REJECTED, "a", "b"), node.publisher(topics.DEPTH, "a")
    for i in range(200):
        stuck.put(rejected(i))
        depths.put(depth(i))
    assert [decode(r.payload, Depth).stamp_ns for r in inbox.wait_for(200)] == list(range(200))
    go_on.set()


def test_what_comes_is_told_before_it_waits_for_the_handler(client: Connect) -> None:
    bus, node = client(), client()
    go_on, arrived, handled = threading.Event(), list[tuple[str, bytes]](), list[bytes]()

    def slow(received: Received) -> None:
        assert go_on.wait(PATIENCE_S)
        handled.append(received.payload)

    publisher = node.publisher(topics.REJECTED, "a", "b")
    publisher.put(rejected(0))
    wait_until_heard(client(), topics.REJECTED.key_any(), 1)
    bus.subscribe("buddyline/pair/*/*/rejected", slow, on_arrival=lambda key, payload: arrived.append((key, payload)))
    # What was held has come, too.
    assert [key for key, _ in arrived] == [publisher.key]
    for trigger in range(1, 10):
        publisher.put(rejected(trigger))
    until(lambda: len(arrived) == 10)
    assert handled == []
    go_on.set()
    until(lambda: len(handled) == 10)
    assert handled == [encode(rejected(trigger)) for trigger in range(10)]
    # One that was lost on the way is fetched, and has come after later ones.
    assert sorted(handled) == sorted(payload for _, payload in arrived)


def test_an_exception_in_a_handler_becomes_the_buss_failure(client: Connect) -> None:
    bus, node, inbox = client(), client(), Inbox()
    failed = threading.Event()

    def broken(received: Received) -> None:
        raise ZeroDivisionError("a bug")

    bus.on_failure(lambda _: failed.set())
    bus.subscribe("buddyline/node/*/depth", broken)
    bus.subscribe("buddyline/pair/*/*/rejected", inbox)
    assert bus.failure is None
    node.publisher(topics.DEPTH, "a").put(depth(1))
    assert failed.wait(PATIENCE_S)
    assert isinstance(bus.failure.__cause__, ZeroDivisionError)
    assert "buddyline/node/*/depth" in str(bus.failure)
    node.publisher(topics.REJECTED, "a", "b").put(rejected(1))
    inbox.wait_for(1)
    late: list[Exception] = []
    bus.on_failure(late.append)
    assert late == [bus.failure]


def test_a_handler_can_publish(client: Connect) -> None:
    """As the solver does."""
    solver, node, inbox = client(), client(), Inbox()
    answers = solver.publisher(topics.REJECTED, "a", "b")

    def answer(received: Received) -> None:
        answers.put(rejected(decode(received.payload, Candidates).trigger))

    solver.subscribe("buddyline/node/*/candidates", answer)
    client().subscribe("buddyline/pair/*/*/rejected", inbox)
    node.publisher(topics.CANDIDATES, "a").put(
        Candidates(node="a", stamp_ns=1, trigger=3, seq=0, boot="x", width_px=640, height_px=480, blobs=[])
    )
    inbox.wait_for(1)
    assert triggers(inbox) == [3]


def test_closing_lets_the_handler_finish_the_queue(client: Connect) -> None:
    publisher, inbox = client().publisher(topics.REJECTED, "a", "b"), Inbox()
    for trigger in range(200):
        publisher.put(rejected(trigger))
    wait_until_heard(client(), "buddyline/pair/a/b/rejected", 200)
    go_on, arrived = threading.Event(), list[bytes]()

    def slow(received: Received) -> None:
        assert go_on.wait(PATIENCE_S)
        inbox(received)

    subscription = client().subscribe(
        "buddyline/pair/a/b/rejected", slow, on_arrival=lambda _, payload: arrived.append(payload)
    )
    until(lambda: len(arrived) == 200)
    closing = threading.Thread(target=subscription.close)
    closing.start()
    go_on.set()
    closing.join(PATIENCE_S)
    assert triggers(inbox) == list(range(200))


def test_a_closed_bus_sends_nothing_and_leaves_no_thread(client: Connect) -> None:
    before = set(threading.enumerate())
    bus = client()
    publisher = bus.publisher(topics.DEPTH, "a")
    bus.publisher(topics.IMAGE, "a")
    bus.subscribe(topics.EVERYTHING, Inbox())
    bus.watch_alive(lambda name, alive: None)
    assert publisher.put(depth(1))
    bus.close()
    bus.close()
    assert not publisher.put(depth(2))
    # Threads of Zenoh end a moment after their subscriber.
    until(lambda: set(threading.enumerate()) <= before)


def test_a_bus_closes_while_another_thread_publishes(client: Connect) -> None:
    """As a device's thread does."""
    bus = client()
    publisher = bus.publisher(topics.DEPTH, "a")
    begun, ended, sent_after_close = threading.Event(), threading.Event(), []

    def publish() -> None:
        while not ended.is_set():
            publisher.put_bytes(b"{}")
            begun.set()
        sent_after_close.append(publisher.put_bytes(b"{}"))

    device = threading.Thread(target=publish, daemon=True)
    device.start()
    assert begun.wait(PATIENCE_S)
    try:
        bus.close()
    finally:
        ended.set()
        device.join(PATIENCE_S)
    assert sent_after_close == [False]


def test_processes_that_start_and_end_are_reported(client: Connect) -> None:
    first, second, watcher, messages = client(), client(), client(), Inbox()
    changes: list[tuple[str, bool]] = []
    watcher.subscribe(topics.EVERYTHING, messages)
    first.declare_alive("node/a")
    until(lambda: watcher.is_alive("node/a"))
    watcher.watch_alive(lambda name, alive: changes.append((name, alive)))
    until(lambda: len(changes) == 1)
    second.declare_alive("solver")
    until(lambda: len(changes) == 2)
    first.close()
    until(lambda: len(changes) == 3)
    assert changes == [("node/a", True), ("solver", True), ("node/a", False)]
    assert not watcher.is_alive("node/a")
    assert messages.received == []


def test_another_process_of_the_same_name_is_alive(client: Connect) -> None:
    first, second = client(), client()
    changes: list[tuple[str, bool]] = []
    assert not first.is_alive("node/a")
    first.declare_alive("node/a")
    assert not first.is_alive("node/a")
    until(lambda: second.is_alive("node/a"))
    assert not second.is_alive("node/b")
    second.declare_alive("node/a")
    until(lambda: first.is_alive("node/a"))
    first.watch_alive(lambda name, alive: changes.append((name, alive)))
    until(lambda: len(changes) == 1)
    second.close()
    until(lambda: not first.is_alive("node/a"))
    assert changes == [("node/a", True)]


@pytest.mark.parametrize("name", ["", "node/*", "node//a", "a/", "@x"])
def test_an_alive_name_that_cannot_be_a_key_is_refused(client: Connect, name: str) -> None:
    with pytest.raises(ValueError, match="alive name"):
        client().declare_alive(name)


def test_a_bus_closes_while_messages_come(client: Connect) -> None:
    """It is no failure of a thread that takes them."""
    node = client()
    publisher, ended = node.publisher(topics.DEPTH, "a"), threading.Event()

    def publish() -> None:
        while not ended.wait(0.0):
            publisher.put_bytes(b"{}")

    device = threading.Thread(target=publish, daemon=True)
    device.start()
    try:
        for _ in range(15):
            bus, inbox = client(), Inbox()
            bus.subscribe(topics.EVERYTHING, inbox, history=False)
            inbox.wait_for(1)
            bus.close()
            assert bus.failure is None
    finally:
        ended.set()
        device.join(PATIENCE_S)
