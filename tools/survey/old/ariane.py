"""Reads Ariane's files (.tml): a packed Data.xml with one entry for each station and the shot that leads to it."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Mapping
from datetime import date
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

from buddyline.tools.survey.old.model import CrossSection, North, OldFix, OldShot, OldSurvey, Passage, SurveyPath
from buddyline.tools.survey.old.row_settings import FOOT_M
from buddyline.tools.survey.old.source import OldSurveyError
from buddyline.tools.survey.old.systems import DEGREES

DATA: Final = "Data.xml"
# A file of 2,400 stations has 6 MB.
MOST_BYTES: Final = 256 << 20
UNITS: Final = {"m": 1.0, "meter": 1.0, "meters": 1.0, "ft": FOOT_M, "feet": FOOT_M}
SIDES: Final = ("Left", "Right", "Up", "Down")
# A depth that was not entered; the shot then begins where the one before ended.
NOT_ENTERED: Final = -1.0


def read_tml(survey: OldSurvey, path: Path, prefix: SurveyPath) -> None:
    """Read a .tml file: stations have their entries' numbers as names; raise OldSurveyError naming the entry."""
    root = _root(path)
    unit = (root.findtext("unit") or "m").strip().lower()
    if unit not in UNITS:
        raise OldSurveyError(f"{path}: unit: {unit!r} is none of {', '.join(UNITS)}")
    north = North("true" if (root.findtext("useMagneticAzimuth") or "").strip().lower() == "false" else "model")
    survey.notes_of(prefix).title = (root.findtext("caveName") or "").strip()
    entries = [
        {field.tag: (field.text or "").strip() for field in entry if not len(field)}
        for entry in root.iter("SurveyData")
    ]
    depths_m = {entry.get("ID", ""): _number(path, entry, "Depth") * UNITS[unit] for entry in entries}
    above = {"ID": "of the first", "elevation": (root.findtext("firstStartAbsoluteElevation") or "").strip()}
    elevation_m = _number(path, above, "elevation") * UNITS[unit]
    for entry in entries:
        _read_entry(survey, path, entry, prefix, depths_m, elevation_m, UNITS[unit], north)


def _root(path: Path) -> ElementTree.Element:
    try:
        with zipfile.ZipFile(path) as packed:
            size = packed.getinfo(DATA).file_size
            if size > MOST_BYTES:
                raise OldSurveyError(f"{path}: {DATA} has {size} bytes; at most {MOST_BYTES} are read")
            with packed.open(DATA) as stream:
                data = stream.read(size + 1)
    except KeyError:
        raise OldSurveyError(f"{path}: there is no {DATA} in it: not a file of Ariane") from None
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise OldSurveyError(f"{path}: cannot be unpacked: {error}") from error
    if b"<!DOCTYPE" in data or b"<!ENTITY" in data:
        raise OldSurveyError(f"{path}: {DATA} defines entities, which Ariane does not: not read")
    try:
        return ElementTree.fromstring(data)
    except ElementTree.ParseError as error:
        raise OldSurveyError(f"{path}: {DATA}: {error}") from error


def _number(path: Path, entry: Mapping[str, str], name: str) -> float:
    word = entry.get(name, "") or "0"
    if not re.fullmatch(r"[-+]?\d{0,9}\.?\d{0,20}([eE][-+]?\d{1,2})?", word) or not re.search(r"\d", word):
        raise OldSurveyError(f"{path}: entry {entry.get('ID', '?')}: {name}: {word!r} is not a number")
    return float(word)


def _read_entry(
    survey: OldSurvey,
    path: Path,
    entry: Mapping[str, str],
    prefix: SurveyPath,
    depths_m: Mapping[str, float],
    elevation_m: float,
    unit_m: float,
    north: North,
) -> None:
    own, before, closes = entry.get("ID", ""), entry.get("FromID", "-1"), entry.get("ClosureToID", "-1")
    if not re.fullmatch(r"\d+", own):
        raise OldSurveyError(f"{path}: ID: {own!r} is not a number")
    station, start = (".".join((*prefix, number)) for number in (own, before))
    place = f"{path.name}:{own}"
    if remark := " ".join(word for word in (entry.get("Name", ""), entry.get("Comment", "")) if word):
        survey.station_notes[station] = remark
    latitude_deg, longitude_deg = _number(path, entry, "Latitude"), _number(path, entry, "Longitude")
    if latitude_deg or longitude_deg:
        spot = (longitude_deg, latitude_deg, elevation_m - depths_m[own])
        survey.fixes.append(OldFix(station, spot, system=DEGREES, place=place))
    if before in depths_m:
        depth_in_m = _number(path, entry, "DepthIn")
        from_m = depths_m[before] if depth_in_m == NOT_ENTERED else depth_in_m * unit_m
        excluded = entry.get("Excluded", "").lower() == "true" or entry.get("Type") == "VIRTUAL"
        survey.shots.append(
            OldShot(
                start,
                station,
                prefix,
                "diving",
                tape_m=_number(path, entry, "Length") * unit_m,
                compass_deg=_number(path, entry, "Azimut") % 360,
                rise_m=from_m - depths_m[own],
                flags=frozenset(("duplicate",)) if excluded else frozenset(),
                when=_date(path, entry),
                north=north,
                note=entry.get("Section", ""),
                place=place,
            )
        )
    elif before != "-1":
        raise OldSurveyError(f"{path}: entry {own}: FromID: there is no entry {before}")
    if closes in depths_m:
        survey.equates.append((station, ".".join((*prefix, closes))))
    sides = [_number(path, entry, name) * unit_m for name in SIDES]
    if any(sides):
        survey.passages.append(Passage(prefix, (CrossSection(station, *sides),)))


def _date(path: Path, entry: Mapping[str, str]) -> date | None:
    try:
        return date.fromisoformat(entry["Date"]) if entry.get("Date") else None
    except ValueError:
        raise OldSurveyError(f"{path}: entry {entry['ID']}: Date: {entry['Date']!r} is no date") from None
