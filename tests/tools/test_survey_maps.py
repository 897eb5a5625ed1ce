"""Maps for other programs: KML, DXF, GeoPackage, and what photogrammetry takes."""

import csv
import io
import sqlite3
import struct
from datetime import date
from xml.etree import ElementTree

import numpy as np
import pytest
from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey import maps
from buddyline.tools.survey.geodesy import radii_m
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.old.joining import joined, named
from buddyline.tools.survey.old.readers import read_old
from buddyline.tools.survey.project import DiveFiles, Equate, FixedPoint, Place
from buddyline.tools.survey.sheet import Sheet
from buddyline.tools.survey.tables import map_features, stations_csv

from tests.tools import survey_world as world

WHERE = {"latitude_deg": 45.5, "longitude_deg": 9.2}
OLD = "*data normal from to tape compass clino\n1 2 10.0 90 0\n*flags splay\n2 .. 3.0 0 45\n"


def sheet_of(tmp_path, **place):
    """A loop of fourteen legs on a grid, with an old survey of a leg and a splay hung on it."""
    course = world.loop(np.random.default_rng(1), 14)
    rows = world.readings_of(course, np.random.default_rng(1))
    (tmp_path / "old.svx").write_text(OLD)
    old = named(read_old(tmp_path / "old.svx"), "old")
    project = world.project_of(
        rows,
        place=Place(declination_deg=3.65, water_level_m=97.0, **WHERE, **place),
        fix=[FixedPoint(station="0", **WHERE, entrance=True)],
        equate=[Equate(stations=["3", "old.1"])],
    )
    project = joined(project, [old])
    return Sheet(project, adjust(project), [old])


def test_kml_has_every_station_and_leg_where_it_is(tmp_path):
    sheet = sheet_of(tmp_path, utm_zone="32N")
    root = ElementTree.fromstring(maps.kml(sheet))
    space = {"k": "http://www.opengis.net/kml/2.2"}
    points = {
        place.findtext("k:name", namespaces=space): place.findtext("k:Point/k:coordinates", namespaces=space)
        for place in root.iterfind(".//k:Placemark", space)
        if place.find("k:Point", space) is not None
    }
    assert set(points) == set(sheet.adjusted.positions)
    longitude, latitude, altitude = map(float, points["0"].split(","))
    assert (longitude, latitude) == pytest.approx((9.2, 45.5), abs=1e-7)
    assert altitude == pytest.approx(sheet.adjusted.positions["0"].position_m[2], abs=1e-3)
    lines = root.findall(".//k:LineString/k:coordinates", space)
    assert len(lines) == 15
    assert all(len(line.text.split()) == 2 for line in lines)


@pytest.mark.parametrize("grid", [{"utm_zone": "32N"}, {"epsg": 2154}, {}])
def test_without_a_fixed_point_a_survey_is_at_the_project_s_place(grid):
    """There count the declination and the grid's north, not where the grid has its zero."""
    legs = world.readings_of(world.line(np.random.default_rng(1), 3), np.random.default_rng(1))
    where = {"latitude_deg": 46.0, "longitude_deg": 11.5}
    fix = FixedPoint(station="0", **where)
    free, fixed = (
        Sheet(project, adjust(project))
        for project in (
            world.project_of(legs, place=Place(**where, **grid)),
            world.project_of(legs, place=Place(**where, **grid), fix=[fix]),
        )
    )
    for name, position in fixed.adjusted.positions.items():
        assert free.adjusted.positions[name].position_m == pytest.approx(position.position_m, abs=1e-6)
    assert free.why == fixed.why
    assert stations_csv(free) == stations_csv(fixed)


def test_a_fixed_point_far_from_the_place_is_refused():
    legs = world.readings_of(world.line(np.random.default_rng(1), 3), np.random.default_rng(1))
    place = Place(latitude_deg=46.0, longitude_deg=11.5, utm_zone="32N")
    exchanged = FixedPoint(station="0", east_m=5098000.0, north_m=693000.0)
    with pytest.raises(ConfigError, match=r"fix of '0': east_m = .* km from \[place\]"):
        adjust(world.project_of(legs, place=place, fix=[exchanged]))
    right = FixedPoint(station="0", east_m=693000.0, north_m=5098000.0)
    assert adjust(world.project_of(legs, place=place, fix=[right])).positions


def test_a_declination_beyond_the_models_is_said_to_be_extrapolated():
    legs = world.readings_of(world.line(np.random.default_rng(1), 3), np.random.default_rng(1))
    for year, said in ((1987, True), (2009, True), (2010, False), (2029, False), (2030, True)):
        project = world.project_of(
            legs, place=Place(**WHERE), dive=[DiveFiles(logs=["a.mcap"], date=date(year, 12, 31))]
        )
        assert ("extrapolated: the models are of 2010 to 2029" in Sheet(project, adjust(project)).why) == said


