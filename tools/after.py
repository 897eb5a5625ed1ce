"""`buddyline after`: from the nodes' folders to a solved dive and its report, in one command.

For two nodes that never heard each other during the dive: everything that is done by hand otherwise, in the same order.
"""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from buddyline.node.choices import DETECTORS
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.topics import parse_key
from buddyline.solver_service.track.clocks import Clocks
from buddyline.tools.align import clocks_json, clocks_of
from buddyline.tools.clock_curves import LEAST_OFFSET_S, beacon_curves
from buddyline.tools.clock_sets import ClockSets
from buddyline.tools.dives import Dive
from buddyline.tools.extras import MissingExtraError
from buddyline.tools.losses import collected
from buddyline.tools.losses import report as report_losses
from buddyline.tools.newfile import new_folder
from buddyline.tools.solve import pair_of

log = logging.getLogger(__name__)

# Logs that overlap, or are this close, are of one dive: a node may have been started again.
SAME_DIVE_S: Final = 120.0


@dataclass
class Outing:
    """The logs of all nodes between one start and one end. nodes: which nodes recorded them."""

    start_ns: int
    end_ns: int
    logs: list[Path] = field(default_factory=list)
    nodes: set[str] = field(default_factory=set)

    @property
    def words(self) -> str:
        """When it was and who recorded it."""
        began = datetime.fromtimestamp(self.start_ns / S_NS, UTC)
        minutes = (self.end_ns - self.start_ns) / 60 / S_NS
        return f"{began:%Y-%m-%d %H:%M} UTC, {minutes:.1f} min, {', '.join(sorted(self.nodes))}"


def run(args: argparse.Namespace) -> int:
    """Solve every dive of the folders; return 1 where one could not be solved, or a log was damaged."""
    found = outings(logs_in(Path(path) for path in args.folders))
    dives = [one for one in found if len(one.nodes) > 1]
    for one in found:
        if one not in dives:
            log.warning("%s: only one node: left out (%s)", one.words, ", ".join(path.name for path in one.logs))
    if not dives:
        raise BuddylineError(
            f"{', '.join(args.folders)}: no dive that two nodes recorded at the same time; if they did, their clocks "
            f"are more than {SAME_DIVE_S:g} s apart"
        )
    # An empty one is what an interrupted call leaves.
    folder, status = new_folder(args.output), 0
    for number, one in enumerate(dives, 1):
        where = folder if len(dives) == 1 else folder / f"dive-{number}"
        where.mkdir(exist_ok=True)
        log.info("dive %d of %d: %s", number, len(dives), one.words)
        try:
            status |= _solve(one, where)
        except BuddylineError as error:
            # The other dives are solved all the same.
            log.error("%s: not solved: %s", where, error)
            status |= 1
    return status


def logs_in(folders: Iterable[Path]) -> list[Path]:
    """Return the logs in these folders, and those that are named themselves; pictures lie beside their log."""
    found: list[Path] = []
    for folder in folders:
        if not folder.exists():
            raise BuddylineError(f"{folder}: does not exist")
        inside = [path for path in sorted(folder.rglob("*.mcap")) if path.parent.suffix != ".pictures"]
        if folder.is_dir() and not inside:
            raise BuddylineError(f"{folder}: holds no log (*.mcap)")
        found += inside if folder.is_dir() else [folder]
    return found


def outings(logs: list[Path]) -> list[Outing]:
    """Return the dives that these logs are of, in order of time; damaged logs count as far as they can be read."""
    spans: list[tuple[int, int, Path, set[str]]] = []
    for path in logs:
        if path.stat().st_size == 0:
            report_losses([f"{path}: is empty: the node ended before it wrote anything"])
            continue
        try:
            reader = DiveLogReader(path)
        except BuddylineError as error:
            report_losses([str(error)])
            continue
        with reader:
            keys = [parse_key(key) for key in reader.keys]
            nodes = {ids[0] for topic, ids in filter(None, keys) if topic.name in ("candidates", "image")}
            start_ns, end_ns = ClockSets([reader]).span_ns(reader)
            if start_ns is not None and end_ns is not None and nodes:
                spans.append((start_ns, end_ns, path, nodes))
    found: list[Outing] = []
    for start_ns, end_ns, path, nodes in sorted(spans, key=lambda span: span[0]):
        if not found or start_ns > found[-1].end_ns + SAME_DIVE_S * S_NS:
            found.append(Outing(start_ns, end_ns))
        found[-1].end_ns = max(found[-1].end_ns, end_ns)
        found[-1].logs.append(path)
        found[-1].nodes |= nodes
    return found


def _solve(outing: Outing, folder: Path) -> int:
    logs, solved = [str(path) for path in outing.logs], folder / "solved.mcap"
    words = ["solve", *logs, "-o", str(solved)]
    if len(outing.nodes) == 2:
        words += _clock_words(logs, folder / "clocks.json")
    status = run_command(words)
    if not solved.exists():
        return 1
    with Dive([solved]) as dive:
        has_rows = bool(dive.ids("pose", "track"))
    if has_rows:
        for kind, name in (("tum", "track.tum"), ("csv", "track.csv")):
            status |= run_command(["export", str(solved), "--format", kind, "-o", str(folder / name)])
    else:
        log.error("%s: no pose: the report says why", solved)
        status |= 1
    try:
        status |= run_command(["report", str(solved), "-o", str(folder / "report.html")])
    except MissingExtraError as error:
        # The report draws; without the extra for it everything else is there.
        log.warning("no report: %s", error)
    except BuddylineError as error:
        log.error("no report: %s", error)
        status |= 1
    print(f"{folder}: {', '.join(sorted(path.name for path in folder.iterdir()))}")
    return status


def _clock_words(logs: list[str], file: Path) -> list[str]:
    """Return what to tell `solve` of the clocks: nothing where beacons tell them at both ends of the dive.

    Else offset and drift, as the dive itself tells them, are written to file.
    """
    with Dive(logs) as dive:
        beacons = beacon_curves(dive, dive.nodes("candidates", "image"))
        if beacons and beacons[0].covers:
            return []
        try:
            pair = pair_of(dive, None)
            found = clocks_of(dive, pair, DETECTORS[0], "auto")
        except BuddylineError as error:
            log.info("clocks: `align` does not tell: %s", error)
            found = None
    if found is None:
        if not beacons:
            log.warning(
                "clocks: neither beacons nor the dive tell their offset; poses are as good as the clocks were set"
            )
        return []
    drift = found.drift if isinstance(found, Clocks) else None
    log.info("clocks: %s's is %+.2f ms from %s's%s, by `align`", pair[1], 1e3 * found.offset_s, pair[0],
             "" if drift is None else f", gaining {1e6 * drift:+.1f} us a second")  # fmt: skip
    if abs(found.offset_s) <= LEAST_OFFSET_S and drift is None:
        return []
    file.write_text(clocks_json(pair, found))
    return ["--clocks", str(file)]


def run_command(words: list[str]) -> int:
    """Run one command of this program; what it could not read is reported with all other losses."""
    from buddyline.tools.cli import command_named

    with collected() as lost:
        status = command_named(words[0]).run(words[1:])
    report_losses(lost.lines())
    return status
