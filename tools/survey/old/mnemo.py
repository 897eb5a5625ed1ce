"""Reads what a Mnemo or JedEye wrote (.dmp): sections of shots with headings and depths at both ends.

Source: "MNemo DMP file format" (versions 2 to 6) and "DMP file format" of the JedEye (7), both in Ariane's manuals.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Final

from buddyline.tools.survey.averages import wrap
from buddyline.tools.survey.old.model import CrossSection, North, OldShot, OldSurvey, Passage, SurveyPath
from buddyline.tools.survey.old.source import OldSurveyError, text_of

# From version 5 on (some of 3 and 4), these bytes follow a section's version; from 5 on, those stand about each shot.
SECTION_MARK: Final = bytes((68, 89, 101))
SHOT_MARK: Final = bytes((57, 67, 77))
SHOT_END: Final = bytes((95, 25, 35))
SCAN_MARK: Final = bytes((32, 33, 34))
# A shot's bytes between its marks: kind, seven readings, then by version sides of the passage, temperature, time; mark.
SHOT_BYTES: Final = {2: 16, 3: 21, 4: 29, 5: 29, 6: 29, 7: 29}
MARKED: Final = 5
# Stands after the last section of some files.
FILE_ENDS: Final = b"MN2Over"
WITH_SIDES: Final = 4
JEDEYE: Final = 7
STANDARD, SECTION_ENDS = 2, 3


@dataclass
class _Bytes:
    """What is left to be read of a file."""

    path: Path
    data: bytes
    at: int = 0

    def take(self, count: int) -> bytes:
        """Return the next bytes; raise OldSurveyError where the file ends before."""
        if self.at + count > len(self.data):
            raise OldSurveyError(f"{self.path}: value {len(self.data)}: the file ends within a section")
        self.at += count
        return self.data[self.at - count : self.at]

    def skip(self, mark: bytes) -> bool:
        """Take a mark, if it is the next."""
        found = self.data.startswith(mark, self.at)
        self.at += len(mark) * found
        return found

    def expect(self, mark: bytes, what: str) -> None:
        """Take a mark; raise OldSurveyError where something else stands."""
        if not self.skip(mark):
            raise OldSurveyError(f"{self.path}: value {self.at + 1}: {what} is not where it should be")


def read_dmp(survey: OldSurvey, path: Path, prefix: SurveyPath) -> None:
    """Read a .dmp file: each section is a survey with stations 0, 1, ...; raise OldSurveyError.

    A damaged section keeps its shots before the damage; what is lost is in `left_out`.
    """
    source = _Bytes(path, _bytes_of(path))
    names: list[str] = []
    while source.at < len(source.data):
        begin = source.at
        try:
            _read_section(survey, source, prefix, names)
        except OldSurveyError as damage:
            following = re.search(rb"[\x05-\x07]" + SECTION_MARK, source.data[begin + 1 :])
            source.at = begin + 1 + following.start() if following else len(source.data)
            if not names:
                raise
            survey.left_out.append(f"{damage}; read on at value {source.at + 1} of {len(source.data)}")


def _bytes_of(path: Path) -> bytes:
    values = []
    words = [word.strip() for word in text_of(path).strip().split(";")]
    for number, word in enumerate(words[: -1 if words[-1] == "" else None], 1):
        if not re.fullmatch(r"-?\d{1,3}", word) or not -128 <= int(word) <= 255:
            raise OldSurveyError(f"{path}: value {number}: {word[:20]!r} is not a number from -128 to 255")
        values.append(int(word) & 255)
    return bytes(values).removesuffix(FILE_ENDS)


def _read_section(survey: OldSurvey, source: _Bytes, prefix: SurveyPath, names: list[str]) -> None:
    (version,) = source.take(1)
    if version not in SHOT_BYTES:
        raise OldSurveyError(f"{source.path}: value {source.at}: {version} is no version of a section; known: 2 to 7")
    marked = source.skip(SECTION_MARK)
    if version >= MARKED and not marked:
        raise OldSurveyError(f"{source.path}: value {source.at + 1}: the section's mark is not where it should be")
    source.take(3 if version == JEDEYE else 0)
    year, month, day, _, _, *letters, outward = source.take(9)
    word = re.sub(r"\W", "_", bytes(letters).decode("latin-1"), flags=re.ASCII)
    name = word if word not in names else f"{word}_{len(names) + 1}"
    names.append(name)
    own = (*prefix, name)
    try:
        when: date | None = date(2000 + year, month, day)
    except ValueError:
        when = None
        survey.left_out.append(
            f"{source.path}: section {name}: {2000 + year}-{month}-{day} is no date; declination is 0"
        )
    survey.notes_of(own).notes.append("surveyed on the way out" if outward else "surveyed on the way in")
    station = 0
    for kind, shot in _shots(source, version):
        if kind != STANDARD:
            survey.left_out.append(f"{source.path}: section {name}: a reference shot after station {station}")
            continue
        _add_shot(survey, shot, own, station, when, f"{source.path.name}:{name}:{station}")
        station += 1


def _shots(source: _Bytes, version: int) -> Iterator[tuple[int, list[int]]]:
    """Yield kind, and readings (two bytes each) of the shots of a section."""
    while True:
        if version >= MARKED:
            source.expect(SHOT_MARK, "a shot's mark")
        row = source.take(SHOT_BYTES[version])
        if version >= MARKED:
            source.expect(SHOT_END, "a shot's end")
        if row[0] >= SECTION_ENDS:
            return
        count = 11 if version >= WITH_SIDES else 7
        yield row[0], [int.from_bytes(row[1 + 2 * i : 3 + 2 * i], "big", signed=True) for i in range(count)]
        while source.skip(SCAN_MARK):
            # Walls as points: what they are of is in no other format here.
            source.take(int.from_bytes(source.take(2), "big" if version == JEDEYE else "little"))


def _add_shot(
    survey: OldSurvey, readings: list[int], own: SurveyPath, station: int, when: date | None, place: str
) -> None:
    start, end = (".".join((*own, str(number))) for number in (station, station + 1))
    fore_deg, back_deg = readings[0] / 10, readings[1] / 10
    # Both headings are along the shot: read where it begins and where it ends.
    middle_deg = fore_deg + math.degrees(wrap(math.radians(back_deg - fore_deg))) / 2
    length_m, depth_in_m, depth_out_m = (value / 100 for value in readings[2:5])
    survey.shots.append(
        OldShot(
            start,
            end,
            own,
            "diving",
            tape_m=length_m,
            compass_deg=middle_deg % 360,
            rise_m=depth_in_m - depth_out_m,
            when=when,
            north=North("model"),
            place=place,
        )
    )
    sides = [value / 100 for value in readings[7:]]
    if any(sides):
        survey.passages.append(Passage(own, (CrossSection(start, *sides),)))
