"""`buddyline monitor`: watch a running pair in the browser, without weighing on it."""

from __future__ import annotations

import argparse
import logging
import webbrowser
from typing import TYPE_CHECKING, Final

from buddyline.protocol.clock import Clock, SystemClock
from buddyline.protocol.service import Service
from buddyline.tools.client import add_client_arguments, client_config
from buddyline.tools.live import LiveClient
from buddyline.tools.monitor.inbox import Inbox
from buddyline.tools.monitor.page import DEFAULT_HOST, DEFAULT_PORT, Page, open_server
from buddyline.tools.monitor.picture import PairPicture

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus

log = logging.getLogger(__name__)

TICK_S: Final = 0.1
TEXTS_EVERY: Final = 3
PLOTS_EVERY: Final = 10


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_client_arguments(parser)
    parser.add_argument("--seconds", type=float, metavar="S", help="end after this long; default: at Ctrl-C")
    add_page_arguments(parser)


def add_page_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare where the page is served."""
    parser.add_argument(
        "--host",
        default=DEFAULT_HOST,
        help=f"default: {DEFAULT_HOST}, this machine alone; 0.0.0.0: everyone on the network, without a password",
    )
    parser.add_argument("--port", type=int, default=DEFAULT_PORT, help=f"default: {DEFAULT_PORT}")
    parser.add_argument("--open", action="store_true", help="open the page in this machine's browser")


def open_page(args: argparse.Namespace, title: str, *, live: bool) -> Page:
    """Serve the page, and say where."""
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
    client = LiveClient("monitor", client_config(args), args.seconds)
    page = open_page(args, "Buddyline", live=True)
    clock = SystemClock()
    inbox = Inbox(clock)
    client.spawn("page", lambda: _draw(client, page, inbox, clock))

    def follow(bus: Bus) -> None:
        inbox.subscribe(bus)
        client.wait()

    try:
        return client.run(follow)
    finally:
        page.close()


def _draw(service: Service, page: Page, inbox: Inbox, clock: Clock) -> None:
    picture = PairPicture()
    tick = 0
    seen: frozenset[int] = frozenset()
    while not service.stop.wait(TICK_S):
        inbox.empty_into(picture)
        viewers, now_ns = page.viewers(), clock.now_ns()
        if not viewers:
            seen = viewers
            continue
        # Who has just come sees all of it at once.
        tick = 0 if viewers - seen else tick + 1
        seen = viewers
        page.draw_scene(picture, now_ns)
        if tick % TEXTS_EVERY == 0:
            page.draw_texts(picture, now_ns)
        if tick % PLOTS_EVERY == 0:
            page.draw_plots(picture, now_ns)
