"""Marks given afterwards: in the project file, or as a table of times."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Final, get_args

import msgspec
from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError, text_of
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Mark
from buddyline.tools.survey.project import HandMark, MarkKind, Station, check_mark
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.tools.survey.old.model import CrossSection

KINDS: Final = get_args(MarkKind)
# The columns of a table of marks.
TEXTS: Final = ("node", "name", "kind", "note")
COLUMNS: Final = ("time", *TEXTS, "dive")
# How a station's note says its cross-section: left, right, up, down in metres, - for what was not measured.
SECTION_WORD: Final = "LRUD"


def section_note(sides: Sequence[str], note: str) -> str:
    """Return a mark's note with a cross-section before it; raise BuddylineError naming a value that is no length."""
    for name, side in zip(("left", "right", "up", "down"), sides, strict=True):
        if side != "-" and not _is_length(side):
            raise BuddylineError(f"--lrud: {name}: {side!r} is neither a length in metres nor -")
    return " ".join(filter(None, [SECTION_WORD, *sides, note]))


def section_of(station: Station) -> CrossSection | None:
    """Return a station's cross-section by its notes, the last one; None without. Raise ConfigError if it is none."""
    # Here, so that `buddyline mark --help` answers at once.
    from buddyline.tools.survey.old.model import CrossSection

    found = None
    for note in station.notes:
        word, *sides = note.split()[:5] or [""]
        if word == SECTION_WORD:
            if len(sides) < 4 or not all(side == "-" or _is_length(side) for side in sides):
                raise ConfigError(f"station {station.name!r}: note {note!r}: {SECTION_WORD} and four lengths, or -")
            found = CrossSection(station.name, *(None if side == "-" else float(side) for side in sides))
    return found


def _is_length(word: str) -> bool:
    return re.fullmatch(r"\d{1,4}(\.\d{0,6})?", word) is not None


def time_of(text: str) -> datetime | float:
    """Return `2026-05-01T10:20:30Z` as a time (UTC if no zone is given), or a number of seconds; else ValueError."""
    try:
        seconds = float(text)
    except ValueError:
        try:
            return datetime.fromisoformat(text.strip())
        except ValueError as error:
            raise ValueError(f"time {text!r}: neither as 2026-05-01T10:20:30Z nor a number of seconds") from error
    if not math.isfinite(seconds):
        raise ValueError(f"time {text!r}: not a finite number")
    return seconds


def stamp_ns_of(time: datetime | float, start_ns: int) -> int:
    """Return the instant of a time, or of seconds from start_ns."""
    if isinstance(time, float):
        return start_ns + round(time * S_NS)
    aware = time if time.tzinfo is not None else time.replace(tzinfo=UTC)
    return round(aware.timestamp() * 1e6) * 1000


def of_project(marks: list[HandMark], dive: int, start_ns: int) -> list[Mark]:
    """Return the marks of one dive, which began at start_ns, as the bus has them."""
    result = []
    for mark in marks:
        time = mark.seconds if mark.time is UNSET else mark.time
        if mark.dive == dive and time is not UNSET:
            stamp_ns = stamp_ns_of(time, start_ns)
            result.append(Mark(node=mark.node, stamp_ns=stamp_ns, kind=mark.kind, name=mark.name, note=mark.note))
    return result


def of_table(path: Path, dives: int = 1) -> list[HandMark]:
    """Read a CSV with the columns time and node, and optionally name, kind, note, and dive (1 where it is not said).

    Raises ConfigError naming file, line and value. dives: how many there are.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    text = text_of(content, path, "a table of marks as CSV")
    # Spreadsheets write semicolons or tabs where a comma is the decimal point.
    head = text.partition("\n")[0]
    delimiter = max(",;\t", key=head.count)
    rows = csv.DictReader(io.StringIO(text), delimiter=delimiter)
    rows.fieldnames = [name.strip().lower() for name in rows.fieldnames or ()]
    if missing := [name for name in ("time", "node") if name not in rows.fieldnames]:
        raise ConfigError(f"{path}: line 1: no column {' and '.join(missing)}; columns: {', '.join(COLUMNS)}")
    marks = []
    for row in rows:
        where = f"{path}: line {rows.line_num}"
        given: dict[str, object] = {name: row[name].strip() for name in TEXTS if row.get(name)}
        try:
            text_of_time = (row["time"] or "").strip()
            time = time_of(text_of_time.replace(",", ".") if delimiter != "," else text_of_time)
            given |= {"seconds": time} if isinstance(time, float) else {"time": time}
            if number := (row.get("dive") or "").strip():
                given["dive"] = int(number)
            marks.append(msgspec.convert(given, HandMark))
        except ValueError as error:
            raise ConfigError(f"{where}: {error}") from error
        check_mark(marks[-1], where, dives)
    return marks
