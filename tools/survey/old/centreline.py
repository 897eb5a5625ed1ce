"""Rows of readings in stated columns, turned into shots and passages: what Survex and Therion share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Final

from buddyline.tools.survey.old.model import (
    CrossSection,
    OldShot,
    OldSurvey,
    Passage,
    StationName,
    Style,
    SurveyPath,
)
from buddyline.tools.survey.old.row_settings import RowSettings, is_number
from buddyline.tools.survey.old.source import SourceLine

SHOT_STYLES: Final[Mapping[str, Style]] = {
    **{"normal": "normal", "diving": "diving", "cartesian": "cartesian"},
    **{"cylpolar": "cylpolar", "nosurvey": "nosurvey"},
}
UP: Final = frozenset(("up", "u", "+v"))
DOWN: Final = frozenset(("down", "d", "-v"))
LEVEL: Final = frozenset(("level", "h"))
# A clinometer that reads this, where plumbs are inferred, is a plumb line.
VERTICAL_DEG: Final = 90.0


class Rows:
    """Turns rows into shots and passages. name_of: a station's full name; "" where it has none, with its flags."""

    def __init__(
        self, survey: OldSurvey, name_of: Callable[[str, SourceLine], tuple[StationName, frozenset[str]]]
    ) -> None:
        self._survey, self._name_of = survey, name_of
        self._pending: list[dict[str, str]] = []
        self._open: dict[str, str] | None = None
        self._leg: dict[str, str] | None = None
        self._passage: list[CrossSection] = []
        self._passage_path: SurveyPath = ()

    def reset(self) -> None:
        """End a traverse and a passage: other columns, an empty line, another survey."""
        self._open = self._leg = None
        self._pending = []
        if self._passage:
            self._survey.passages.append(Passage(self._passage_path, tuple(self._passage)))
        self._passage = []

    def blank(self, settings: RowSettings) -> None:
        """Take an empty line, which ends a traverse of interleaved rows."""
        if "newline" in settings.order:
            self._open = self._leg = None
            self._pending = []

    def take(self, words: Sequence[str], settings: RowSettings, path: SurveyPath, line: SourceLine) -> None:
        """Take a row; raise OldSurveyError if it does not have the stated columns."""
        if settings.style == "ignore":
            return
        if "newline" not in settings.order:
            self._row(_named(words, settings.order, line), settings, path, line)
            return
        cut = settings.order.index("newline")
        parts = settings.order[:cut], settings.order[cut + 1 :]
        if "station" not in settings.order:
            self._pending.append(_named(words, parts[len(self._pending)], line))
            if len(self._pending) == 2:
                self._row(self._pending[0] | self._pending[1], settings, path, line)
                self._pending = []
            return
        if self._open is None or self._leg is not None:
            row = _named(words, parts[0], line)
            if self._open is not None and self._leg is not None:
                self._row(_joined(self._open, row, self._leg), settings, path, line)
            self._open, self._leg = row, None
        else:
            self._leg = _named(words, parts[1], line)

    def _row(self, row: dict[str, str], settings: RowSettings, path: SurveyPath, line: SourceLine) -> None:
        if settings.style == "passage":
            self._section(row, settings, path, line)
        elif settings.style == "nosurvey" and "station" in row:
            before, self._open = self._open, row
            if before is not None:
                self._row({"from": before["station"], "to": row["station"]}, settings, path, line)
        else:
            self._shot(row, settings, path, line)

    def _section(self, row: dict[str, str], settings: RowSettings, path: SurveyPath, line: SourceLine) -> None:
        station = self._station(row, "station", line)[0]
        self._passage_path = path
        self._passage.append(CrossSection(station, *_sides(row, settings, line)))

    def _station(self, row: dict[str, str], column: str, line: SourceLine) -> tuple[StationName, frozenset[str]]:
        if column not in row:
            raise line.error(f"no {column!r} station; columns: {' '.join(row)}")
        return self._name_of(row[column], line)

    def _shot(self, row: dict[str, str], settings: RowSettings, path: SurveyPath, line: SourceLine) -> None:
        (start, flags), (end, more) = self._station(row, "from", line), self._station(row, "to", line)
        if row.get("direction", "f").lower() in ("b", "back"):
            start, end = end, start
        style = SHOT_STYLES[settings.style]
        shot = OldShot(
            start,
            end,
            path,
            style,
            flags=settings.flags | flags | more,
            when=settings.when,
            north=settings.north,
            sigmas=settings.sigmas,
            extend=settings.extend,
            place=line.place,
            text=line.text.strip(),
        )
        sides = tuple(_sides(row, settings, line))
        if any(side is not None for side in sides) and start:
            self._survey.passages.append(Passage(path, (CrossSection(start, *sides),)))
        if style != "nosurvey":
            shot = _read(shot, row, settings, line)
        word = row.get("tape", "")
        if style == "normal" and "equates" in settings.inferred and is_number(word) and float(word) == 0:
            self._survey.equates.append((start, end))
            return
        self._survey.shots.append(shot)


def _named(words: Sequence[str], columns: Sequence[str], line: SourceLine) -> dict[str, str]:
    row: dict[str, str] = {}
    values = list(words)
    for column in columns:
        if column == "ignoreall":
            return row
        if not values:
            raise line.error(f"{line.text.strip()!r} ends before its {column}; columns: {' '.join(columns)}")
        value = values.pop(0)
        if column != "ignore":
            row[column] = value
    if values:
        raise line.error(f"{values[0]!r} is too much; columns: {' '.join(columns)}")
    return row


