"""`buddyline monitor`: watch a running pair in the browser, without a load on the pair."""

from __future__ import annotations

import argparse
import logging
import threading
import webbrowser
from typing import TYPE_CHECKING, Final

from buddyline.protocol import topics
from buddyline.tools.client import add_client_arguments, client_config
from buddyline.tools.live import LiveClient, follow
from buddyline.tools.pairs import add_pair_argument

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus
    from buddyline.protocol.envelope import Envelope, Refusals
    from buddyline.tools.monitor.page import Page
    from buddyline.tools.monitor.picture import PairPicture

log = logging.getLogger(__name__)

DEFAULT_HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8080
STATES: Final = (topics.INFO, topics.NODE_STATUS, topics.SOLVER_STATUS)
STREAMS: Final = (topics.POSE, topics.TRACK, topics.REJECTED, topics.CANDIDATES, topics.ATTITUDE, topics.DEPTH)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_client_arguments(parser)
    add_pair_argument(parser, "the first that the solver reports")
    add_page_arguments(parser)


def add_page_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare how long and where the page is served."""
    parser.add_argument("--seconds", type=float, metavar="S", help="end after this long; default: at Ctrl-C")
    parser.add_argument(
        "--host",
        default=DEFAULT_HOST,
        help=f"default: {DEFAULT_HOST}, this machine alone; 0.0.0.0: everyone on the network, without a password",
    )
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help=f"default: {DEFAULT_PORT}")
    parser.add_argument("--open", action="store_true", help="open the page in this machine's browser")


def open_page(args: argparse.Namespace, title: str, *, live: bool) -> Page:
    """Serve the page, and print its address."""
    from buddyline.tools.monitor.page import Page, open_server

    server = open_server(args.host, args.port, title)
    address = f"http://{'127.0.0.1' if args.host == '0.0.0.0' else args.host}:{server.get_port()}"
    if args.host not in ("127.0.0.1", "localhost", "::1"):
        log.warning("the page is open to everyone who reaches this machine on port %d", server.get_port())
    log.info("%s: look at %s; Ctrl-C ends", title, address)
    if args.open:
        webbrowser.open(address)
    return Page(server, live=live)


def run(args: argparse.Namespace) -> int:
    """Serve the page until stopped."""
    from buddyline.protocol.clock import SystemClock
    from buddyline.tools.monitor.picture import PairPicture

    client = LiveClient("monitor", client_config(args), args.seconds)
    page = open_page(args, "Buddyline", live=True)
    clock, picture, lock = SystemClock(), PairPicture(args.pair), threading.Lock()

    def work(bus: Bus) -> None:
        subscribe(bus, client.refusals, picture, lock)
        client.wait()

    client.spawn("page", lambda: page.draw_until(client.stop, lambda _: (picture, clock.now_ns(), False), lock))
    try:
        return client.run(work)
    finally:
        page.close()


def subscribe(bus: Bus, refusals: Refusals, picture: PairPicture, lock: threading.Lock) -> None:
    """Subscribe to everything that is shown; messages go into the picture, under the lock.

    Only the last message of each latest-only topic is fetched: a history of the rest would load the link that the
    solver needs. Each subscription's queue drops its oldest message, so a slow page does not slow the publishers.
    """

    def take(envelope: Envelope) -> None:
        with lock:
            picture.take(envelope)

    def alive(name: str, is_alive: bool) -> None:
        with lock:
            picture.alive(name, is_alive, bus.clock.now_ns())

    for followed, capacity, history in ((STATES, 64, True), (STREAMS, 1024, False), ((topics.IMAGE,), 4, False)):
        follow(bus, tuple(topic.key_any() for topic in followed), refusals, take, capacity=capacity, history=history)
    bus.watch_alive(alive)
