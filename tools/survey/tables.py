"""Plain tables: legs and stations as CSV, the survey as GeoJSON, and the .dat file of Compass."""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterable
from datetime import UTC, date, datetime
from typing import Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.measure.tables import csv_lines
from buddyline.tools.survey.connected import station_depths
from buddyline.tools.survey.fit import detectable
from buddyline.tools.survey.geodesy import leg_date
from buddyline.tools.survey.observations import CHECKED, KINDS
from buddyline.tools.survey.old.model import CrossSection
from buddyline.tools.survey.project import Leg
from buddyline.tools.survey.sheet import Reading, Sheet
from buddyline.tools.survey.survex import corrected
from msgspec import to_builtins

# A station's columns and their digits after the point; empty if a value is not known.
STATION_DIGITS: Final = {
    "name": None,
    "kind": None,
    **dict.fromkeys(("east_m", "north_m", "up_m", "depth_m"), 3),
    **dict.fromkeys(("sigma_east_m", "sigma_north_m", "sigma_up_m"), 3),
    **{"ellipse_major_m": 3, "ellipse_minor_m": 3, "ellipse_azimuth_deg": 1, "latitude_deg": 8, "longitude_deg": 8},
}
# The columns that go on a map.
MAP_PROPERTIES: Final = ("name", "kind", "ellipse_major_m", "ellipse_minor_m", "ellipse_azimuth_deg", "sigma_up_m")

PATH_COLUMNS: Final = (
    *("dive", "node", "from", "to", "seen_from", "time"),
    *("east_m", "north_m", "up_m", "sigma_east_m", "sigma_north_m", "sigma_up_m"),
)

FOOT_M: Final = 0.3048
MISSING: Final = "-999.00"
NO_SIDE: Final = "-9.90"
# Bearings in degrees, lengths and passages in feet, inclinations in degrees; backsights present.
COMPASS_FORMAT: Final = "DDDDLUDRLADadBF"


def _csv(columns: Collection[str], rows: Iterable[dict[str, Any]]) -> str:
    return "".join(csv_lines(list(columns), ([row.get(name, "") for name in columns] for row in rows)))


def legs_csv(sheet: Sheet) -> str:
    """Return every leg and point with all its readings; `used` says whether it took part.

    detectable_m: the least error of its distance that its residual would show; empty where nothing checks it.
    """
    adjusted = sheet.adjusted
    errors_m, row_of = detectable(adjusted.solution), adjusted.solution.observations.rows
    least_m = {id(leg): float(errors_m[row_of[n, "distance"]]) for n, leg in enumerate(adjusted.survey.legs)}
    chi2 = {id(one.leg): one.chi2 for one in sheet.adjusted.residuals}
    left_out = {id(leg): why for leg, why in sheet.adjusted.left_out}
    rows = []
    for leg in sheet.project.leg + sheet.project.point:
        why, value = left_out.get(id(leg), ""), chi2.get(id(leg))
        row = to_builtins(leg) | {"disturbed": " ".join(leg.disturbed), "alarms": "; ".join(leg.alarms)}
        row |= {"used": "no" if why else "yes", "why_not": why}
        row["residual_chi2"] = "" if value is None else f"{value:.2f}"
        shown_m = least_m.get(id(leg), math.inf)
        rows.append(row | {"detectable_m": f"{shown_m:.3f}" if math.isfinite(shown_m) else ""})
    fields = [name for name in Leg.__struct_encode_fields__ if name not in ("unused", "alarms", "disturbed")]
    return _csv([*fields, "disturbed", "alarms", "used", "why_not", "residual_chi2", "detectable_m"], rows)


