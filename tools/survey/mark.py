"""`buddyline mark`: publish a node's station, a point or a note, so that all logs record it."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from buddyline.protocol.clock import SystemClock
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Mark
from buddyline.protocol.options import above_zero, finite
from buddyline.protocol.security import SURVEYOR
from buddyline.protocol.topics import MARK, check_node_id
from buddyline.tools.client import add_client_arguments, client_config
from buddyline.tools.live import LiveClient
from buddyline.tools.survey.marks import KINDS, section_note, stamp_ns_of, time_of
from buddyline.tools.survey.project import STATION_NAME, YEARS

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("name", nargs="?", default="", help="station or point: 1 to 12 of A-Z a-z 0-9 _ -")
    parser.add_argument("--node", required=True, metavar="NODE", help="the node that stands there")
    parser.add_argument("--kind", choices=KINDS, default="station", help="default: station")
    parser.add_argument("--note", default="", metavar="TEXT", help="a remark on the place")
    parser.add_argument(
        "--lrud",
        nargs=4,
        metavar=("LEFT", "RIGHT", "UP", "DOWN"),
        help="a station's cross-section, metres, seen along the line; - for what was not measured",
    )
    parser.add_argument("--at", metavar="TIME", help="UTC, such as 2026-05-01T10:20:30Z; default: now")
    add_client_arguments(parser, SURVEYOR)
    parser.add_argument(
        "--seconds", type=above_zero, metavar="S", help="give up after this long without a hub; default: wait for it"
    )
    parser.add_argument(
        "--linger",
        type=finite,
        default=1.0,
        metavar="S",
        help="stay connected for this long after the mark; default: 1",
    )


def mark_of(args: argparse.Namespace, now_ns: int) -> Mark:
    """Return the message; raise BuddylineError if name, note or time cannot be used."""
    if args.kind != "note" and not STATION_NAME.match(args.name):
        raise BuddylineError(f"name {args.name!r}: use 1 to 12 of A-Z a-z 0-9 _ -")
    if args.kind == "note" and not args.note:
        raise BuddylineError("a note needs --note TEXT")
    try:
        stamp_ns = stamp_ns_of(time_of(args.at), now_ns) if args.at else now_ns
    except ValueError as error:
        raise BuddylineError(f"--at {args.at}: {error}") from error
    if not 0 <= stamp_ns < 2**63:
        raise BuddylineError(f"--at {args.at}: is not within the years {YEARS[0]} to {YEARS[-1]}")
    if args.lrud and args.kind != "station":
        raise BuddylineError(f"--lrud is of a station, not of a {args.kind}")
    note = section_note(args.lrud, args.note) if args.lrud else args.note
    return Mark(node=check_node_id(args.node), stamp_ns=stamp_ns, kind=args.kind, name=args.name, note=note)


def run(args: argparse.Namespace) -> int:
    """Publish one mark."""
    mark = mark_of(args, SystemClock().now_ns())
    client = LiveClient("mark", client_config(args, SURVEYOR), args.seconds)
    marked = False

    def publish(bus: Bus) -> None:
        nonlocal marked
        marked = bus.publisher(MARK, mark.node).put(mark)
        # Stay for a while: a recorder that misses the mark fetches it from this process's cache.
        client.stop.wait(args.linger)

    status = client.run(publish)
    if marked:
        print(f"{mark.kind} {mark.name or mark.note}: node {mark.node}")
    return status
