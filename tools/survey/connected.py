"""A project's legs that hang together, and their adjustment, also with a change that a suspicion makes."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final

import numpy as np
from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.assembly import SIGHT, Fixed, assemble, depths_of
from buddyline.tools.survey.averages import Floats, wrap
from buddyline.tools.survey.gauges import tides_of
from buddyline.tools.survey.geodesy import Grid, leg_date
from buddyline.tools.survey.lines import ABSOLUTE_DEPTH_SIGMA_M, Line, Measures, line_of, measures_of, slopes_of
from buddyline.tools.survey.observations import Observations, Solution
from buddyline.tools.survey.old.model import merged
from buddyline.tools.survey.placing import place_all, step_m_of
from buddyline.tools.survey.project import Leg, Project
from msgspec import UNSET, structs

# An observation with this many times its sigma counts no more.
DROPPED: Final = 1e4
NOWHERE: Final = np.full(3, np.nan)


@dataclass(frozen=True)
class Change:
    """A suspicion to try. names: by leg and end (0, 1), another station; drops: observations (leg or -1, what)."""

    names: dict[tuple[int, int], str] = field(default_factory=dict)
    drops: frozenset[tuple[int, str]] = frozenset()

    def with_(self, other: Change) -> Change:
        """Return both changes together."""
        return Change(self.names | other.names, self.drops | other.drops)


def station_depths(project: Project) -> dict[str, float]:
    """Return the mean depth of every station whose gauges were read."""
    return {station.name: station.depth_m for station in project.station if station.depth_m is not UNSET}


def held_depths(project: Project) -> dict[str, float]:
    """Return the held stations and their gauges' mean depth; none if each leg keeps its readings."""
    return station_depths(project) if project.adjust.depth == "absolute" else {}


def water_level_m(project: Project) -> float:
    """Return the surface's altitude: stated, or from a fixed point's altitude and depth, or 0."""
    if project.place.water_level_m is not UNSET:
        return project.place.water_level_m
    depths = station_depths(project)
    known = (f.altitude_m + depths[f.station] for f in project.fix if f.altitude_m is not UNSET and f.station in depths)
    return next(known, 0.0)


def fixed_points(project: Project, grid: Grid) -> Fixed:
    """Return the fixed stations' positions and sigmas; without any, the first leg's start.

    That is at the project's place in a map grid, whose north differs from place to place; else at east 0, north 0.
    An altitude is NaN where depths give it.
    """
    depths, level_m = station_depths(project), water_level_m(project)
    by_depth = depths if project.adjust.depth == "absolute" else {}
    fixed: Fixed = {}
    for fix in project.fix:
        altitude_m, altitude_sigma_m = fix.altitude_m, fix.altitude_sigma_m
        if altitude_m is UNSET:
            by_gauge = fix.station in by_depth
            altitude_m, altitude_sigma_m = math.nan if by_gauge else level_m - depths.get(fix.station, 0.0), 0.0
        sigmas_m = np.array([fix.sigma_m, fix.sigma_m, altitude_sigma_m])
        fixed[fix.station] = np.array([*grid.position_m(fix), altitude_m]), sigmas_m
    if not fixed:
        if not project.leg:
            next_step = "its lines NO LEG say why" if project.dive else "run `buddyline survey legs` first"
            raise BuddylineError(f"the project has no legs; {next_step}")
        start = _start_of(project)
        altitude_m = math.nan if start in by_depth else level_m - depths.get(start, 0.0)
        fixed[start] = np.array([*grid.anchor_m, altitude_m]), np.zeros(3)
    return fixed


def _start_of(project: Project) -> str:
    """Return the first station of the largest part of a survey that legs in use join."""
    legs = [leg for leg in project.used(project.leg) if leg.from_ != leg.to] or project.leg
    directed = [leg for leg in legs if (leg.azimuth_deg, leg.back_azimuth_deg) != (UNSET, UNSET)] or legs
    part_of = merged((leg.from_, leg.to) for leg in directed)
    (largest, _), *_ = Counter(part_of(leg.from_) for leg in directed).most_common(1)
    return next(leg.from_ for leg in directed if part_of(leg.from_) == largest)


