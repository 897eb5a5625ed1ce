"""`buddyline survey`: legs, adjustment, report and exports of a project."""

from __future__ import annotations

import argparse
import json
import os
import sys
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.security import SURVEYOR
from buddyline.tools.client import add_client_arguments
from msgspec.structs import replace

if TYPE_CHECKING:
    from collections.abc import Callable

    from buddyline.tools.survey.network import Adjusted
    from buddyline.tools.survey.project import Project

FORMATS: Final = ("svx", "svx-cartesian", "th", "dat", "csv", "stations", "geojson", "svg", "profile", "pdf")
SUFFIXES: Final = {
    "svx-cartesian": ".svx",
    "stations": ".stations.csv",
    "profile": ".profile.svg",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    does = parser.add_subparsers(dest="does", required=True, metavar="{legs,adjust,report,export,watch}")
    legs = does.add_parser("legs", help="make legs of the project's dives, or begin a project with --dive")
    legs.add_argument("project", metavar="PROJECT.toml")
    legs.add_argument("--dive", nargs="+", metavar="LOG.mcap", help="new project: the solved log, and each node's own")
    legs.add_argument("--marks", metavar="TIMES.csv", help="columns time, node, name, and perhaps kind and note")
    for name, text in (
        ("adjust", "adjust the network: loops, residuals, blunders"),
        ("report", "write an HTML report"),
    ):
        one = does.add_parser(name, help=text)
        one.add_argument("project", metavar="PROJECT.toml")
        _depth_argument(one)
        if name == "adjust":
            one.add_argument("--json", action="store_true")
        else:
            one.add_argument("-o", "--output", metavar="REPORT.html")
    export = does.add_parser("export", help="write the survey for other programs")
    export.add_argument("project", metavar="PROJECT.toml")
    export.add_argument("--format", choices=FORMATS, default="svx", help="default: svx (Survex)")
    export.add_argument(
        "--style",
        choices=("auto", "diving", "normal"),
        default="auto",
        help="of svx: diving (tape, compass, depths) or normal (tape, compass, clino); default: diving, but normal for "
        "legs of loops, because no Survex up to 1.4.22 adjusts loops of diving legs rightly",
    )
    export.add_argument("-o", "--output", metavar="FILE", help="default: beside the project; - for stdout")
    _depth_argument(export)
    watch = does.add_parser("watch", help="say on the bus, live, when sights, fields or depths disagree")
    add_client_arguments(watch, SURVEYOR)
    watch.add_argument("--seconds", type=float, metavar="S", help="stop after this long; default: at Ctrl-C")


def _depth_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--depth",
        choices=("absolute", "readings"),
        help="hold stations at their gauges' mean, or let each leg keep its two readings; default: the project's",
    )


def run(args: argparse.Namespace) -> int:
    """Run a subcommand; return 1 where adjustment finds a blunder."""
    if args.does == "watch":
        from buddyline.tools.survey.live import run_watch

        return run_watch(args, args.seconds)
    path = Path(args.project)
    if args.does == "legs":
        return _legs(path, args.dive, args.marks)
    from buddyline.tools.survey.network import adjust
    from buddyline.tools.survey.project import AdjustSettings, load_project

    project = load_project(path)
    if args.depth:
        project = replace(project, adjust=AdjustSettings(depth=args.depth))
    adjusted = adjust(project)
    if args.does == "export":
        return _export(path, args, project, adjusted)
    from buddyline.tools.survey import report

    if args.does == "report":
        output = args.output or str(path.with_suffix(".html"))
        _write(output, report.page(project, adjusted))
        return 0
    if args.json:
        print(json.dumps(_as_json(adjusted), allow_nan=False))
    else:
        print("\n".join(report.summary(project, adjusted)))
    return 1 if adjusted.blunders else 0


