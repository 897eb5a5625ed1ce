"""Plain tables: legs and stations as CSV, the survey as GeoJSON."""

from __future__ import annotations

import csv
import io
import json
import math
from typing import Any

from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.heading import heading_of
from buddyline.tools.survey.network import Adjusted, Position
from buddyline.tools.survey.project import Leg, Project
from msgspec import UNSET, to_builtins

STATION_COLUMNS = (
    *("name", "kind", "east_m", "north_m", "up_m", "depth_m"),
    *("sigma_east_m", "sigma_north_m", "sigma_up_m"),
    *("ellipse_major_m", "ellipse_minor_m", "ellipse_azimuth_deg", "latitude_deg", "longitude_deg"),
)


def legs_csv(project: Project, adjusted: Adjusted) -> str:
    """Return every leg and point with all its readings, as text; `used` says whether it took part."""
    fields = [field for field in Leg.__struct_encode_fields__ if field not in ("unused", "alarms", "disturbed")]
    chi2 = {id(one.leg): one.chi2 for one in adjusted.residuals}
    left_out = {id(leg): why for leg, why in adjusted.left_out}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow([*fields, "disturbed", "alarms", "used", "why_not", "residual_chi2"])
    for leg in project.leg + project.point:
        row = to_builtins(leg)
        why = left_out.get(id(leg), "")
        value = chi2.get(id(leg))
        writer.writerow(
            [row.get(field, "") for field in fields]
            + [" ".join(leg.disturbed), "; ".join(leg.alarms), "no" if why else "yes", why]
            + ["" if value is None else f"{value:.2f}"]
        )
    return out.getvalue()


def stations_csv(project: Project, adjusted: Adjusted) -> str:
    """Return adjusted stations and points: metres, 1 sd, and the horizontal ellipse."""
    depths = {station.name: station.depth_m for station in project.station}
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(STATION_COLUMNS)
    for kind, position in _all(adjusted):
        major_m, minor_m, azimuth = position.ellipse
        depth_m = depths.get(position.name, UNSET)
        place = adjusted.grid.degrees(position.position_m)
        writer.writerow(
            [position.name, kind]
            + [f"{value:.3f}" for value in position.position_m]
            + ["" if depth_m is UNSET or kind == "point" else f"{depth_m:.3f}"]
            + [f"{math.sqrt(max(float(position.covariance[i, i]), 0.0)):.3f}" for i in range(3)]
            + [f"{major_m:.3f}", f"{minor_m:.3f}", f"{math.degrees(azimuth):.1f}"]
            + (["", ""] if place is None else [f"{place[0]:.8f}", f"{place[1]:.8f}"])
        )
    return out.getvalue()


def _all(adjusted: Adjusted) -> list[tuple[str, Position]]:
    stations = [("station", position) for position in adjusted.positions.values()]
    return stations + [("point", position) for position in adjusted.points]


def geojson(project: Project, adjusted: Adjusted) -> str:
    """Return stations, points and legs as GeoJSON (RFC 7946: WGS 84, longitude first, altitude third)."""
    if adjusted.grid.north == "magnetic":
        raise BuddylineError("a map needs a declination: give [place] in the project")
    features: list[dict[str, Any]] = []
    at: dict[str, list[float]] = {}
    for kind, position in _all(adjusted):
        place = adjusted.grid.degrees(position.position_m)
        if place is None:
            raise BuddylineError("a map needs a fixed point in degrees, or place.utm_zone: give them in the project")
        where = [round(place[1], 8), round(place[0], 8), round(float(position.position_m[2]), 3)]
        if kind == "station":
            at[position.name] = where
        major_m, minor_m, azimuth = position.ellipse
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": where},
                "properties": {
                    "name": position.name,
                    "kind": kind,
                    "ellipse_major_m": round(major_m, 3),
                    "ellipse_minor_m": round(minor_m, 3),
                    "ellipse_azimuth_deg": round(math.degrees(azimuth), 1),
                    "sigma_up_m": round(position.up_sigma_m, 3),
                },
            }
        )
    for line in adjusted.lines:
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": "LineString", "coordinates": [at[line.leg.from_], at[line.leg.to]]},
                "properties": {
                    "name": line.leg.name,
                    "kind": "leg",
                    "distance_m": line.leg.distance_m,
                    "grade": line.leg.grade,
                    "alarms": line.leg.alarms,
                },
            }
        )
    heading = heading_of(project, adjusted)
    return json.dumps(
        {
            "type": "FeatureCollection",
            "name": heading.name,
            "description": f"{heading.title}; {heading.date}; {heading.why}",
            "features": features,
        },
        indent=1,
        allow_nan=False,
    )
