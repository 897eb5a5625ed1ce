"""Arguments of the commands whose modules take long to import, so that `--help` answers at once.

One function for each command, by its name. Every other command declares its arguments in its own module. Nothing here
imports numpy, OpenCV, MCAP or Zenoh.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Final, TypeAlias

from buddyline.node.choices import DETECTORS, PRESETS
from buddyline.protocol.options import above_zero, finite
from buddyline.protocol.security import PLAYER, ROS
from buddyline.solver_service.choices import CHECKS, METHODS, TRACKS
from buddyline.tools.client import add_client_arguments
from buddyline.tools.export.formats import FORMATS
from buddyline.tools.pairs import add_pair_argument

DIVE: Final = "one dive: its log, or each node's own"


if TYPE_CHECKING:
    Subcommands: TypeAlias = argparse._SubParsersAction[argparse.ArgumentParser]


def subcommand(parsers: Subcommands, name: str, text: str, example: str) -> argparse.ArgumentParser:
    """Add the parser of a subcommand, with what it does and an example."""
    description, epilog = f"{text[0].upper()}{text[1:]}.", f"example: buddyline {example}"
    return parsers.add_parser(name, help=text, description=description, epilog=epilog)


def _dives(parser: argparse.ArgumentParser, text: str = DIVE) -> None:
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help=text)


def _new_log(parser: argparse.ArgumentParser, text: str = "must not exist yet", name: str = "OUT.mcap") -> None:
    parser.add_argument("-o", "--output", required=True, metavar=name, help=text)


def _authority(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--authority",
        metavar="CA.crt",
        help="the logs must be signed by nodes of this authority (`buddyline keys init`); default: any",
    )


def _json(parser: argparse.ArgumentParser, text: str) -> None:
    parser.add_argument("--json", action="store_true", help=text)


def _seconds(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=above_zero, metavar="S", help="stop after this long; default: at Ctrl-C")


def _two_nodes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--nodes", nargs=2, metavar=("A", "B"), help="the pair; default: the dive's two nodes")


def _detector(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--environment", default="auto", help="the waters, for --detector paper; default: auto")
    parser.add_argument(
        "--detector",
        default="source",
        help="of dives that have pictures and no candidates: source, paper or an installed one; default: source",
    )


def play(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `play`."""
    _dives(parser)
    parser.add_argument("--speed", type=finite, default=1.0, help="times real time; 0: as fast as possible; default: 1")
    parser.add_argument(
        "--start", type=finite, default=0.0, metavar="S", help="begin so many seconds after the dive's start"
    )
    parser.add_argument("--end", type=finite, metavar="S", help="end so many seconds after the dive's start")
    parser.add_argument("--loop", action="store_true", help="repeat the dive; the times continue")
    add_client_arguments(parser, PLAYER)