def _joined(before: dict[str, str], after: dict[str, str], leg: dict[str, str]) -> dict[str, str]:
    """Return one row of two stations' rows and the leg's between them."""
    row = dict(leg)
    for start, (prefix, station) in (("from", ("from", before)), ("to", ("to", after))):
        for column, value in station.items():
            row[start if column == "station" else f"{prefix}{column}"] = value
    return row


def _sides(row: dict[str, str], settings: RowSettings, line: SourceLine) -> Iterator[float | None]:
    for name in ("left", "right", "up", "down"):
        yield _value(row.get(name, "-"), name, settings, line)


def _value(word: str, name: str, settings: RowSettings, line: SourceLine) -> float | None:
    """Return a reading in metres or degrees, its calibration taken off; None if it was left out."""
    if word in ("-", "", "--", ".") or (word.lower() == "nan"):
        return None
    unit = settings.units.get(name, 1.0)
    if name in settings.percent and name in ("clino", "backclino"):
        value = math.degrees(math.atan(line.number_of(word, name) * unit / 100))
    elif name in settings.percent:
        value = _quadrant_deg(word, name, line)
    else:
        value = line.number_of(word, name) * unit
    return (value - settings.zeros.get(name, 0.0)) * settings.scales.get(name, 1.0)


def _quadrant_deg(word: str, name: str, line: SourceLine) -> float:
    """Return the bearing of a quadrant such as S34E, N or E."""
    text = word.upper()
    if text in ("N", "E", "S", "W"):
        return {"N": 0.0, "E": 90.0, "S": 180.0, "W": 270.0}[text]
    if len(text) < 3 or text[0] not in "NS" or text[-1] not in "EW":
        raise line.error(f"{name}: {word!r} is no quadrant such as S34E")
    angle = line.number_of(text[1:-1], name)
    from_deg = 0.0 if text[0] == "N" else 180.0
    return (from_deg + (angle if (text[0] == "N") == (text[-1] == "E") else -angle)) % 360


def _read(shot: OldShot, row: dict[str, str], settings: RowSettings, line: SourceLine) -> OldShot:
    """Return a shot with the readings of its row."""

    def value(name: str) -> float | None:
        return _value(row.get(name, "-"), name, settings, line)

    if shot.style == "cartesian":
        found = [value(name) for name in ("dx", "dy", "dz")]
        if any(one is None for one in found):
            raise line.error("dx, dy and dz are all needed; one is missing")
        return replace(shot, vector_m=(found[0] or 0.0, found[1] or 0.0, found[2] or 0.0))
    shot = replace(
        shot, tape_m=_tape_m(row, settings, line), compass_deg=value("compass"), back_deg=value("backcompass")
    )
    if shot.style == "normal":
        shot = _sloped(shot, row, settings, line)
    else:
        shot = replace(shot, rise_m=_rise_m(row, settings, line))
        if shot.style == "diving" and abs(shot.rise_m or 0.0) > shot.tape_m + 0.5 and "splay" not in shot.flags:
            raise line.error(f"tape: {shot.tape_m:.2f} m is less than the change of depth, {shot.rise_m:.2f} m")
    blind = shot.compass_deg is None and shot.back_deg is None
    if blind and not shot.clino_word and shot.style == "normal" and shot.tape_m:
        slopes = [abs(one) for one in (shot.clino_deg, shot.back_clino_deg) if one is not None]
        if not slopes or min(slopes) < VERTICAL_DEG - 1e-9:
            raise line.error("compass: '-' is for plumbed legs alone")
    return shot


def _tape_m(row: dict[str, str], settings: RowSettings, line: SourceLine) -> float:
    read = [_value(row[name], name, settings, line) for name in ("tape", "backtape") if name in row]
    if "fromcount" in row and "tocount" in row:
        ends = [line.number_of(row[name], name) for name in ("fromcount", "tocount")]
        read.append(abs(ends[1] - ends[0]) * settings.units.get("count", 1.0) * settings.scales.get("count", 1.0))
    known = [one for one in read if one is not None]
    if not known:
        raise line.error(f"{line.text.strip()!r} has no tape")
    return sum(known) / len(known)


def _rise_m(row: dict[str, str], settings: RowSettings, line: SourceLine) -> float:
    unit, scale = settings.units.get("depth", 1.0), settings.scales.get("depth", 1.0)
    if "depthchange" in row:
        change = line.number_of(row["depthchange"], "depthchange") * unit
        return (change - settings.zeros.get("depth", 0.0)) * scale
    if "fromdepth" not in row or "todepth" not in row:
        raise line.error("depths of both stations, or their change, are needed")
    ends = [line.number_of(row[name], name) for name in ("fromdepth", "todepth")]
    return (ends[1] - ends[0]) * unit * scale


def _sloped(shot: OldShot, row: dict[str, str], settings: RowSettings, line: SourceLine) -> OldShot:
    word = row.get("clino", "-").lower()
    back = row.get("backclino", "-").lower()
    if word in UP | DOWN | LEVEL or back in UP | DOWN | LEVEL:
        if word in LEVEL or (word not in UP | DOWN and back in LEVEL):
            return replace(shot, clino_word="level")
        upward = word in UP if word in UP | DOWN else back in DOWN
        return replace(shot, clino_word="up" if upward else "down", compass_deg=None, back_deg=None)
    names = ("clino", "backclino")
    fore, back_deg = (_value(row.get(name, "-"), name, settings, line) for name in names)
    if "plumbs" in settings.inferred and fore is not None and back_deg is None:
        raw_deg = line.number_of(row["clino"], "clino") * settings.units.get("clino", 1.0)
        if abs(abs(raw_deg) - VERTICAL_DEG) < 1e-9:
            return replace(shot, clino_word="up" if raw_deg > 0 else "down", compass_deg=None, back_deg=None)
    return replace(shot, clino_deg=fore, back_clino_deg=back_deg)