def test_a_survey_may_cross_the_meridian_where_180_and_minus_180_degrees_meet():
    course = world.loop(np.random.default_rng(1), 14)
    legs = world.readings_of(course, np.random.default_rng(1))
    east_m = (course.stations_m[7] - course.stations_m[0])[1]
    # At the equator: metres a degree of longitude.
    per_deg_m = np.radians(radii_m(0.0)[0])
    first_deg = np.copysign(180, east_m) - 0.5 * east_m / per_deg_m
    last_deg = first_deg + east_m / per_deg_m
    north_m = (course.stations_m[7] - course.stations_m[0])[0]
    fixes = [
        FixedPoint(station="0", latitude_deg=0.0, longitude_deg=float(first_deg), sigma_m=0.5),
        FixedPoint(
            station="7",
            latitude_deg=float(np.degrees(north_m / radii_m(0.0)[1])),
            longitude_deg=float(np.remainder(last_deg + 180, 360) - 180),
            sigma_m=0.5,
        ),
    ]
    assert fixes[0].longitude_deg * fixes[1].longitude_deg < 0
    project = world.project_of(legs, place=Place(declination_deg=0.0), fix=fixes)
    sheet = Sheet(project, adjust(project))
    assert sheet.adjusted.fit.factor < 2
    rows = list(csv.DictReader(io.StringIO(stations_csv(sheet))))
    longitudes_deg = [float(row["longitude_deg"]) for row in rows]
    assert min(longitudes_deg) < -179
    assert max(longitudes_deg) > 179
    for one in map_features(sheet):
        if one["geometry"]["type"] == "LineString":
            (start_deg, *_), (end_deg, *_) = one["geometry"]["coordinates"]
            assert abs(end_deg - start_deg) < 0.001


def test_a_map_of_nowhere_is_refused(tmp_path):
    course = world.line(np.random.default_rng(1), 3)
    project = world.project_of(world.readings_of(course, np.random.default_rng(1)))
    with pytest.raises(BuddylineError, match="declination"):
        maps.kml(Sheet(project, adjust(project)))
    # A drawing needs none.
    assert "AC1009" in maps.dxf(Sheet(project, adjust(project)))


def test_dxf_has_legs_splays_and_names_in_layers(tmp_path):
    sheet = sheet_of(tmp_path, utm_zone="32N")
    lines = maps.dxf(sheet).splitlines()
    codes = list(zip(map(int, lines[::2]), lines[1::2], strict=True))
    assert codes[-1] == (0, "EOF")
    entities = []
    for code, value in codes[codes.index((2, "ENTITIES")) + 1 :]:
        if code == 0:
            entities.append({"kind": value})
        elif entities:
            entities[-1][code] = value
    of_kind = {kind: [one for one in entities if one["kind"] == kind] for kind in ("LINE", "POINT", "TEXT")}
    assert len([one for one in of_kind["LINE"] if one[8] == "LEG"]) == 15
    (splay,) = [one for one in of_kind["LINE"] if one[8] == "SPLAY"]
    away_m = [float(splay[11 + k]) - float(splay[10 + k]) for k in (0, 10, 20)]
    assert np.allclose(away_m, [0.0, 3 * np.sqrt(0.5), 3 * np.sqrt(0.5)], atol=1e-3)
    assert {one[1] for one in of_kind["TEXT"]} == set(sheet.adjusted.positions)
    start = sheet.adjusted.positions["0"].position_m
    found = next(one for one in of_kind["TEXT"] if one[1] == "0")
    assert [float(found[code]) for code in (10, 20, 30)] == pytest.approx(start.tolist(), abs=1e-4)


@pytest.mark.parametrize(("grid", "code"), [({"utm_zone": "32N"}, 32632), ({"epsg": 3035}, 3035), ({}, 4326)])
def test_a_geopackage_is_in_the_grid_s_own_system(tmp_path, grid, code):
    sheet = sheet_of(tmp_path, **grid)
    (tmp_path / "a.gpkg").write_bytes(maps.geopackage(sheet))
    base = sqlite3.connect(tmp_path / "a.gpkg")
    try:
        assert base.execute("PRAGMA application_id").fetchone() == (maps.GPKG_ID,)
        assert base.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        assert base.execute("SELECT DISTINCT srs_id FROM gpkg_geometry_columns").fetchall() == [(code,)]
        (wkt,) = base.execute("SELECT definition FROM gpkg_spatial_ref_sys WHERE srs_id = ?", (code,)).fetchone()
        assert wkt.startswith(("PROJCS", "GEOGCS"))
        places = dict(base.execute("SELECT name, geom FROM stations"))
        assert set(places) == set(sheet.adjusted.positions)
        magic, _, _, srs, order, kind, x, y, z = struct.unpack("<2sBBiBI3d", places["0"])
        assert (magic, srs, order, kind) == (b"GP", code, 1, 1001)
        expected = sheet.adjusted.positions["0"].position_m.tolist()
        assert (x, y) == pytest.approx((9.2, 45.5) if code == 4326 else expected[:2], abs=1e-3)
        assert z == pytest.approx(expected[2], abs=1e-3)
        low_x, high_y = base.execute("SELECT min_x, max_y FROM gpkg_contents WHERE table_name = 'lines'").fetchone()
        assert low_x <= x
        assert high_y >= y
        assert base.execute("SELECT count(*) FROM lines WHERE kind = 'leg'").fetchone() == (15,)
    finally:
        base.close()


def test_control_points_and_scale_bars_have_their_sds(tmp_path):
    sheet = sheet_of(tmp_path, utm_zone="32N")
    control = {row["label"]: row for row in csv.DictReader(io.StringIO(maps.control_csv(sheet)))}
    far = sheet.adjusted.positions["7"]
    assert float(control["7"]["accuracy_x_m"]) == pytest.approx(far.sigmas_m[0], abs=1e-4)
    assert float(control["7"]["x_m"]) == pytest.approx(far.position_m[0], abs=1e-4)
    assert float(control["0"]["accuracy_x_m"]) > 0
    bars = list(csv.DictReader(io.StringIO(maps.scale_bars_csv(sheet))))
    assert len(bars) == 15
    for bar, leg in zip(bars, sheet.project.leg, strict=True):
        assert float(bar["distance_m"]) == pytest.approx(leg.distance_m, rel=0.01)
        assert float(bar["accuracy_m"]) == pytest.approx(leg.distance_sigma_m, abs=1e-4)
