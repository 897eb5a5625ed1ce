"""The project: one TOML file. A person writes the upper part, the lower part is derived from the dives.

The text above the line MARKER is never changed. The text below it is derived again from the dives' logs, which
never change. A copy of the file before each change is kept beside it.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Sequence
from datetime import UTC, date, datetime
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeAlias

import msgspec
from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import Config, ConfigError, load_config
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NodeId, NonNegative, Positive
from buddyline.tools.newfile import replace_text, write_new
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from msgspec import UNSET, Meta, UnsetType, field

MARKER: Final = "# ---- From the dives, by `buddyline survey legs`: made anew each time. Edit above. ----"
STATION_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,12}\Z")
ANOTHER_DIVE: Final = "add the dive to it as another [[dive]]"
# The years whose instants are counts of nanoseconds in 64 bits.
YEARS: Final = range(1970, 2262)
# No dive is so long.
MOST_S: Final = 1e6

Latitude: TypeAlias = Annotated[float, Meta(ge=-90, le=90)]
Longitude: TypeAlias = Annotated[float, Meta(ge=-180, le=180)]


class About(Config, frozen=True, kw_only=True):
    """[survey]: the heading of every export. instruments: name of an instrument to what it is."""

    name: str = "survey"
    title: str = ""
    date: date | UnsetType = UNSET
    team: list[str] = field(default_factory=list)
    instruments: dict[str, str] = field(default_factory=dict)
    notes: str = ""


class Place(Config, frozen=True, kw_only=True):
    """[place]: where the dive is, for the declination; water_level_m: altitude of the surface, where depth
    is 0; by default from the first fix's altitude and its station's depth, or 0. utm_zone ("32N") or epsg (any
    projected coordinate system in metres to east and north, such as 2154): the map grid of all coordinates."""

    latitude_deg: Latitude | UnsetType = UNSET
    longitude_deg: Longitude | UnsetType = UNSET
    water_level_m: float | UnsetType = UNSET
    declination_deg: Annotated[float, Meta(ge=-180, le=180)] | UnsetType = UNSET
    declination_source: str = ""
    utm_zone: Annotated[str, Meta(pattern=r"^\d{1,2}[NS]$")] | UnsetType = UNSET
    epsg: int | UnsetType = UNSET

    @property
    def degrees(self) -> tuple[float, float] | None:
        """Latitude and longitude, where both are given."""
        return _pair(self.latitude_deg, self.longitude_deg)


class FixedPoint(Config, frozen=True, kw_only=True):
    """[[fix]]: a station known from elsewhere, in metres (UTM where the place names a zone) or in degrees.

    altitude_m: by default from the station's depth; both count, where the water level is stated as well. sigma_m: 1
    sd of east and of north, altitude_sigma_m: of the altitude; 0 for exact.
    """

    station: str
    east_m: float | UnsetType = UNSET
    north_m: float | UnsetType = UNSET
    latitude_deg: Latitude | UnsetType = UNSET
    longitude_deg: Longitude | UnsetType = UNSET
    altitude_m: float | UnsetType = UNSET
    sigma_m: NonNegative = 0.0
    altitude_sigma_m: NonNegative = 0.0
    entrance: bool = False

    @property
    def degrees(self) -> tuple[float, float] | None:
        """Latitude and longitude, where both are given."""
        return _pair(self.latitude_deg, self.longitude_deg)

    @property
    def metres(self) -> tuple[float, float] | None:
        """East and north, where both are given."""
        return _pair(self.east_m, self.north_m)


def _half(one: float | UnsetType, other: float | UnsetType) -> bool:
    """Return whether only one of two coordinates is given."""
    return (one is UNSET) != (other is UNSET)


def _pair(one: float | UnsetType, other: float | UnsetType) -> tuple[float, float] | None:
    return None if one is UNSET or other is UNSET else (one, other)


class DiveFiles(Config, frozen=True, kw_only=True):
    """[[dive]]: the solved log and the nodes' own, relative to the project file. date: where the clocks were wrong."""

    logs: list[str]
    date: date | UnsetType = UNSET
    note: str = ""


