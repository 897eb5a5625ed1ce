"""Maps and models of a survey for other programs: KML, DXF, GeoPackage, and what photogrammetry scales itself by."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator, Sequence
from contextlib import closing
from itertools import pairwise
from typing import Final, TypeAlias
from xml.etree import ElementTree

import numpy as np
from buddyline.tools.measure.tables import csv_lines
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.geodesy import leg_date
from buddyline.tools.survey.old.joining import leg_of, same_place
from buddyline.tools.survey.placing import step_m_of
from buddyline.tools.survey.sheet import Sheet
from buddyline.tools.survey.tables import map_features

# Name, kind, and places (n, 3): one of a station or point, more of a leg, splay or path.
Feature: TypeAlias = tuple[str, str, Floats]

# "GPKG", and the version of the standard that is kept, 1.3.
GPKG_ID: Final = 0x47504B47
GPKG_VERSION: Final = 10300
WGS_84: Final = 4326
# Well-known binary's types of a point and of a line with heights.
POINT_Z, LINE_Z = 1001, 1002
# The layers of a drawing and their colours, by AutoCAD's numbers.
LAYERS: Final = {"station": 7, "point": 3, "leg": 5, "splay": 8, "path": 4}
TEXT_M: Final = 0.2


def features_of(sheet: Sheet) -> Iterator[Feature]:
    """Yield stations, points, legs, paths and splays in the grid, metres."""
    adjusted = sheet.adjusted
    for kind, found in (("station", list(adjusted.positions.values())), ("point", adjusted.points)):
        for position in found:
            yield position.name, kind, position.position_m[None]
    for leg, names in adjusted.survey.stations_legs:
        yield leg.name, "leg", np.array([adjusted.positions[name].position_m for name in names])
    for path in adjusted.paths:
        yield from ((path.swim.name, "path", part_m) for part_m in path.parts)
    same_as = same_place(sheet.project, sheet.olds)
    for shot in (shot for old in sheet.olds for shot in old.shots if shot.start and not shot.end):
        start = adjusted.positions.get(same_as(shot.start))
        if start is None or shot.style in ("nosurvey", "distance"):
            continue
        leg = leg_of(shot)
        turn_rad = adjusted.grid.leg_turn_rad(leg, leg_date(sheet.project, leg), start.position_m)
        away_m = step_m_of(leg, turn_rad)
        if away_m is None:
            continue
        yield f"{start.name}-", "splay", np.array([start.position_m, start.position_m + away_m])


def kml(sheet: Sheet) -> str:
    """Return stations, points and legs as KML (OGC 2.3); raise BuddylineError without a place on the Earth."""
    root = ElementTree.Element("kml", xmlns="http://www.opengis.net/kml/2.2")
    document = ElementTree.SubElement(root, "Document")
    ElementTree.SubElement(document, "name").text = sheet.title
    ElementTree.SubElement(document, "description").text = sheet.why
    for feature in map_features(sheet):
        placemark = ElementTree.SubElement(document, "Placemark")
        ElementTree.SubElement(placemark, "name").text = feature["properties"]["name"]
        ElementTree.SubElement(placemark, "description").text = feature["properties"]["kind"]
        kind, places = feature["geometry"]["type"], feature["geometry"]["coordinates"]
        shape = ElementTree.SubElement(placemark, kind)
        ElementTree.SubElement(shape, "altitudeMode").text = "absolute"
        row = [places] if kind == "Point" else places
        ElementTree.SubElement(shape, "coordinates").text = " ".join(",".join(map(repr, place)) for place in row)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True) + "\n"


def dxf(sheet: Sheet) -> str:
    """Return a drawing in three dimensions, metres of the grid, of the exchange format's release 12, a layer a kind."""
    layers = [
        [(0, "LAYER"), (2, name.upper()), (70, 0), (62, colour), (6, "CONTINUOUS")] for name, colour in LAYERS.items()
    ]
    codes: list[tuple[int, object]] = [(0, "SECTION"), (2, "HEADER"), (9, "$ACADVER"), (1, "AC1009"), (0, "ENDSEC")]
    codes += [(0, "SECTION"), (2, "TABLES"), (0, "TABLE"), (2, "LAYER"), (70, len(layers))]
    codes += [code for layer in layers for code in layer]
    codes += [(0, "ENDTAB"), (0, "ENDSEC"), (0, "SECTION"), (2, "ENTITIES")]
    for name, kind, places_m in features_of(sheet):
        layer, first = (8, kind.upper()), places_m[0].tolist()
        for start, end in pairwise(places_m.tolist()):
            codes += [(0, "LINE"), layer, *_xyz(10, start), *_xyz(11, end)]
        if len(places_m) == 1:
            codes += [(0, "POINT"), layer, *_xyz(10, first)]
            # Release 12 has no other letters than these.
            said = name.encode("ascii", "replace").decode()
            codes += [(0, "TEXT"), layer, *_xyz(10, first), (40, TEXT_M), (1, said)]
    codes += [(0, "ENDSEC"), (0, "EOF")]
    return "".join(f"{code:3d}\n{value}\n" for code, value in codes)


