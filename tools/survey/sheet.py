"""The common content of all exports: who, when and where, fixed stations, and each leg's readings."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from buddyline.tools.survey.assembly import Fixed
from buddyline.tools.survey.geodesy import leg_date, survey_date
from buddyline.tools.survey.lines import Line, bearing_of
from buddyline.tools.survey.marks import section_of
from buddyline.tools.survey.network import Adjusted
from buddyline.tools.survey.old.joining import leg_of, same_place
from buddyline.tools.survey.old.model import CrossSection, North, OldShot, OldSurvey, merged
from buddyline.tools.survey.old.writing import one_line
from buddyline.tools.survey.project import Leg, Project
from msgspec import UNSET, structs

# Survex refuses, as a warning, sights that differ by three sd of their difference.
SEEN_SIGMAS: Final = 2.5
# After a survey's name, where an old survey has the same.
OWN: Final = "dives"


@dataclass(frozen=True)
class Reading:
    """One leg as surveyors write it: degrees, metres, depths positive down; None: not read. Sigmas: 1 sd.

    off_deg: what compass and backcompass read too much, by the adjustment. scale: what distances are multiplied by.
    by_clino: the rise is the clinometers'; then there are no depths. held: its stations are held at their depths.
    looped: the leg is part of a loop. compass_sigma_deg: of each sight, the same for both, for their plain mean.
    turn_deg: grid azimuth minus magnetic. declination_deg: true azimuth minus magnetic, there and then.
    """

    line: Line
    compass_deg: float | None
    back_deg: float | None
    clino_deg: float
    depth_from_m: float | None
    depth_to_m: float | None
    compass_sigma_deg: float
    by_clino: bool
    held: bool
    looped: bool
    turn_deg: float
    declination_deg: float
    distance_m: float
    remark: str
    off_deg: tuple[float, float] = (0.0, 0.0)
    scale: float = 1.0

    @property
    def leg(self) -> Leg:
        """The leg that was read."""
        return self.line.leg


def remark_on(leg: Leg) -> str:
    """Say who saw whom, how often, how well and when; the gauges as read; alarms."""
    words = [f"{leg.from_node}>{leg.to_node} n={leg.fixes} grade {leg.grade} {leg.moment:%H:%M:%S}"]
    if leg.depth_from_m is not UNSET and leg.depth_to_m is not UNSET:
        words.append(f"gauges {leg.depth_from_m:.2f} {leg.depth_to_m:.2f}")
    return " ".join(words + ["ALARM " + "; ".join(leg.alarms)] * bool(leg.alarms))


class Sheet:
    """An adjusted survey, ready to be written down."""

    def __init__(self, project: Project, adjusted: Adjusted, olds: Sequence[OldSurvey] = ()) -> None:
        self.project, self.adjusted = project, adjusted
        same_as = same_place(project, olds)

        def placed(shot: OldShot) -> bool:
            return shot.style != "distance" or {same_as(shot.start), same_as(shot.end)} <= set(adjusted.positions)

        def turned(shot: OldShot) -> OldShot:
            if shot.north != North("model"):
                return shot
            leg, start = leg_of(shot), adjusted.positions.get(same_as(shot.start))
            where = None if start is None else start.position_m
            turn_rad = adjusted.grid.leg_turn_rad(leg, leg_date(project, leg), where)
            return replace(shot, north=North("grid", math.degrees(turn_rad)))

        # Distances that are too few to place a station: no cave program takes it. What a file does not tell the north
        # of, nor the place for a magnetic model, has the angle that counts here.
        self.olds = [replace(old, shots=[turned(shot) for shot in old.shots if placed(shot)]) for old in olds]
        about = project.survey
        theirs = {station.partition(".")[0] for old in olds for station in old.stations}
        # A survey of the hierarchy has one name.
        self.name = re.sub(r"[^A-Za-z0-9_-]", "_", about.name) or "survey"
        self.name += f"_{OWN}" * (self.name in theirs)
        self.title = one_line(about.title or about.name)
        self.team = [one_line(person) for person in about.team]
        when = survey_date(project)
        # The stated date, or the first leg's; empty if there is none.
        self.date = when.strftime("%Y.%m.%d") if when else ""

    @property
    def north_known(self) -> bool:
        """Whether the declination is known."""
        return self.adjusted.grid.declination is not None

    @cached_property
    def why(self) -> str:
        """The origin of the angle to north, in words."""
        grid = self.adjusted.grid
        if grid.declination is None:
            return "declination not known: north is magnetic"
        readings, source = self.readings, one_line(grid.declination.source)
        if not readings:
            return f"declination: {source}"
        why = f"declination {_span([one.declination_deg for one in readings])} deg: {source}"
        if grid.projection is None:
            return why
        convergences = [one.declination_deg - one.turn_deg for one in readings]
        return f"{why}; with grid convergence of {_span(convergences)} deg, {self.grid_name}"

    @property
    def grid_name(self) -> str:
        """The map grid's name: a UTM zone, or a code of the EPSG registry; empty without one."""
        zone, projection = self.project.place.utm_zone, self.adjusted.grid.projection
        return f"UTM {zone}" if zone is not UNSET else f"EPSG:{projection.epsg}" if projection is not None else ""

    @property
    def grid_turn_deg(self) -> float | None:
        """The azimuth of the map grid's north where the survey is; None without a grid."""
        grid = self.adjusted.grid
        return None if grid.projection is None else math.degrees(grid.convergence_rad())

    @property
    def instruments(self) -> dict[str, str]:
        """The stated instruments; for tape and compass, if not stated, the nodes' own."""
        nodes = sorted({node for leg in self.project.leg for node in (leg.from_node, leg.to_node) if node})
        if not nodes:
            return dict(self.project.survey.instruments)
        ours = {
            "tape": f"Buddyline optical range, nodes {' and '.join(nodes)}",
            "compass": "Buddyline nodes' own, as foresight and backsight",
        }
        stated = self.project.survey.instruments
        return stated | {kind: text for kind, text in ours.items() if kind not in stated}

    @property
    def notes(self) -> list[str]:
        """The notes of the survey and of its stations, and every edit of a leg."""
        notes = [line for line in self.project.survey.notes.splitlines() if line.strip()]
        notes += [f"station {station.name}: {note}" for station in self.project.station for note in station.notes]
        for edit in self.project.edit:
            notes.append(f"leg {edit.leg}: {'' if edit.use else 'taken out; '}{edit.note}".rstrip("; "))
        return list(map(one_line, notes))

    @property
    def fixed(self) -> Fixed:
        """Fixed stations: positions and sigmas; an altitude by depths is the adjusted one."""
        fixed: Fixed = {}
        for name, (position_m, sigmas_m) in self.adjusted.survey.fixed.items():
            altitude_m = self.adjusted.positions[name].position_m[2] if name in self.adjusted.positions else 0.0
            by_depth = math.isnan(position_m[2])
            fixed[name] = (
                np.array([*position_m[:2], altitude_m if by_depth else position_m[2]]),
                np.array([*sigmas_m[:2], 0.0 if by_depth else sigmas_m[2]]),
            )
        return fixed

    @property
    def own_fixed(self) -> Fixed:
        """Fixed stations that no old survey has fixed, those of this survey's legs; by the names they have here."""
        if not self.olds:
            return self.fixed | self.held
        same_as = same_place(self.project, self.olds)
        theirs = {same_as(fix.station) for old in self.olds for fix in old.fixes}
        return {self.local(name): at for name, at in self.fixed.items() if name in self._own_stations - theirs}

    @cached_property
    def held(self) -> Fixed:
        """Stations that other programs, which place nothing by distances, must be told: as fixed, or as adjusted.

        Of each part that bearings join, if nothing else in the file fixes it: what the project fixes there, or the
        first station where there are several parts.
        """
        same_as, positions = same_place(self.project, self.olds), self.adjusted.positions
        part_of = merged((line.leg.from_, line.leg.to) for line in self.adjusted.lines)
        parts: dict[str, list[str]] = {}
        for name in positions:
            parts.setdefault(part_of(name), []).append(name)
        written = {same_as(fix.station) for old in self.olds for fix in old.fixes}
        written |= set(self.fixed) if not self.olds else set(self.fixed) & self._own_stations
        found: Fixed = {}
        for names in parts.values():
            if written.isdisjoint(names):
                stated = [name for name in names if self.project.fix and name in self.fixed]
                for name in stated or (names[:1] if len(parts) > 1 else []):
                    found[name] = self.fixed.get(name) or (positions[name].position_m, positions[name].sigmas_m)
        return found

    @staticmethod
    def local(name: str) -> str:
        """Return a station's name among this survey's own; a point stands before the names of old surveys."""
        return name.replace(".", "_")

    def renamed(self, reading: Reading) -> Reading:
        """Return a reading with stations' names of this survey."""
        leg = structs.replace(reading.leg, from_=self.local(reading.leg.from_), to=self.local(reading.leg.to))
        return replace(reading, line=replace(reading.line, leg=leg)) if self.olds else reading

    @property
    def joints(self) -> list[list[str]]:
        """Names of one place in this survey and in old ones, the latter with points."""
        ours = self._own_stations
        of_old = {name for old in self.olds for name in old.stations}
        stated = [[name for name in one.stations if name in ours | of_old] for one in self.project.equate]
        shared = [[name, self.local(name)] for name in sorted(ours) if "." in name and name in of_old]
        return [same for same in [*stated, *shared] if len(same) > 1 and self.olds]

    @cached_property
    def passages(self) -> list[list[CrossSection]]:
        """Cross-sections of stations, one after the other along consecutive legs."""
        known = {one.name: section for one in self.project.station if (section := section_of(one)) is not None}
        found: list[list[CrossSection]] = []
        for reading in self.readings:
            start, end = known.get(reading.leg.from_), known.get(reading.leg.to)
            if start is not None and (not found or found[-1][-1] is not start):
                found.append([start])
            if end is not None and start is None:
                found.append([])
            if end is not None:
                found[-1].append(end)
        return found

    @cached_property
    def undirected(self) -> list[Leg]:
        """The nodes' legs that took part and make no vector: they have no bearing, or no rise."""
        directed = {id(line.leg) for line in self.adjusted.lines}
        return [leg for leg, _ in self.adjusted.survey.stations_legs if leg.from_node and id(leg) not in directed]

    @cached_property
    def _own_stations(self) -> set[str]:
        own = [*(reading.leg for reading in self.readings), *self.undirected]
        return {name for leg in own for name in (leg.from_, leg.to)}

    @property
    def entrances(self) -> list[str]:
        """Fixed stations that are entrances."""
        return [fix.station for fix in self.project.fix if fix.entrance]

    @cached_property
    def readings(self) -> list[Reading]:
        """Every leg that took part, as it was weighed."""
        looped = {number for loop in self.adjusted.loops for number in loop.legs}
        numbers = {id(leg): number for number, leg in enumerate(self.adjusted.survey.legs)}
        return [
            self._reading(line, numbers[id(line.leg)], numbers[id(line.leg)] in looped)
            for line in self.adjusted.lines
            if line.leg.from_node
        ]

    def _reading(self, line: Line, number: int, looped: bool) -> Reading:
        leg, survey = line.leg, self.adjusted.survey
        bearing = bearing_of(leg, self.project)
        if bearing is None:
            raise ValueError(f"leg {leg.name} has no bearing")
        start, end = (self.adjusted.positions[name].position_m for name in (leg.from_, leg.to))
        held = self.project.adjust.depth == "absolute" and not line.by_clino
        level_m = survey.level_m
        depths: tuple[float | None, float | None] = (None, None)
        if not line.by_clino and leg.depth_from_m is not UNSET and leg.depth_to_m is not UNSET:
            own = leg.depth_from_m, leg.depth_from_m - line.rise_m
            depths = (level_m - float(start[2]), level_m - float(end[2])) if held else own
        both = bearing.fore is not None and bearing.back is not None
        azimuth_deg = math.degrees(line.measures.azimuth[0] - line.turn_rad)
        fore_deg, back_deg = (None if rad is None else math.degrees(rad) % 360 for rad in (bearing.fore, bearing.back))
        off_deg = tuple(
            0.0 if read is None else math.remainder(read - azimuth_deg - turn_deg, 360)
            for read, turn_deg in ((fore_deg, 0.0), (back_deg, 180.0))
        )
        sigma_deg = math.degrees(line.measures.azimuth[1]) * (math.sqrt(2) if both else 1.0)
        near = abs(off_deg[0] - off_deg[1]) < SEEN_SIGMAS * math.sqrt(2) * sigma_deg
        if both and near and number not in survey.carried:
            # Their mean is corrected; what the sights differ by stays to be seen.
            off_deg = (0.5 * (off_deg[0] + off_deg[1]),) * 2
        distance_m, remark, scale = leg.distance_m, remark_on(leg), line.measures.distance[0] / leg.distance_m
        if line.by_clino:
            # Distance, inclinations and depths together make one vector.
            distance_m, scale = line.length_m, 1.0
            remark = f"by clino, read {leg.distance_m:.3f} m; {remark}"
        return Reading(
            line=line,
            compass_deg=fore_deg,
            back_deg=back_deg,
            clino_deg=math.degrees(math.asin(max(-1.0, min(1.0, line.rise_m / (distance_m * scale))))),
            depth_from_m=depths[0],
            depth_to_m=depths[1],
            compass_sigma_deg=sigma_deg,
            by_clino=line.by_clino,
            held=held,
            looped=looped,
            distance_m=distance_m,
            remark=remark,
            turn_deg=math.degrees(line.turn_rad),
            declination_deg=math.degrees(self._declination_rad(leg)),
            off_deg=(off_deg[0], off_deg[1]),
            scale=scale,
        )

    def _declination_rad(self, leg: Leg) -> float:
        return self.adjusted.grid.declination_rad(
            leg_date(self.project, leg), self.adjusted.positions[leg.from_].position_m
        )


def _span(values: list[float]) -> str:
    """Write one number, or the least and the largest."""
    ends = list(dict.fromkeys(f"{value + 0.0:.2f}" for value in (min(values), max(values))))
    return " to ".join(ends)
