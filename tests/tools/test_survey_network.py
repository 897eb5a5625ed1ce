"""The network: exact with exact readings, true covariances with noisy ones, and it names the wrong leg."""

import math
from datetime import date

import numpy as np
import pytest
from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.geodesy import Projection, declination, grid_of, radii_m, utm_epsg
from buddyline.tools.survey.lines import bearing_of, line_of, measures_of
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.project import DiveFiles, Edit, FixedPoint, Place, Project
from msgspec import UNSET
from msgspec.structs import replace

from tests.tools import survey_world as world

EXACT = {"compass_deg": 0.0, "tape_m": 0.0, "depth_m": 0.0}


@pytest.mark.parametrize("depth", ["absolute", "readings"])
@pytest.mark.parametrize("make", [world.line, world.loop])
def test_exact_readings_give_the_true_stations(make, depth):
    course = make(np.random.default_rng(3), 14)
    project = world.project_of(world.readings_of(course, np.random.default_rng(0), **EXACT), depth)
    adjusted = adjust(project)
    start = course.stations_m[0]
    for name, place in zip(course.names, course.stations_m, strict=True):
        expected = world.enu(place - start) - (0, 0, start[2])
        np.testing.assert_allclose(adjusted.positions[name].position_m, expected, atol=2e-3)
    assert all(loop.error_m < 2e-3 for loop in adjusted.loops)
    assert not adjusted.blunders
    assert len(adjusted.loops) == (make is world.loop)


def test_stated_covariance_is_the_scatter():
    course = world.loop(np.random.default_rng(5), 12)
    far = "6"
    errors, chi2, loop_h, loop_v = [], [], [], []
    for seed in range(25):
        legs = world.readings_of(course, np.random.default_rng(seed), depth_m=0.03)
        project = world.project_of(legs, "readings")
        project = replace(project, settings=replace(project.settings, compass_common_deg=0.0))
        adjusted = adjust(project)
        position = adjusted.positions[far]
        error = position.position_m - adjusted.positions["0"].position_m
        error = (error - world.enu(course.stations_m[6] - course.stations_m[0]))[:2]
        errors.append(error)
        chi2.append(error @ np.linalg.solve(position.covariance[:2, :2], error))
        loop_h.append(adjusted.loops[0].horizontal_ratio ** 2)
        loop_v.append(adjusted.loops[0].vertical_ratio ** 2)
    # A chi^2 of 2 degrees of freedom has mean 2 and sd 2; of 25 of them the mean's sd is 0.4.
    assert 0.8 < np.mean(chi2) < 3.4
    assert 0.45 < np.mean(loop_h) < 1.7
    assert 0.35 < np.mean(loop_v) < 1.9
    assert np.abs(np.mean(errors, axis=0)).max() < 0.05


def test_common_compass_error_turns_the_far_end_and_is_in_its_ellipse():
    course = world.line(np.random.default_rng(2), 20)
    legs = world.readings_of(course, np.random.default_rng(0), compass_deg=0.0, tape_m=0.0, depth_m=0.0)
    project = world.project_of(legs)
    far = adjust(project).positions["20"]
    away = np.linalg.norm((course.stations_m[20] - course.stations_m[0])[:2])
    assert far.ellipse[0] == pytest.approx(math.radians(0.5) * away, rel=0.1)
    # The ellipse lies across the way to the station.
    way = world.enu(course.stations_m[20] - course.stations_m[0])
    across = math.atan2(way[0], way[1]) + math.pi / 2
    assert abs(math.cos(far.ellipse[2] - across)) > 0.99


def test_a_blunder_is_named():
    course = world.loop(np.random.default_rng(8), 12)
    # Cross-legs make the network stiff enough to tell which of them is wrong.
    course.legs += [(2, 8, 0), (5, 11, 0), (3, 10, 0), (0, 6, 0)]
    legs = world.readings_of(course, np.random.default_rng(1))
    sound = adjust(world.project_of(legs))
    assert not sound.blunders
    legs[12] = replace(legs[12], distance_m=legs[12].distance_m + 1.5)
    adjusted = adjust(world.project_of(legs))
    assert adjusted.blunders[0].legs == ("2-8",)
    assert adjusted.blunders[0].cause == "leg 2-8: distance"
    assert adjusted.blunders[0].off == pytest.approx(1.5, abs=0.5)
    taken_out = replace(world.project_of(legs), edit=[Edit(leg="2-8", use=False, note="line slack")])
    again = adjust(taken_out)
    assert not again.blunders
    assert again.left_out[0][1] == "taken out: line slack"


