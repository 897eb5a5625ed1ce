"""`buddyline sample`: write the dive that comes with the program, to try the commands on."""

from __future__ import annotations

import argparse
import shlex
from importlib import resources

from buddyline.tools.newfile import write_new


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `sample`."""
    parser.add_argument(
        "-o", "--output", default="sample.mcap", metavar="OUT.mcap", help="must not exist yet; default: sample.mcap"
    )


def run(args: argparse.Namespace) -> int:
    """Run `sample`; return the exit status."""
    content = resources.files("buddyline.tools").joinpath("sample.mcap").read_bytes()
    write_new(args.output, content)
    name = shlex.quote(args.output)
    print(
        f"wrote {args.output}: 30 s of a simulated cavern, two nodes, with truth. Go on with\n"
        f"  buddyline solve {name} -o solved.mcap     # a pose for each trigger, and the track\n"
        f"  buddyline report solved.mcap -o sample.html      # to look at in a browser (extra plots)"
    )
    return 0