class Survey:
    """A project's legs and points that can be adjusted, with first places of their stations.

    ends: each leg's stations, points by names of their own. left_out: the other legs, each with the reason.
    """

    def __init__(self, project: Project, grid: Grid) -> None:
        self.project, self.grid = project, grid
        self.fixed = fixed_points(project, grid)
        stations = {name for leg in project.leg for name in (leg.from_, leg.to)}
        for name in self.fixed:
            if name not in stations and not project.old:
                raise BuddylineError(f"fix of {name!r}: no leg has this station; known: {', '.join(sorted(stations))}")
        for one in project.known:
            if missing := {one.from_, one.to} - stations:
                raise ConfigError(f"known line {one.from_}-{one.to}: no leg has station {', '.join(sorted(missing))}")
            if one.from_ == one.to:
                raise ConfigError(f"known line {one.from_}-{one.to}: both ends are one station")
            if one.distance_m is UNSET and one.azimuth_deg is UNSET:
                raise ConfigError(f"known line {one.from_}-{one.to}: give distance_m, azimuth_deg or both")
        azimuths = any(one.azimuth_deg is not UNSET for one in project.known)
        if project.adjust.compass == "ignore" and len(self.fixed) < 2 and not azimuths:
            raise ConfigError('adjust.compass = "ignore": north needs a [[known]] azimuth_deg or two fixed points')
        self.origin_m = np.nan_to_num(next(iter(self.fixed.values()))[0])
        self.level_m = water_level_m(project)
        self.tides = tides_of(project.leg) if _may_have_tides(project) else []
        self.left_out: list[tuple[Leg, str]] = []
        self.legs: list[Leg] = []
        self.ends: list[tuple[str, str]] = []
        for number, leg in enumerate(project.leg + project.point):
            edit = project.edit_of(leg) if project.edit else None
            if edit is not None and not edit.use:
                self.left_out.append((leg, f"taken out{': ' + edit.note if edit.note else ''}"))
            elif leg.from_ == leg.to:
                self.left_out.append((leg, "both ends at one station"))
            else:
                self.legs.append(leg)
                # A point is no station, and another point of its name another one.
                self.ends.append((leg.from_, leg.to if number < len(project.leg) else f"point {number}"))
        self.first_m: dict[str, Floats] = {}
        self.turns_rad: list[float] = []
        self.north_along: tuple[str, str] | None = None
        self.place(self.ends)
        if grid.projection is not None or (grid.declination is not None and grid.declination.stated_rad is None):
            self.place(self.ends)

    @property
    def stations_legs(self) -> list[tuple[Leg, tuple[str, str]]]:
        """Legs between stations, with their ends."""
        return [(leg, ends) for leg, ends in zip(self.legs, self.ends, strict=True) if " " not in ends[1]]

    def place(self, ends: list[tuple[str, str]]) -> None:
        """Find first places of all stations by the shortest way of legs; leave out legs that hang on nothing."""
        project, grid, at = self.project, self.grid, self.first_m
        self.turns_rad = [grid.leg_turn_rad(leg, leg_date(project, leg), at.get(leg.from_)) for leg in self.legs]
        self.steps = list(map(step_m_of, self.legs, self.turns_rad))
        self.first_m, why, self.north_along = place_all(project, self.legs, ends, self.steps, self._starts())
        self.left_out += [(leg, said) for leg, said in zip(self.legs, why, strict=True) if said]
        kept = [number for number, said in enumerate(why) if not said]
        self.legs = [self.legs[number] for number in kept]
        self.ends = [ends[number] for number in kept]
        self.turns_rad = [self.turns_rad[number] for number in kept]
        self.steps = [self.steps[number] for number in kept]

    def _starts(self) -> dict[str, Floats]:
        return {name: np.where(np.isnan(p), self._altitude_m(name), p) for name, (p, _) in self.fixed.items()}

    def _altitude_m(self, name: str) -> float:
        return self.level_m - station_depths(self.project).get(name, 0.0)

    @cached_property
    def carried(self) -> set[int]:
        """Legs whose azimuths gyroscopes tie to others'."""
        turned = {(one.dive, ns) for one in self.project.turn for ns in (one.from_ns, one.to_ns)}
        return {number for number, leg in enumerate(self.legs) if (leg.dive, leg.start_ns) in turned}

    def name_at(self, leg: int, end: int, change: Change) -> str:
        """Return the station at a leg's start (0) or end (1), after a change of names."""
        return change.names.get((leg, end)) or self.ends[leg][end]

    def adjust(self, change: Change | None = None, *, linear: bool = False) -> Solution:
        """Return the least squares solution, with other names and without the observations that a change drops."""
        if change is None or not (change.names or change.drops):
            of, at_m = self._as_read
        else:
            ends = [(self.name_at(n, 0, change), self.name_at(n, 1, change)) for n in range(len(self.legs))]
            legs = [_without(leg, number, change.drops) for number, leg in enumerate(self.legs)]
            steps = list(map(step_m_of, legs, self.turns_rad))
            # Without the observation a station may hang on nothing; as before it is a place to begin with.
            first_m = self.first_m | place_all(self.project, legs, ends, steps, self._starts())[0]
            of, at_m = self._observed(ends, steps, first_m)
            for row, key in enumerate(zip(of.leg, of.what, strict=True) if change.drops else ()):
                if key in change.drops:
                    of.sigma[row] *= DROPPED
        return of.adjust(at_m, linear=linear)

    @cached_property
    def _as_read(self) -> tuple[Observations, Floats]:
        return self._observed(self.ends, self.steps, self.first_m)

    def _observed(
        self, ends: list[tuple[str, str]], steps: list[Floats | None], first_m: dict[str, Floats]
    ) -> tuple[Observations, Floats]:
        """Return the observations with these ends of legs, and first places (s, 3) of their stations."""
        names = list(dict.fromkeys([*(name for name in self.fixed if name in first_m), *(n for e in ends for n in e)]))
        if lost := set(names) - set(first_m):
            raise BuddylineError(f"station {min(lost)} hangs on nothing")
        of = assemble(
            self.project,
            self.legs,
            ends,
            names,
            self.fixed,
            self.turns_rad,
            self.tides,
            self.level_m,
            self.origin_m,
            self.north_along,
        )
        of.vectors_m = np.array([NOWHERE if step_m is None else step_m for step_m in steps]).reshape(-1, 3)
        return of, np.array([first_m[name] for name in names]) - self.origin_m

    def corrected(self, solution: Solution) -> list[Line]:
        """Return the legs between stations with what the instruments add taken off."""
        found = []
        up_m = dict(zip(solution.observations.stations, solution.position_m[:, 2].tolist(), strict=True))
        for number, (leg, ends) in enumerate(zip(self.legs, self.ends, strict=True)):
            if " " not in ends[1]:
                line = line_of(leg, self._measures(solution, number, up_m), self.turns_rad[number])
                found += [line] if line is not None else []
        return found

    def _measures(self, solution: Solution, number: int, up_m: dict[str, float]) -> Measures | None:
        rows, leg, (start, end) = solution.observations.rows, self.legs[number], self.ends[number]
        if not leg.from_node and leg.azimuth_deg is not UNSET:
            return measures_of(leg, self.project, self.turns_rad[number], {})
        sigma = solution.model.sigma
        distance = rows[number, "distance"]
        distance_m = leg.distance_m / (1 + float(solution.terms[distance]))
        carried = solution.observations.has(f"{SIGHT} {number}")
        if carried is not None:
            run_m = max(leg.distance_m, 0.3)
            held = math.sqrt(2) * max(self.project.settings.centering_m, 1e-3) / run_m
            azimuth = wrap(float(solution.x[carried])), held
        else:
            sighted = [row for what in ("fore", "back") if (row := rows.get((number, what))) is not None]
            if not sighted:
                return None
            read = [float(solution.model.value[row] - solution.terms[row]) for row in sighted]
            mean = read[0] + sum(wrap(one - read[0]) for one in read) / len(read)
            azimuth = wrap(mean), float(sigma[sighted[0]]) / math.sqrt(len(sighted))
        rise: tuple[float, float] | None = None
        if self.project.adjust.depth == "absolute" and all(depths_of(leg)):
            rise = up_m[end] - up_m[start], math.sqrt(2) * ABSOLUTE_DEPTH_SIGMA_M
        elif (row := rows.get((number, "rise"))) is not None:
            rise = float(solution.model.value[row] - solution.terms[row]), float(sigma[row])
        return Measures((distance_m, float(sigma[distance])), azimuth, rise, slopes_of(leg))


def _without(leg: Leg, number: int, drops: frozenset[tuple[int, str]]) -> Leg:
    """Return a leg without a dropped compass's reading, for first places: it may point anywhere."""
    if (number, f"compass of {leg.from_node}") in drops and leg.back_azimuth_deg is not UNSET:
        return structs.replace(leg, azimuth_deg=UNSET)
    if (number, f"compass of {leg.to_node}") in drops and leg.azimuth_deg is not UNSET:
        return structs.replace(leg, back_azimuth_deg=UNSET)
    return leg


def _may_have_tides(project: Project) -> bool:
    return project.adjust.depth == "absolute" and any(one.readings for one in project.station)
