"""What heads every export: names, people, instruments, the angle to north and where it comes from."""

from __future__ import annotations

import math
from dataclasses import dataclass

from buddyline.tools.survey.geodesy import declination, survey_date
from buddyline.tools.survey.lines import Line, bearing_of
from buddyline.tools.survey.network import Adjusted
from buddyline.tools.survey.project import Project
from msgspec import UNSET


@dataclass(frozen=True)
class Heading:
    """angle_deg: grid azimuth minus magnetic, None where the declination is not known; why: in words."""

    name: str
    title: str
    date: str
    team: list[str]
    instruments: dict[str, str]
    notes: list[str]
    angle_deg: float | None
    why: str


def heading_of(project: Project, adjusted: Adjusted) -> Heading:
    """Return the heading; a survey that has no date of its own has its first leg's."""
    about = project.survey
    known = declination(project)
    if known is None:
        angle_deg, why = None, "declination not known: north is magnetic"
    else:
        angle_deg = math.degrees(adjusted.grid.to_grid_rad)
        why = f"declination {math.degrees(known.rad):.2f} deg: {known.source}"
        if adjusted.grid.zone is not None:
            why += f"; with grid convergence of {math.degrees(known.rad) - angle_deg:.2f} deg, UTM {adjusted.grid.zone}"
    when = survey_date(project)
    nodes = sorted({leg.from_node for leg in project.leg} | {leg.to_node for leg in project.leg})
    instruments = dict(about.instruments)
    instruments.setdefault("tape", f"Buddyline optical range, nodes {' and '.join(nodes)}")
    instruments.setdefault("compass", "Buddyline nodes' own, as foresight and backsight")
    notes = [line for line in about.notes.splitlines() if line.strip()]
    for station in project.station:
        notes += [f"station {station.name}: {note}" for note in station.notes]
    for edit in project.edit:
        notes.append(f"leg {edit.leg}: {'' if edit.use else 'taken out; '}{edit.note}".rstrip("; "))
    return Heading(
        about.name,
        about.title or about.name,
        when.strftime("%Y.%m.%d") if when else "",
        about.team,
        instruments,
        notes,
        angle_deg,
        why,
    )


@dataclass(frozen=True)
class Reading:
    """One leg as surveyors write it: degrees, metres, depths positive down; None: not read. sigmas: 1 sd.

    compass_sigma_deg: of each sight, alike for both, as their plain mean wants them.
    """

    tape_m: float
    compass_deg: float | None
    back_deg: float | None
    clino_deg: float
    depth_from_m: float | None
    depth_to_m: float | None
    tape_sigma_m: float
    compass_sigma_deg: float
    rise_sigma_m: float
    remark: str


def reading_of(line: Line, project: Project, depths_m: dict[str, float]) -> Reading:
    """Return a leg's readings as they are weighed; depths_m: stations held at these depths.

    A steep leg, and one without depths, has clino_deg by the clinometers and no depths.
    """
    leg = line.leg
    bearing = bearing_of(leg, project)
    if bearing is None:
        raise ValueError(f"leg {leg.name} has no bearing")
    held = leg.from_ in depths_m and leg.to in depths_m
    own = [None if d is UNSET else d for d in (leg.depth_from_m, leg.depth_to_m)]
    depths = [depths_m[leg.from_], depths_m[leg.to]] if held else own
    both = bearing.fore is not None and bearing.back is not None
    remark = f"{leg.from_node}>{leg.to_node} n={leg.fixes} grade {leg.grade} {leg.moment:%H:%M:%S}"
    if None not in own:
        remark += f" gauges {own[0]:.2f} {own[1]:.2f}"
    if leg.alarms:
        remark += " ALARM " + "; ".join(leg.alarms)
    return Reading(
        tape_m=leg.distance_m,
        compass_deg=_degrees(bearing.fore),
        back_deg=_degrees(bearing.back),
        clino_deg=math.degrees(math.asin(max(-1.0, min(1.0, line.rise_m / leg.distance_m)))),
        depth_from_m=None if line.by_clino else depths[0],
        depth_to_m=None if line.by_clino else depths[1],
        tape_sigma_m=line.distance_sigma_m,
        compass_sigma_deg=math.degrees(bearing.sigma) * (math.sqrt(2) if both else 1.0),
        rise_sigma_m=line.rise_sigma_m,
        remark=remark,
    )


def _degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad) % 360
