"""Reads tables of shots: CSV with a line of column names, PocketTopo's text, TopoDroid's CSV."""

from __future__ import annotations

import csv
import math
import re
from datetime import date
from pathlib import Path
from typing import Final

from buddyline.tools.survey.old.model import CrossSection, North, OldFix, OldShot, OldSurvey, Passage, SurveyPath
from buddyline.tools.survey.old.row_settings import FOOT_M
from buddyline.tools.survey.old.source import SourceLine, lines_of

# Column names, without units, to the readings of a shot.
COLUMNS: Final = {
    **dict.fromkeys(("from", "from station", "start"), "from"),
    **dict.fromkeys(("to", "to station", "end"), "to"),
    **dict.fromkeys(("distance", "length", "tape", "dist"), "tape"),
    **dict.fromkeys(("azimuth", "compass", "bearing", "azi", "heading"), "compass"),
    **dict.fromkeys(("inclination", "clino", "inc", "gradient", "dip"), "clino"),
    **dict.fromkeys(("back azimuth", "backcompass", "backbearing", "backsight"), "back"),
    **dict.fromkeys(("back inclination", "backclino"), "backclino"),
    **dict.fromkeys(("depth from", "fromdepth", "depth in"), "fromdepth"),
    **dict.fromkeys(("depth to", "todepth", "depth out"), "todepth"),
    **{name: name for name in ("left", "right", "up", "down", "flags", "date", "note", "declination", "survey")},
    **dict.fromkeys(("sd", "sigma", "distance sigma", "distance sd"), "sigma"),
    **dict.fromkeys(("depth sd", "depth sigma"), "depthsigma"),
    **dict.fromkeys(("comment", "comments", "remark"), "note"),
}
FEET: Final = frozenset(("ft", "feet", "foot"))
GRADS: Final = frozenset(("grad", "grads", "gon"))
# A tape may be shorter than the depths differ by this many sd.
DEPTH_SIGMAS: Final = 3.0
# TopoDroid's shots have no line of names.
TOPODROID: Final = ("from", "to", "tape", "compass", "clino")


def read_csv(survey: OldSurvey, path: Path, prefix: SurveyPath) -> None:
    """Read a table with a line of column names (TopoDroid's has none); raise OldSurveyError."""
    lines = [line for line in lines_of(path) if line.text.strip() and not line.text.lstrip().startswith("#")]
    if not lines:
        return
    head = lines[0]
    gap = max(";\t,", key=head.text.count)
    first = _cells(head, gap)
    units: list[float] = [1.0] * len(first)
    names = [_column(word) for word in first]
    if "from" in names:
        for number, word in enumerate(first):
            said = set(re.split(r"[^a-z]+", word.lower()))
            units[number] = FOOT_M if said & FEET else 0.9 if said & GRADS else 1.0
        lines = lines[1:]
    elif len(first) >= len(TOPODROID) and _is_number(first[2]):
        names = [*TOPODROID, *[""] * (len(first) - len(TOPODROID))]
    else:
        raise head.error(f"{head.text.strip()!r} names no columns from, to, distance, azimuth, inclination")
    depths = {"fromdepth", "todepth"} <= set(names)
    if missing := ({"from", "to", "tape"} | (set() if depths else {"compass"})) - set(names):
        raise head.error(f"no column for {', '.join(sorted(missing))}")
    for line in lines:
        row = dict(zip(names, _cells(line, gap), strict=False))
        _shot(survey, row, dict(zip(names, units, strict=True)), line, prefix)
    if lost := sum(shot.north == North("model") and shot.when is None for shot in survey.shots):
        survey.left_out.append(f"shots with neither declination nor date: {lost}; there declination is 0")


def _cells(line: SourceLine, gap: str) -> list[str]:
    return [cell.strip() for cell in next(csv.reader([line.text], delimiter=gap))]


def _column(word: str) -> str:
    plain = re.sub(r"[(\[].*", "", word.lower()).replace("_", " ").strip()
    plain = re.sub(r"\s+(m|ft|feet|deg|degrees|grads?)$", "", plain)
    return COLUMNS.get(plain, "")


def _is_number(word: str) -> bool:
    return re.fullmatch(r"[-+]?\d+(?:[.,]\d*)?", word) is not None