def record(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `record`."""
    parser.add_argument("output", metavar="OUT.mcap", help="the log to write; must not exist yet")
    add_client_arguments(parser)
    _seconds(parser)


def repair(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `repair`."""
    parser.add_argument("input", metavar="IN.mcap", help="the damaged log; it is not changed")
    _new_log(parser)


def backfill(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `backfill`."""
    parser.add_argument("topside", metavar="TOPSIDE.mcap", help="what `buddyline record` wrote")
    parser.add_argument("nodes", nargs="+", metavar="NODE.mcap", help="the nodes' own logs, all of the dive")
    _new_log(parser)
    _authority(parser)


def detect(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `detect`."""
    parser.add_argument("inputs", nargs="+", metavar="IMAGE|FOLDER|DIVE.mcap", help="pictures, or a dive of pictures")
    parser.add_argument("-o", "--output", metavar="OUT.mcap", help="write a dive log instead of JSON lines")
    parser.add_argument("--draw", metavar="DIR", help="a new folder for the pictures with their candidates marked")
    parser.add_argument(
        "--environment",
        default="auto",
        choices=PRESETS,
        help="the waters, for --method paper (`source` adapts by itself); default: auto",
    )
    _method(parser)
    parser.add_argument(
        "--mask",
        action="append",
        default=[],
        metavar="U,V,U,V",
        help="never search this rectangle (or polygon) of each picture, corners as shares of width and height; "
        "may be repeated; default: the masks in a dive's logs",
    )
    _json(parser, "JSON lines on stdout (the default without -o)")


def after(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `after`."""
    parser.add_argument("folders", nargs="+", metavar="FOLDER|LOG.mcap", help="what each node recorded")
    parser.add_argument(
        "-o", "--output", required=True, metavar="DIR", help="folder for poses, track and report; must be new or empty"
    )


def _method(parser: argparse.ArgumentParser) -> None:
    known = ", ".join(DETECTORS)
    parser.add_argument(
        "--method", default=DETECTORS[0], help=f"the detector: {known}, or an installed one; default: {DETECTORS[0]}"
    )


def tune(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `tune`."""
    parser.add_argument("inputs", nargs="*", metavar="IMAGE|FOLDER|DIVE.mcap", help="pictures, or a dive of pictures")
    parser.add_argument(
        "--truth", metavar="T.mcap", help="the true places of the lights; default: the dive's own, if it has them"
    )
    _method(parser)
    parser.add_argument(
        "--environment", default="auto", choices=PRESETS, help="the waters from which --method paper starts"
    )
    parser.add_argument(
        "--fit", action="store_true", help="fit the score's weights, and print them; the pictures must show no lamp"
    )
    parser.add_argument(
        "--fit-sigma", action="store_true", help="fit the candidates' sigmas to simulated pictures, and print them"
    )
    parser.add_argument("--note", default="", help="with --fit: what the pictures are, for the record")
    parser.add_argument(
        "--pictures", type=int, default=24, metavar="N", help="judge by N at most, evenly spread; default: 24"
    )
    parser.add_argument(
        "--draw", default="tuned", metavar="DIR", help="new folder for the marked pictures; default: tuned"
    )
    _json(parser, "print the proposal as JSON")


def solve(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `solve`."""
    _dives(parser)
    _new_log(parser, "poses, rejections, and their inputs; must not exist yet")
    _authority(parser)
    parser.add_argument(
        "--method",
        choices=METHODS,
        default=METHODS[0],
        help="the closed form, then refined by least squares; the closed form alone (exact); or the paper's, read in "
        "three ways; default: %(default)s",
    )
    parser.add_argument(
        "--checks", default=",".join(CHECKS), help=f"which may reject a pose: {','.join(CHECKS)}; default: all"
    )
    parser.add_argument(
        "--nodes", nargs="+", metavar="NODE", help="solve every pair of these, A B or a,b,c; default: all in the logs"
    )
    parser.add_argument(
        "--info",
        action="append",
        default=[],
        metavar="NODE=FILE",
        help="this node's calibration, instead of the log's: JSON or another log; repeatable",
    )
    parser.add_argument(
        "--place",
        action="append",
        default=[],
        metavar="NODE=FILE.toml",
        help="where a node stood still, as `buddyline net init` writes it, instead of the log's; repeatable",
    )
    clocks = parser.add_mutually_exclusive_group()
    clocks.add_argument(
        "--clock-offset",
        type=finite,
        metavar="S",
        help="B's clock minus A's, from `buddyline align`; default: what the nodes' beacons tell; 0: none",
    )
    clocks.add_argument("--clocks", metavar="FILE.json", help="offset and drift, from `buddyline align --json`")
    parser.add_argument(
        "--attitude-again",
        nargs="*",
        metavar="NODE=FILE.toml",
        help="compute the attitudes again from the inertial samples, in both directions of time; with the log's "
        "calibration of the magnetometer, or a later one in these files",
    )
    parser.add_argument(
        "--track",
        choices=TRACKS,
        default=TRACKS[0],
        help="the fused estimate over time: by the whole dive (smooth), by up to a second later (lag), by what came "
        "before (filter), or none; default: %(default)s",
    )
    parser.add_argument(
        "--track-hz", type=finite, default=50.0, metavar="HZ", help="rows a second; default: %(default)s"
    )
    _detector(parser)
    _json(parser, "print the summary as JSON")


def align(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `align`."""
    _dives(parser)
    _two_nodes(parser)
    _detector(parser)
    _json(parser, "print the result as JSON")


def evaluate(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `evaluate`."""
    parser.add_argument(
        "logs", nargs="+", metavar="SOLVED.mcap", help="the solved log; further logs where it lacks candidates or truth"
    )
    parser.add_argument("--truth", action="append", default=[], metavar="T.mcap", help="the log with the truth")
    add_pair_argument(parser, "the only one; of several pairs, all nodes of their net")
    parser.add_argument("--net", action="store_true", help="all nodes in one frame, also of a single pair")
    _json(parser, "print one JSON object: metres, radians, seconds")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write plots (PNG); needs the extra `plots`")


def report(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `report`."""
    _dives(parser, "one dive: a solved log, or each node's own")
    add_pair_argument(parser, "the first in the logs")
    parser.add_argument(
        "--about",
        type=Path,
        metavar="FILE.toml",
        help="what the report says of the dive: title, site, people (a list), instrument, text; each may be left out",
    )
    _authority(parser)
    parser.add_argument(
        "-o", "--output", required=True, type=Path, metavar="REPORT.html", help="the page to write; must not exist yet"
    )


def ros2(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `ros2`."""
    add_client_arguments(parser, ROS)
    parser.add_argument("--domain", type=int, default=0, metavar="ID", help="ROS_DOMAIN_ID; default: 0")
    _seconds(parser)


def artag(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `artag`."""
    _dives(parser, "one dive of pictures: its log, or each node's")
    _new_log(parser, "poses from tags, and the truth; must not exist yet", "TAGS.mcap")
    _two_nodes(parser)
    parser.add_argument(
        "--tags",
        action="append",
        default=[],
        metavar="NODE=FILE",
        help="a node's tags, instead of its NodeInfo's: JSON, a list of {id, corners_m, family}",
    )
    _json(parser, "print the summary as JSON")


def experiments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `experiments`."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="a new folder for the report")
    parser.add_argument("--quick", action="store_true", help="short dives: a first look, not figures to quote")
    parser.add_argument(
        "--readme", type=Path, metavar="README.md", help="write the main figures into this file, between its markers"
    )
    parser.add_argument(
        "--tag-video",
        type=Path,
        metavar="FILE",
        help="also compare AR tags in real water: test_vid.mp4 of github.com/mark-belbin/underwater-apriltags",
    )


def plan(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `plan`."""
    shown = "default: %(default)s"
    parser.add_argument(
        "--baseline", type=finite, default=0.88, metavar="M", help=f"distance between a node's lights; {shown}"
    )
    parser.add_argument("--visibility", type=finite, metavar="M", help="how far a diver sees; default: no limit")
    parser.add_argument(
        "--camera",
        metavar="FILE",
        help="the node's .toml, its NodeInfo as .json, or its log; default: 820 px, 48.8 deg",
    )
    parser.add_argument(
        "--sigma-px",
        type=finite,
        metavar="PX",
        help="1 sd of a light's place in a picture; default: the camera's, or 0.7",
    )
    parser.add_argument(
        "--compass-deg", type=finite, default=2.0, metavar="DEG", help=f"error of the compasses; {shown}"
    )
    tolerance = parser.add_argument_group("tolerances, RMS")
    tolerance.add_argument("--range-tolerance", type=finite, default=0.10, metavar="M", help=shown)
    tolerance.add_argument("--position-tolerance", type=finite, default=0.10, metavar="M", help=shown)
    tolerance.add_argument("--azimuth-tolerance", type=finite, default=3.0, metavar="DEG", help=shown)
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw it; needs the extra `plots`")
    _json(parser, "print one JSON object: metres, radians")


def export(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `export`."""
    parser.add_argument("logs", nargs="+", metavar="SOLVED.mcap", help="the solved log, or one with truth")
    parser.add_argument(
        "--format",
        choices=tuple(each.name for each in FORMATS),
        required=True,
        help="; ".join(f"{each.name}: {each.says}" for each in FORMATS),
    )
    parser.add_argument(
        "--what",
        choices=("poses", "track", "net"),
        help="default: the track if the log has one (the best of its modes), else the poses; net: all nodes",
    )
    parser.add_argument("--node", metavar="ID", help="of --what net: this node; tum needs it")
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="default, and -: standard output")
    parser.add_argument("--truth", action="store_true", help="the true poses instead of the solved ones (tum)")
    parser.add_argument("--rejected", action="store_true", help="rows for triggers without a pose as well (csv)")
    add_pair_argument(parser, "the only one")
