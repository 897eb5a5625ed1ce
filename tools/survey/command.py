"""`buddyline survey`: legs, adjustment, report and exports of a project."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.options import above_zero
from buddyline.protocol.security import SURVEYOR
from buddyline.tools.arguments import subcommand
from buddyline.tools.client import add_client_arguments

if TYPE_CHECKING:
    from buddyline.tools.survey.network import Adjusted
    from buddyline.tools.survey.readings import PairReadings
    from buddyline.tools.survey.sheet import Sheet

# Format to the ending of its file, beside the project.
FORMATS: Final = {
    "svx": ".svx",
    "svx-cartesian": ".svx",
    "th": ".th",
    "dat": ".dat",
    "csv": ".csv",
    "stations": ".stations.csv",
    "residuals": ".residuals.csv",
    "paths": ".paths.csv",
    "geojson": ".geojson",
    "kml": ".kml",
    "dxf": ".dxf",
    "gpkg": ".gpkg",
    "control": ".control.csv",
    "scalebars": ".scalebars.csv",
    "svg": ".svg",
    "profile": ".profile.svg",
    "pdf": ".pdf",
}

SAYS: Final = (
    "svx, svx-cartesian: Survex, by measurements or by coordinates; th: Therion; dat: Compass; csv: the legs; "
    "stations, residuals, paths: tables; geojson, kml, gpkg, dxf: maps; control, scalebars: tables for photogrammetry; "
    "svg, profile: plan and side view; pdf: both to print; default: svx"
)

# Formats that can be written in more than one way.
STYLES: Final = {"svx": ("auto", "diving", "normal"), "th": ("auto", "diving")}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    does = parser.add_subparsers(dest="does", required=True, metavar="{legs,import,adjust,report,export,watch,tags}")

    def add(text: str, runs: Callable[[argparse.Namespace], int], example: str) -> argparse.ArgumentParser:
        one = subcommand(does, example.split(maxsplit=1)[0], text, f"survey {example}")
        one.set_defaults(survey=runs)
        if runs not in (_watch, _tags):
            one.add_argument("project", metavar="PROJECT.toml", type=Path, help="the survey; `legs --dive` begins one")
        if runs not in (_watch, _tags, _legs, _import):
            one.add_argument(
                "--depth",
                choices=("absolute", "readings"),
                help="absolute: hold each station at the mean of its gauges; readings: each leg keeps its own two "
                "depths; default: what the project says",
            )
        return one

    legs = add(
        "make legs from the project's dives; with --dive, begin a new project",
        _legs,
        "legs cave.toml --dive solved.mcap a.mcap b.mcap",
    )
    legs.add_argument("--dive", nargs="+", metavar="LOG.mcap", help="new project: the solved log, and each node's own")
    legs.add_argument(
        "--marks",
        type=Path,
        metavar="TIMES.csv",
        help="which node was where when; columns: time, node, name, and optionally kind, note and dive (default: 1)",
    )
    imported = add(
        "take in surveys of other programs: they are adjusted with the project's own legs",
        _import,
        "import cave.toml old/161.svx",
    )
    imported.add_argument(
        "files",
        nargs="+",
        metavar="FILE",
        type=Path,
        help="Survex .svx, Therion .th, Compass .dat or .mak, Walls .srv, a table .csv, PocketTopo .txt, "
        "Mnemo and JedEye .dmp, Ariane .tml",
    )
    imported.add_argument(
        "--name", metavar="NAME", help="put this before its stations' names; default: the file's name"
    )
    adjust = add("adjust the network and print loops, residuals and probable blunders", _adjust, "adjust cave.toml")
    adjust.add_argument("--json", action="store_true", help="print everything as one JSON object")
    report = add("write an HTML report", _report, "report cave.toml -o cave.html")
    report.add_argument("-o", "--output", metavar="REPORT.html", help="default: beside the project")
    export = add("write the survey for other programs", _export, "export cave.toml --format svx")
    export.add_argument("--format", choices=FORMATS, default="svx", help=SAYS)
    export.add_argument(
        "--style",
        choices=("auto", "diving", "normal"),
        default="auto",
        help="diving (tape, compass, depths; of svx and th) or normal (tape, compass, clino; of svx); default: diving, "
        "but for legs in loops normal in svx, because no Survex up to 1.4.22 adjusts loops of diving legs correctly, "
        "and as adjusted in th, because Therion weighs loops without correlations",
    )
    export.add_argument("-o", "--output", metavar="FILE", help="default: beside the project; - for stdout")
    watch = add("tell monitor and nodes, while the divers rest, whether their leg is good", _watch, "watch")
    add_client_arguments(watch, SURVEYOR)
    watch.add_argument("--seconds", type=above_zero, metavar="S", help="stop after this long; default: at Ctrl-C")
    tags = add("write pages of station tags to print", _tags, "tags 100 139 -o tags.pdf")
    tags.add_argument("first", type=int, help="number of the first tag, from 100 on")
    tags.add_argument("last", type=int, help="number of the last one, up to 586")
    tags.add_argument(
        "--side-mm", type=above_zero, default=60.0, metavar="MM", help="side of the black square; default: 60"
    )
    tags.add_argument("-o", "--output", required=True, metavar="TAGS.pdf", help="- for stdout")


def run(args: argparse.Namespace) -> int:
    """Run a subcommand."""
    status: int = args.survey(args)
    return status


@contextmanager
def _naming(project: Path) -> Iterator[None]:
    """Put a project's name before the errors of what it says."""
    try:
        yield
    except BuddylineError as error:
        raise ConfigError(f"{project}: {error}") from error


