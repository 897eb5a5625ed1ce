"""An old survey as it was read: shots, passages, equates, fixed points, and the hierarchy they stand in.

Metres and degrees, with instruments' calibrations taken off; the angle to north is beside each shot, not in it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import Final, Literal, TypeAlias

from buddyline.tools.survey.averages import wrap

# A station's full name: the surveys around it and its own name, with points between; "" has no name (splays).
StationName: TypeAlias = str
SurveyPath: TypeAlias = tuple[str, ...]
Style: TypeAlias = Literal["normal", "diving", "cartesian", "cylpolar", "nosurvey", "distance"]

# 1 sd of what no file states, metres and degrees: BCRA grade 5 as Survex has it, its default.
SIGMAS: Final[Mapping[str, float]] = {
    **dict.fromkeys(("position", "tape", "dx", "dy", "dz", "depth"), 0.05),
    **dict.fromkeys(("compass", "backcompass", "clino", "backclino"), 0.5),
    **dict.fromkeys(("level", "plumb"), 0.25),
}
LEAST_M: Final = 1e-4


@dataclass(frozen=True)
class North:
    """Where bearings are from. kind: grid (value_deg to the map's north), true (to true north), or model.

    model: by the magnetic model, at `at` (coordinate system, x, y, z) where the file names a place.
    """

    kind: Literal["grid", "true", "model"] = "grid"
    value_deg: float = 0.0
    at: tuple[str, float, float, float] | None = None


@dataclass(frozen=True)
class OldShot:
    """One shot as read. None: not read. rise_m: by depth gauges, up. vector_m: of cartesian style, east, north, up.
    depths_m: of both ends, of distance style, which has a tape alone.

    clino_word: up, down or level, where no angle was read. when: first day. text: the line of its file.
    sigmas: 1 sd by quantity, those of SIGMAS if not here. extend: of the extended elevation: left, right, ignore, ...
    """

    start: StationName
    end: StationName
    survey: SurveyPath
    style: Style = "normal"
    tape_m: float = 0.0
    compass_deg: float | None = None
    back_deg: float | None = None
    clino_deg: float | None = None
    back_clino_deg: float | None = None
    clino_word: Literal["", "up", "down", "level"] = ""
    rise_m: float | None = None
    vector_m: tuple[float, float, float] | None = None
    depths_m: tuple[float, float] | None = None
    flags: frozenset[str] = frozenset()
    when: date | None = None
    north: North = field(default_factory=North)
    sigmas: Mapping[str, float] = field(default_factory=dict)
    extend: str = ""
    note: str = ""
    place: str = ""
    text: str = ""

    def sigma(self, what: str) -> float:
        """Return 1 sd of a quantity, metres or degrees."""
        return self.sigmas.get(what, SIGMAS[what])

    @property
    def polar(self) -> tuple[float, float, float]:
        """Distance (m), azimuth from where bearings are from, and inclination (degrees)."""
        if self.vector_m is not None:
            east_m, north_m, up_m = self.vector_m
            run_m = math.hypot(east_m, north_m)
            azimuth_deg = math.degrees(math.atan2(east_m, north_m))
        else:
            azimuth_deg = self._azimuth_deg
            if self.style == "normal":
                slope = math.radians(self._slope_deg)
                run_m, up_m = self.tape_m * math.cos(slope), self.tape_m * math.sin(slope)
            else:
                up_m = self.rise_m or 0.0
                run_m = self.tape_m
                if self.style == "diving":
                    run_m = math.sqrt(max(self.tape_m**2 - up_m**2, 0.0))
                    up_m = self._plumbed_m if run_m == 0.0 else up_m
                if self.compass_deg is None and self.back_deg is None:
                    run_m = 0.0
        return math.hypot(run_m, up_m), azimuth_deg % 360, math.degrees(math.atan2(up_m, run_m))

    @property
    def polar_sigmas(self) -> tuple[float, float, float]:
        """1 sd along the shot, aside and across its slope, m, as Survex has it, but for depths."""
        distance_m, _, slope_deg = self.polar
        held_m = self.sigma("position") / math.sqrt(3)
        if self.vector_m is not None:
            return self.sigma("dx"), self.sigma("dy"), self.sigma("dz")
        if distance_m == 0.0:
            return held_m, held_m, held_m
        steep = self.clino_word in ("up", "down")
        clino = "plumb" if steep else "level" if self.clino_word == "level" else "clino"
        slope_m = distance_m * math.radians(self.sigma(clino))
        run_m = distance_m * math.cos(math.radians(slope_deg))
        aside_m = slope_m if steep else run_m * math.radians(self.sigma("compass"))
        if self.back_deg is not None and self.compass_deg is not None:
            aside_m = 0.5 * run_m * math.radians(math.hypot(self.sigma("compass"), self.sigma("backcompass")))
        if self.clino_deg is not None and self.back_clino_deg is not None:
            slope_m = 0.5 * distance_m * math.radians(math.hypot(self.sigma("clino"), self.sigma("backclino")))
        elif self.style == "normal" and self.clino_deg is None and self.back_clino_deg is None and not self.clino_word:
            slope_m = distance_m * math.sqrt(0.1)
        elif self.style != "normal":
            slope_m = math.sqrt(2) * self.sigma("depth")
        along_m = self.sigma("tape")
        if self.style == "diving" and self.tape_m <= abs(self.rise_m or 0.0):
            along_m, slope_m = along_m * slope_m / math.hypot(along_m, slope_m), 0.0
        one, two, three = (math.hypot(held_m, own_m) for own_m in (along_m, aside_m, slope_m))
        return one, two, three

    @property
    def _plumbed_m(self) -> float:
        """Rise (m) of a diver's shot whose tape is no longer than the depths differ: the mean of both, as in Survex."""
        rise_m, tape_var, rise_var = self.rise_m or 0.0, self.sigma("tape") ** 2, 2 * self.sigma("depth") ** 2
        return (rise_m * tape_var + math.copysign(self.tape_m, rise_m) * rise_var) / (tape_var + rise_var)

    @property
    def _azimuth_deg(self) -> float:
        fore, back = self.compass_deg, self.back_deg
        if back is None:
            return fore or 0.0
        if fore is None:
            return back + 180
        gap = math.degrees(wrap(math.radians(back + 180 - fore)))
        return fore + gap * self.sigma("compass") ** 2 / (self.sigma("compass") ** 2 + self.sigma("backcompass") ** 2)

    @property
    def _slope_deg(self) -> float:
        if self.clino_word:
            return {"up": 90.0, "down": -90.0, "level": 0.0}[self.clino_word]
        fore, back = self.clino_deg, self.back_clino_deg
        if back is None:
            return fore or 0.0
        if fore is None:
            return -back
        share = self.sigma("clino") ** 2 / (self.sigma("clino") ** 2 + self.sigma("backclino") ** 2)
        return fore - (fore + back) * share


@dataclass(frozen=True)
class CrossSection:
    """Left, right, up and down (m) at a station, seen along the passage. None: not read."""

    station: StationName
    left_m: float | None = None
    right_m: float | None = None
    up_m: float | None = None
    down_m: float | None = None

    @property
    def sides_m(self) -> tuple[float | None, float | None, float | None, float | None]:
        """Left, right, up, down."""
        return self.left_m, self.right_m, self.up_m, self.down_m


@dataclass(frozen=True)
class Passage:
    """Cross-sections, one after the other along a passage."""

    survey: SurveyPath
    sections: tuple[CrossSection, ...]


@dataclass(frozen=True)
class OldFix:
    """A fixed station: x, y, z in a coordinate system as the file names it ("": none), with 1 sd each, m."""

    station: StationName
    position: tuple[float, float, float]
    sigmas_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    system: str = ""
    place: str = ""


@dataclass
class SurveyNotes:
    """What is said of a survey of the hierarchy: one person or instrument each."""

    title: str = ""
    team: list[str] = field(default_factory=list)
    instruments: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class OldSurvey:
    """All that was read of a file and of those that it names. left_out: what was not read, in words."""

    shots: list[OldShot] = field(default_factory=list)
    passages: list[Passage] = field(default_factory=list)
    equates: list[tuple[StationName, ...]] = field(default_factory=list)
    fixes: list[OldFix] = field(default_factory=list)
    entrances: list[StationName] = field(default_factory=list)
    surveys: dict[SurveyPath, SurveyNotes] = field(default_factory=dict)
    station_notes: dict[StationName, str] = field(default_factory=dict)
    # The coordinate system that the survey is computed in.
    system: str = ""
    left_out: list[str] = field(default_factory=list)

    @property
    def stations(self) -> list[StationName]:
        """Every station that has a name, once."""
        ends = (end for shot in self.shots for end in (shot.start, shot.end) if end)
        return list(dict.fromkeys([*ends, *(fix.station for fix in self.fixes)]))

    def notes_of(self, path: SurveyPath) -> SurveyNotes:
        """Return the notes of a survey, to be added to."""
        return self.surveys.setdefault(path, SurveyNotes())


def merged(equates: Iterable[tuple[StationName, ...]]) -> Callable[[StationName], StationName]:
    """Return the name that stands for each station, the first that was stated of each place."""
    parent: dict[StationName, StationName] = {}

    def root(name: StationName) -> StationName:
        top = name
        while top in parent:
            top = parent[top]
        while name != top:
            parent[name], name = top, parent[name]
        return top

    for first, *others in equates:
        for other in others:
            one, two = root(first), root(other)
            if one != two:
                parent[two] = one
    return root
