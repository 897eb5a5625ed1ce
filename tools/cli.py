"""The `buddyline` program: one table of commands; each is imported when it is called."""

from __future__ import annotations

import argparse
import difflib
import errno
import gc
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Final

from buddyline.protocol import __version__
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.options import CommandParser
from buddyline.tools.losses import collected

# What the system says where no more can be written, by no fault of the program.
NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS)
SUMMARY: Final = "Two or more underwater nodes see each other's lights; Buddyline says where they are."


@dataclass(frozen=True)
class Command:
    """A command: what it does in a line, examples, and its module with run(args), below buddyline.

    Its arguments are declared in tools/arguments.py, by a function of its name, or by add_arguments(parser) of its
    module where that imports nothing heavy.
    """

    name: str
    does: str
    examples: tuple[str, ...]
    module: str = ""

    @property
    def path(self) -> str:
        """The module's full name."""
        return f"buddyline.{self.module or 'tools.' + self.name.replace('-', '_')}"

    def parser(self) -> argparse.ArgumentParser:
        """Return the command's parser."""
        parser = CommandParser(
            prog=f"buddyline {self.name}",
            description=f"{self.does[0].upper()}{self.does[1:]}.",
            epilog="\n  ".join(["examples:", *(f"buddyline {example}" for example in self.examples)]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self.declare(parser)
        return parser

    def declare(self, parser: argparse.ArgumentParser) -> None:
        """Declare the command's arguments."""
        from buddyline.tools import arguments

        declare = getattr(arguments, self.name, None) or import_module(self.path).add_arguments
        declare(parser)

    def run(self, words: Sequence[str]) -> int:
        """Run it with the words that follow its name; return the exit status."""
        args = self.parser().parse_args(words)
        status: int = import_module(self.path).run(args)
        return status


# In the order of use: to begin, to set up, while it runs, after a dive, a survey, experiments.
COMMANDS: Final = (
    Command(
        "demo",
        "run a hub, simulated nodes and the solver on this machine, and watch the poses",
        ("demo", "demo --environment lake --seconds 30"),
        "tools.demo.command",
    ),
    Command("sample", "write a small dive, to try the other commands on", ("sample", "sample -o dive.mcap")),
    Command(
        "plan",
        "say how far two nodes will measure well, by camera, lights and visibility",
        ("plan --baseline 0.88 --visibility 6 --camera a.toml",),
    ),
    Command(
        "init",
        "write a commented configuration of a node, a hub or a solver to start from",
        ("init node --node a --connect tls/192.168.2.1:7447", "init solver"),
        "tools.installation.init",
    ),
    Command(
        "keys",
        "make keys and certificates, so that the hub may listen beyond this machine",
        ("keys init --hub 192.168.2.1", "keys node a", "keys solver"),
        "tools.installation.keys",
    ),
    Command("hub", "run the hub, through which all others talk", ("hub", "hub --config keys/hub.toml")),
    Command(
        "solver",
        "run the solver: it makes poses and tracks of what the nodes see",
        ("solver", "solver --config keys/solver.toml"),
        "solver_service.__main__",
    ),
    Command("node", "run one node: camera, sensors, detector, log", ("node --config a.toml",), "node.__main__"),
    Command(
        "install-service",
        "write the systemd unit of node, hub or solver",
        ("install-service node --config pi.toml", "install-service hub --print"),
        "tools.installation.install_service",
    ),
    Command(
        "setup",
        "make this Raspberry Pi a node: packages, devices, clock, address, service; says what it would do",
        ("setup pi --config a.toml", "setup pi --config a.toml --apply"),
        "tools.installation.setup_pi",
    ),
    Command(
        "image",
        "make a fresh card with Raspberry Pi OS into a node",
        ("image /media/me/bootfs --config a.toml --source URL --ssh-key ~/.ssh/id_ed25519.pub --gateway 192.168.2.1",),
        "tools.installation.image",
    ),
    Command(
        "doctor",
        "check all that a dive needs, and say what to do about each problem",
        ("doctor --config a.toml", "doctor", "doctor --config a.toml --json"),
        "tools.doctor.command",
    ),
    Command(
        "calibrate",
        "calibrate camera, lights, magnetometer, gyroscope or clocks, and say whether the result is good",
        ("calibrate board -o board.pdf", "calibrate camera pictures/ --square-mm 30", "calibrate clock"),
        "tools.calibration.command",
    ),
    Command(
        "net",
        "find where nodes on tripods stand, for their configurations",
        (
            "net init dive.mcap --still a --still c",
            "net init a/*.mcap b/*.mcap c/*.mcap --still a --still c -o places/",
        ),
    ),
    Command(
        "monitor",
        "watch running nodes in the browser: scene, cameras, plots, health",
        ("monitor", "monitor --config keys/viewer.toml --open"),
        "tools.monitor.live",
    ),
    Command("record", "record all that nodes and solver publish into a dive log", ("record topside.mcap",)),
    Command(
        "mark",
        "name a station or a point of a running dive",
        ('mark T4 --node b --note "flake"',),
        "tools.survey.mark",
    ),
    Command(
        "ros2",
        "publish poses, track, pictures, sensors and problems to ROS 2 (rmw_zenoh)",
        ("ros2", "ros2 --config keys/ros2.toml --domain 7"),
    ),
    Command(
        "bridge",
        "say where a vehicle is to an autopilot (MAVLink), a chart plotter (NMEA 0183) or a program (HTTP)",
        (
            "bridge --vehicle b --mavlink 192.168.2.2:14660",
            "bridge --vehicle b --place 47.12,9.65 --nmea 127.0.0.1:10110 --http 127.0.0.1:8082",
        ),
        "tools.bridge.command",
    ),
    Command(
        "play",
        "publish stored dives again, as if they happened now",
        ("play a.mcap b.mcap", "play dive.mcap --speed 4 --start 10 --end 60"),
    ),
    Command(
        "after",
        "after a dive, of the nodes' folders: align the clocks, find poses and track, write the report",
        ("after a/ b/ -o dive/",),
    ),
    Command(
        "repair", "make a proper log from a damaged one, and say what was lost", ("repair cut.mcap -o whole.mcap",)
    ),
    Command(
        "backfill",
        "complete a topside recording from the nodes' own logs",
        ("backfill topside.mcap a.mcap b.mcap -o dive.mcap",),
    ),
    Command(
        "align",
        "find offset and drift of two nodes' clocks from a dive in which they moved",
        ("align a.mcap b.mcap",),
    ),
    Command(
        "detect",
        "find what may be lights (candidates) in stored pictures or a dive's pictures",
        ("detect photos/ --draw marked/", "detect dive.mcap -o candidates.mcap"),
    ),
    Command(
        "tune",
        "propose detector values for a site, and show the pictures they were judged on",
        (
            "tune dive.mcap",
            "tune pictures/ --draw judged/",
            "tune --fit without_lamps/ > score.toml",
            "tune --fit-sigma > sigma.toml",
        ),
        "tools.tune.command",
    ),
    Command(
        "solve",
        "find the poses and the track of stored dives",
        ("solve a.mcap b.mcap -o poses.mcap", "solve dive.mcap -o p.mcap --checks range"),
    ),
    Command(
        "evaluate",
        "measure the errors of poses, track and candidates against truth",
        ("evaluate poses.mcap --truth dive.truth.mcap",),
        "tools.evaluation.command",
    ),
    Command(
        "export",
        "write poses, the track, all nodes or the whole log for other programs",
        ("export poses.mcap --format tum -o poses.tum",),
        "tools.export.command",
    ),
    Command(
        "view",
        "look at a stored dive in the browser, from any moment on",
        ("view poses.mcap", "view pictures.mcap poses.mcap --start 60"),
        "tools.monitor.view",
    ),
    Command(
        "report",
        "write a dive's report: one page to keep and to send",
        ("report poses.mcap -o report.html",),
        "tools.monitor.report",
    ),
    Command(
        "survey",
        "make legs and stations from solved dives, adjust them, and write files for surveyors",
        ("survey legs cave.toml --dive solved.mcap a.mcap b.mcap", "survey export cave.toml --format svx"),
        "tools.survey.command",
    ),
    Command(
        "simulate",
        "make a dive with known truth",
        ("simulate dive.mcap --environment basin --seconds 60", "simulate dive.mcap --images"),
    ),
    Command(
        "artag",
        "find poses from AR tags in a dive's pictures, to compare the lights with",
        ("simulate dive.mcap --images --tags", "artag dive.mcap -o tags.mcap"),
        "tools.tags.command",
    ),
    Command(
        "experiments",
        "repeat the figures of the paper (Damron et al. 2018), with ours beside them, in one report",
        ("experiments -o report/ --quick", "experiments -o report/ --tag-video test_vid.mp4"),
        "tools.experiments.command",
    ),
    Command(
        "completion",
        "print what a shell needs to complete commands and options at the tab key",
        ("completion bash > ~/.local/share/bash-completion/completions/buddyline",),
    ),
)


def command_named(name: str) -> Command:
    """Return the command of this name; raise KeyError for none."""
    return {command.name: command for command in COMMANDS}[name]


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
    # Of a closed one there is none, and the next file that is opened has its number.
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
    # On a terminal or pipe limited to ASCII, other characters become "?"; there is no traceback.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    status = 0
    try:
        try:
            status = _run(words)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our output has gone (as `head` does): say nothing.
        _drop_output()
    except OSError as error:
        if error.errno not in NO_ROOM:
            raise
        _drop_output()
        print(f"{' '.join(['buddyline', *words[:1]])}: output cannot be written: {error.strerror}", file=sys.stderr)
        status = 2
    return status


def _drop_output() -> None:
    """Let what is left of standard output go nowhere, also what is flushed at exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(words: list[str]) -> int:
    """Run the command that the first word names; return the exit status."""
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
    from buddyline.protocol.service import start_logging

    start_logging()
    # Messages and arrays make no cycles: to look for some after every 700 objects takes a twentieth of a solver's time.
    gc.set_threshold(50_000)
    try:
        with collected() as lost:
            try:
                status = command.run(words[1:])
            finally:
                for line in lost.lines():
                    print(f"buddyline {command.name}: {line}", file=sys.stderr)
        return status or (1 if lost else 0)
    except BuddylineError as error:
        print(f"buddyline {command.name}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130


if __name__ == "__main__":
    sys.exit(main())
