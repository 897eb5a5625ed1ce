"""Reads Walls data (.srv): compass and tape or rectangular vectors, with the units that #units states."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Final

from buddyline.tools.survey.old.model import CrossSection, North, OldFix, OldShot, OldSurvey, Passage, SurveyPath
from buddyline.tools.survey.old.row_settings import FOOT_M
from buddyline.tools.survey.old.source import SourceLine, lines_of

MISSING: Final = re.compile(r"-{2,}|-(?=/)|")
PERCENT: Final = "p"
ANGLES: Final = {"d": 1.0, "g": 0.9, "m": 360 / 6400}
SIDES: Final = "LRUD"
# Options of #units that change nothing here, and those that are read apart.
SILENT: Final = frozenset(
    ("uv", "uvh", "uvv", "flag", "typeab", "typevb", "note", "save", "restore", "reset", "prefix")
)
UNKNOWN: Final = frozenset(("tape", "incd", "inca", "incab", "incv", "incvb", "inch", "incs", "rect", "grid"))


@dataclass(frozen=True)
class WallsUnits:
    """What #units has set: factors to metres and degrees, orders of columns, declination, corrected backsights."""

    length: float = 1.0
    sides: float = 1.0
    angles: Mapping[str, float] = field(default_factory=dict)
    order: str = "DAV"
    vector_order: str = "ENU"
    vectors: bool = False
    side_order: str = "LRUD"
    declination_deg: float = 0.0
    corrected: frozenset[str] = frozenset()
    case: str = ""


def read_srv(survey: OldSurvey, path: Path, prefix: SurveyPath) -> None:
    """Read a .srv file; raise OldSurveyError for what has no meaning here, rather than guess."""
    units, saved, when, inside = WallsUnits(), [], None, 0
    own: tuple[str, ...] = ()
    flags: frozenset[str] = frozenset()
    for line in lines_of(path):
        text = line.text.split(";")[0].strip()
        if re.match(r"#\[", text):
            inside += 1
        elif re.match(r"#\]", text):
            inside -= 1
        elif inside or not text:
            continue
        elif match := re.match(r"#(\w+)\s*(.*)", text):
            name, said = match[1].lower(), match[2]
            if "units".startswith(name):
                words = said.lower().split()
                saved += [units] * ("save" in words)
                if "restore" in words and saved:
                    units = saved.pop()
                units = _with_units(WallsUnits() if "reset" in words else units, said, line)
            elif name == "date":
                when = _date(said.split()[0] if said else "", line)
            elif name == "prefix":
                own = (said.split()[0],) if said else ()
            elif name == "fix":
                _fix(survey, said, units, (*prefix, *own), line)
            elif name in ("segment", "seg", "s"):
                flags = frozenset(("surface",)) if said.strip().lower().lstrip("/") == "s" else frozenset()
            elif name not in ("note", "flag", "symbol", "sym", "prefix2", "prefix3"):
                raise line.error(f"'#{match[1]}' is no directive that is read here")
        else:
            _shot(survey, text, units, (*prefix, *own), when, flags, line)


def _date(word: str, line: SourceLine) -> date:
    match = re.fullmatch(r"(\d{4})[-/](\d{1,2})[-/](\d{1,2})", word)
    american = re.fullmatch(r"(\d{1,2})[-/](\d{1,2})[-/](\d{4})", word)
    try:
        if match:
            return date(int(match[1]), int(match[2]), int(match[3]))
        if american:
            return date(int(american[3]), int(american[1]), int(american[2]))
    except ValueError:
        pass
    raise line.error(f"#date {word!r} is no date such as 1990-09-09")


def _with_units(units: WallsUnits, said: str, line: SourceLine) -> WallsUnits:
    for word in said.split():
        name, _, value = word.lower().partition("=")
        unit = FOOT_M if value.startswith("f") else 1.0
        if name in ("f", "feet", "m", "meters"):
            unit = FOOT_M if name.startswith("f") else 1.0
            units = replace(units, length=unit, sides=unit)
        elif name == "d":
            units = replace(units, length=unit)
        elif name == "s":
            units = replace(units, sides=unit)
        elif name in ("a", "ab", "v", "vb"):
            if value[:1] not in ANGLES:
                raise line.error(f"#units {word}: d, g or m (mils) for angles is read here")
            units = replace(units, angles={**units.angles, name: ANGLES[value[:1]]})
        elif name in ("o", "order"):
            vectors = "e" in value or "n" in value
            given = value.upper()
            units = replace(units, vector_order=given) if vectors else replace(units, order=given)
        elif name in ("ct", "rect") and not value:
            units = replace(units, vectors=name == "rect")
        elif name == "decl":
            units = replace(units, declination_deg=line.number_of(value.rstrip("d"), "decl"))
        elif name in ("typeab", "typevb") and value.startswith("c"):
            units = replace(units, corrected=units.corrected | {name})
        elif name == "lrud":
            order = value.rpartition(":")[2].upper()
            units = replace(units, side_order=order if sorted(order) == sorted(SIDES) else units.side_order)
        elif name == "case":
            units = replace(units, case=value[:1])
        elif name in UNKNOWN and value not in ("", "0", "it"):
            raise line.error(f"#units {word}: this correction is not read here; apply it in Walls first")
        elif name not in SILENT | UNKNOWN | {"rect", "ct"}:
            raise line.error(f"#units {word}: no such option is known here")
    return units


def _name(word: str, units: WallsUnits, path: SurveyPath) -> str:
    own = word.upper() if units.case == "u" else word.lower() if units.case == "l" else word
    # A prefix before a colon takes the place of the current one.
    before, colon, last = own.rpartition(":")
    inside = [part for part in before.split(":") if part] if colon else list(path)
    return ".".join([*inside, last])


