"""Exports against the programs that read them: Survex and Therion."""

import csv
import io
import json
import math
import shutil
import subprocess
from itertools import pairwise

import numpy as np
import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.draw import figures
from buddyline.tools.draw.survey import plan, profile
from buddyline.tools.survey import report, survex, tables
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.project import Edit, FixedPoint, Place
from buddyline.tools.survey.sheet import Sheet
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Text
from msgspec.structs import replace

from tests.processes import PATIENCE_S
from tests.tools import survey_world as world

CAVERN = pytest.mark.skipif(shutil.which("cavern") is None, reason="survex is not installed")
THERION = pytest.mark.skipif(shutil.which("therion") is None, reason="therion is not installed")
# Survex writes coordinates to the centimetre, so half of one is lost there.
SAME_M = 0.01


def on_grid(latitude_deg, longitude_deg, **grid):
    """A place on a map grid, and a station fixed there."""
    where = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
    return {
        "place": Place(declination_deg=3.65, water_level_m=97.0, **where, **grid),
        "fix": [FixedPoint(station="0", **where, entrance=True)],
    }


# Both edges of a zone, where grid north is up to 2.6 degrees off; both hemispheres; national grids of five kinds.
GRIDS = {
    "utm": on_grid(45.5, 9.2, utm_zone="32N"),
    "utm_west": on_grid(60.1, 6.02, utm_zone="32N"),
    "utm_east": on_grid(60.1, 11.98, utm_zone="32N"),
    "utm_south": on_grid(-33.2, 149.9, utm_zone="55S"),
    "lambert": on_grid(44.3, 1.6, epsg=2154),
    "lambert_paris": on_grid(45.5, 4.9, epsg=27572),
    "swiss": on_grid(46.9, 7.1, epsg=2056),
    "british": on_grid(54.1, -2.4, epsg=27700),
    "krovak": on_grid(49.4, 16.7, epsg=5514),
}
PLACES = {
    "nowhere": {},
    "declination": {"place": Place(declination_deg=-12.3, declination_source="chart")},
    **GRIDS,
}


def survey(make=world.loop, legs=14, depth="absolute", seed=1, **tables_):
    course = make(np.random.default_rng(seed), legs)
    rows = world.readings_of(course, np.random.default_rng(seed))
    rows[3] = replace(rows[3], disturbed=["b"], alarms=["field: at node b the magnetic field is not the usual one"])
    project = world.project_of(rows, depth, **tables_)
    return project, adjust(project)


def ratio(adjusted):
    """H of the one loop of all legs, with what the instruments add taken off, as cavern has them."""
    misclosure_m = sum(line.vector_m for line in adjusted.lines)
    covariance = sum(line.covariance for line in adjusted.lines)
    return np.hypot(*misclosure_m[:2]) / np.sqrt(np.trace(covariance[:2, :2]))


def differences(adjusted, found, *, shift=False):
    start = adjusted.positions["0"].position_m - found["0"] if shift else 0.0
    return [np.abs(p.position_m - found[name] - start).max() for name, p in adjusted.positions.items()]