MarkKind: TypeAlias = Literal["station", "point", "note"]


class HandMark(Config, frozen=True, kw_only=True):
    """[[mark]]: like the bus's Mark, by hand. time: UTC; or seconds from the dive's first fix."""

    node: NodeId
    time: datetime | UnsetType = UNSET
    seconds: Annotated[float, Meta(ge=-MOST_S, le=MOST_S)] | UnsetType = UNSET
    dive: Annotated[int, Meta(ge=1)] = 1
    kind: MarkKind = "station"
    name: str = ""
    note: str = ""


class Edit(Config, frozen=True, kw_only=True):
    """[[edit]]: a person's decision on a leg, named "from-to" ("3-4"), or on the repeat that began at start_ns.

    extend: which way it goes in the extended elevation, where the survey that it was read from says otherwise, or not.
    """

    leg: str
    start_ns: int | UnsetType = UNSET
    use: bool = True
    compass: Literal["both", "fore", "back"] | UnsetType = UNSET
    extend: Literal["right", "left", "vertical", "ignore"] | UnsetType = UNSET
    note: str = ""


class Equate(Config, frozen=True, kw_only=True):
    """[[equate]]: stations that are one place; it has the first one's name."""

    stations: Annotated[list[str], Meta(min_length=2)]


class OldFile(Config, frozen=True, kw_only=True):
    """[[old]]: a survey made with another program, read anew each time; relative to the project file.

    name: before its stations' names; by default the file's.
    """

    file: str
    name: str = ""


class AdjustSettings(Config, frozen=True, kw_only=True):
    """[adjust]. depth: absolute takes each reading as its station's depth; readings lets each leg keep its own two.

    compass: ignore takes directions from gyroscopes and known azimuths or fixed points alone. datum: where nothing is
    fixed, ellipses are relative to the first station (start), or to all stations' mean (free: inner constraints).
    """

    depth: Literal["absolute", "readings"] = "absolute"
    compass: Literal["use", "ignore"] = "use"
    datum: Literal["start", "free"] = "start"


class Known(Config, frozen=True, kw_only=True):
    """[[known]]: a line between two stations that is known from elsewhere: a tape, a baseline, a theodolite.

    azimuth_deg: from the grid's north. sigma_m, azimuth_sigma_deg: 1 sd; 0 for exact.
    """

    from_: str = field(name="from")
    to: str
    distance_m: Positive | UnsetType = UNSET
    sigma_m: NonNegative = 0.0
    azimuth_deg: float | UnsetType = UNSET
    azimuth_sigma_deg: NonNegative = 0.0
    note: str = ""


class Turn(Config, frozen=True, kw_only=True):
    """[[turn]]: how far a node's sight turned between two legs of a dive, clockwise, by its gyroscope, in `seconds`.

    from_ns, to_ns: the legs' start_ns. A sight is the direction in which the node sees the other one. sigma_deg: 1 sd,
    without what the gyroscope's zero and scale add.
    """

    node: str
    dive: int = 1
    from_ns: int
    to_ns: int
    seconds: float
    angle_deg: float
    sigma_deg: Positive


class Swim(Config, frozen=True, kw_only=True, gc=False):
    """[[swim]]: the way of `node` from one rest to the next, seen from `station`, at which the other node stood.

    rows: seconds since start_ns; ahead, right, down, m, in level axes of any azimuth; 1 sd along the sight, and across
    it. The first is at `from`, the last at `to`. sigma_deg: 1 sd of the standing node's gyroscope over all of it.
    """

    node: str
    station: str
    from_: str = field(name="from")
    to: str
    dive: int = 1
    start_ns: int
    sigma_deg: NonNegative
    rows: list[Annotated[list[float], Meta(min_length=6, max_length=6)]]

    @property
    def name(self) -> str:
        """Its name on maps: node, and `from-to`."""
        return f"{self.node} {self.from_}-{self.to}"