def _length(word: str, factor: float, line: SourceLine) -> float:
    feet = re.fullmatch(r"(-?)(\d*)i(\d*\.?\d*)", word)
    if feet:
        metres = (int(feet[2] or 0) + float(feet[3] or 0) / 12) * FOOT_M
        return -metres if feet[1] else metres
    unit = {"f": FOOT_M, "m": 1.0}.get(word[-1:].lower())
    return line.number_of(word[:-1] if unit else word, "distance") * (unit or factor)


def _angle(word: str, factor: float, line: SourceLine) -> float | None:
    if MISSING.fullmatch(word):
        return None
    if match := re.fullmatch(r"([NS])([\d.:]*)([EW])", word.upper()):
        turn = _angle(match[2] or "0", 1.0, line) or 0.0
        from_deg = 0.0 if match[1] == "N" else 180.0
        return (from_deg + (turn if (match[1] == "N") == (match[3] == "E") else -turn)) % 360
    if word.upper() in "NESW":
        return 90.0 * "NESW".index(word.upper())
    if word[-1:].lower() == PERCENT:
        return math.degrees(math.atan(line.number_of(word[:-1], "angle") / 100))
    if ":" in word:
        parts = [line.number_of(part or "0", "angle") for part in word.lstrip("+-").split(":")]
        value = float(sum(part / 60.0**i for i, part in enumerate(parts)))
        return -value if word.startswith("-") else value
    unit = ANGLES.get(word[-1:].lower())
    return line.number_of(word[:-1] if unit else word, "angle") * (unit or factor)


def _shot(
    survey: OldSurvey,
    text: str,
    units: WallsUnits,
    path: SurveyPath,
    when: date | None,
    flags: frozenset[str],
    line: SourceLine,
) -> None:
    text, _, said = text.partition("#")
    if re.match(r"(s|seg|segment)\s+/?s\b", said, re.IGNORECASE):
        flags = flags | {"surface"}
    sides = re.search(r"[<*]([^<>*]*)[>*]?\s*$", text)
    words = (text[: sides.start()] if sides else text).split()
    if len(words) < 1:
        raise line.error(f"{text.strip()!r} has no station")
    start = _name(words[0], units, path)
    if sides:
        _sides(survey, start, sides[1], units, path, line)
    if len(words) == 1:
        return
    end = "" if MISSING.fullmatch(words[1]) or words[1] == "-" else _name(words[1], units, path)
    flags = flags if end else flags | {"splay", "wall"}
    shot = OldShot(
        start,
        end,
        path,
        flags=flags,
        when=when,
        north=North("grid", units.declination_deg),
        place=line.place,
        text=line.text.strip(),
    )
    order = units.vector_order if units.vectors else units.order
    values = dict(zip(order, [word for word in words[2:] if not word.startswith("(")], strict=False))
    needed = [letter for letter in order if letter not in "VU"]
    if missing := [letter for letter in needed if letter not in values]:
        raise line.error(f"{text.strip()!r} ends before its {' '.join(missing)}; order {order}")
    if units.vectors:
        east, north, up = (_length(values.get(letter, "0"), units.length, line) for letter in "ENU")
        survey.shots.append(replace(shot, style="cartesian", vector_m=(east, north, up), north=North()))
        return
    fore, _, back = values["A"].partition("/")
    slope, _, back_slope = values.get("V", "0").partition("/")
    back_deg = _angle(back, units.angles.get("ab", 1.0), line)
    back_slope_deg = _angle(back_slope, units.angles.get("vb", 1.0), line)
    shot = replace(
        shot,
        tape_m=_length(values["D"], units.length, line),
        compass_deg=_angle(fore, units.angles.get("a", 1.0), line),
        clino_deg=_angle(slope, units.angles.get("v", 1.0), line),
        back_deg=back_deg + 180 if back_deg is not None and "typeab" in units.corrected else back_deg,
        back_clino_deg=-back_slope_deg
        if back_slope_deg is not None and "typevb" in units.corrected
        else back_slope_deg,
    )
    clino = shot.clino_deg if shot.clino_deg is not None else -(shot.back_clino_deg or 0.0)
    if shot.clino_deg is shot.back_clino_deg is None:
        shot = replace(shot, clino_word="level")
    elif abs(abs(clino) - 90) < 1e-9:
        shot = replace(shot, clino_word="up" if clino > 0 else "down", compass_deg=None, back_deg=None)
    if shot.compass_deg is shot.back_deg is None and shot.clino_word not in ("up", "down") and shot.tape_m:
        raise line.error(f"{text.strip()!r}: no azimuth")
    survey.shots.append(shot)


def _sides(survey: OldSurvey, start: str, said: str, units: WallsUnits, path: SurveyPath, line: SourceLine) -> None:
    read = dict(zip(units.side_order, re.split(r"[\s,]+", said.strip()), strict=False))
    sides = [
        None if MISSING.fullmatch(word := read.get(letter, "--")) else _length(word, units.sides, line)
        for letter in SIDES
    ]
    survey.passages.append(Passage(path, (CrossSection(start, *sides),)))


def _fix(survey: OldSurvey, said: str, units: WallsUnits, path: SurveyPath, line: SourceLine) -> None:
    words = said.split()
    if len(words) < 4:
        raise line.error(f"#fix {said}: a station and its coordinates {units.vector_order}")
    place = {k: _length(word, units.length, line) for k, word in zip(units.vector_order, words[1:4], strict=False)}
    if set(place) != set("ENU"):
        raise line.error(f"#fix {said}: coordinates in the order {units.vector_order}; E, N and U are needed")
    survey.fixes.append(OldFix(_name(words[0], units, path), (place["E"], place["N"], place["U"]), place=line.place))
