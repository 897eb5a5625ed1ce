"""Run one node: `python -m buddyline.node --config a.toml`."""

from __future__ import annotations

import argparse
import sys

from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.options import CommandParser, above_zero
from buddyline.protocol.service import start_logging


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--config", required=True, metavar="FILE.toml", help="this node's configuration")
    parser.add_argument("--connect", metavar="ENDPOINT", help="the hub, as tcp/host:7447; replaces the configured one")
    parser.add_argument("--seconds", type=above_zero, metavar="S", help="stop after this time")


def run(args: argparse.Namespace) -> int:
    """Run the node until it is stopped; return the exit status."""
    import msgspec
    from buddyline.node.config import load_node_config
    from buddyline.node.service import NodeService

    config = load_node_config(args.config)
    if args.connect:
        config = msgspec.structs.replace(config, connect=args.connect)
    service = NodeService(config)
    service.handle_signals()
    service.open()
    service.start()
    service.wait(args.seconds)
    return service.close()


def main() -> int:
    """Run as a program of its own."""
    parser = CommandParser(
        prog="python -m buddyline.node", description="One Buddyline node: capture, detect, publish, record."
    )
    add_arguments(parser)
    start_logging()
    try:
        return run(parser.parse_args())
    except BuddylineError as error:
        print(f"node: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
