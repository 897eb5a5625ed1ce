"""Run the solver: `python -m buddyline.solver_service`."""

from __future__ import annotations

import argparse
import sys

from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.options import CommandParser, above_zero
from buddyline.protocol.service import start_logging


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("--config", metavar="FILE.toml", help="the solver's configuration (every key has a default)")
    parser.add_argument("--connect", metavar="ENDPOINT", help="the hub, as tcp/host:7447; replaces the configured one")
    parser.add_argument("--nodes", metavar="A,B,...", help="solve only the pairs of these, not the configured ones")
    parser.add_argument(
        "--share", action="store_true", help="divide the pairs among all solvers of this hub that are started so"
    )
    parser.add_argument(
        "--lights",
        action="append",
        default=[],
        metavar="FILE.json",
        help="the NodeInfo of a buoy or tripod of lamps alone, which runs no program; may be given again",
    )
    parser.add_argument("--seconds", type=above_zero, metavar="S", help="stop after this time")


def run(args: argparse.Namespace) -> int:
    """Run the solver until it is stopped; return the exit status."""
    import msgspec
    from buddyline.solver_service.config import load_solver_config, node_ids
    from buddyline.solver_service.service import SolverService

    config = load_solver_config(args.config)
    if args.connect:
        config = msgspec.structs.replace(config, connect=args.connect)
    if args.nodes:
        config = msgspec.structs.replace(config, nodes=node_ids([args.nodes]), pairs=[])
    if args.share:
        config = msgspec.structs.replace(config, share=True)
    if args.lights:
        config = msgspec.structs.replace(config, lights=[*config.lights, *args.lights])
    service = SolverService(config, args.config or "defaults")
    service.handle_signals()
    service.start()
    service.wait(args.seconds)
    return service.join()


def main() -> int:
    """Run as a program of its own."""
    parser = CommandParser(
        prog="python -m buddyline.solver_service",
        description="Buddyline's solver: candidates of the nodes in, relative poses out.",
    )
    add_arguments(parser)
    start_logging()
    try:
        return run(parser.parse_args())
    except BuddylineError as error:
        print(f"solver: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
