"""The arguments of commands whose own modules take long to import: declared here, so that `--help` need not wait.

Nothing here imports numpy or OpenCV. A command's function has the command's name; the others declare their own.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from buddyline.node.choices import DETECTORS, PRESETS
from buddyline.protocol.security import ROS
from buddyline.solver_service.choices import CHECKS, METHODS
from buddyline.tools.client import add_client_arguments
from buddyline.tools.pairs import add_pair_argument

EXPORT_FORMATS = ("tum", "csv", "foxglove")


def repair(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline repair`."""
    parser.add_argument("input", metavar="IN.mcap", help="is left as it is")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.mcap", help="must not exist yet")


def backfill(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline backfill`."""
    parser.add_argument("topside", metavar="TOPSIDE.mcap", help="what `buddyline record` wrote")
    parser.add_argument("nodes", nargs="+", metavar="NODE.mcap", help="the nodes' own logs, all of the dive")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.mcap", help="must not exist yet")


def detect(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline detect`."""
    parser.add_argument("inputs", nargs="+", metavar="IMAGE|FOLDER|DIVE.mcap")
    parser.add_argument("-o", "--output", metavar="OUT.mcap", help="write a dive log in place of JSON lines")
    parser.add_argument("--draw", metavar="DIR", help="a new folder for the pictures with their candidates marked")
    parser.add_argument("--environment", default="auto", choices=PRESETS, help="default: auto")
    parser.add_argument(
        "--method", default=DETECTORS[0], choices=DETECTORS, help=f"default: {DETECTORS[0]}; paper: the paper's"
    )
    parser.add_argument("--json", action="store_true", help="JSON lines on stdout (the default without -o)")


def tune(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline tune`."""
    parser.add_argument("inputs", nargs="+", metavar="IMAGE|FOLDER|DIVE.mcap")
    parser.add_argument(
        "--truth", metavar="T.mcap", help="where the lights truly are; default: in the dive, if it says"
    )
    parser.add_argument("--method", default=DETECTORS[0], choices=DETECTORS, help=f"default: {DETECTORS[0]}")
    parser.add_argument("--environment", default=PRESETS[1], choices=PRESETS[1:], help="the preset to start from")
    parser.add_argument("--pictures", type=int, default=24, metavar="N", help="at most, evenly spread; default: 24")
    parser.add_argument(
        "--draw", default="tuned", metavar="DIR", help="a new folder for marked pictures; default: tuned"
    )
    parser.add_argument("--json", action="store_true")


def solve(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline solve`."""
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="one dive: its log, or each node's own")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.mcap", help="poses, rejections, and their inputs")
    parser.add_argument("--method", choices=METHODS, default="refined", help="default: refined")
    parser.add_argument(
        "--checks", default=",".join(CHECKS), help=f"comma-separated, of {', '.join(CHECKS)} (default: all)"
    )
    parser.add_argument(
        "--nodes", nargs="+", metavar="NODE", help="solve every pair of these, A B or a,b,c; default: all in the logs"
    )
    parser.add_argument(
        "--info",
        action="append",
        default=[],
        metavar="NODE=FILE",
        help="calibration in place of the log's: JSON or log",
    )
    parser.add_argument(
        "--clock-offset",
        type=float,
        default=0.0,
        metavar="S",
        help="B's clock minus A's, as `buddyline align` tells it",
    )
    parser.add_argument("--environment", default="auto", help="for dives of pictures; default: auto")
    parser.add_argument("--detector", default="source", help="for dives of pictures; default: source")
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def align(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline align`."""
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="one dive: its log, or each node's own")
    parser.add_argument("--nodes", nargs=2, metavar=("A", "B"), help="the pair; default: the dive's two nodes")
    parser.add_argument("--environment", default="auto", help="for dives of pictures; default: auto")
    parser.add_argument("--detector", default="source", help="for dives of pictures; default: source")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def evaluate(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline evaluate`."""
    parser.add_argument(
        "logs", nargs="+", metavar="OUT.mcap", help="the solved log; further logs, where it lacks candidates or truth"
    )
    parser.add_argument("--truth", action="append", default=[], metavar="T.mcap", help="the log with the truth")
    add_pair_argument(parser, "the only one")
    parser.add_argument("--json", action="store_true", help="print one JSON object: metres, radians, seconds")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="write plots (PNG); needs the extra `plots`")


def report(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline report`."""
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="one dive: a solved log, or each node's own")
    add_pair_argument(parser, "the first in the logs")
    parser.add_argument("-o", "--output", required=True, type=Path, metavar="report.html")


def ros2(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline ros2`."""
    add_client_arguments(parser, ROS)
    parser.add_argument("--domain", type=int, default=0, metavar="ID", help="ROS_DOMAIN_ID; default: 0")
    parser.add_argument("--seconds", type=float, metavar="S", help="end after this long; default: at Ctrl-C")


def artag(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline artag`."""
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="one dive of pictures: its log, or each node's")
    parser.add_argument("-o", "--output", required=True, metavar="TAGS.mcap", help="poses from tags, and the truth")
    parser.add_argument("--nodes", nargs=2, metavar=("A", "B"), help="the pair; default: the dive's two nodes")
    parser.add_argument(
        "--tags",
        action="append",
        default=[],
        metavar="NODE=FILE",
        help="the tags that a node carries, in place of its NodeInfo's: JSON, a list of {id, corners_m, family}",
    )
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")


def experiments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline experiments`."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR", help="a new folder for the report")
    parser.add_argument("--quick", action="store_true", help="short dives: a look, not figures to quote")
    parser.add_argument(
        "--readme",
        type=Path,
        metavar="README.md",
        help="write the table at a glance into this file, between its markers",
    )
    parser.add_argument(
        "--tag-video",
        type=Path,
        metavar="FILE",
        help="test_vid.mp4 of github.com/mark-belbin/underwater-apriltags",
    )


def plan(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline plan`."""
    parser.add_argument("--baseline", type=float, default=0.88, metavar="M", help="spacing of the lights (%(default)s)")
    parser.add_argument(
        "--visibility", type=float, metavar="M", help="how far a diver sees; default: the water ends nothing"
    )
    parser.add_argument(
        "--camera", metavar="FILE", help="the node's .toml, or NodeInfo as .json or .mcap; default: 820 px, 48.8 deg"
    )
    parser.add_argument("--sigma-px", type=float, metavar="PX", help="noise of a light; default: the camera's, or 0.7")
    parser.add_argument("--compass-deg", type=float, default=2.0, metavar="DEG", help="error of headings (%(default)s)")
    tolerance = parser.add_argument_group("tolerances, RMS")
    tolerance.add_argument("--range-tolerance", type=float, default=0.10, metavar="M", help="default: %(default)s")
    tolerance.add_argument("--position-tolerance", type=float, default=0.10, metavar="M", help="default: %(default)s")
    tolerance.add_argument("--azimuth-tolerance", type=float, default=3.0, metavar="DEG", help="default: %(default)s")
    parser.add_argument("--plot", type=Path, metavar="FILE.png", help="draw it; needs the extra `plots`")
    parser.add_argument("--json", action="store_true", help="print one JSON object: metres, radians")


def export(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of `buddyline export`."""
    parser.add_argument("logs", nargs="+", metavar="OUT.mcap", help="the solved log, or one with truth")
    parser.add_argument(
        "--format",
        choices=EXPORT_FORMATS,
        required=True,
        help="tum: t x y z qx qy qz qw, for evo and others; csv: a row a pose, units in the header; foxglove: a log "
        "with pictures, marks and transforms as Foxglove, Lichtblick and rerun draw them",
    )
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help="default: standard output")
    parser.add_argument("--truth", action="store_true", help="the true poses in place of the solved ones (tum)")
    parser.add_argument("--rejected", action="store_true", help="rows for triggers without a pose, too (csv)")
    add_pair_argument(parser, "the only one")