def _shot(
    survey: OldSurvey, row: dict[str, str], units: dict[str, float], line: SourceLine, prefix: SurveyPath
) -> None:
    def value(name: str) -> float | None:
        word = row.get(name, "").replace(",", ".")
        return None if word in ("", "-") else line.number_of(word, name) * units.get(name, 1.0)

    path = (*prefix, *(part for part in row.get("survey", "").split(".") if part))
    start, end = (".".join([*path, row.get(name, "").split("@")[0]]) for name in ("from", "to"))
    end = "" if row.get("to", "") in ("", "-", ".") else end
    if not row.get("from"):
        raise line.error(f"{line.text.strip()!r} has no station to begin at")
    tape, compass, clino, back = (value(name) for name in ("tape", "compass", "clino", "back"))
    depths = value("fromdepth"), value("todepth")
    if tape is None:
        raise line.error(f"{line.text.strip()!r}: no distance")
    own = {what: value(name) for what, name in (("tape", "sigma"), ("depth", "depthsigma"))}
    sigmas = {what: sigma for what, sigma in own.items() if sigma is not None}
    if any(sigma <= 0 for sigma in sigmas.values()):
        raise line.error(f"{line.text.strip()!r}: a standard deviation is above zero")
    if compass is back is None and abs(clino or 0.0) < 90:
        if depths[0] is None or depths[1] is None or not end:
            raise line.error(f"{line.text.strip()!r}: no azimuth, and for a distance alone no depths of both ends")
        _distance(survey, (start, end, path), tape, (depths[0], depths[1]), sigmas, line)
        return
    turn_deg = value("declination")
    flags = frozenset(word for word in re.split(r"[\s|;]+", row.get("flags", "").lower()) if word)
    by_depth = depths[0] is not None and depths[1] is not None and clino is None
    survey.shots.append(
        OldShot(
            start,
            end,
            path,
            "diving" if by_depth else "normal",
            tape_m=tape,
            compass_deg=compass,
            back_deg=back,
            clino_deg=clino,
            back_clino_deg=value("backclino"),
            rise_m=depths[0] - depths[1] if by_depth and depths[0] is not None and depths[1] is not None else None,
            flags=flags if end else flags | {"splay"},
            when=_date(row.get("date", ""), line),
            north=North("model") if turn_deg is None else North("grid", turn_deg),
            sigmas=sigmas,
            note=row.get("note", ""),
            place=line.place,
            text=line.text.strip(),
        )
    )
    sides = [value(name) for name in ("left", "right", "up", "down")]
    if any(side is not None for side in sides):
        survey.passages.append(Passage(path, (CrossSection(start, *sides),)))


def _distance(
    survey: OldSurvey,
    ends: tuple[str, str, SurveyPath],
    tape_m: float,
    depths_m: tuple[float, float],
    sigmas: dict[str, float],
    line: SourceLine,
) -> None:
    """Add a distance without a direction."""
    shot = OldShot(*ends, "distance", tape_m=tape_m, depths_m=depths_m, sigmas=sigmas, place=line.place)
    least_m = abs(depths_m[1] - depths_m[0]) - DEPTH_SIGMAS * math.hypot(shot.sigma("tape"), shot.sigma("depth"))
    if tape_m <= max(least_m, 0.0):
        raise line.error(f"distance: {tape_m:g} m is less than the difference of depth")
    survey.shots.append(shot)


def _date(word: str, line: SourceLine) -> date | None:
    try:
        return date.fromisoformat(word.replace(".", "-").replace("/", "-")[:10]) if word else None
    except ValueError:
        raise line.error(f"date: {word!r} is no date such as 2026-05-01") from None


def read_pockettopo(survey: OldSurvey, path: Path, prefix: SurveyPath) -> None:
    """Read PocketTopo's text export: trips of shots, several for each leg, as they were measured."""
    part, when, north = "", None, North()
    for line in lines_of(path):
        words = line.text.split("\t") if "\t" in line.text else line.text.split()
        words = [word.strip() for word in words]
        name = words[0].upper() if words else ""
        if name in ("FIX", "TRIP", "DATA", "PLAN", "ELEVATION", "STATIONS", "SHOTS"):
            part = name
        elif name.startswith("DATE") and part == "TRIP":
            when = _date("".join(line.text.split()[1:2]), line)
        elif name.startswith("DECLINATION") and part == "TRIP":
            north = North("grid", line.number_of(line.text.split()[-1], "DECLINATION"))
        elif part == "FIX" and len(words) >= 4:
            x, y, z = (line.number_of(word, "FIX") for word in words[1:4])
            survey.fixes.append(OldFix(".".join([*prefix, words[0]]), (x, y, z), place=line.place))
        elif part == "DATA" and any(words):
            _pocket_shot(survey, words, line, prefix, when, north)


def _pocket_shot(
    survey: OldSurvey, words: list[str], line: SourceLine, prefix: SurveyPath, when: date | None, north: North
) -> None:
    if len(words) < 5:
        raise line.error(
            f"{line.text.strip()!r}: from, to, azimuth, inclination and distance, not {len(words)} columns"
        )
    compass, clino, tape = (line.number_of(word, "DATA") for word in words[2:5])
    start = ".".join([*prefix, words[0]])
    end = ".".join([*prefix, words[1]]) if words[1] else ""
    if end and tape == 0.0:
        survey.equates.append((start, end))
        return
    survey.shots.append(
        OldShot(
            start,
            end,
            prefix,
            tape_m=tape,
            compass_deg=compass,
            clino_deg=clino,
            flags=frozenset() if end else frozenset(("splay",)),
            when=when,
            north=north,
            extend={"<": "left", ">": "right"}.get(words[5] if len(words) > 5 else "", ""),
            place=line.place,
            text=line.text.strip(),
        )
    )
