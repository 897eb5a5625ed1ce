"""A bus of each kind: within one process, and over Zenoh with a real hub on loopback."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
from buddyline.protocol.bus import Bus
from buddyline.protocol.clock import ManualClock
from buddyline.protocol.local_bus import LocalNetwork
from buddyline.protocol.zenoh_bus import connect, open_hub

from tests.processes import free_endpoint
from tests.protocol.buses import NOW_NS, Connect


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with open_hub(free_endpoint()) as hub:
        yield hub.endpoint


@pytest.fixture(params=["local", "zenoh"])
def client(request: pytest.FixtureRequest) -> Iterator[Connect]:
    """A function that connects one more client to the same bus; all are closed at the end."""
    buses: list[Bus] = []
    clock = ManualClock(NOW_NS)
    network = LocalNetwork(clock)

    def local() -> Bus:
        return network.connect()

    def zenoh() -> Bus:
        endpoint = request.getfixturevalue("endpoint")
        bus = connect(endpoint, stop=threading.Event(), on_wait=lambda _: None, clock=clock)
        assert bus is not None
        return bus

    def make() -> Bus:
        buses.append(local() if request.param == "local" else zenoh())
        return buses[-1]

    yield make
    for bus in buses:
        bus.close()