def _xyz(code: int, place_m: Sequence[float]) -> list[tuple[int, object]]:
    return [(code + 10 * axis, f"{value:z.4f}") for axis, value in enumerate(place_m)]


def geopackage(sheet: Sheet) -> bytes:
    """Return a GeoPackage (OGC 12-128) of two layers, stations and lines, in the map grid, or in WGS 84 without one."""
    projection = sheet.adjusted.grid.projection
    if projection is not None:
        features = list(features_of(sheet))
        code = projection.epsg
    else:
        code = WGS_84
        features = [
            (one["properties"]["name"], one["properties"]["kind"], np.atleast_2d(one["geometry"]["coordinates"]))
            for one in map_features(sheet)
        ]
    with closing(sqlite3.connect(":memory:")) as base:
        base.executescript(_GPKG_TABLES)
        systems = [(-1, "NONE", "undefined"), (0, "NONE", "undefined")]
        systems += [(one, "EPSG", _wkt(one)) for one in dict.fromkeys((WGS_84, code))]
        listed = [
            (f"{organization}:{number}", number, organization, number, wkt) for number, organization, wkt in systems
        ]
        base.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", listed)
        points = [one for one in features if len(one[2]) == 1]
        lines = [one for one in features if len(one[2]) > 1]
        for table, shape, own in (("stations", "POINT", points), ("lines", "LINESTRING", lines)):
            every = _all(own)[:, :2]
            bounds = [*every.min(axis=0).tolist(), *every.max(axis=0).tolist()]
            base.execute(f"CREATE TABLE {table} (id INTEGER PRIMARY KEY, geom {shape}, name TEXT, kind TEXT)")
            base.execute(
                "INSERT INTO gpkg_contents VALUES (?, 'features', ?, ?, '1970-01-01T00:00:00.000Z', ?, ?, ?, ?, ?)",
                (table, table, sheet.title, *bounds, code),
            )
            base.execute("INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 1, 0)", (table, shape, code))
            rows = [(_geometry(places, code), name, kind) for name, kind, places in own]
            base.executemany(f"INSERT INTO {table} (geom, name, kind) VALUES (?, ?, ?)", rows)
        base.commit()
        return base.serialize()


def _all(features: Sequence[Feature]) -> Floats:
    """Return all places (n, 3) of features; one of zeros if there is none."""
    return np.concatenate([places for _, _, places in features]) if features else np.zeros((1, 3))


def _geometry(places: Floats, code: int) -> bytes:
    """Return a geometry as GeoPackages have it: a short header, and well-known binary, little-endian."""
    head = struct.pack("<2sBBi", b"GP", 0, 1, code)
    if len(places) == 1:
        return head + struct.pack("<BI3d", 1, POINT_Z, *places[0].tolist())
    return head + struct.pack("<BII", 1, LINE_Z, len(places)) + np.asarray(places, dtype="<f8").tobytes()


def _wkt(code: int) -> str:
    from pyproj import CRS

    return CRS.from_epsg(code).to_wkt("WKT1_GDAL")


_GPKG_TABLES: Final = f"""
PRAGMA application_id = {GPKG_ID};
PRAGMA user_version = {GPKG_VERSION};
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY, organization TEXT NOT NULL,
  organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL, min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
  srs_id INTEGER REFERENCES gpkg_spatial_ref_sys(srs_id));
CREATE TABLE gpkg_geometry_columns (table_name TEXT PRIMARY KEY REFERENCES gpkg_contents(table_name),
  column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL,
  srs_id INTEGER NOT NULL REFERENCES gpkg_spatial_ref_sys(srs_id), z TINYINT NOT NULL, m TINYINT NOT NULL);
"""


def control_csv(sheet: Sheet) -> str:
    """Return stations and points as control points of photogrammetry: places and 1 sd, m, as Metashape reads them."""
    rows = [
        [one.name, *(f"{value:z.4f}" for value in (*one.position_m, *np.maximum(one.sigmas_m, 1e-4)))]
        for one in [*sheet.adjusted.positions.values(), *sheet.adjusted.points]
    ]
    return "".join(csv_lines(("label", "x_m", "y_m", "z_m", "accuracy_x_m", "accuracy_y_m", "accuracy_z_m"), rows))


def scale_bars_csv(sheet: Sheet) -> str:
    """Return legs as scale bars: measured distances, what the instruments are off taken off, and 1 sd, m."""
    survey, solution = sheet.adjusted.survey, sheet.adjusted.solution
    rows = []
    for number, (leg, (start, end)) in enumerate(zip(survey.legs, survey.ends, strict=True)):
        if " " not in end:
            scale = 1 + solution.correction(number, "distance") if leg.from_node else 1.0
            rows.append([start, end, f"{leg.distance_m / scale:.4f}", f"{leg.distance_sigma_m:.4f}"])
    return "".join(csv_lines(("label_a", "label_b", "distance_m", "accuracy_m"), rows))
