"""Places that are swum past, and lines that are swum without long rests, against truth."""

import math
from itertools import pairwise

import numpy as np
import pytest
from buddyline.tools.survey import swims
from buddyline.tools.survey.averages import wrap
from buddyline.tools.survey.maps import features_of
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.project import Swim, Turn, load_project, new_project, write_derived
from buddyline.tools.survey.settings import SurveySettings
from buddyline.tools.survey.sheet import Sheet
from buddyline.tools.survey.tables import paths_csv
from msgspec.structs import replace

from tests.tools import survey_world as world
from tests.tools import swum_line
from tests.tools.swum_survey import nees

PAUSES = SurveySettings(pause_s=2.0)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_places_that_are_swum_past_are_as_good_as_they_say():
    # More of them: python -m tests.tools.swum_survey.
    found, count = zip(*(nees(seed, 40.0) for seed in (0, 2)), strict=True)
    every = np.concatenate(found)
    assert len(every) >= 0.8 * sum(count)
    # Of 12 places that a compass's slow error ties to each other.
    assert 0.2 < every.mean() < 2.5


def line_of_pauses(seed, legs=12, compass_deg=1.5, every_s=30.0):
    """A line whose legs follow each other within seconds, as survey_world's compasses and gyroscopes read it."""
    rng = np.random.default_rng([seed, 3])
    course = world.line(rng, legs)
    rows = world.readings_of(course, rng, compass_deg=0.0)
    turns, yaw = [], compass_deg
    azimuths = [
        math.degrees(math.atan2(*(course.stations_m[j] - course.stations_m[i])[1::-1])) for i, j, _ in course.legs
    ]
    for node in world.NODES:
        zero, iron, slow = (
            rng.normal(0, yaw * math.sqrt(0.1)),
            rng.normal(0, yaw * math.sqrt(0.4), 2),
            world._Slow(rng, 60.0),
        )
        gyro_dps, wander = rng.normal(0, 0.1), world._Slow(rng, 300.0)
        sights = []
        for k, leg in enumerate(rows):
            side = "" if leg.from_node == node else "back_"
            sights.append(azimuths[k] + (0 if leg.from_node == node else 180))
            heading = math.radians(sights[-1])
            error = zero + iron @ [math.cos(heading), math.sin(heading)]
            error += yaw * (math.sqrt(0.4) * slow.at(k * every_s) + math.sqrt(0.1) * rng.normal())
            read = {f"{side}azimuth_deg": (sights[-1] + error) % 360, f"{side}azimuth_sigma_deg": yaw}
            start_ns = world.START_NS + round(k * every_s * 1e9)
            rows[k] = replace(leg, start_ns=start_ns, end_ns=start_ns + 2 * 10**9, **read)
        for k, (before, after) in enumerate(pairwise(sights)):
            off_deg = every_s * (gyro_dps + 0.003 * wander.at(k * every_s)) + rng.normal(0, 0.12)
            angle_deg = math.degrees(wrap(math.radians(after - before + off_deg)))
            ends = {"from_ns": rows[k].start_ns, "to_ns": rows[k + 1].start_ns}
            turns.append(Turn(node=node, seconds=every_s, angle_deg=angle_deg, sigma_deg=0.12, **ends))
    return course, rows, turns


def far_end(course, adjusted):
    """The far end's error over its ellipse: chi2 over 2."""
    far, start = adjusted.positions[course.names[-1]], adjusted.positions[course.names[0]]
    off_m = far.position_m - start.position_m - world.enu(course.stations_m[-1] - course.stations_m[0])
    return float(off_m[:2] @ np.linalg.solve(far.covariance[:2, :2], off_m[:2])) / 2


@pytest.mark.parametrize("turned", [True, False])
def test_legs_that_follow_within_seconds_count_what_a_compass_keeps(turned):
    found, alone = [], []
    for seed in range(40):
        course, legs, turns = line_of_pauses(seed)
        project = world.project_of(legs, turn=turns if turned else [], settings=replace(PAUSES, compass_common_deg=0.0))
        found.append(far_end(course, adjust(project)))
        alone.append(far_end(course, adjust(replace(project, settings=replace(project.settings, pause_s=0.0)))))
    # Of 40 dives the mean scatters by 0.16. Taken as independent, legs say too little.
    assert 0.6 < np.mean(found) < 1.4
    assert np.mean(found) < np.mean(alone)