def test_what_explains_as_much_is_named_with_the_blunder():
    course = world.loop(np.random.default_rng(8), 12)
    course.legs += [(2, 8, 0), (5, 11, 0), (3, 10, 0), (0, 6, 0)]
    legs = world.readings_of(course, np.random.default_rng(1))
    legs[4] = replace(legs[4], distance_m=legs[4].distance_m + 1.5)
    assert adjust(world.project_of(legs)).blunders[0].legs[0] == "4-5"
    one_loop = adjust(world.project_of(legs[:12]))
    # In one loop all legs of about its direction are as suspect.
    assert "4-5" in one_loop.blunders[0].legs
    assert len(one_loop.blunders[0].legs) > 1


def test_an_open_traverse_is_reported_as_unchecked():
    course = world.line(np.random.default_rng(1), 12)
    adjusted = adjust(world.project_of(world.readings_of(course, np.random.default_rng(1))))
    assert all(one.chi2 is None for one in adjusted.residuals)
    assert not adjusted.loops


def test_two_fixed_points_close_a_loop():
    course = world.line(np.random.default_rng(4), 12)
    legs = world.readings_of(course, np.random.default_rng(1), **EXACT)
    ends = [world.enu(course.stations_m[i]) for i in (0, 12)]
    fixes = [FixedPoint(station=n, east_m=e[0], north_m=e[1]) for n, e in zip(("0", "12"), ends, strict=True)]
    adjusted = adjust(world.project_of(legs, fix=fixes, place=Place(declination_deg=0.0, declination_source="test")))
    assert len(adjusted.loops) == 1
    assert adjusted.loops[0].error_m < 0.01
    shifted = [fixes[0], replace(fixes[1], east_m=fixes[1].east_m + 3.0)]
    off = adjust(world.project_of(legs, fix=shifted, place=Place(declination_deg=0.0, declination_source="test")))
    assert off.loops[0].error_m == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize(("lost", "left_out"), [(4, [5]), (2, [0, 1]), (3, [4, 5])])
def test_legs_that_hang_on_nothing_are_left_out_and_the_larger_part_stays(lost, left_out):
    course = world.line(np.random.default_rng(4), 6)
    legs = world.readings_of(course, np.random.default_rng(1))
    del legs[lost]
    adjusted = adjust(world.project_of(legs))
    assert [(leg.name, why) for leg, why in adjusted.left_out] == [
        (f"{k}-{k + 1}", "not connected to a fixed point") for k in left_out
    ]
    assert str(left_out[-1]) not in adjusted.positions


@pytest.mark.parametrize("change", [{"use": False}, {"azimuth_deg": UNSET, "back_azimuth_deg": UNSET}])
def test_a_first_leg_that_does_not_count_takes_no_other_leg_with_it(change):
    legs = world.readings_of(world.line(np.random.default_rng(4), 6), np.random.default_rng(1))
    edit = [Edit(leg="0-1", use=False)] if "use" in change else []
    if not edit:
        legs[0] = replace(legs[0], **change)
    adjusted = adjust(world.project_of(legs, edit=edit))
    assert [leg.name for leg, _ in adjusted.left_out] == ["0-1"]
    assert set(adjusted.positions) - {"0"} == {str(k) for k in range(1, 7)}


def test_an_altitude_and_a_water_level_that_contradict_are_no_silence():
    legs = world.readings_of(world.line(np.random.default_rng(4), 4), np.random.default_rng(1))
    for off_m, wrong in ((0.0, False), (2.0, True)):
        altitude_m = 100.0 - legs[0].depth_from_m + off_m
        fix = [FixedPoint(station="0", east_m=0.0, north_m=0.0, altitude_m=altitude_m, altitude_sigma_m=0.02)]
        adjusted = adjust(world.project_of(legs, fix=fix, place=Place(water_level_m=100.0)))
        causes = {cause for one in adjusted.blunders for cause in (one.cause, *one.others)}
        assert ("fixed point 0" in causes) == wrong


def test_a_fixed_point_without_a_station_is_an_error():
    legs = world.readings_of(world.line(np.random.default_rng(4), 3), np.random.default_rng(1))
    with pytest.raises(BuddylineError, match="no leg has this station"):
        adjust(world.project_of(legs, fix=[FixedPoint(station="entrance", east_m=0.0, north_m=0.0)]))


