"""The `buddyline` program: one table of commands; each is imported when it is called."""

from __future__ import annotations

import argparse
import difflib
import os
import sys
from dataclasses import dataclass
from importlib import import_module
from typing import Final

from buddyline.protocol import __version__
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.losses import collected

SUMMARY: Final = "Two underwater nodes see each other's lights; Buddyline says where they are."


@dataclass(frozen=True)
class Command:
    """A command: the module with add_arguments(parser) and run(args), and what it does in a line.

    slow: the module takes long to import; tools/arguments.py declares its arguments.
    """

    name: str
    module: str
    does: str
    examples: tuple[str, ...] = ()
    slow: bool = False


COMMANDS: Final = (
    Command(
        "demo",
        "buddyline.tools.demo",
        "run hub, two simulated nodes and solver on this machine, and watch the poses",
        ("buddyline demo", "buddyline demo --environment lake --seconds 30"),
    ),
    Command("hub", "buddyline.tools.hub", "run the hub that all others connect to", ("buddyline hub",)),
    Command(
        "keys",
        "buddyline.tools.keys",
        "make keys and certificates, so that the hub may listen beyond this machine",
        ("buddyline keys init --hub 192.168.2.1", "buddyline keys node a", "buddyline keys solver"),
    ),
    Command(
        "node",
        "buddyline.node.__main__",
        "run one node: camera, sensors, detector, log",
        ("buddyline node --config a.toml",),
    ),
    Command(
        "install-service",
        "buddyline.tools.install_service",
        "write the systemd unit of node, hub or solver",
        ("sudo .venv/bin/buddyline install-service node --config pi.toml", "buddyline install-service hub --print"),
    ),
    Command(
        "doctor",
        "buddyline.tools.doctor.command",
        "check what a diver would forget, and say what to do about it",
        ("buddyline doctor --config a.toml", "buddyline doctor", "buddyline doctor --config a.toml --json"),
    ),
    Command(
        "solver", "buddyline.solver_service.__main__", "run the solver: candidates in, poses out", ("buddyline solver",)
    ),
    Command(
        "play",
        "buddyline.tools.play",
        "send stored dives over the bus, as if they happened now",
        ("buddyline play a.mcap b.mcap", "buddyline play dive.mcap --speed 4 --start 10 --end 60"),
    ),
    Command("record", "buddyline.tools.record", "record the bus into a dive log", ("buddyline record topside.mcap",)),
    Command(
        "repair",
        "buddyline.tools.repair",
        "make a proper log out of a damaged one, and say what was lost",
        ("buddyline repair cut.mcap -o whole.mcap",),
        slow=True,
    ),
    Command(
        "backfill",
        "buddyline.tools.backfill",
        "complete a topside recording out of the nodes' own logs",
        ("buddyline backfill topside.mcap a.mcap b.mcap -o dive.mcap",),
        slow=True,
    ),
    Command(
        "detect",
        "buddyline.tools.detect",
        "find light candidates in stored pictures or a dive's pictures",
        (
            "buddyline detect photos/ --draw marked/",
            "buddyline detect dive.mcap -o candidates.mcap --environment lake",
        ),
        slow=True,
    ),
    Command(
        "tune",
        "buddyline.tools.tune",
        "propose a site's detector values, and show the pictures they were judged on",
        ("buddyline tune dive.mcap", "buddyline tune pictures/ --draw judged/"),
        slow=True,
    ),
    Command(
        "solve",
        "buddyline.tools.solve",
        "solve stored dives offline",
        ("buddyline solve a.mcap b.mcap -o poses.mcap", "buddyline solve dive.mcap -o p.mcap --checks range"),
        slow=True,
    ),
    Command(
        "align",
        "buddyline.tools.align",
        "find the offset between the two nodes' clocks from a dive in which they moved",
        ("buddyline align a.mcap b.mcap",),
        slow=True,
    ),
    Command(
        "calibrate",
        "buddyline.tools.calibrate",
        "calibrate camera, lights, magnetometer or clocks, and say whether the result is good",
        ("buddyline calibrate board -o board.pdf", "buddyline calibrate camera pictures/", "buddyline calibrate clock"),
    ),
    Command(
        "simulate",
        "buddyline.tools.simulate",
        "make a dive with known truth",
        ("buddyline simulate dive.mcap --environment basin --seconds 60", "buddyline simulate dive.mcap --images"),
    ),
    Command(
        "evaluate",
        "buddyline.tools.evaluate",
        "measure poses and candidates against truth",
        ("buddyline evaluate poses.mcap --truth dive.truth.mcap",),
        slow=True,
    ),
    Command(
        "monitor",
        "buddyline.tools.monitor.live",
        "watch a running pair in the browser: scene, cameras, plots, health",
        ("buddyline monitor", "buddyline monitor --connect tcp/192.168.2.1:7447 --open"),
    ),
    Command(
        "view",
        "buddyline.tools.monitor.view",
        "look at a stored dive in the browser, played from anywhere",
        ("buddyline view poses.mcap", "buddyline view pictures.mcap poses.mcap --start 60"),
    ),
    Command(
        "report",
        "buddyline.tools.monitor.report",
        "write a dive's report: one page to keep and to send",
        ("buddyline report poses.mcap -o report.html",),
        slow=True,
    ),
    Command(
        "ros2",
        "buddyline.tools.ros2",
        "let ROS 2 (rmw_zenoh) see attitudes, depths, poses and transforms",
        ("buddyline ros2", "buddyline ros2 --connect tcp/192.168.2.1:7447 --domain 7"),
        slow=True,
    ),
    Command(
        "artag",
        "buddyline.tools.artag",
        "poses from AR tags in a dive's pictures, to compare the lights with",
        ("buddyline simulate dive.mcap --images --tags", "buddyline artag dive.mcap -o tags.mcap"),
        slow=True,
    ),
    Command(
        "experiments",
        "buddyline.tools.experiments.command",
        "the paper's figures and numbers, again, with ours beside them: one report",
        ("buddyline experiments -o report/ --quick", "buddyline experiments -o report/ --tag-video test_vid.mp4"),
        slow=True,
    ),
    Command(
        "plan",
        "buddyline.tools.plan",
        "how far a pair will measure well, by camera, lights and visibility",
        ("buddyline plan --baseline 0.88 --visibility 6 --camera a.toml",),
        slow=True,
    ),
    Command(
        "mark",
        "buddyline.tools.survey.mark",
        "name a station or a point of a running dive",
        ('buddyline mark T4 --node b --note "flake"',),
    ),
    Command(
        "survey",
        "buddyline.tools.survey.command",
        "legs and stations out of solved dives, adjusted, and files that surveyors use",
        (
            "buddyline survey legs cave.toml --dive solved.mcap a.mcap b.mcap",
            "buddyline survey export cave.toml --format svx",
        ),
    ),
    Command(
        "export",
        "buddyline.tools.export",
        "write poses for other programs",
        ("buddyline export poses.mcap --format tum -o poses.tum",),
        slow=True,
    ),
)


