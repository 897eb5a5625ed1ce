"""The common content of all exports: who, when and where, fixed stations, and each leg's readings."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from buddyline.tools.survey.geodesy import leg_date, survey_date
from buddyline.tools.survey.lines import Line, bearing_of
from buddyline.tools.survey.network import Adjusted, Fixed, fixed_points, held_depths
from buddyline.tools.survey.project import Leg, Project
from msgspec import UNSET


@dataclass(frozen=True)
class Reading:
    """One leg as surveyors write it: degrees, metres, depths positive down; None: not read. Sigmas: 1 sd.

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

    def __init__(self, project: Project, adjusted: Adjusted) -> None:
        self.project, self.adjusted = project, adjusted
        about = project.survey
        self.name = about.name
        self.title = about.title or about.name
        self.team = about.team
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
        readings = self.readings
        why = f"declination {_span([one.declination_deg for one in readings])} deg: {grid.declination.source}"
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
    def instruments(self) -> dict[str, str]:
        """The stated instruments; for tape and compass, if not stated, the nodes' own."""
        nodes = sorted({node for leg in self.project.leg for node in (leg.from_node, leg.to_node)})
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
        return notes

    @property
    def fixed(self) -> Fixed:
        """Fixed stations: positions and sigmas."""
        return fixed_points(self.project, self.adjusted.grid)

    @property
    def entrances(self) -> list[str]:
        """Fixed stations that are entrances."""
        return [fix.station for fix in self.project.fix if fix.entrance]

    @cached_property
    def readings(self) -> list[Reading]:
        """Every leg that took part, as it was weighed."""
        depths = held_depths(self.project)
        looped = {id(one.leg) for one in self.adjusted.residuals if one.chi2 is not None}
        return [self._reading(line, depths, id(line.leg) in looped) for line in self.adjusted.lines]

    def _reading(self, line: Line, depths: dict[str, float], looped: bool) -> Reading:
        leg = line.leg
        bearing = bearing_of(leg, self.project)
        if bearing is None:
            raise ValueError(f"leg {leg.name} has no bearing")
        held = leg.from_ in depths and leg.to in depths
        own = (depths[leg.from_], depths[leg.to]) if held else (leg.depth_from_m, leg.depth_to_m)
        from_m, to_m = (None if line.by_clino or depth_m is UNSET else depth_m for depth_m in own)
        both = bearing.fore is not None and bearing.back is not None
        fore_deg, back_deg = (None if rad is None else math.degrees(rad) % 360 for rad in (bearing.fore, bearing.back))
        return Reading(
            line=line,
            compass_deg=fore_deg,
            back_deg=back_deg,
            clino_deg=math.degrees(math.asin(max(-1.0, min(1.0, line.rise_m / leg.distance_m)))),
            depth_from_m=from_m,
            depth_to_m=to_m,
            compass_sigma_deg=math.degrees(bearing.sigma) * (math.sqrt(2) if both else 1.0),
            by_clino=line.by_clino,
            held=held and not line.by_clino,
            looped=looped,
            distance_m=leg.distance_m,
            remark=remark_on(leg),
            turn_deg=math.degrees(line.turn_rad),
            declination_deg=math.degrees(self._declination_rad(leg)),
        )

    def _declination_rad(self, leg: Leg) -> float:
        return self.adjusted.grid.declination_rad(
            leg_date(self.project, leg), self.adjusted.positions[leg.from_].position_m
        )


def _span(values: list[float]) -> str:
    """Write one number, or the least and the largest."""
    ends = list(dict.fromkeys(f"{value + 0.0:.2f}" for value in (min(values), max(values)))) if values else ["0.00"]
    return " to ".join(ends)
