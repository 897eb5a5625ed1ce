"""Beacons between two nodes, and chrony's figures on their way into the status."""

import threading

import msgspec
import pytest
from buddyline.node.chrony import ChronyError, decode_tracking
from buddyline.node.clock_sync import HEARD_FOR_S, Beacons, ClockSync
from buddyline.node.time_base import NodeClock
from buddyline.protocol.bus import Received
from buddyline.protocol.codec import decode, encode
from buddyline.protocol.errors import MessageError
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import MAX_HEARD, ClockBeacon, ClockSet
from buddyline.protocol.topics import CLOCK

from tests.node.test_chrony import FOLLOWS, LOST
from tests.processes import PATIENCE_S

NOW_NS = 1_764_000_000_000_000_000


def clock_at(now_ns):
    """A clock that stands still."""
    return NodeClock(lambda: now_ns, lambda: 5_000_000_000, lambda: 7_000_000_000)


def received(beacon, key=None, receive_ns=NOW_NS):
    return Received(key or CLOCK.key(beacon.node), encode(beacon), receive_ns, CLOCK.encoding)


def of(node, stamp_ns, heard=()):
    return ClockBeacon(node=node, stamp_ns=stamp_ns, boot="x", heard=list(heard))


def test_a_beacon_says_when_the_other_was_heard():
    a, b = Beacons("a", "boot_a"), Beacons("b", "boot_b")
    first = a.beacon(clock_at(NOW_NS), 0.0)
    assert (first.node, first.stamp_ns, first.raw_ns, first.heard) == ("a", NOW_NS, 7_000_000_000, [])
    b.hear(received(first, receive_ns=NOW_NS + 5_000_300), 0.1)
    answer = b.beacon(clock_at(NOW_NS + 9_000_000), 0.2)
    (heard,) = answer.heard
    assert (heard.node, heard.boot, heard.sent_ns, heard.received_ns) == ("a", "boot_a", NOW_NS, NOW_NS + 5_000_300)
    assert b.beacon(clock_at(NOW_NS), 0.1 + HEARD_FOR_S + 0.01).heard == []


def test_own_forged_and_broken_beacons_are_ignored():
    a = Beacons("a", "boot")
    a.hear(received(of("a", NOW_NS)), 0.0)
    a.hear(received(of("b", NOW_NS), key=CLOCK.key("c")), 0.0)
    a.hear(Received(CLOCK.key("b"), b"{}", NOW_NS, CLOCK.encoding), 0.0)
    assert a.beacon(clock_at(NOW_NS), 0.0).heard == []
    assert a.refusals.count == 2


def test_a_beacon_stays_valid_with_too_many_nodes():
    a = Beacons("a", "boot")
    for number in range(3 * MAX_HEARD):
        a.hear(received(of(f"n{number}", NOW_NS)), 0.0)
    beacon = decode(encode(a.beacon(clock_at(NOW_NS), 0.0)), ClockBeacon)
    assert [heard.node for heard in beacon.heard] == [f"n{number}" for number in range(2 * MAX_HEARD, 3 * MAX_HEARD)]
    with pytest.raises(MessageError, match="heard"):
        encode(msgspec.structs.replace(beacon, heard=beacon.heard * 2))


class Sent:
    """An outlet that publishes, and says when it has."""

    def __init__(self, bus, node):
        self._publisher = bus.publisher(CLOCK, node)
        self.heard = threading.Event()

    def send(self, message):
        self._publisher.put(message)
        if message.heard:
            self.heard.set()


def test_two_nodes_hear_each_other_over_a_bus():
    network, stop = LocalNetwork(), threading.Event()
    buses = [network.connect() for _ in "ab"]
    outlets = [Sent(bus, node) for bus, node in zip(buses, "ab", strict=True)]
    threads = []
    for bus, outlet, node in zip(buses, outlets, "ab", strict=True):
        sync = ClockSync(node, node, NodeClock(network.clock.now_ns), lambda: None)
        sync.listen(bus)
        threads.append(threading.Thread(target=sync.send_beacons, args=(outlet, stop), name=node))
    for thread in threads:
        thread.start()
    try:
        assert all(outlet.heard.wait(PATIENCE_S) for outlet in outlets)
    finally:
        stop.set()
        for thread in threads:
            thread.join()
        for bus in buses:
            bus.close()


@pytest.mark.parametrize(
    ("answer", "problem", "fields"),
    [
        (FOLLOWS, "", {"clock_source": "127.0.0.1", "clock_rms_s": 9.47e-7}),
        (LOST, "not synchronised", {"clock_source": ""}),
        (None, "", {}),
        (ChronyError("chronyc gave no answer"), "no answer", {}),
    ],
)
def test_chronys_figures_reach_the_status(answer, problem, fields):
    stop = threading.Event()

    def read():
        stop.set()
        if isinstance(answer, Exception):
            raise answer
        return None if answer is None else decode_tracking(answer)

    sync = ClockSync("a", "x", clock_at(NOW_NS), read)
    sync.follow_chrony(stop)
    assert problem in sync.problem
    assert bool(problem) == bool(sync.problem)
    said = sync.status_fields()
    assert {name: said.get(name) for name in fields} == fields
    assert bool(fields) == bool(said)


def test_a_clock_that_is_set_is_said_before_the_first_beacon_after_it():
    wall, sent, stop = [NOW_NS], [], threading.Event()
    clock = NodeClock(lambda: wall[0], lambda: 5_000_000_000, lambda: 7_000_000_000)

    class BeaconOutlet:
        def send(self, message):
            sent.append(message)
            wall[0] = NOW_NS + 36_000_000
            if len(sent) == 3:
                stop.set()

    ClockSync("a", "x", clock, lambda: None).send_beacons(BeaconOutlet(), stop)
    assert [type(message) for message in sent] == [ClockBeacon, ClockSet, ClockBeacon]
    assert [message.stamp_ns for message in sent] == [NOW_NS, NOW_NS + 36_000_000, NOW_NS + 36_000_000]
    assert sent[1].moved_ns == 36_000_000