def test_a_project_without_legs_is_an_error():
    with pytest.raises(BuddylineError, match="no legs"):
        adjust(Project())


def test_the_undisturbed_compass_is_used_unless_an_edit_decides():
    course = world.line(np.random.default_rng(4), 1)
    (leg,) = world.readings_of(course, np.random.default_rng(1))
    project = Project()
    assert bearing_of(leg, project).sigma == pytest.approx(math.radians(1.0) / math.sqrt(2))
    at_far = bearing_of(replace(leg, disturbed=["b"]), project)
    assert at_far.back is None
    assert at_far.sigma == pytest.approx(math.radians(1.0))
    edited = replace(project, edit=[Edit(leg="0-1", compass="back")])
    assert bearing_of(replace(leg, disturbed=["b"]), edited).fore is None
    # Two compasses that contradict each other are not better than either.
    apart = bearing_of(replace(leg, back_azimuth_deg=(leg.azimuth_deg + 190) % 360), project)
    assert apart.sigma > math.radians(4.0)


def test_steep_legs_follow_the_clinometers():
    course = world.line(np.random.default_rng(4), 1)
    course.stations_m[1] = course.stations_m[0] + (0.5, 0.2, 4.0)
    (leg,) = world.readings_of(course, np.random.default_rng(1), **EXACT)
    line = line_of(leg, measures_of(leg, Project(), 0.0, {}), 0.0)
    assert line.by_clino
    np.testing.assert_allclose(line.vector_m, world.enu(course.stations_m[1] - course.stations_m[0]), atol=1e-9)
    by_clino = replace(leg, distance_m=3.0, inclination_deg=-80.0, back_inclination_deg=80.0)
    assert line_of(by_clino, measures_of(by_clino, Project(), 0.0, {}), 0.0)


def test_utm_of_a_known_place_and_back():
    # The CN Tower, as given in the literature on UTM: zone 17N, 630084 m east, 4833438 m north.
    latitude, longitude = 43 + 38 / 60 + 33.24 / 3600, -(79 + 23 / 60 + 13.7 / 3600)
    utm = Projection(utm_epsg("17N"))
    east, north = utm.metres(latitude, longitude)
    assert (round(east), round(north)) == (630084, 4833439)
    for zone, place in (("17N", (latitude, longitude)), ("55S", (-33.2, 149.9)), ("32N", (0.1, 6.5))):
        grid = Projection(utm_epsg(zone))
        np.testing.assert_allclose(grid.degrees(*grid.metres(*place)), place, atol=1e-9)
    # Convergence is about the longitude from the central meridian times the latitude's sine.
    assert utm.convergence_rad(latitude, longitude) == pytest.approx(
        math.radians(longitude + 81) * math.sin(math.radians(latitude)), rel=1e-3
    )


def test_declination_is_stated_modelled_or_unknown():
    pytest.importorskip("pygeomag")
    legs = world.readings_of(world.line(np.random.default_rng(4), 2), np.random.default_rng(1))
    assert declination(world.project_of(legs)) is None
    assert grid_of(world.project_of(legs)).north == "magnetic"
    modelled = declination(world.project_of(legs, place=Place(latitude_deg=45.5, longitude_deg=9.2)))
    # NOAA's calculator gives 3.6 degrees east for northern Italy in May 2026.
    assert math.degrees(modelled.rad((45.5, 9.2), date(2026, 5, 1))) == pytest.approx(3.6, abs=0.3)
    assert "2026-05-01" in modelled.source
    stated = declination(world.project_of(legs, place=Place(declination_deg=-2.0)))
    assert math.degrees(stated.rad(None, date(2026, 5, 1))) == pytest.approx(-2.0)


def forgotten_loop(seed):
    """A loop whose closing mark was forgotten: its last station has a number of its own."""
    course = world.loop(np.random.default_rng(seed), 14)
    legs = world.readings_of(course, np.random.default_rng(seed))
    return [*legs[:-1], replace(legs[-1], to="14")]