def overview() -> str:
    """Return what `buddyline --help` prints."""
    width = max(len(command.name) for command in COMMANDS)
    lines = [f"usage: buddyline COMMAND ... ({__version__})", "", SUMMARY, "", "commands:"]
    lines += [f"  {command.name:<{width}}  {command.does}" for command in COMMANDS]
    lines += ["", "`buddyline COMMAND --help` tells more, with examples. Start with `buddyline demo`."]
    return "\n".join(lines)


def main(argv: list[str] | None = None) -> int:
    """Run the program; return its exit status.

    0 done, 1 a check failed or input was damaged, 2 a known error, 130 interrupted.
    """
    words = sys.argv[1:] if argv is None else argv
    if not words or words[0] in ("-h", "--help", "help"):
        print(overview())
        return 0
    if words[0] == "--version":
        print(f"buddyline {__version__}")
        return 0
    command = next((command for command in COMMANDS if command.name == words[0]), None)
    if command is None:
        near = difflib.get_close_matches(words[0], [command.name for command in COMMANDS], 1)
        hint = f"did you mean `{near[0]}`?" if near else "see `buddyline --help`"
        print(f"buddyline: no command {words[0]!r}; {hint}", file=sys.stderr)
        return 2
    try:
        with collected() as lost:
            try:
                status = _run(command, words[1:])
            finally:
                for line in lost.lines():
                    print(f"buddyline {command.name}: {line}", file=sys.stderr)
        return status or (1 if lost else 0)
    except BuddylineError as error:
        print(f"buddyline {command.name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Whoever read our output has gone: nothing is left to say, and nothing to flush at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


def parser_of(command: Command) -> argparse.ArgumentParser:
    """Return the parser of a command's words, with its help."""
    parser = argparse.ArgumentParser(
        prog=f"buddyline {command.name}",
        description=f"{command.does[0].upper()}{command.does[1:]}.",
        epilog="examples:\n" + "\n".join(f"  {example}" for example in command.examples) if command.examples else None,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    if command.slow:
        getattr(import_module("buddyline.tools.arguments"), command.name)(parser)
    else:
        import_module(command.module).add_arguments(parser)
    return parser


def _run(command: Command, words: list[str]) -> int:
    from buddyline.protocol.service import start_logging

    args = parser_of(command).parse_args(words)
    start_logging()
    status: int = import_module(command.module).run(args)
    return status


if __name__ == "__main__":
    sys.exit(main())
