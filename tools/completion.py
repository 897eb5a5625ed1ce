"""`buddyline completion`: what bash, zsh or tcsh need to complete commands, options and their values."""

from __future__ import annotations

import argparse
from collections.abc import Mapping

from buddyline.tools.extras import needed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("shell", choices=("bash", "zsh", "tcsh"), help="for which shell")


def run(args: argparse.Namespace) -> int:
    """Print the shell's script."""
    shtab = needed("shtab", "completion", "completion")
    print(shtab.complete(_whole(shtab.FILE), shell=args.shell))
    return 0


def _whole(file: Mapping[str, object]) -> argparse.ArgumentParser:
    """Return one parser of all commands. What takes a value without choices completes as a file."""
    from buddyline.tools.cli import COMMANDS

    whole = argparse.ArgumentParser(prog="buddyline")
    whole.add_argument("--version", action="store_true", help="say the version")
    chosen = whole.add_subparsers()
    parsers = []
    for command in COMMANDS:
        parsers.append(chosen.add_parser(command.name, help=command.does.replace("%", "%%")))
        command.declare(parsers[-1])
    while parsers:
        for action in parsers.pop()._actions:
            if isinstance(action, argparse._SubParsersAction):
                parsers += action.choices.values()
            elif action.choices is None and action.nargs != 0:
                action.complete = file  # type: ignore[attr-defined]
    return whole
