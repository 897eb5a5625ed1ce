"""The formats of `export`: a line of this table, and a module that writes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

from buddyline.protocol.errors import BuddylineError

if TYPE_CHECKING:
    from buddyline.tools.dives import Dive


@dataclass(frozen=True)
class ExportFormat:
    """A format. module: beside this one, with export(dive, output, what) -> number of messages or frames.

    "": text, which command.py writes to a file or to standard output. counts: what its number is of. of_net: it
    has all nodes of a net, whatever is asked for. table: rows and columns; its module has
    write(output, said, names, rows).
    """

    name: str
    says: str
    module: str = ""
    counts: str = "messages"
    of_net: bool = False
    table: bool = False


FORMATS: Final = (
    ExportFormat("tum", "t x y z qx qy qz qw, for evo and others"),
    ExportFormat("csv", "a row for each sample, units in the header", table=True),
    ExportFormat("trc", "all nodes and their lamps as markers, for motion capture programs"),
    ExportFormat("c3d", "the same as C3D, which most of them read (extra `c3d`)", "c3d", "frames", of_net=True),
    ExportFormat(
        "colmap",
        "a folder with all nodes' pictures and cameras, as COLMAP's text",
        "colmap",
        "pictures",
        of_net=True,
    ),
    ExportFormat("metashape", "the same with cameras.xml for Metashape", "metashape", "pictures", of_net=True),
    ExportFormat(
        "parquet", "the columns of csv, typed, for pandas and others (extra `parquet`)", "parquet", table=True
    ),
    ExportFormat(
        "foxglove",
        "a log with scene, pictures, marks, path, series and log for Foxglove and Lichtblick, and a layout beside it",
        "foxglove",
    ),
    ExportFormat("rerun", "a recording for rerun: nodes in space, pictures, series, log (extra `rerun`)", "rerun"),
    ExportFormat(
        "mcap-ros2",
        "a log for `ros2 bag play` and other programs: tf, odometry, poses, pictures, diagnostics (extra `ros2`)",
        "ros2",
    ),
)


def format_of(name: str) -> ExportFormat:
    """Return the format of this name."""
    return next(each for each in FORMATS if each.name == name)


def check_shows(dive: Dive, count: int) -> None:
    """Raise BuddylineError if nothing of a dive is in its export."""
    if not count:
        held = ", ".join(dive.keys) or "no message"
        raise BuddylineError(
            f"{dive.name}: nothing to export in it: no pose, track, attitude, depth or picture (it holds {held}); name "
            "the dive's own logs, too, or solve it: buddyline solve DIVE.mcap -o OUT.mcap"
        )