@pytest.mark.parametrize("seed", range(5))
def test_a_forgotten_closing_mark_is_proposed_and_nothing_else(seed):
    adjusted = adjust(world.project_of(forgotten_loop(seed)))
    assert [(one.station, one.other) for one in adjusted.proposals] == [("14", "0")]
    (proposal,) = adjusted.proposals
    closed = adjust(
        world.project_of([replace(leg, to="0" if leg.to == "14" else leg.to) for leg in forgotten_loop(seed)])
    )
    assert proposal.ratio == pytest.approx(closed.loops[0].horizontal_ratio, rel=0.3, abs=0.1)
    assert not closed.proposals
    assert '[[equate]] stations = ["0", "14"]' in proposal.text


@pytest.mark.parametrize("seed", range(5))
def test_an_open_line_has_no_station_that_may_be_another(seed):
    course = world.line(np.random.default_rng(seed), 20)
    assert not adjust(world.project_of(world.readings_of(course, np.random.default_rng(seed)))).proposals


def test_height_takes_nothing_of_the_sigma_of_a_place():
    legs = world.readings_of(world.line(np.random.default_rng(4), 3), np.random.default_rng(1))
    fix = FixedPoint(station="0", east_m=0.0, north_m=0.0, sigma_m=5.0)
    for depth, altitude_sigma_m in (("absolute", 0.0), ("readings", 0.0), ("readings", 0.3)):
        fixed = replace(fix, altitude_m=90.0, altitude_sigma_m=altitude_sigma_m)
        at = adjust(world.project_of(legs, depth, fix=[fixed])).positions["0"]
        assert at.sigmas_m[:2] == pytest.approx([5.0, 5.0], rel=0.01)
        assert at.sigmas_m[2] == pytest.approx(max(altitude_sigma_m, 0.02), abs=0.02)


def test_a_leg_has_the_declination_of_its_own_date():
    pytest.importorskip("pygeomag")
    legs = world.readings_of(world.line(np.random.default_rng(4), 2), np.random.default_rng(1))
    later_ns = round(3 * 365.25 * 86400e9)
    second = replace(legs[1], dive=2, start_ns=legs[1].start_ns + later_ns, end_ns=legs[1].end_ns + later_ns)
    # Declination changes fast near the magnetic pole.
    project = world.project_of([legs[0], second], place=Place(latitude_deg=78.2, longitude_deg=15.6))
    turns_deg = [math.degrees(line.turn_rad) for line in adjust(project).lines]
    assert 0.5 < abs(turns_deg[1] - turns_deg[0]) < 2.0
    stated = replace(project, dive=[DiveFiles(logs=[], date=date(2026, 5, 1))] * 2)
    assert len({line.turn_rad for line in adjust(stated).lines}) == 1


# UTM; meridians counted from Paris; angles not kept; axes of a datum that PROJ reaches on several ways.
@pytest.mark.parametrize(
    ("epsg", "latitude_deg", "longitude_deg"),
    [(32632, 45.5, 9.0), (27572, 45.5, 4.9), (3035, 42.5, 20.0), (5514, 49.3, 16.7)],
)
def test_a_map_grid_s_north_and_scale_are_taken_off_latitude_and_longitude(epsg, latitude_deg, longitude_deg):
    legs = world.readings_of(world.line(np.random.default_rng(4), 40), np.random.default_rng(1))
    where = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
    fix = [FixedPoint(station="0", **where)]
    on_map = adjust(world.project_of(legs, place=Place(declination_deg=0.0, epsg=epsg, **where), fix=fix))
    local = adjust(world.project_of(legs, place=Place(declination_deg=0.0), fix=fix))
    start_m = on_map.positions["0"].position_m
    far = max(on_map.positions.values(), key=lambda one: float(np.linalg.norm((one.position_m - start_m)[:2])))
    assert np.linalg.norm((far.position_m - start_m)[:2]) > 90.0
    same, other = on_map.grid.degrees(far.position_m), local.grid.degrees(local.positions[far.name].position_m)
    # At its central meridian UTM is 0.04 % too small: 4 cm of a hundred metres.
    apart_m = np.radians(np.subtract(same, other)) * np.array(radii_m(latitude_deg))[::-1]
    assert np.linalg.norm(apart_m) < 0.01


@pytest.mark.parametrize("epsg", [2053, 5513])
def test_a_map_grid_to_south_and_west_is_refused(epsg):
    with pytest.raises(ConfigError, match=f"place.epsg {epsg}: .* has axes to .*west.*: name a grid to east and north"):
        Projection(epsg).metres(-26.5, 28.5)
