"""`buddyline monitor`: watch a running pair in the browser, without weighing on it."""

from __future__ import annotations

import argparse
import logging
import webbrowser
from typing import TYPE_CHECKING, Final

from buddyline.tools.client import add_client_arguments, client_config
from buddyline.tools.pairs import add_pair_argument

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus
    from buddyline.tools.monitor.page import Page
    from buddyline.tools.monitor.picture import PairPicture

log = logging.getLogger(__name__)

DEFAULT_HOST: Final = "127.0.0.1"
DEFAULT_PORT: Final = 8080


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_client_arguments(parser)
    add_pair_argument(parser, "the first that the solver speaks of")
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
    """Serve the page, and say where."""
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
    from buddyline.tools.live import LiveClient
    from buddyline.tools.monitor.inbox import Inbox
    from buddyline.tools.monitor.picture import PairPicture

    client = LiveClient("monitor", client_config(args), args.seconds)
    page = open_page(args, "Buddyline", live=True)
    clock = SystemClock()
    inbox, picture = Inbox(clock), PairPicture(args.pair)

    def step(_: bool) -> tuple[PairPicture, int, bool]:
        inbox.empty_into(picture)
        return picture, clock.now_ns(), False

    def follow(bus: Bus) -> None:
        inbox.subscribe(bus)
        client.wait()

    client.spawn("page", lambda: page.draw_until(client.stop, step))
    try:
        return client.run(follow)
    finally:
        page.close()