def swum(rng, errors=False):
    """A way from station F to T past S, as rows of a swim; with errors of the sds that it states."""
    places_m = {"S": np.array([0.0, 0.0, 0.0]), "F": np.array([-4.0, 1.0, 0.5]), "T": np.array([5.0, 1.5, -0.7])}
    s = np.linspace(0, 1, 25)[:, None]
    way_m = places_m["F"] * (1 - s) + places_m["T"] * s + np.array([0.3, -2.5, 0.8]) * s * (1 - s)
    azimuth = 0.7
    east, north, up = way_m.T
    flat = (east + 1j * north) * np.exp(1j * azimuth)
    rows_m = np.column_stack([flat.imag, flat.real, -up])
    if errors:
        walk = np.cumsum(rng.normal(0, math.radians(0.4) / math.sqrt(24), 25))
        turned = np.exp(1j * (walk - walk[0])) * flat
        rows_m = np.column_stack([turned.imag, turned.real, -up]) + rng.normal(0, 0.004, (25, 3))
    times = 30 * s[:, 0]
    rows = [[float(t), *map(float, row), 0.004, 0.004] for t, row in zip(times, rows_m, strict=True)]
    names = {"node": "b", "station": "S", "from_": "F", "to": "T"}
    return places_m, way_m, Swim(start_ns=world.START_NS, sigma_deg=0.4, rows=rows, **names)


def test_a_way_hangs_between_its_adjusted_stations():
    places_m, way_m, swim = swum(np.random.default_rng(1))
    stations_m = np.array(list(places_m.values()))
    path = swims._hung(swim, stations_m, np.zeros((9, 9)), SurveySettings())
    np.testing.assert_allclose(path.position_m, way_m, atol=1e-9)
    # Its derivatives by the stations, against differences.
    joint = np.zeros((9, 9))
    for k in range(9):
        moved = stations_m.copy().ravel()
        moved[k] += 1e-6
        other = swims._hung(swim, moved.reshape(3, 3), joint, SurveySettings())
        along = (other.position_m - path.position_m) / 1e-6
        unit = joint.copy()
        unit[k, k] = 1.0
        grown = swims._hung(swim, stations_m, unit, SurveySettings()).covariance - path.covariance
        np.testing.assert_allclose(grown, along[:, :, None] * along[:, None, :], atol=2e-4)


def test_a_way_is_as_good_as_it_says():
    rng, found = np.random.default_rng(4), []
    settings = SurveySettings(centering_m=0.0, tilt_floor_deg=0.0)
    sigma_m = np.array([0.0, 0.05, 0.08])
    for _ in range(200):
        places_m, way_m, swim = swum(rng, errors=True)
        stations_m = np.array(list(places_m.values())) + sigma_m[:, None] * rng.normal(size=(3, 3))
        path = swims._hung(swim, stations_m, np.diag(np.repeat(sigma_m**2, 3)), settings)
        off_m = (path.position_m - way_m)[1:-1]
        found.append(np.einsum("ni,nij,nj->n", off_m, np.linalg.inv(path.covariance[1:-1]), off_m) / 3)
    assert 0.8 < np.mean(found) < 1.2
    assert 0.6 < np.mean(found, axis=0).min() < np.mean(found, axis=0).max() < 1.4


def test_ways_are_kept_in_the_project_and_exported(tmp_path):
    course = world.SurveyCourse(np.array([[0.0, 0, 9], [4, 1, 9], [9, 2, 9]]), [(0, 1, 0), (1, 2, 1)], ["F", "S", "T"])
    legs = world.readings_of(course, np.random.default_rng(1))
    _, _, swim = swum(np.random.default_rng(1))
    project = world.project_of(legs, swim=[swim])
    path = tmp_path / "cave.toml"
    new_project(path, "cave", [])
    write_derived(path, {"leg": project.leg, "swim": project.swim})
    assert load_project(path).swim == [swim]
    # A station that nothing places has no way.
    sheet = Sheet(project, adjust(replace(project, swim=[swim, replace(swim, to="U")])))
    rows = paths_csv(sheet).splitlines()
    assert len(rows) == 1 + len(swim.rows)
    first = dict(zip(rows[0].split(","), rows[1].split(","), strict=True))
    at_m = sheet.adjusted.positions["F"].position_m
    assert [float(first[name]) for name in ("east_m", "north_m", "up_m")] == pytest.approx(at_m, abs=1e-3)
    assert (first["node"], first["from"], first["to"], first["seen_from"]) == ("b", "F", "T", "S")
    assert [kind for _, kind, places_m in features_of(sheet) if len(places_m) > 2] == ["path"]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_line_is_swum_without_long_rests():
    # More of them: python -m tests.tools.swum_line.
    found = swum_line.judge(*swum_line.swim(3, legs=4), PAUSES)
    assert found["right"] == [True]
    assert found["swims"] == [3]
    assert found["far end, chi2 / 2"][0] < 4.6
    assert np.median(found["path from the standing node, m"]) < 0.1
    assert 0.1 < np.mean(found["path, NEES / 3"]) < 3.0