def _legs(path: Path, dive: list[str] | None, table: str | None) -> int:
    from buddyline.tools.survey.derive import Derived
    from buddyline.tools.survey.marks import of_project, of_table
    from buddyline.tools.survey.project import load_project, new_project, write_derived
    from buddyline.tools.survey.readings import of_logs

    if dive:
        new_project(path, path.stem, [os.path.relpath(log, path.parent) for log in dive])
    project = load_project(path)
    if not project.dive:
        raise BuddylineError(f"{path}: names no dive; add [[dive]] with its logs")
    derived = Derived()
    for number, one in enumerate(project.dive, 1):
        readings = of_logs([str(path.parent / log) for log in one.logs])
        start_ns = int(readings.stamps_ns[0])
        by_hand = of_project(project.mark, number, start_ns)
        if table and number == 1:
            by_hand += of_table(Path(table), start_ns)
        readings.marks.extend(by_hand)
        readings.marks.sort(key=lambda mark: mark.stamp_ns)
        derived.add(readings, project.settings, project.alarms, number)
    stations = derived.stations()
    write_derived(
        path, {"problem": derived.problems, "station": stations, "leg": derived.legs, "point": derived.points}
    )
    alarms = sum(len(leg.alarms) for leg in derived.legs + derived.points)
    print(f"{path}: {len(derived.legs)} legs, {len(stations)} stations, {len(derived.points)} points, {alarms} alarms")
    for problem in derived.problems:
        print(f"  {problem.text}")
    return 0 if derived.legs or derived.points else 1


def _export(path: Path, args: argparse.Namespace, project: Project, adjusted: Adjusted) -> int:
    from buddyline.tools.survey import compass, drawing, survex, tables, therion

    kind = args.format
    if args.style != "auto" and kind != "svx":
        raise BuddylineError(f"--style is of svx; {kind} has one style")
    title = project.survey.title or project.survey.name
    target = args.output or str(path.with_suffix(SUFFIXES.get(kind, f".{kind}")))
    if kind == "pdf":
        content: str | bytes = drawing.pdf([drawing.plan(adjusted, title), drawing.profile(adjusted, title)])
    elif kind in ("svg", "profile"):
        content = (drawing.plan if kind == "svg" else drawing.profile)(adjusted, title).svg()
    else:
        writers: dict[str, Callable[[Project, Adjusted], str]] = {
            "svx": partial(survex.readings, style=args.style),
            "svx-cartesian": survex.cartesian,
            "th": therion.centreline,
            "dat": compass.dat,
            "csv": tables.legs_csv,
            "stations": tables.stations_csv,
            "geojson": tables.geojson,
        }
        content = writers[kind](project, adjusted)
    _write(target, content)
    return 0


def _write(target: str, content: str | bytes) -> None:
    data = content.encode() if isinstance(content, str) else content
    if target == "-":
        sys.stdout.buffer.write(data)
        sys.stdout.flush()
        return
    try:
        Path(target).write_bytes(data)
    except OSError as error:
        raise BuddylineError(f"{target}: cannot be written: {error.strerror}") from error
    print(f"wrote {target}", file=sys.stderr)


def _as_json(adjusted: Adjusted) -> dict[str, object]:
    return {
        "length_m": adjusted.length_m,
        "north": adjusted.grid.north,
        "stations": {
            name: {
                "position_m": position.position_m.tolist(),
                "covariance_m2": position.covariance.tolist(),
                "ellipse": position.ellipse,
            }
            for name, position in adjusted.positions.items()
        },
        "points": {
            point.name: {"position_m": point.position_m.tolist(), "ellipse": point.ellipse} for point in adjusted.points
        },
        "loops": [asdict(loop) for loop in adjusted.loops],
        "residuals": [{"leg": one.leg.name, "moved_m": one.moved_m, "chi2": one.chi2} for one in adjusted.residuals],
        "blunders": [{"legs": one.legs, "chi2": one.chi2} for one in adjusted.blunders],
        "left_out": [{"leg": leg.name, "why": why} for leg, why in adjusted.left_out],
    }