def by_therion(folder, sheet):
    """Stations by the real therion."""
    (folder / "survey.th").write_text(survex.th(sheet))
    grid = survex.coordinate_system(sheet)
    system = f"cs {grid}\n" if grid else ""
    (folder / "thconfig").write_text(f"{system}source survey.th\nexport model -o survey.3d -fmt survex\n")
    done = subprocess.run(
        ["therion", "-q"], cwd=folder, capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 0, done.stdout[-500:]
    return world.coordinates(folder / "survey.3d")


@CAVERN
@pytest.mark.parametrize("depth", ["absolute", "readings"])
@pytest.mark.parametrize("place", list(PLACES))
@pytest.mark.parametrize("make", [world.line, world.loop])
def test_cavern_agrees_to_the_centimetre(tmp_path, make, place, depth):
    project, adjusted = survey(make, depth=depth, **PLACES[place])
    said, ratios, found = world.cavern(tmp_path, survex.svx(Sheet(project, adjusted)))
    assert not said
    assert max(differences(adjusted, found)) <= SAME_M
    assert len(ratios) == len(adjusted.loops)
    for (h, v), loop in zip(ratios, adjusted.loops, strict=True):
        assert h == pytest.approx(ratio(adjusted), rel=0.05, abs=0.02)
        # Held depths close by construction: cavern has no other to judge by.
        assert v < 0.01 if depth == "absolute" else v == pytest.approx(loop.vertical_ratio, rel=0.15, abs=0.05)


@CAVERN
@THERION
@pytest.mark.parametrize("name", ["my cave", "H\u00f6hle", "a.b", ""])
def test_a_project_may_have_any_name(tmp_path, name):
    project, adjusted = survey()
    project = replace(project, survey=replace(project.survey, name=name))
    sheet = Sheet(project, adjusted)
    said, _, found = world.cavern(tmp_path, survex.svx(sheet))
    assert not said
    assert max(differences(adjusted, found)) <= SAME_M
    assert max(differences(adjusted, by_therion(tmp_path, sheet))) <= SAME_M


@CAVERN
@pytest.mark.parametrize("style", ["diving", "normal"])
def test_cavern_accepts_all_legs_in_one_style(tmp_path, style):
    project, adjusted = survey(depth="readings")
    text = survex.svx(Sheet(project, adjusted), style)
    assert (survex.SURVEX.diving in text) == (style == "diving")
    assert (survex.SURVEX.normal in text) == (style == "normal")
    said, ((h, v),), found = world.cavern(tmp_path, text)
    assert not said
    assert h == pytest.approx(ratio(adjusted), rel=0.15)
    assert v == pytest.approx(adjusted.loops[0].vertical_ratio, rel=0.15, abs=0.05)
    # Diving style fails here because of a fault of Survex; once that is mended, `auto` is no longer needed.
    assert (max(differences(adjusted, found)) <= SAME_M) == (style == "normal")


def places_of_vectors(adjusted):
    """Places by least squares of the corrected legs as vectors, which is what cavern does."""
    at, lines = adjusted.solution.observations.at, adjusted.lines
    assert at["0"] == 0
    joined = np.zeros((len(lines), len(at)))
    weights = np.zeros((len(lines), 3, len(lines), 3))
    for row, (line, (start, end)) in enumerate(zip(lines, adjusted.survey.ends, strict=True)):
        joined[row, at[start]], joined[row, at[end]] = -1.0, 1.0
        weights[row, :, row, :] = np.linalg.inv(line.covariance)
    # Station 0 stays.
    A = np.kron(joined[:, 1:], np.eye(3))
    AtW = A.T @ weights.reshape(len(A), len(A))
    moved_m = np.linalg.solve(AtW @ A, AtW @ np.concatenate([line.vector_m for line in lines])).reshape(-1, 3)
    return dict(zip(at, adjusted.positions["0"].position_m + np.vstack([np.zeros(3), moved_m]), strict=True))


def with_sections(project, sections):
    """Return a project whose stations of these names have notes with their cross-sections."""
    stations = [replace(one, notes=[sections[one.name]] if one.name in sections else []) for one in project.station]
    return replace(project, station=stations)


def test_cross_sections_follow_the_legs():
    project, adjusted = survey(world.line, 6)
    sections = {"0": "LRUD 1 2 3 4", "1": "LRUD 1.5 - 3 4 wide", "3": "LRUD 1 1 1 1"}
    sheet = Sheet(with_sections(project, sections), adjusted)
    assert [[one.station for one in passage] for passage in sheet.passages] == [["0", "1"], ["3"]]
    lines = survex.svx(sheet).splitlines()
    assert lines[(at := lines.index("*data passage station left right up down")) + 2] == "1\t1.500\t-\t3.000\t4.000"
    assert lines[at + 3] == "*data passage station left right up down"
    assert "    1 1.500 - 3.000 4.000" in survex.th(sheet)
    # Feet; left, up, down, right.
    assert " 4.92 9.84 13.12 -9.90 " in tables.compass_dat(sheet_with_north(project, sections))


def sheet_with_north(project, sections):
    project = replace(with_sections(project, sections), place=Place(declination_deg=3.0))
    return Sheet(project, adjust(project))


@CAVERN
def test_cavern_takes_cross_sections(tmp_path):
    project, adjusted = survey(world.line, 6)
    text = survex.svx(Sheet(with_sections(project, {str(i): "LRUD 1 2 3 4" for i in range(7)}), adjusted))
    said, _, found = world.cavern(tmp_path, text)
    assert not said
    assert max(differences(adjusted, found)) <= SAME_M


@CAVERN
@pytest.mark.parametrize("seed", range(3, 6))
def test_held_depths_cost_cavern_s_rounding_and_a_second_order(tmp_path, seed):
    project, adjusted = survey(legs=25, seed=seed)
    _, _, found = world.cavern(tmp_path, survex.svx(Sheet(project, adjusted)))
    places_m = places_of_vectors(adjusted)
    assert max(np.abs(places_m[name] - found[name]).max() for name in places_m) <= 0.0055
    # The rest is of second order in what the adjustment moves a leg: vectors do not turn with it, readings do.
    moved = ((residual.moved_m, residual.leg.distance_m) for residual in adjusted.residuals)
    second_order_m = sum(float(np.dot(moved_m, moved_m)) / distance_m for moved_m, distance_m in moved)
    assert max(differences(adjusted, places_m)) <= second_order_m


@CAVERN
def test_cavern_agrees_on_crossing_loops_side_shots_and_steep_legs(tmp_path):
    course = world.loop(np.random.default_rng(6), 12)
    course.stations_m = np.vstack([course.stations_m, course.stations_m[4] + (1.0, 0.5, 6.0), course.stations_m[2] - 2])
    course.names += ["pit", "side"]
    course.legs += [(2, 8, 0), (4, 12, 0), (2, 13, 1), (4, 5, 0)]
    project = world.project_of(world.readings_of(course, np.random.default_rng(2)))
    adjusted = adjust(project)
    text = survex.svx(Sheet(project, adjusted))
    assert survex.SURVEX.normal in text
    assert survex.SURVEX.diving in text
    said, _, found = world.cavern(tmp_path, text)
    assert not said
    assert max(differences(adjusted, found)) <= SAME_M


@CAVERN
def test_cavern_accepts_contradicting_sights_without_a_warning(tmp_path):
    course = world.line(np.random.default_rng(6), 4)
    legs = world.readings_of(course, np.random.default_rng(2))
    legs[1] = replace(legs[1], back_azimuth_deg=(legs[1].back_azimuth_deg + 15) % 360)
    project = world.project_of(legs)
    said, _, found = world.cavern(tmp_path, survex.svx(Sheet(project, adjust(project))))
    assert not said
    assert found


@CAVERN
@pytest.mark.parametrize("place", list(PLACES))
def test_cavern_accepts_cartesian_vectors(tmp_path, place):
    project, adjusted = survey(world.line, **PLACES[place])
    said, _, found = world.cavern(tmp_path, survex.svx_cartesian(Sheet(project, adjusted)))
    assert not said
    assert max(differences(adjusted, found)) <= SAME_M


@CAVERN
def test_cavern_reads_compass_data(tmp_path):
    project, adjusted = survey(world.line, place=Place(declination_deg=5.25, declination_source="chart"))
    # Of a .dat file cavern 1.4 reads foresights alone.
    project = replace(project, edit=[Edit(leg=leg.name, compass="fore") for leg in project.leg], leg=project.leg)
    adjusted = adjust(replace(project, leg=[replace(leg, disturbed=[]) for leg in project.leg]))
    said, _, found = world.cavern(tmp_path, tables.compass_dat(Sheet(project, adjusted)), "survey.dat")
    assert not said
    assert max(differences(adjusted, found, shift=True)) <= 2 * SAME_M


@THERION
@pytest.mark.parametrize("make", [world.line, world.loop])
# Of the British and the Bohemian grid Therion wants datum shifts that it fetches from the network.
@pytest.mark.parametrize("place", [place for place in PLACES if place not in ("british", "krovak")])
def test_therion_agrees_to_the_centimetre(tmp_path, make, place):
    project, adjusted = survey(make, **PLACES[place])
    project = replace(project, survey=replace(project.survey, team=["A.", "Ann B. C. van Diver", 'Bo "Fin" O\'Neill']))
    assert max(differences(adjusted, by_therion(tmp_path, Sheet(project, adjusted)))) <= SAME_M


def test_an_unknown_declination_is_never_written():
    project, adjusted = survey(place=Place())
    text = survex.svx(Sheet(project, adjusted))
    assert "*declination" not in text
    assert "declination not known" in text
    assert "\n    declination" not in survex.th(Sheet(project, adjusted))
    with pytest.raises(BuddylineError, match="declination"):
        tables.compass_dat(Sheet(project, adjusted))
    with pytest.raises(BuddylineError, match="declination"):
        tables.geojson(Sheet(project, adjusted))


def test_the_export_has_readings_people_instruments_and_notes():
    project, adjusted = survey(**PLACES["declination"])
    project = replace(
        project,
        survey=replace(project.survey, notes="silt at 4", instruments={"depth": "MS5837"}),
        edit=[Edit(leg="0-1", note="second try")],
    )
    text = survex.svx(Sheet(project, adjusted))
    for words in ('*team "A. Diver"', '*instrument depth "MS5837"', "; silt at 4", "second try", "*date 2026.05.01"):
        assert words in text
    assert "*declination -12.300 degrees" in text
    rows = [row.split("\t") for row in text.splitlines() if row.count("\t") >= 6]
    assert [(row[0], row[1]) for row in rows] == [(leg.from_, leg.to) for leg in project.leg]
    for row, leg in zip(rows, project.leg, strict=True):
        assert float(row[2]) == pytest.approx(leg.distance_m, abs=1e-4)
        for word, angle, node in (
            (row[3], leg.azimuth_deg, leg.from_node),
            (row[4], leg.back_azimuth_deg, leg.to_node),
        ):
            if node in leg.disturbed:
                assert word == "-"
            else:
                assert float(word) == pytest.approx(angle, abs=1e-3)


def test_tables_and_geojson_hold_every_leg_and_station():
    point = replace(survey()[0].leg[0], to="amphora", note="neck up")
    project, adjusted = survey(points=[point], **PLACES["utm"])
    legs = list(csv.DictReader(io.StringIO(tables.legs_csv(Sheet(project, adjusted)))))
    assert [row["from"] for row in legs] == [leg.from_ for leg in [*project.leg, point]]
    assert legs[3]["alarms"].startswith("field")
    # A loop checks its distances, but not to the centimetre.
    assert all(0.05 < float(row["detectable_m"]) < 5.0 for row in legs[:14])
    stations = {row["name"]: row for row in csv.DictReader(io.StringIO(tables.stations_csv(Sheet(project, adjusted))))}
    assert stations["amphora"]["kind"] == "point"
    assert float(stations["0"]["latitude_deg"]) == pytest.approx(45.5, abs=1e-7)
    assert float(stations["amphora"]["ellipse_major_m"]) > 0
    collection = json.loads(tables.geojson(Sheet(project, adjusted)))
    kinds = [feature["properties"]["kind"] for feature in collection["features"]]
    assert (kinds.count("station"), kinds.count("point"), kinds.count("leg")) == (14, 1, 14)
    longitude, latitude, _ = collection["features"][0]["geometry"]["coordinates"]
    assert (longitude, latitude) == pytest.approx((9.2, 45.5), abs=1e-6)


def test_geojson_of_a_local_grid_is_where_the_survey_is():
    fix = FixedPoint(station="0", latitude_deg=45.5, longitude_deg=9.2)
    project, adjusted = survey(fix=[fix], place=Place(declination_deg=3.65, declination_source="chart"))
    utm, _ = survey(**PLACES["utm"])
    one = json.loads(tables.geojson(Sheet(project, adjusted)))["features"]
    other = json.loads(tables.geojson(Sheet(utm, adjust(utm))))["features"]
    for a, b in zip(one, other, strict=True):
        if a["geometry"]["type"] == "Point":
            # A ten-millionth of a degree is a centimetre; the grids differ by UTM's scale.
            np.testing.assert_allclose(a["geometry"]["coordinates"][:2], b["geometry"]["coordinates"][:2], atol=3e-7)


def test_drawings_and_report_hold_every_station():
    project, adjusted = survey(points=[replace(survey()[0].leg[0], to="amphora<1>")], **PLACES["utm"])
    svg = figures.svg(plan(adjusted, "Demo"))
    assert svg.startswith("<?xml")
    assert "amphora&lt;1&gt;" in svg
    for name in adjusted.positions:
        assert f">{name}</text>" in svg
    pdf = figures.pdf([plan(adjusted, "Demo"), profile(adjusted, "Demo (1)")])
    assert pdf.startswith(b"%PDF-1.4")
    assert pdf.rstrip().endswith(b"%%EOF")
    start = int(pdf.split(b"startxref\n")[1].split()[0])
    assert pdf[start:].startswith(b"xref")
    page = report.page(Sheet(project, adjusted))
    assert page.count("<svg") == 2
    assert "misclosure" in page
    assert "ALARM: leg 3-4" in page
    assert "://" not in page


def test_a_leg_goes_in_the_profile_as_it_is_extended():
    course = world.line(np.random.default_rng(3), 5)
    legs = world.readings_of(course, np.random.default_rng(2))
    legs[1] = replace(legs[1], extend="left")
    legs[2] = replace(legs[2], extend="normal")
    edits = [Edit(leg="3-4", extend="vertical"), Edit(leg="4-5", extend="ignore")]
    adjusted = adjust(world.project_of(legs, edit=edits))
    (axis,) = profile(adjusted, "Demo").axes
    moved_m = [float(np.diff(line.get_xdata())[0]) for line in axis.lines]
    runs_m = [
        math.hypot(*(adjusted.positions[b].position_m - adjusted.positions[a].position_m)[:2])
        for a, b in pairwise("0123")
    ]
    assert moved_m == pytest.approx([runs_m[0], -runs_m[1], -runs_m[2], 0.0])


def test_no_name_stands_on_another_and_the_plan_has_north_and_a_scale():
    course = world.loop(np.random.default_rng(6), 30)
    # A cluster of side shots: their names want the same place.
    course.stations_m = np.vstack(
        [course.stations_m, course.stations_m[4] + np.random.default_rng(1).normal(0, 0.3, (12, 3))]
    )
    course.names += [f"cluster_{k}" for k in range(12)]
    course.legs += [(4, 30 + k, 0) for k in range(12)]
    adjusted = adjust(world.project_of(world.readings_of(course, np.random.default_rng(2))))
    for figure in (plan(adjusted, "Demo"), profile(adjusted, "Demo")):
        (axis,) = figure.axes
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        named = [one for one in axis.texts if one.get_text() in adjusted.positions]
        for one in named:
            one.update_positions(canvas.get_renderer())
        # The text alone, without the line that leads to it.
        boxes = [Text.get_window_extent(one) for one in named]
        assert len(boxes) == len(adjusted.positions)
        assert not [1 for i, one in enumerate(boxes) for other in boxes[:i] if one.overlaps(other)]
    texts = {one.get_text() for one in plan(adjusted, "Demo").axes[0].texts}
    assert "N" in texts
    assert any(text.endswith(" m") for text in texts)
