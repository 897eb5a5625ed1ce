"""Marks given afterwards: in the project file, or as a table of times."""

from __future__ import annotations

import csv
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal, cast

from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError
from buddyline.protocol.messages import Mark
from buddyline.protocol.topics import check_node_id
from buddyline.tools.survey.project import HandMark
from msgspec import UNSET

Kind = Literal["station", "point", "note"]
KINDS: tuple[str, ...] = ("station", "point", "note")


def stamp_ns_of(text: str, start_ns: int) -> int:
    """Return the instant of `2026-05-01T10:20:30Z` (UTC where no zone is given), or of seconds from start_ns."""
    try:
        return start_ns + round(float(text) * S_NS)
    except ValueError:
        pass
    moment = datetime.fromisoformat(text.strip())
    return _ns(moment)


def _ns(moment: datetime) -> int:
    aware = moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    return round(aware.timestamp() * 1e6) * 1000


def of_project(marks: list[HandMark], dive: int, start_ns: int) -> list[Mark]:
    """Return the project's own marks of one dive."""
    result = []
    for mark in marks:
        if mark.dive != dive:
            continue
        if mark.time is not UNSET:
            stamp_ns = _ns(mark.time)
        elif mark.seconds is not UNSET:
            stamp_ns = start_ns + round(mark.seconds * S_NS)
        else:
            raise ConfigError(f"mark {mark.name!r} of node {mark.node}: give time or seconds")
        result.append(Mark(node=mark.node, stamp_ns=stamp_ns, kind=mark.kind, name=mark.name, note=mark.note))
    return result


def of_table(path: Path, start_ns: int) -> list[Mark]:
    """Read a CSV of marks with the columns time, node, name, and perhaps kind and note."""
    try:
        with open(path, newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    marks = []
    for number, row in enumerate(rows, 2):
        kind = (row.get("kind") or "station").strip()
        try:
            if kind not in KINDS:
                raise ValueError(f"kind {kind!r} is none of {', '.join(KINDS)}")
            marks.append(
                Mark(
                    node=check_node_id((row.get("node") or "").strip()),
                    stamp_ns=stamp_ns_of(row.get("time") or "", start_ns),
                    kind=cast(Kind, kind),
                    name=(row.get("name") or "").strip(),
                    note=(row.get("note") or "").strip(),
                )
            )
        except ValueError as error:
            raise ConfigError(f"{path}: line {number}: {error}") from error
    return marks
