"""A loop over live messages: what comes, in order, until it is stopped."""

import threading

import buddyline
import pytest
from buddyline.protocol.bus import Received
from buddyline.protocol.codec import encode
from buddyline.protocol.delivery import ThreadDiedError
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.messages import Depth
from buddyline.protocol.topics import DEPTH, TRACK, TRACK_LAG
from buddyline.tools import livestream
from buddyline.tools.client import ClientConfig
from buddyline.tools.live import NoHubError
from buddyline.tools.livestream import LiveStream

from tests.processes import PATIENCE_S, free_endpoint
from tests.tools.evaluated import track


def depth(number, node="a"):
    return Depth(node=node, stamp_ns=number, depth_m=float(number), sigma_m=0.1)


@pytest.fixture
def network(monkeypatch):
    network = LocalNetwork()
    monkeypatch.setattr(livestream, "open_bus_within", lambda config, seconds: network.connect())
    return network


@pytest.fixture
def bus(network):
    with network.connect() as bus:
        yield bus


def stream(**options):
    return LiveStream(DEPTH, Depth, ClientConfig(), **options)


def test_messages_come_in_order_and_break_ends(bus):
    with stream() as depths:
        publisher = bus.publisher(DEPTH, "a")
        for number in range(3):
            publisher.put(depth(number))
        found = []
        for one in depths:
            found.append(one.stamp_ns)
            if len(found) == 3:
                break
    assert found == [0, 1, 2]


def test_only_the_named_nodes_messages_come(bus):
    with stream(ids=("b",)) as depths:
        bus.publisher(DEPTH, "a").put(depth(1))
        bus.publisher(DEPTH, "b").put(depth(2, "b"))
        assert next(iter(depths)).node == "b"


def test_tracks_come_at_once_or_a_second_later_and_better(bus):
    live, late = bus.publisher(TRACK, "a", "b"), bus.publisher(TRACK_LAG, "a", "b")
    with buddyline.live_tracks() as now, buddyline.live_tracks(pair=("a", "b"), lag=True) as later:
        late.put(track(0, mode="lag"))
        live.put(track(1, mode="filter"))
        assert next(iter(now)).mode == "filter"
        assert next(iter(later)).mode == "lag"


def test_earlier_messages_are_not_given(bus):
    publisher = bus.publisher(DEPTH, "a")
    publisher.put(depth(1))
    with stream() as depths:
        publisher.put(depth(2))
        assert next(iter(depths)).stamp_ns == 2


def test_stop_from_another_thread_ends_a_loop_that_waits(network):
    with stream() as depths:
        begun, ended = threading.Event(), threading.Event()

        def loop():
            begun.set()
            for _ in depths:
                pass
            ended.set()

        thread = threading.Thread(target=loop)
        thread.start()
        assert begun.wait(PATIENCE_S)
        depths.stop()
        thread.join(PATIENCE_S)
        assert ended.is_set()
        assert list(depths) == []


def test_it_ends_when_its_time_is_over(network):
    with stream(seconds=0.05) as depths:
        assert list(depths) == []


def test_a_slow_loop_loses_the_oldest_and_they_are_counted(network, monkeypatch):
    monkeypatch.setattr(livestream, "CAPACITY", 4)
    with stream() as depths:
        for number in range(10):
            depths._receive(Received(DEPTH.key("a"), encode(depth(number)), 0, DEPTH.encoding))
        assert depths.dropped == 6
        assert next(iter(depths)).stamp_ns == 6


def test_invalid_messages_are_counted_and_left_out(bus):
    with stream() as depths:
        publisher = bus.publisher(DEPTH, "a")
        publisher.put(depth(1, "b"))
        publisher.put_bytes(b"{}")
        publisher.put(depth(2))
        assert next(iter(depths)).stamp_ns == 2
        assert depths.refused == 2


def test_a_dead_thread_of_the_bus_is_raised(network):
    with stream() as depths:
        depths._fail(ThreadDiedError("reader"))
        with pytest.raises(ThreadDiedError):
            next(iter(depths))


def test_no_hub_is_an_error():
    with pytest.raises(NoHubError, match=r"within 0\.2 s"):
        LiveStream(DEPTH, Depth, ClientConfig(connect=free_endpoint()), connect_s=0.2)