def _watch(args: argparse.Namespace) -> int:
    from buddyline.tools.survey.live import run_watch

    return run_watch(args, args.seconds)


def _tags(args: argparse.Namespace) -> int:
    from buddyline.node.station_tags import NUMBERS
    from buddyline.tools.draw import figures
    from buddyline.tools.draw.tag_sheet import tag_sheet, tags_on_a_page
    from buddyline.tools.newfile import write_output

    figures.check()
    numbers = range(args.first, args.last + 1)
    if not numbers or numbers[0] not in NUMBERS or numbers[-1] not in NUMBERS:
        raise BuddylineError(f"tags {args.first} {args.last}: numbers are from {NUMBERS[0]} to {NUMBERS[-1]}")
    if not all(tags_on_a_page(args.side_mm)):
        raise BuddylineError(f"--side-mm {args.side_mm:g}: no such tag fits on a page of A4")
    write_output(args.output, figures.pdf(tag_sheet(numbers, args.side_mm)))
    return 0


def _legs(args: argparse.Namespace) -> int:
    from buddyline.tools.newfile import check_new
    from buddyline.tools.survey.derive import Derived
    from buddyline.tools.survey.gauges import adjust_gauges
    from buddyline.tools.survey.marks import of_project, of_table
    from buddyline.tools.survey.project import (
        ANOTHER_DIVE,
        Made,
        beside,
        load_project,
        new_project,
        own_equates,
        sources_of,
        write_derived,
    )
    from buddyline.tools.survey.readings import of_logs

    path: Path = args.project
    read: dict[int, list[PairReadings]] = {}
    if args.dive:
        # What cannot be read begins no project, so that the next call may have the same name.
        check_new(path, ANOTHER_DIVE)
        read[1] = of_logs(args.dive)
        new_project(path, path.stem, [beside(path, log) for log in args.dive])
    project = load_project(path)
    if not project.dive:
        raise BuddylineError(f"{path}: names no dive; add [[dive]] with its logs")
    marks = project.mark + (of_table(args.marks, len(project.dive)) if args.marks else [])
    derived = Derived()
    for number, one in enumerate(project.dive, 1):
        pairs = read.get(number) or of_logs([str(path.parent / log) for log in one.logs])
        with _naming(path):
            by_hand = of_project(marks, number, int(pairs[0].stamps_ns[0]))
            derived.add(pairs, project.settings, project.alarms, number, by_hand)
    with _naming(path):
        for same in own_equates(project):
            derived.equate(same)
        gauges = adjust_gauges(derived.legs, project.alarms)
    stations = derived.stations(gauges.depths)
    for text in gauges.alarms:
        derived.add_problem(text)
    for dive, rate in gauges.tides_m_per_h.items():
        derived.add_problem(
            f"water level in dive {dive}: {rate:+.2f} m an hour, by the gauges' own readings; taken off"
        )
    write_derived(
        path,
        {
            "made": [Made(of=sources_of(project))],
            "problem": derived.problems,
            "station": stations,
            "leg": derived.legs,
            "turn": derived.turns,
            "swim": derived.swims,
            "point": derived.points,
        },
    )
    alarms = sum(len(leg.alarms) for leg in derived.legs + derived.points) + len(gauges.alarms)
    print(f"{path}: {len(derived.legs)} legs, {len(stations)} stations, {len(derived.points)} points, {alarms} alarms")
    for problem in derived.problems:
        print(f"  {problem.text}")
    return 0 if (derived.legs or derived.points) and not derived.faults else 1