class Leg(Config, frozen=True, kw_only=True, gc=False):
    """[[leg]] and [[point]]: one shot from a station to a station or point, as read; angles magnetic, in degrees.

    azimuth_deg, inclination_deg: by the node at `from`, towards `to`; back_*: by the node at `to`, towards
    `from`. turn_deg: from magnetic to grid north, where it was stated, declination_deg: to true north. *_sigma_*: 1
    sd; *_noise_*: its part that is new in each leg, not the gauge's own. fixes_used, unused: triggers, as ranges;
    unused: by reason. A leg of an old survey has no nodes. extend: as an old survey says it.
    """

    from_: str = field(name="from")
    to: str
    from_node: str
    to_node: str
    dive: int = 1
    start_ns: int
    end_ns: int
    distance_m: float
    distance_sigma_m: Positive
    azimuth_deg: float | UnsetType = UNSET
    azimuth_sigma_deg: float | UnsetType = UNSET
    inclination_deg: float | UnsetType = UNSET
    inclination_sigma_deg: float | UnsetType = UNSET
    back_azimuth_deg: float | UnsetType = UNSET
    back_azimuth_sigma_deg: float | UnsetType = UNSET
    back_inclination_deg: float | UnsetType = UNSET
    back_inclination_sigma_deg: float | UnsetType = UNSET
    depth_from_m: float | UnsetType = UNSET
    depth_from_sigma_m: float | UnsetType = UNSET
    depth_from_noise_m: float | UnsetType = UNSET
    depth_to_m: float | UnsetType = UNSET
    depth_to_sigma_m: float | UnsetType = UNSET
    depth_to_noise_m: float | UnsetType = UNSET
    field_from_ut: float | UnsetType = UNSET
    field_to_ut: float | UnsetType = UNSET
    dip_from_deg: float | UnsetType = UNSET
    dip_to_deg: float | UnsetType = UNSET
    turn_deg: float | UnsetType = UNSET
    declination_deg: float | UnsetType = UNSET
    heading_gap_deg: float | UnsetType = UNSET
    disturbed: list[str] = field(default_factory=list)
    fixes: int
    fixes_used: str = ""
    unused: dict[str, str] = field(default_factory=dict)
    grade: int = 0
    extend: str = ""
    alarms: list[str] = field(default_factory=list)
    note: str = ""

    @property
    def name(self) -> str:
        """The leg's name in edits and reports: `from-to`."""
        return f"{self.from_}-{self.to}"

    @property
    def moment(self) -> datetime:
        """Begin of the shot, UTC."""
        return datetime.fromtimestamp(self.start_ns / S_NS, UTC)


class Station(Config, frozen=True, kw_only=True, gc=False):
    """[[station]]: depth_m: mean of what the gauges read there; readings: how many legs' gauges."""

    name: str
    depth_m: float | UnsetType = UNSET
    depth_sigma_m: float | UnsetType = UNSET
    readings: int = 0
    notes: list[str] = field(default_factory=list)


class Made(Config, frozen=True, kw_only=True):
    """[[made]]: a hash of what the lower part was made of: dives, marks and equates."""

    of: str


class Problem(Config, frozen=True, kw_only=True):
    """[[problem]]: a question that the logs leave open, in words."""

    text: str


