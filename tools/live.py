"""One way to run a command on the bus: connect as configured, work until stopped, return the exit status."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from buddyline.protocol.envelope import Envelope, Refusals
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.service import Service
from buddyline.protocol.topics import IMAGE, Topic

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus, KeyExprs, Received, Subscription
    from buddyline.tools.client import ClientConfig

log = logging.getLogger(__name__)


class NoHubError(BuddylineError):
    """No hub answered in time."""


class LiveClient(Service):
    """A command on the bus. Ends at Ctrl-C, after `seconds`, or when one of its threads fails.

    seconds count from the start, whether a hub answers or not; None: no limit. refusals: counts invalid messages.
    """

    def __init__(self, name: str, config: ClientConfig, seconds: float | None = None) -> None:
        super().__init__(name)
        self.config = config
        self.refusals = Refusals(name)
        self._seconds = seconds
        self._time_is_over = False

    def run(self, work: Callable[[Bus], None]) -> int:
        """Connect, hand the bus to work, leave the bus when work returns; return the exit status.

        0: the work is done or the time is over; 2: no hub answered in time, or another known error; 130: Ctrl-C.
        For the main thread of a process.
        """
        self.handle_signals()
        if self._seconds is not None:
            timer = threading.Timer(self._seconds, self._end)
            timer.daemon = True
            timer.start()
        try:
            bus = open_bus(self.config, self.stop, lambda text: log.info("%s: %s", self.name, text))
            if bus is None:
                if self._time_is_over and self._seconds is not None:
                    self.fail("bus", no_hub(self.config, self._seconds))
            else:
                with bus:
                    bus.on_failure(lambda error: self.fail("bus", error))
                    work(bus)
        finally:
            status = self.join()
        return status

    def _end(self) -> None:
        self._time_is_over = True
        self.stop.set()


def open_bus(config: ClientConfig, stop: threading.Event, on_wait: Callable[[str], None]) -> Bus | None:
    """Connect to the configured hub, waiting for it; None if stop was set before it answered.

    on_wait is called once, with what is waited for. Raises RefusedError if the hub refuses this client.
    """
    from buddyline.protocol.zenoh_bus import connect

    namespace = config.namespace or None
    return connect(config.connect, namespace=namespace, stop=stop, on_wait=on_wait, tls=config.tls)


def open_bus_within(config: ClientConfig, seconds: float) -> Bus:
    """Connect to the configured hub; raise NoHubError if none answers within this time."""
    stop = threading.Event()
    timer = threading.Timer(seconds, stop.set)
    timer.start()
    try:
        bus = open_bus(config, stop, lambda _: None)
    finally:
        timer.cancel()
    if bus is None:
        raise no_hub(config, seconds)
    return bus


def no_hub(config: ClientConfig, seconds: float) -> NoHubError:
    """Return the error of a hub that did not answer."""
    return NoHubError(f"no hub at {config.connect} within {seconds:g} s (start one with `buddyline hub`)")


def follow_running(
    bus: Bus,
    states: Sequence[Topic],
    streams: Sequence[Topic],
    refusals: Refusals,
    take: Callable[[Envelope], None],
    *,
    pictures: bool = True,
) -> None:
    """Follow running nodes and solver. states: whose last message is fetched; streams: from now on; and pictures.

    A history of the streams would load the link that the solver needs. Each queue drops its oldest message, so what is
    slow here does not slow the publishers.
    """
    of_pictures = [((IMAGE,), 4, False)] if pictures else []
    for topics, capacity, history in ((states, 64, True), (streams, 1024, False), *of_pictures):
        follow(bus, tuple(topic.key_any() for topic in topics), refusals, take, capacity=capacity, history=history)


def follow(
    bus: Bus,
    keys: KeyExprs,
    refusals: Refusals,
    take: Callable[[Envelope], None],
    *,
    capacity: int = 1024,
    history: bool = True,
) -> Subscription:
    """Pass the valid messages on these keys to take, as Bus.subscribe does; refusals counts the others."""

    def receive(received: Received) -> None:
        envelope = refusals.open(received)
        if envelope is not None:
            take(envelope)

    return bus.subscribe(keys, receive, capacity=capacity, history=history)