def _import(args: argparse.Namespace) -> int:
    """Add old surveys to a project, new if there is none; return 1 where something in them was not read."""
    from buddyline.tools.survey.old.joining import joined, name_of, read_project_files
    from buddyline.tools.survey.project import About, OldFile, Project, add_old, beside, load_project, new_project
    from msgspec import structs

    path: Path = args.project
    if args.name and len(args.files) > 1:
        raise BuddylineError("--name is for one file")
    added = [OldFile(file=beside(path, one), name=args.name or name_of(one)) for one in args.files]
    project = load_project(path) if path.exists() else Project(survey=About(name=path.stem))
    whole = structs.replace(project, old=project.old + added)
    olds = read_project_files(whole, path.parent)
    with _naming(path):
        joined(whole, olds)
    if path.exists():
        add_old(path, added)
    else:
        new_project(path, path.stem, [], added)
    for one, old in zip(added, olds[len(project.old) :], strict=True):
        splays = sum("splay" in shot.flags for shot in old.shots)
        print(
            f"{one.file} as {one.name}: {len(old.shots) - splays} shots, {splays} splays, "
            f"{len(old.stations)} stations, {len(old.passages)} passages, {len(old.fixes)} fixed"
        )
        for said in old.left_out:
            print(f"  left out: {said}")
    return 1 if any(old.left_out for old in olds[len(project.old) :]) else 0


def _sheet(args: argparse.Namespace) -> Sheet:
    """Return the project's survey, adjusted."""
    from buddyline.tools.survey.network import adjust
    from buddyline.tools.survey.old.joining import joined, read_project_files
    from buddyline.tools.survey.project import load_project
    from buddyline.tools.survey.sheet import Sheet
    from msgspec.structs import replace

    project = load_project(args.project)
    olds = read_project_files(project, args.project.parent)
    with _naming(args.project):
        project = joined(project, olds)
        if args.depth:
            project = replace(project, adjust=replace(project.adjust, depth=args.depth))
        return Sheet(project, adjust(project), olds)


def _adjust(args: argparse.Namespace) -> int:
    """Print the adjustment; return 1 if it finds a blunder, leaves out a leg that nobody has taken out, or is stale."""
    from buddyline.tools.survey import report

    sheet = _sheet(args)
    if args.json:
        print(json.dumps(as_json(sheet.adjusted), allow_nan=False))
    else:
        print("\n".join(report.summary(sheet)))
    taken_out = {id(leg) for leg in sheet.project.leg + sheet.project.point if sheet.project.taken_out(leg)}
    lost = [leg for leg, _ in sheet.adjusted.left_out if id(leg) not in taken_out]
    return 1 if _is_stale(args, sheet) or sheet.adjusted.blunders or lost else 0