class Project(Config, frozen=True, kw_only=True):
    """A whole project."""

    survey: About = field(default_factory=About)
    place: Place = field(default_factory=Place)
    fix: list[FixedPoint] = field(default_factory=list)
    dive: list[DiveFiles] = field(default_factory=list)
    old: list[OldFile] = field(default_factory=list)
    mark: list[HandMark] = field(default_factory=list)
    edit: list[Edit] = field(default_factory=list)
    equate: list[Equate] = field(default_factory=list)
    settings: SurveySettings = field(default_factory=SurveySettings)
    alarms: AlarmSettings = field(default_factory=AlarmSettings)
    known: list[Known] = field(default_factory=list)
    adjust: AdjustSettings = field(default_factory=AdjustSettings)
    made: list[Made] = field(default_factory=list)
    leg: list[Leg] = field(default_factory=list)
    point: list[Leg] = field(default_factory=list)
    turn: list[Turn] = field(default_factory=list)
    swim: list[Swim] = field(default_factory=list)
    station: list[Station] = field(default_factory=list)
    problem: list[Problem] = field(default_factory=list)

    def edit_of(self, leg: Leg) -> Edit | None:
        """Return a person's decision on this repeat of a leg, or on the leg."""
        if not self.edit:
            return None
        found = [edit for edit in self.edit if edit.leg == leg.name and edit.start_ns in (UNSET, leg.start_ns)]
        return max(found, key=lambda edit: edit.start_ns is not UNSET, default=None)

    def extend_of(self, leg: Leg) -> str:
        """Return which way a leg goes in the extended elevation: right, left, vertical, ignore, ...; or nothing."""
        edit = self.edit_of(leg)
        return leg.extend if edit is None or edit.extend is UNSET else edit.extend

    def taken_out(self, leg: Leg) -> bool:
        """Tell whether a person's edit has taken the leg out."""
        edit = self.edit_of(leg)
        return edit is not None and not edit.use

    def used(self, legs: list[Leg]) -> list[Leg]:
        """Return the legs that no edit has taken out."""
        return [leg for leg in legs if not self.taken_out(leg)]


def load_project(path: Path | str) -> Project:
    """Read a project file; raise ConfigError naming file, field and value."""
    project = load_config(path, Project)
    if _half(project.place.latitude_deg, project.place.longitude_deg):
        raise ConfigError(f"{path}: place: give both latitude_deg and longitude_deg, or neither")
    for fix in project.fix:
        half = _half(fix.east_m, fix.north_m) or _half(fix.latitude_deg, fix.longitude_deg)
        if half or (fix.metres is None) == (fix.degrees is None):
            raise ConfigError(
                f"{path}: fix of {fix.station!r}: give east_m and north_m, or latitude_deg and longitude_deg"
            )
    for mark in project.mark:
        check_mark(mark, f"{path}: mark {mark.name!r} of node {mark.node}", len(project.dive))
    fixed = [fix.station for fix in project.fix]
    if twice := {name for name in fixed if fixed.count(name) > 1}:
        raise ConfigError(f"{path}: fix of {min(twice)!r}: is stated twice; give one place, or their mean")
    names = {leg.name for leg in project.leg}
    for edit in project.edit:
        # The legs of old surveys are read later.
        if names and edit.leg not in names and not project.old:
            raise ConfigError(f"{path}: edit of leg {edit.leg!r}: no such leg; known: {', '.join(sorted(names))}")
    return project


def check_mark(mark: HandMark, name: str, dives: int) -> None:
    """Raise ConfigError, with the mark's name, if it has no instant, or is of none of so many dives."""
    if (mark.time is UNSET) == (mark.seconds is UNSET):
        raise ConfigError(f"{name}: give time or seconds, and not both")
    if mark.time is not UNSET and mark.time.year not in YEARS:
        raise ConfigError(f"{name}: time {mark.time.isoformat()}: its year is not within {YEARS[0]} to {YEARS[-1]}")
    if mark.dive > dives:
        raise ConfigError(f"{name}: dive = {mark.dive}: the project has {dives} [[dive]]")


def own_equates(project: Project) -> list[list[str]]:
    """Return the dives' stations that are one place. Those of old surveys, with points, are joined when adjusted."""
    own = ([name for name in one.stations if "." not in name] for one in project.equate)
    return [names for names in own if len(names) > 1]


def sources_of(project: Project) -> str:
    """Return a hash of what the legs are made of."""
    sources = [one.logs for one in project.dive], project.mark, own_equates(project)
    return hashlib.sha256(msgspec.json.encode(sources)).hexdigest()[:16]


def write_derived(path: Path, derived: dict[str, list[Any]]) -> None:
    """Write the derived part below the marker; keep the old file as `NAME.1`, `NAME.2`, ..."""
    old = _text_of(path)
    upper = old.split(MARKER)[0].rstrip("\r\n")
    text = upper + _ends_as(old, f"\n\n{MARKER}\n{_toml(derived)}")
    if text == old:
        return
    _write_again(path, text, old if MARKER in old else "")