def residuals_csv(sheet: Sheet) -> str:
    """Return every observation's residual: what it is of, its value less the adjusted one, and how well it is checked.

    In metres and degrees, as the unit says; what is known of an instrument beforehand has none. redundancy: share of an
    error that shows; w: residual over its own sd, empty where nothing checks it.
    """
    solution = sheet.adjusted.solution
    of, model, r = solution.observations, solution.model, solution.redundancies
    rows = []
    for row, what in enumerate(of.what):
        leg = int(model.leg[row])
        angle = bool(model.is_angle[row])
        scale = math.degrees(1) if angle else 1.0
        sigma = scale * float(solution.weights[row]) ** -0.5
        residual = scale * float(solution.misfit[row])
        w = residual / (sigma * math.sqrt(r[row])) if r[row] > CHECKED else None
        rows.append(
            {
                "leg": sheet.adjusted.survey.legs[leg].name if leg >= 0 else "",
                "observation": what,
                "unit": "deg" if angle else "m" if leg >= 0 or model.kind[row] != KINDS["number"] else "",
                "residual": f"{residual:z.4f}",
                "sigma": f"{sigma:.4f}",
                "redundancy": f"{r[row]:.3f}",
                "w": "" if w is None else f"{w:z.2f}",
            }
        )
    return _csv(("leg", "observation", "unit", "residual", "sigma", "redundancy", "w"), rows)


def _station_rows(sheet: Sheet) -> list[dict[str, Any]]:
    """Return adjusted stations and points with the columns of STATION_DIGITS; None: not known."""
    depths = station_depths(sheet.project)
    rows = []
    stations = [("station", position) for position in sheet.adjusted.positions.values()]
    for kind, position in [*stations, *(("point", position) for position in sheet.adjusted.points)]:
        major_m, minor_m, azimuth = position.ellipse
        values = [position.name, kind, *position.position_m.tolist()]
        values += [depths.get(position.name) if kind == "station" else None, *position.sigmas_m.tolist()]
        values += [major_m, minor_m, math.degrees(azimuth)]
        values += sheet.adjusted.grid.degrees(position.position_m) or (None, None)
        rows.append(dict(zip(STATION_DIGITS, values, strict=True)))
    return rows


def stations_csv(sheet: Sheet) -> str:
    """Return adjusted stations and points: metres, 1 sd, and the horizontal ellipse."""

    def text(value: Any, digits: int | None) -> str:
        return "" if value is None else str(value) if digits is None else f"{value:z.{digits}f}"

    rows = _station_rows(sheet)
    return _csv(
        STATION_DIGITS, ({name: text(row[name], digits) for name, digits in STATION_DIGITS.items()} for row in rows)
    )


def paths_csv(sheet: Sheet) -> str:
    """Return the ways that were swum, place by place: metres, 1 sd of each axis, and the time in UTC."""
    rows = []
    for path in sheet.adjusted.paths:
        swim = path.swim
        sigmas_m = np.sqrt(path.covariance[:, range(3), range(3)])
        for seconds, place_m, sigma_m in zip(path.seconds.tolist(), path.position_m, sigmas_m, strict=True):
            when = datetime.fromtimestamp(swim.start_ns / S_NS + seconds, UTC).isoformat(timespec="milliseconds")
            known = [f"{value:z.3f}" for value in (*place_m, *sigma_m)]
            rows.append([swim.dive, swim.node, swim.from_, swim.to, swim.station, when, *known])
    return "".join(csv_lines(PATH_COLUMNS, rows))


def map_features(sheet: Sheet) -> list[dict[str, Any]]:
    """Return stations, points and legs as features of GeoJSON: WGS 84, longitude first, altitude third."""
    if not sheet.north_known:
        raise BuddylineError("a map needs a declination: give [place] in the project")
    features: list[dict[str, Any]] = []
    at: dict[str, list[float]] = {}

    def add(kind: str, coordinates: object, properties: dict[str, Any]) -> None:
        geometry = {"type": kind, "coordinates": coordinates}
        features.append({"type": "Feature", "geometry": geometry, "properties": properties})

    for row in _station_rows(sheet):
        if row["latitude_deg"] is None:
            raise BuddylineError(
                "a map needs a fixed point in degrees, or place.utm_zone or epsg: give them in the project"
            )
        where = [round(row["longitude_deg"], 8), round(row["latitude_deg"], 8), round(row["up_m"], 3)]
        if row["kind"] == "station":
            at[row["name"]] = where
        digits = {name: STATION_DIGITS[name] for name in MAP_PROPERTIES}
        add("Point", where, {name: row[name] if n is None else round(row[name], n) for name, n in digits.items()})
    for leg, names in sheet.adjusted.survey.stations_legs:
        properties = {"name": leg.name, "kind": "leg", "distance_m": leg.distance_m, "grade": leg.grade}
        add("LineString", _unbroken([at[name] for name in names]), properties | {"alarms": leg.alarms})
    for path in sheet.adjusted.paths:
        for part_m in path.parts:
            degrees = [sheet.adjusted.grid.degrees(place_m) or (0.0, 0.0) for place_m in part_m]
            heights_m = part_m[:, 2].tolist()
            line = [[round(e, 8), round(n, 8), round(z, 3)] for (n, e), z in zip(degrees, heights_m, strict=True)]
            add("LineString", _unbroken(line), {"name": path.swim.name, "kind": "path"})
    return features


