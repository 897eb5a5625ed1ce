"""`buddyline hub`: the one listener that nodes, solver and viewers connect to."""

from __future__ import annotations

import argparse
import logging

from protocol.service import Service

log = logging.getLogger(__name__)

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--config", metavar="FILE.toml", help="the hub's configuration")
    parser.add_argument("--listen", metavar="ENDPOINT", help=f"default: {DEFAULT_ENDPOINT}")
    parser.add_argument("--seconds", type=float, metavar="S", help="stop after this long")


def run(args: argparse.Namespace) -> int:
    """Run the hub until it is stopped."""
    from protocol.config import Config, load_config

    class HubConfig(Config, frozen=True, kw_only=True):
        """The hub's TOML file."""

        listen: str = DEFAULT_ENDPOINT

    from protocol.zenoh_bus import open_hub

    config = load_config(args.config, HubConfig) if args.config else HubConfig()
    service = Service("hub")
    service.handle_signals()
    with open_hub(args.listen or config.listen):
        log.info("hub: listens on %s", args.listen or config.listen)
        service.wait(args.seconds)
    return service.join()