def add_old(path: Path, added: list[OldFile]) -> None:
    """Add old surveys to the upper part; keep the file as it was as `NAME.1`, `NAME.2`, ..."""
    for one in added:
        _check_unicode(one.file)
    old = _text_of(path)
    upper, marker, lower = old.partition(MARKER)
    tables = _ends_as(old, f"\n{_toml({'old': added})}\n")
    _write_again(path, f"{upper.rstrip()}{tables}{marker}{lower}".rstrip() + _ends_as(old, "\n"), old)


def _text_of(path: Path) -> str:
    """Return a file's text with its own line ends, which differ between systems."""
    return path.read_bytes().decode()


def _ends_as(old: str, text: str) -> str:
    """Return text, which has newlines, with the line ends of an old text."""
    return text.replace("\n", "\r\n") if "\r\n" in old else text


def _write_again(path: Path, text: str, old: str) -> None:
    """Replace a project's text. old: what to keep; "" for nothing."""
    if old:
        numbered = (path.with_name(f"{path.name}.{number}") for number in count(1))
        write_new(next(kept for kept in numbered if not kept.exists()), old)
    replace_text(path, text)


def beside(path: Path, file: Path | str) -> str:
    """Return a file's name relative to the folder of a project, to which a link may lead."""
    return os.path.relpath(os.path.abspath(file), path.parent.resolve())


def new_project(path: Path, name: str, logs: list[str], old: Sequence[OldFile] = ()) -> None:
    """Write a project file to fill in; raise BuddylineError if one exists."""
    for each in (name, *logs, *(one.file for one in old)):
        _check_unicode(each)
    text = TEMPLATE.format(name=_toml_value(name))
    text += f"\n[[dive]]\nlogs = {_toml_value(logs)}\n" * bool(logs) + (_toml({"old": list(old)}) if old else "")
    write_new(path, text, ANOTHER_DIVE)


def _check_unicode(name: str) -> None:
    """Raise BuddylineError if a file's name, which goes into the project, is no UTF-8."""
    if any("\ud800" <= letter <= "\udfff" for letter in name):
        raise BuddylineError(f"{name}: this name is not UTF-8 text, as a project file is; rename the file")


TEMPLATE: Final = """\
# A survey by Buddyline. Yours to edit, down to the line of dashes.

[survey]
name = {name}
title = ""
team = []
notes = ""

[survey.instruments]
# tape = "optical range, calibrated 2026-04-28"

[place]
# For the declination, with the date of the first dive; or declination_deg = 3.4 and declination_source = "map".
# latitude_deg = 45.5
# longitude_deg = 9.2
# water_level_m = 100.0

# [[fix]]
# station = "0"
# latitude_deg = 45.5
# longitude_deg = 9.2
# entrance = true

# [[mark]]            # stations, points and notes by hand
# node = "b"
# time = 2026-05-01T10:20:30Z
# name = "T1"
# note = "tie-off on the big flake"

# [[edit]]            # a verdict on a leg
# leg = "3-4"
# use = false
# note = "line was moved"
"""


def _toml(tables: dict[str, list[Any]]) -> str:
    """Write arrays of tables. Their structs have scalars, lists of scalars or flat dicts; empty values are left out."""
    lines: list[str] = []
    for name, rows in tables.items():
        for row in rows:
            lines.append(f"\n[[{name}]]")
            values = msgspec.to_builtins(row).items()
            lines += [f"{key} = {_toml_value(value)}" for key, value in values if value not in ({}, [], "")]
    return "\n".join(lines) + "\n"


def _toml_value(value: Any) -> str:
    """Write a value: TOML's strings, numbers and arrays are JSON's, except one forbidden character; tables differ."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_toml_value(key)} = {_toml_value(one)}" for key, one in value.items()) + " }"
    return json.dumps(value, ensure_ascii=False, allow_nan=False).replace("\x7f", "\\u007F")
