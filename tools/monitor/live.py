"""`buddyline monitor`: watch a running pair in the browser, without weighing on it."""

from __future__ import annotations

import argparse
import logging
import webbrowser
from typing import Final

from buddyline.protocol.clock import Clock, SystemClock
from buddyline.protocol.service import Service
from buddyline.tools.client import ClientConfig, add_client_arguments, client_config
from buddyline.tools.monitor.inbox import Inbox
from buddyline.tools.monitor.page import DEFAULT_HOST, DEFAULT_PORT, Page, open_server
from buddyline.tools.monitor.picture import PairPicture

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
    config = client_config(args)
    service = Service("monitor")
    service.handle_signals()
    page = open_page(args, "Buddyline", live=True)
    clock = SystemClock()
    inbox = Inbox(clock)
    service.spawn("bus", lambda: _follow(service, config, inbox))
    service.spawn("page", lambda: _draw(service, page, inbox, clock))
    service.wait(args.seconds)
    status = service.join()
    page.close()
    return status


def _follow(service: Service, config: ClientConfig, inbox: Inbox) -> None:
    from buddyline.protocol.zenoh_bus import connect

    bus = connect(
        config.connect,
        namespace=config.namespace or None,
        stop=service.stop,
        on_wait=lambda text: log.info("monitor: %s", text),
        tls=config.tls,
    )
    if bus is None:
        return
    with bus:
        bus.on_failure(lambda error: service.fail("bus", error))
        inbox.subscribe(bus)
        service.stop.wait()


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
