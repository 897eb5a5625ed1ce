"""Reads Compass data (.dat) and projects (.mak): feet and degrees, whatever the notebook had."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from datetime import date
from itertools import pairwise
from pathlib import Path
from typing import Final

from buddyline.tools.survey.old.model import CrossSection, North, OldFix, OldShot, OldSurvey, Passage, SurveyPath
from buddyline.tools.survey.old.row_settings import FOOT_M
from buddyline.tools.survey.old.source import SourceLine, beside, lines_of, text_of

# Compass writes -999 for what was not read, Karst 999.
MISSING: Final = 900.0
# Years of two digits are of this century; Compass began in it.
CENTURY: Final = 1900
# Two readings of angles beside each other stand in columns after the passage's, if the format says so.
BACKSIGHTS: Final = ("B", "C")
FLAGS: Final = {"L": "duplicate", "P": "surface", "S": "splay"}
# A leg that is not to be adjusted has this sd, as in Survex.
HELD_M: Final = 0.001
DATUMS: Final = {"WGS 1984": 0, "NORTH AMERICAN 1983": 26900, "NORTH AMERICAN 1927": 26700, "EUROPEAN 1950": 23000}


@dataclass(frozen=True)
class _CompassHeading:
    """What the heading of a survey says of its shots."""

    when: date | None = None
    north: North = field(default_factory=North)
    backsights: bool = False
    corrections: tuple[float, ...] = (0.0, 0.0, 0.0)
    back_corrections: tuple[float, ...] = (0.0, 0.0)


def read_dat(survey: OldSurvey, path: Path, prefix: SurveyPath) -> None:
    """Read a .dat file; raise OldSurveyError."""
    lines = list(lines_of(path))
    block: list[SourceLine] = []
    for line in lines:
        before, cut, after = line.text.partition("\f")
        if before.strip("\x1a"):
            block.append(replace(line, text=before))
        elif not cut:
            block.append(replace(line, text=""))
        if cut:
            _read_survey(survey, block, prefix)
            block = [replace(line, text=after)] if after.strip() else []
    if any(line.text.strip() for line in block):
        _read_survey(survey, block, prefix)


def _read_survey(survey: OldSurvey, block: list[SourceLine], prefix: SurveyPath) -> None:
    start = next((i for i, line in enumerate(block) if re.match(r"\s*FROM\s+TO\s", line.text)), None)
    if start is None:
        raise block[0].error(f"{block[0].text.strip()!r} begins no survey: no columns FROM TO ... follow")
    heading = _CompassHeading()
    notes = survey.notes_of(prefix)
    for number, line in enumerate(block[:start]):
        if match := re.match(r"SURVEY NAME:\s*(.*)", line.text):
            notes.notes.append(f"Compass survey {match[1].strip()}")
        elif match := re.match(r"SURVEY DATE:\s*(.*?)\s*(?:COMMENT:(.*))?$", line.text):
            heading = replace(heading, when=_date(match[1], line))
            notes.notes += [match[2].strip()] if match[2] and match[2].strip() else []
        elif line.text.startswith("SURVEY TEAM:") and number + 1 < start:
            said = block[number + 1].text
            team = [] if said.startswith("DECLINATION") else [name.strip() for name in re.split(r"[,;]", said)]
            notes.team += [name for name in team if name and name not in notes.team]
        elif line.text.startswith("DECLINATION:"):
            heading = _with_readings(heading, line)
    for line in block[start + 1 :]:
        if line.text.strip():
            _read_shot(survey, heading, line, prefix)


def _date(text: str, line: SourceLine) -> date | None:
    words = text.split()
    if len(words) < 3:
        return None
    try:
        month, day, year = (int(word) for word in words[:3])
        return date(year if year > 99 else CENTURY + year, month, day)
    except ValueError:
        raise line.error(f"SURVEY DATE: {text!r} is no month, day and year") from None


def _with_readings(heading: _CompassHeading, line: SourceLine) -> _CompassHeading:
    words = line.text.split()
    found = dict(pairwise(words))
    turn_deg = line.number_of(found.get("DECLINATION:", "?"), "DECLINATION")
    form = found.get("FORMAT:", "")
    kind = form[13:14] if len(form) >= 15 else form[11:12]
    heading = replace(heading, north=North("grid", turn_deg), backsights=kind in BACKSIGHTS)
    for name, count in (("CORRECTIONS:", 3), ("CORRECTIONS2:", 2)):
        if name in words:
            at = words.index(name) + 1
            values = tuple(line.number_of(word, name) for word in words[at : at + count])
            if len(values) < count:
                raise line.error(f"{name} has {len(values)} numbers, not {count}")
            both = {"corrections": values, "back_corrections": values[:2]}
            heading = replace(heading, **(both if count == 3 else {"back_corrections": values}))  # type: ignore[arg-type]
    return heading


def _read_shot(survey: OldSurvey, heading: _CompassHeading, line: SourceLine, prefix: SurveyPath) -> None:
    words = line.text.split()
    columns: tuple[str, ...] = ("LENGTH", "BEARING", "INC", "LEFT", "UP", "DOWN", "RIGHT")
    if heading.backsights:
        columns = (*columns, "AZM2", "INC2")
    if len(words) < 2 + len(columns):
        raise line.error(f"{line.text.strip()!r} ends before its {columns[max(len(words) - 2, 0)]}")
    read = {name: line.number_of(word, name) for name, word in zip(columns, words[2:], strict=False)}
    rest = " ".join(words[2 + len(columns) :])
    said = ""
    if match := re.match(r"#\|([A-Z]*)#\s*", rest):
        said, rest = match[1], rest[match.end() :]
    if "X" in said:
        survey.left_out.append(f"{line.place}: {words[0]} {words[1]}, which the file excludes")
        return
    length_m = (read["LENGTH"] + heading.corrections[2]) * FOOT_M
    angle_deg, slope_deg = heading.corrections[:2]
    back_deg, back_slope_deg = heading.back_corrections
    start, end = (".".join([*prefix, word]) for word in words[:2])
    sides = [None if read[name] < 0 else read[name] * FOOT_M for name in ("LEFT", "RIGHT", "UP", "DOWN")]
    if any(side is not None for side in sides):
        survey.passages.append(Passage(prefix, (CrossSection(start, *sides),)))
    if read["LENGTH"] == 0.0 or start == end:
        survey.equates += [(start, end)] if start != end else []
        return
    shot = OldShot(
        start,
        end,
        prefix,
        tape_m=length_m,
        compass_deg=_angle(read["BEARING"], angle_deg),
        clino_deg=_angle(read["INC"], slope_deg),
        back_deg=_angle(read.get("AZM2", MISSING), back_deg),
        back_clino_deg=_angle(read.get("INC2", MISSING), back_slope_deg),
        flags=frozenset(FLAGS[flag] for flag in said if flag in FLAGS),
        when=heading.when,
        north=heading.north,
        sigmas={"position": HELD_M, "tape": HELD_M, "compass": HELD_M, "clino": HELD_M} if "C" in said else {},
        note=rest,
        place=line.place,
        text=line.text.strip(),
    )
    if shot.back_clino_deg is None and shot.clino_deg is not None and abs(abs(read["INC"]) - 90) < 1e-9:
        shot = replace(shot, clino_word="up" if read["INC"] > 0 else "down", compass_deg=None, back_deg=None)
    if shot.compass_deg is shot.back_deg is None and not shot.clino_word:
        raise line.error(f"BEARING: {words[3]!r} and no backsight: the shot has no direction")
    survey.shots.append(shot)


def _angle(value: float, correction_deg: float) -> float | None:
    return None if abs(value) >= MISSING else value + correction_deg


def read_mak(survey: OldSurvey, path: Path, prefix: SurveyPath) -> None:
    """Read a .mak file, and the .dat files that it names; raise OldSurveyError."""
    text = re.sub(r"/.*", "", text_of(path))
    zone, datum, folders = 0, "", [Path()]
    place: tuple[float, float, float] | None = None
    for match in re.finditer(r"([#$&@\[\]%!*])([^;\[]*(?:\[[^\]]*\][^;\[]*)*);", text):
        line = SourceLine(path, text.count("\n", 0, match.start()) + 1, match[0])
        kind, said = match[1], match[2].strip()
        if kind == "$":
            zone = int(line.number_of(said, "UTM zone"))
        elif kind == "&":
            datum = said.upper()
        elif kind == "@":
            values = [line.number_of(word, "base location") for word in said.split(",")]
            place = (values[0], values[1], values[2]) if len(values) > 3 and values[3] else None
            zone = zone or (int(values[3]) if len(values) > 3 else 0)
        elif kind == "[":
            folders.append(folders[-1] / said.replace("\\", "/"))
        elif kind == "]":
            folders = folders[:-1] or [Path()]
        elif kind == "#":
            _read_link(survey, line, said, folders[-1], _system(zone, datum, line), place, prefix)


def _system(zone: int, datum: str, line: SourceLine) -> str:
    if not zone or not datum:
        return ""
    base = DATUMS.get(datum)
    if base is None:
        raise line.error(f"datum {datum!r} is not known here; known: {', '.join(DATUMS)}")
    return f"UTM{abs(zone)}{'S' if zone < 0 else 'N'}" if not base else f"EPSG:{base + abs(zone)}"


def _read_link(
    survey: OldSurvey,
    line: SourceLine,
    said: str,
    folder: Path,
    system: str,
    place: tuple[float, float, float] | None,
    prefix: SurveyPath,
) -> None:
    name, *stations = re.split(r",(?![^\[]*\])", said)
    before = len(survey.shots)
    read_dat(survey, beside(line, str(folder / " ".join(name.split())), ".dat"), prefix)
    if place is not None and system:
        # With a base location Compass takes the declination of its model, not the stated one.
        north = North("model", at=(system, *place))
        survey.shots[before:] = [replace(shot, north=north) for shot in survey.shots[before:]]
    for station in stations:
        if match := re.fullmatch(r"\s*([^\s\[]+)\s*\[\s*([fFmM])[\s,]*([^\]]*)\]\s*", station):
            unit = FOOT_M if match[2] in "fF" else 1.0
            xyz = [line.number_of(word, "fixed station") * unit for word in re.split(r"[\s,]+", match[3].strip())]
            if len(xyz) != 3:
                raise line.error(f"{station.strip()!r}: three coordinates, not {len(xyz)}")
            full = ".".join([*prefix, match[1]])
            survey.fixes.append(OldFix(full, (xyz[0], xyz[1], xyz[2]), system=system, place=line.place))
            survey.entrances.append(full)
