"""What every export is written from: who, when and where, fixed stations, and the readings leg by leg."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.geodesy import declination, survey_date
from buddyline.tools.survey.lines import Line, bearing_of
from buddyline.tools.survey.network import Adjusted, fixed_points, held_depths
from buddyline.tools.survey.project import Leg, Project
from msgspec import UNSET


@dataclass(frozen=True)
class Reading:
    """One leg as surveyors write it: degrees, metres, depths positive down; None: not read. Sigmas: 1 sd.

    by_clino: the rise is the clinometers'; then there are no depths. held: its stations are held at their depths.
    looped: the leg is part of a loop. compass_sigma_deg: of each sight, the same for both, for their plain mean.
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

    @property
    def leg(self) -> Leg:
        """The leg that was read."""
        return self.line.leg

    @property
    def remark(self) -> str:
        """Who saw whom, how often, how well and when; the gauges as read; alarms."""
        leg = self.leg
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
        # The stated date, or the first leg's; empty where there is none.
        self.date = when.strftime("%Y.%m.%d") if when else ""

    @cached_property
    def angle_deg(self) -> float | None:
        """Grid azimuth minus magnetic; None where the declination is not known."""
        known = declination(self.project)
        return None if known is None else math.degrees(self.adjusted.grid.to_grid_rad)

    @property
    def why(self) -> str:
        """Where the angle to north comes from, in words."""
        known, angle_deg, zone = declination(self.project), self.angle_deg, self.adjusted.grid.zone
        if known is None or angle_deg is None:
            return "declination not known: north is magnetic"
        declination_deg = math.degrees(known.rad)
        why = f"declination {declination_deg:.2f} deg: {known.source}"
        return why + (f"; with grid convergence of {declination_deg - angle_deg:.2f} deg, UTM {zone}" if zone else "")

    @property
    def instruments(self) -> dict[str, str]:
        """The stated instruments, and ours where tape or compass are not stated."""
        nodes = sorted({node for leg in self.project.leg for node in (leg.from_node, leg.to_node)})
        ours = {
            "tape": f"Buddyline optical range, nodes {' and '.join(nodes)}",
            "compass": "Buddyline nodes' own, as foresight and backsight",
        }
        stated = self.project.survey.instruments
        return stated | {kind: text for kind, text in ours.items() if kind not in stated}

    @property
    def notes(self) -> list[str]:
        """The survey's notes, the stations', and every verdict on a leg."""
        notes = [line for line in self.project.survey.notes.splitlines() if line.strip()]
        notes += [f"station {station.name}: {note}" for station in self.project.station for note in station.notes]
        for edit in self.project.edit:
            notes.append(f"leg {edit.leg}: {'' if edit.use else 'taken out; '}{edit.note}".rstrip("; "))
        return notes

    @property
    def fixed(self) -> dict[str, tuple[Floats, float]]:
        """Fixed stations: position (3,) and sigma, m."""
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
        )
