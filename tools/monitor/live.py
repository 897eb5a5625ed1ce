"""`buddyline monitor`: watch a running pair in the browser, without a load on the pair."""

from __future__ import annotations

import argparse
import logging
import secrets
import socket
import threading
import webbrowser
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final

from buddyline.protocol import topics
from buddyline.protocol.options import above_zero
from buddyline.tools.client import add_client_arguments, client_config
from buddyline.tools.live import LiveClient, follow_running
from buddyline.tools.pairs import add_pair_argument

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus
    from buddyline.protocol.clock import Clock
    from buddyline.protocol.envelope import Envelope, Refusals
    from buddyline.tools.monitor.overview import Overview
    from buddyline.tools.monitor.server import PageServer, Session

log = logging.getLogger(__name__)

DEFAULT_HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8080
# Half of the time between two frames.
TOGETHER_NS: Final = 16_000_000
STATES: Final = (topics.INFO, topics.NODE_STATUS, topics.SOLVER_STATUS)
STREAMS: Final = (
    *(topics.POSE, topics.TRACK, topics.REJECTED, topics.NET_POSE),
    *(topics.CANDIDATES, topics.ATTITUDE, topics.DEPTH, topics.MARK),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_client_arguments(parser)
    add_pair_argument(parser, "the first that the solver reports")
    add_page_arguments(parser)


def add_page_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare how long and where the page is served."""
    parser.add_argument("--seconds", type=above_zero, metavar="S", help="end after this long; default: at Ctrl-C")
    parser.add_argument(
        "--host",
        default=DEFAULT_HOST,
        help=f"default: {DEFAULT_HOST}, this machine alone; 0.0.0.0: everyone on the network who has the printed link",
    )
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help=f"default: {DEFAULT_PORT}")
    parser.add_argument("--open", action="store_true", help="open the page in this machine's browser")


def open_page(args: argparse.Namespace, title: str, open_session: Callable[[], Session], *, live: bool) -> PageServer:
    """Listen for viewers, and print the page's link."""
    from buddyline.tools.monitor.server import PageServer, is_local, open_listener

    listener = open_listener(args.host, args.port)
    token = "" if is_local(args.host) else secrets.token_urlsafe(16)
    page = PageServer(listener, title, token, open_session, live)
    host = this_machine() if args.host in ("0.0.0.0", "::") else args.host
    link = f"http://{f'[{host}]' if ':' in host else host}:{page.port}/{f'#{token}' if token else ''}"
    if token:
        log.warning("everyone who has this link can look; it goes over the network in the clear")
    log.info("%s: look at %s ; Ctrl-C ends", title, link)
    if args.open:
        webbrowser.open(link)
    return page


def this_machine() -> str:
    """Return this machine's address as others see it, or its name."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Nothing is sent: the kernel only chooses the way.
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])


class LiveSession:
    """What all viewers of running nodes share."""

    def __init__(self, overview: Overview, clock: Clock) -> None:
        self.lock = threading.Lock()
        self._overview = overview
        self._clock = clock
        self._now_ns = 0

    def step(self, commands: list[dict[str, Any]]) -> tuple[Overview, int, bool]:
        """Return what is watched, now. Those who ask together get the same instant."""
        now_ns = self._clock.now_ns()
        self._overview.look_at_clock(now_ns)
        if not 0 <= now_ns - self._now_ns < TOGETHER_NS:
            self._now_ns = now_ns
        return self._overview, self._now_ns, False

    def playback(self) -> None:
        """Return None: nothing is played."""
        return

    def close(self) -> None:
        """Do nothing: the other viewers look on."""


def run(args: argparse.Namespace) -> int:
    """Serve the page until stopped."""
    from buddyline.protocol.clock import SystemClock
    from buddyline.tools.monitor.overview import Overview

    client = LiveClient("monitor", client_config(args), args.seconds)
    # Before the link is printed: who reads it may end this at once.
    client.handle_signals()
    overview = Overview(args.pair)
    session = LiveSession(overview, SystemClock())
    page = open_page(args, "Buddyline", lambda: session, live=True)

    def work(bus: Bus) -> None:
        subscribe(bus, client.refusals, overview, session.lock)
        client.wait()

    client.spawn("page", lambda: page.run(client.stop))
    try:
        return client.run(work)
    finally:
        page.close()


def subscribe(bus: Bus, refusals: Refusals, overview: Overview, lock: threading.Lock) -> None:
    """Subscribe to everything that is shown; messages go into overview, under the lock."""

    def take(envelope: Envelope) -> None:
        with lock:
            overview.take(envelope)

    def alive(name: str, is_alive: bool) -> None:
        with lock:
            overview.alive(name, is_alive, bus.clock.now_ns())

    follow_running(bus, STATES, STREAMS, refusals, take)
    bus.watch_alive(alive)