def _is_stale(args: argparse.Namespace, sheet: Sheet) -> bool:
    """Tell, and say, whether what the legs are made of has changed since."""
    from buddyline.tools.survey.project import sources_of

    if not sheet.project.made or sheet.project.made[0].of == sources_of(sheet.project):
        return False
    changed = "dives, marks or equates have changed since `buddyline survey legs` made its legs: run it again"
    print(f"{args.project}: {changed}", file=sys.stderr)
    return True


def _target(args: argparse.Namespace, ending: str) -> str:
    """Return the output's name, by default beside the project."""
    project: Path = args.project
    if args.output is None and project.parent in (Path("/dev"), Path("/dev/fd"), Path("/proc/self/fd")):
        raise BuddylineError(f"{project}: the output cannot be beside it; name it with -o")
    return str(args.output or project.with_suffix(ending))


def _report(args: argparse.Namespace) -> int:
    from buddyline.tools.newfile import write_output
    from buddyline.tools.survey import report

    target = _target(args, ".html")
    sheet = _sheet(args)
    with _naming(args.project):
        page = report.page(sheet)
    write_output(target, page)
    return 0


def _export(args: argparse.Namespace) -> int:
    """Write the survey in one of FORMATS; return 1 where the format leaves old surveys out, or the legs are stale."""
    from buddyline.tools.newfile import write_output

    if args.style not in STYLES.get(args.format, ("auto",)):
        known = "; ".join(f"{name}: {', '.join(styles)}" for name, styles in STYLES.items())
        raise BuddylineError(f"--style {args.style}: {args.format} has no such style ({known})")
    target = _target(args, FORMATS[args.format])
    sheet = _sheet(args)
    with _naming(args.project):
        content = exported(sheet, args.format, args.style)
    write_output(target, content)
    if sheet.olds and args.format == "dat":
        print(f"{args.project}: left out: old surveys, which dat has not; svx and th have them", file=sys.stderr)
        return 1
    return int(_is_stale(args, sheet))


def exported(sheet: Sheet, kind: str, style: str = "auto") -> str | bytes:
    """Return a survey in one of FORMATS."""
    from buddyline.tools.draw import figures
    from buddyline.tools.draw.survey import plan, profile
    from buddyline.tools.survey import maps, survex, tables

    adjusted, title = sheet.adjusted, sheet.title
    writers: dict[str, Callable[[], str | bytes]] = {
        "svx": lambda: survex.svx(sheet, style),
        "svx-cartesian": lambda: survex.svx_cartesian(sheet),
        "th": lambda: survex.th(sheet, style),
        "dat": lambda: tables.compass_dat(sheet),
        "csv": lambda: tables.legs_csv(sheet),
        "stations": lambda: tables.stations_csv(sheet),
        "residuals": lambda: tables.residuals_csv(sheet),
        "paths": lambda: tables.paths_csv(sheet),
        "geojson": lambda: tables.geojson(sheet),
        "kml": lambda: maps.kml(sheet),
        "dxf": lambda: maps.dxf(sheet),
        "gpkg": lambda: maps.geopackage(sheet),
        "control": lambda: maps.control_csv(sheet),
        "scalebars": lambda: maps.scale_bars_csv(sheet),
        "svg": lambda: figures.svg(plan(adjusted, title)),
        "profile": lambda: figures.svg(profile(adjusted, title)),
        "pdf": lambda: figures.pdf([plan(adjusted, title), profile(adjusted, title)]),
    }
    return writers[kind]()


def as_json(adjusted: Adjusted) -> dict[str, object]:
    """Return an adjustment as JSON takes it."""
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
        "blunders": [asdict(one) | {"text": one.text} for one in adjusted.blunders],
        "fit": asdict(adjusted.fit) | {"variance_factor": adjusted.fit.factor},
        "proposals": [asdict(one) for one in adjusted.proposals],
        "left_out": [{"leg": leg.name, "why": why} for leg, why in adjusted.left_out],
    }