def _unbroken(line: list[list[float]]) -> list[list[float]]:
    """Return a line's places with longitudes beyond 180 degrees where it crosses that meridian: no map goes about."""
    first_deg = line[0][0]
    return [[round(first_deg + math.remainder(e_deg - first_deg, 360), 8), *rest] for e_deg, *rest in line]


def geojson(sheet: Sheet) -> str:
    """Return stations, points and legs as GeoJSON (RFC 7946)."""
    features = map_features(sheet)
    description = f"{sheet.title}; {sheet.date}; {sheet.why}"
    collection = {"type": "FeatureCollection", "name": sheet.name, "description": description, "features": features}
    return json.dumps(collection, indent=1, allow_nan=False)


def compass_dat(sheet: Sheet) -> str:
    """Return .dat text: feet and degrees; raise BuddylineError without declination, which it must state."""
    if not sheet.north_known:
        raise BuddylineError("Compass files must state a declination, and it is not known: give [place] in the project")
    sections: dict[tuple[date, str], list[Reading]] = {}
    for reading in sheet.readings:
        key = leg_date(sheet.project, reading.leg), f"{reading.turn_deg + 0.0:7.2f}"
        sections.setdefault(key, []).append(reading)
    return "".join(_compass_section(sheet, *key, readings) for key, readings in sections.items())


def _compass_sides(section: CrossSection) -> str:
    """Return left, up, down and right in feet."""
    left_m, right_m, up_m, down_m = section.sides_m
    return " ".join(NO_SIDE if one is None else f"{one / FOOT_M:.2f}" for one in (left_m, up_m, down_m, right_m))


def _compass_section(sheet: Sheet, when: date, turn_deg: str, readings: list[Reading]) -> str:
    """Return the legs of one date and one declination."""
    comment = f"{sheet.title}; {sheet.why}".replace("\n", " ")[:76]
    rows = [
        sheet.name,
        f"SURVEY NAME: {sheet.name[:12]}",
        f"SURVEY DATE: {when.month} {when.day} {when.year}  COMMENT:{comment}",
        "SURVEY TEAM:",
        ", ".join(sheet.team),
        f"DECLINATION: {turn_deg}  FORMAT: {COMPASS_FORMAT}  CORRECTIONS:  0.00 0.00 0.00",
        "",
        "FROM TO LENGTH BEARING INC LEFT UP DOWN RIGHT AZM2 INC2 FLAGS COMMENTS",
        "",
    ]
    sides = {one.station: _compass_sides(one) for sections in sheet.passages for one in sections}
    # The format has no corrections of a single leg.
    for reading in map(corrected, readings):
        leg, fore_deg, back_deg, remark = reading.leg, reading.compass_deg, reading.back_deg, reading.remark
        if fore_deg is None and back_deg is not None:
            # The format has no leg without a bearing.
            fore_deg, remark = (back_deg + 180) % 360, f"bearing by backsight; {remark}"
        fore, back = (MISSING if angle is None else f"{angle:.2f}" for angle in (fore_deg, back_deg))
        rows.append(
            f"{leg.from_:>12} {leg.to:>12} {reading.distance_m / FOOT_M:.3f} {fore} {reading.clino_deg:.3f} "
            f"{sides.get(leg.from_, ' '.join([NO_SIDE] * 4))} {back} {MISSING} {remark}"
        )
    return "\r\n".join(rows) + "\r\n\f\r\n"
