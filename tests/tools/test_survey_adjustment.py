"""One adjustment of all observations: sparse as dense, instruments found, blunders named by their cause."""

import math
from itertools import pairwise

import numpy as np
import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey import normal, report
from buddyline.tools.survey.blunders import critical_chi2
from buddyline.tools.survey.connected import Survey
from buddyline.tools.survey.fit import SurveyFit, chance_of, detectable
from buddyline.tools.survey.geodesy import grid_of
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.project import AdjustSettings, FixedPoint, Known, Place
from buddyline.tools.survey.sheet import Sheet
from msgspec import UNSET
from msgspec.structs import replace

from tests.tools import survey_world as world
from tests.tools.test_survey_turns import turned


def two_loops(seed):
    """A loop of 16 stations, and a way of 8 to 13 more that leaves it and comes back; names by rng's own choice."""
    rng = np.random.default_rng(seed)
    course = world.loop(rng, 16)
    course.marks = {}
    first, last, count = int(rng.integers(2, 6)), int(rng.integers(9, 13)), int(rng.integers(8, 14))
    start, end = course.stations_m[first], course.stations_m[last]
    out = ((start + end) / 2 - course.stations_m.mean(axis=0)) * (1, 1, 0)
    out /= np.linalg.norm(out)
    share = np.linspace(0, 1, count + 2)[1:-1, None]
    way = start + (end - start) * share + 14 * np.sin(np.pi * share) * out + rng.normal(0, 1, (count, 3)) * (1, 1, 0.5)
    chain = [first, *range(16, 16 + count), last]
    course.stations_m = np.vstack([course.stations_m, way])
    course.legs = course.legs + [(i, j, k % 2) for k, (i, j) in enumerate(pairwise(chain))]
    course.names = [str(number) for number in range(len(course.stations_m))]
    return course, rng


def misnamed(seed):
    """Legs with one stay at a station under another's name: the legs, that name, its legs, and the true name."""
    course, rng = two_loops(seed)
    legs, of_loop = world.readings_of(course, rng), 16
    if seed % 3 == 0:  # The mark that closes the first loop.
        true, wrong, bad = "0", str(int(rng.integers(3, 13))), [(of_loop - 1, "to")]
    elif seed % 3 == 1:  # Where the second dive begins.
        true = legs[of_loop].from_
        others = [str(k) for k in range(16) if abs(k - int(true)) > 1]
        wrong, bad = str(rng.choice(others)), [(of_loop, "from_")]
    else:  # A new station, by a name that is in use.
        number = int(rng.integers(of_loop + 1, len(legs) - 1))
        true, wrong, bad = legs[number].to, str(int(rng.integers(0, 16))), [(number, "to"), (number + 1, "from_")]
        if wrong in (legs[number].from_, legs[number + 1].to):
            wrong = str((int(wrong) + 3) % 16)
    for number, end in bad:
        legs[number] = replace(legs[number], **{end: wrong})
    return legs, wrong, [legs[number].name for number, _ in bad], true


def named_first(seed):
    """Whether a misnamed station is the first thing said, and whether also where it truly is."""
    legs, wrong, bad, true = misnamed(seed)
    found = adjust(world.project_of(legs)).blunders
    right = bool(found) and found[0].cause.startswith(f"station name: {wrong} of {bad[0]}")
    known = "it is another place" if seed % 3 == 2 else f"it is {true}"
    return right, right and found[0].cause.endswith(known)


@pytest.mark.parametrize("seed", range(6))
def test_a_misnamed_station_is_named_first_and_with_its_true_name(seed):
    assert named_first(seed) == (True, True)


@pytest.mark.parametrize("seed", range(6))
def test_a_misnamed_station_is_told_from_the_one_joint_of_two_loops(seed):
    """Either, elsewhere, would let all close; the water level of the second dive would be metres off."""
    rng = np.random.default_rng(seed)
    first, second = world.loop(rng, 14), world.loop(rng, 12)
    second.stations_m = second.stations_m + first.stations_m[4] - second.stations_m[0] + (40.0, 10.0, 3.0)
    places = np.vstack([first.stations_m, second.stations_m])
    legs = [*first.legs, (4, 14, 0), *((14 + i, 14 + j, (k + 1) % 2) for k, (i, j, _) in enumerate(second.legs))]
    course = world.SurveyCourse(places, legs, [str(k) for k in range(len(places))])
    read = world.readings_of(course, rng, compass_deg=1.5)
    read = [replace(leg, dive=1 + (k >= len(first.legs))) for k, leg in enumerate(read)]
    wrong = str(7 + seed)
    at = len(first.legs) + 4
    read[at], read[at + 1] = replace(read[at], to=wrong), replace(read[at + 1], from_=wrong)
    found = adjust(world.project_of(read)).blunders
    assert found[0].cause == f"station name: {wrong} of {read[at].name} and {read[at + 1].name}: it is another place"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_nearly_all_misnamed_stations_are_named_first():
    found = [named_first(seed) for seed in range(200)]
    assert np.mean([right for right, _ in found]) >= 0.95
    assert np.mean([known for _, known in found]) >= 0.9


def false_blunder(seed):
    """Whether something is said to be wrong in a sound survey of 3 to 40 legs: a line, a loop, or a network."""
    rng = np.random.default_rng([seed, 77])
    legs = int(rng.integers(3, 41))
    course = (world.line(rng, legs), world.loop(rng, max(legs, 4)), two_loops(seed)[0])[seed % 3]
    read = world.readings_of(course, rng, compass_deg=float(rng.choice([1.0, 1.5, 4.0])))
    turns = turned(course, read, rng) if seed % 4 < 2 else []
    return bool(adjust(world.project_of(read, "absolute" if seed % 5 else "readings", turn=turns)).blunders)


@pytest.mark.parametrize("seed", range(1000, 1006))
def test_few_legs_whose_instruments_nothing_else_checks_have_no_blunder(seed):
    rng = np.random.default_rng(seed)
    course = world.line(rng, 3)
    legs = world.readings_of(course, rng, compass_deg=1.5)
    # Both compasses err by more than is stated: nothing tells whether it is one's iron or the other's.
    legs = [replace(leg, azimuth_deg=leg.azimuth_deg + 4.0) for leg in legs]
    assert not adjust(world.project_of(legs, turn=turned(course, legs, rng))).blunders


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_sound_surveys_have_no_blunder():
    assert sum(false_blunder(seed) for seed in range(200)) <= 4


def test_the_fewer_observations_too_many_the_more_a_suspicion_needs():
    needed = [critical_chi2(100, variance_freedom) for variance_freedom in (20, 50, 1000)]
    assert needed == sorted(needed, reverse=True)
    # Of one in 10,000, both ways, of Student's and of the normal distribution.
    assert needed[0] == pytest.approx(4.84**2, rel=0.02)
    assert needed[2] == pytest.approx(3.90**2, rel=0.02)


@pytest.mark.parametrize("seed", range(100, 106))
def test_a_sound_network_has_no_blunder(seed):
    course, rng = two_loops(seed)
    adjusted = adjust(world.project_of(world.readings_of(course, rng)))
    assert not adjusted.blunders
    assert 0.5 < adjusted.fit.factor < 2.0


def test_a_turned_compass_and_a_misread_gauge_are_named():
    course, rng = two_loops(3)
    legs = world.readings_of(course, rng)
    turned = replace(legs[20], back_azimuth_deg=(legs[20].back_azimuth_deg + 180) % 360)
    (blunder,) = adjust(world.project_of([*legs[:20], turned, *legs[21:]])).blunders
    assert blunder.cause == f"leg {turned.name}: compass of {turned.to_node}"
    assert "turned by 180 deg" in blunder.text
    deeper = replace(legs[20], depth_to_m=legs[20].depth_to_m + 0.5)
    (blunder,) = adjust(world.project_of([*legs[:20], deeper, *legs[21:]])).blunders
    # Its node has read it there once more, in the next leg: either may be the wrong one.
    assert {f"leg {leg.name}: gauge of {deeper.to_node}" for leg in legs[19:22]} & {blunder.cause, *blunder.others}
    assert blunder.off == pytest.approx(0.5, abs=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_a_baseline_finds_a_wrong_focal_length(seed):
    course = world.line(np.random.default_rng(seed), 12)
    course.stations_m[1] = course.stations_m[0] + (14.0, 14.28, 0.3)
    legs = world.readings_of(course, np.random.default_rng(seed), tape_m=0.01)
    # A leg's stated sd holds the scale's as well.
    legs = [
        replace(leg, distance_m=leg.distance_m * 1.005, distance_sigma_m=math.hypot(0.01, 0.0015 * leg.distance_m))
        for leg in legs
    ]
    base_m = float(np.linalg.norm(course.stations_m[1] - course.stations_m[0]))
    known = [Known(from_="0", to="1", distance_m=base_m, sigma_m=0.002)]
    unknown = adjust(world.project_of(legs)).solution.unknown("scale of a and b")
    assert unknown[1] == pytest.approx(0.0015, rel=0.02)
    scale, sigma = adjust(world.project_of(legs, known=known)).solution.unknown("scale of a and b")
    assert sigma < 0.001
    assert scale == pytest.approx(0.005, abs=2.5 * sigma)


@pytest.mark.parametrize("seed", range(4))
def test_two_fixed_points_find_a_wrong_focal_length(seed):
    course = world.line(np.random.default_rng(seed), 12)
    # A straight line: what compasses err moves its end aside, not along.
    course.stations_m = np.linspace((0.0, 0.0, 10.0), (60.0, 40.0, 12.0), 13)
    legs = world.readings_of(course, np.random.default_rng(seed), tape_m=0.01)
    legs = [replace(leg, distance_m=leg.distance_m * 1.005) for leg in legs]
    ends = [world.enu(course.stations_m[k]) for k in (0, 12)]
    fix = [FixedPoint(station=n, east_m=e[0], north_m=e[1]) for n, e in zip(("0", "12"), ends, strict=True)]
    fixed = adjust(world.project_of(legs, fix=fix, place=Place(declination_deg=0.0)))
    assert fixed.solution.unknown("scale of a and b")[0] == pytest.approx(0.005, abs=0.001)


def test_exact_readings_and_two_fixed_points_give_the_scale_itself():
    course = world.line(np.random.default_rng(4), 12)
    legs = world.readings_of(course, np.random.default_rng(4), compass_deg=0.0, tape_m=0.0, depth_m=0.0)
    legs = [replace(leg, distance_m=leg.distance_m * 1.005, distance_sigma_m=0.02) for leg in legs]
    ends = [world.enu(course.stations_m[k]) for k in (0, 12)]
    fix = [FixedPoint(station=n, east_m=e[0], north_m=e[1]) for n, e in zip(("0", "12"), ends, strict=True)]
    scale, sigma = adjust(world.project_of(legs, fix=fix)).solution.unknown("scale of a and b")
    # What was known of it before is freed, so that it pulls no more.
    assert sigma < 0.0015 / 2
    assert scale == pytest.approx(0.005, abs=2e-5)


def test_a_sparse_inverse_is_the_dense_one(monkeypatch):
    pytest.importorskip("scipy")
    course, rng = two_loops(1)
    project = world.project_of(world.readings_of(course, rng))
    dense = adjust(project)
    monkeypatch.setattr(normal, "DENSE", 0)
    sparse = adjust(project)
    assert sparse.solution.chi2 == pytest.approx(dense.solution.chi2)
    for name, position in dense.positions.items():
        np.testing.assert_allclose(sparse.positions[name].position_m, position.position_m, atol=1e-7)
        np.testing.assert_allclose(sparse.positions[name].covariance, position.covariance, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(sparse.solution.redundancies, dense.solution.redundancies, atol=1e-7)
    some = np.array([0, 1, 2, 40, 7, 41, len(dense.solution.x) - 1])
    expected = dense.solution.normal.inverse(some)
    np.testing.assert_allclose(
        expected, dense.solution.normal.solve(np.eye(len(dense.solution.x))[:, some])[some], rtol=1e-6, atol=1e-15
    )
    np.testing.assert_allclose(sparse.solution.normal.inverse(some), expected, rtol=1e-6, atol=1e-15)
    # The trace of I - A N^-1 A^T W.
    assert dense.solution.redundancies.sum() == pytest.approx(dense.solution.freedom, rel=1e-6)


@pytest.mark.parametrize(("legs", "of_a_dive"), [(1500, 300), (900, 20)])
def test_an_inverse_stays_sparse_over_long_lines_and_many_dives(legs, of_a_dive):
    pytest.importorskip("scipy")
    rng = np.random.default_rng(1)
    read = world.readings_of(world.line(rng, legs), rng)
    adjusted = adjust(world.project_of([replace(leg, dive=1 + k // of_a_dive) for k, leg in enumerate(read)]))
    solved = adjusted.solution.normal
    # Of neighbours and of a dive's own instruments, not of other dives'.
    assert np.mean([len(below) for below in solved.tree.below]) < 40
    for name in ("1", str(legs // 2), str(legs)):
        number = adjusted.solution.observations.at[name]
        unit = np.zeros((len(adjusted.solution.x), 3))
        unit[3 * number : 3 * number + 3] = np.eye(3)
        expected = solved.solve(unit)[3 * number : 3 * number + 3]
        np.testing.assert_allclose(adjusted.positions[name].covariance, expected, rtol=1e-6, atol=1e-12)


def test_a_network_of_distances_alone_keeps_its_shape():
    rng = np.random.default_rng(2)
    datums_m = np.column_stack([rng.uniform(0, 12, (6, 2)), rng.uniform(8, 10, 6)])
    pairs = [(i, j, 0) for i in range(6) for j in range(i + 1, 6)]
    course = world.SurveyCourse(datums_m, pairs, [f"D{k}" for k in range(6)])
    legs = [
        replace(leg, azimuth_deg=UNSET, back_azimuth_deg=UNSET, inclination_deg=UNSET, back_inclination_deg=UNSET)
        for leg in world.readings_of(course, rng, tape_m=0.01, depth_m=0.01)
    ]
    project = world.project_of(legs)
    adjusted = adjust(replace(project, adjust=AdjustSettings(datum="free")))
    assert len(adjusted.positions) == 6
    assert not adjusted.left_out
    found = np.array([adjusted.positions[name].position_m for name in course.names])
    for i, j, _ in pairs:
        true_m = np.linalg.norm(datums_m[i] - datums_m[j])
        assert np.linalg.norm(found[i] - found[j]) == pytest.approx(true_m, abs=0.05)
    start = adjust(replace(project, adjust=AdjustSettings(datum="start")))
    sizes = [sum(p.ellipse[0] ** 2 for p in one.positions.values()) for one in (adjusted, start)]
    # Inner constraints have the least trace.
    assert sizes[0] < sizes[1]


@pytest.mark.parametrize("dense", [0, 1500])
def test_legs_that_no_gyroscope_ties_to_a_known_azimuth_are_refused_in_words(monkeypatch, dense):
    pytest.importorskip("scipy")
    monkeypatch.setattr(normal, "DENSE", dense)
    legs = world.readings_of(world.line(np.random.default_rng(1), 6), np.random.default_rng(1))
    known = [Known(from_="0", to="1", azimuth_deg=20.0, azimuth_sigma_deg=0.1)]
    with pytest.raises(BuddylineError, match="stations that its observations do not fix"):
        adjust(replace(world.project_of(legs, known=known), adjust=AdjustSettings(compass="ignore")))


def test_an_unchecked_leg_has_no_detectable_error_and_the_report_says_the_global_test():
    legs = world.readings_of(world.line(np.random.default_rng(1), 5), np.random.default_rng(1))
    project = world.project_of([replace(leg, back_azimuth_deg=UNSET, back_azimuth_sigma_deg=UNSET) for leg in legs])
    adjusted = adjust(project)
    of = adjusted.solution
    azimuths = [
        row for row, what in enumerate(of.observations.what) if what.startswith("compass of") and of.model.leg[row] >= 0
    ]
    assert np.isinf(detectable(of)[azimuths]).all()
    assert any("variance factor" in line for line in report.summary(Sheet(project, adjusted)))


@pytest.mark.parametrize(
    ("chi2", "freedom", "said"),
    [
        (0.0, 0, "no observation more than needed, so nothing is checked"),
        (
            8.0,
            9,
            "9 observations more than needed; all agree as well as their sds say (chi2 8.0, variance factor 0.89)",
        ),
        (
            0.5,
            9,
            "9 observations more than needed; all agree better than their sds say (chi2 0.5, variance factor 0.06)",
        ),
        (
            *(20.0, 1),
            "1 observation more than needed; all contradict each other by more than their sds explain "
            "(chi2 20.0, variance factor 20.00)",
        ),
    ],
)
def test_the_global_test_is_said_in_plain_words(chi2, freedom, said):
    assert SurveyFit(chi2, freedom, chance_of(chi2, freedom), {}).verdict == said


def test_gps_in_height_is_apart_from_gps_on_the_map():
    legs = world.readings_of(world.line(np.random.default_rng(4), 3), np.random.default_rng(1))
    fixes = [
        FixedPoint(station=name, east_m=0.0, north_m=0.0, sigma_m=20.0, altitude_m=altitude_m, altitude_sigma_m=sigma_m)
        for name, altitude_m, sigma_m in (("0", 90.0, 0.1), ("3", 88.0, 3.0))
    ]
    adjusted = adjust(world.project_of(legs, fix=fixes))
    # The better height counts; both have one water level.
    assert adjusted.positions["0"].position_m[2] == pytest.approx(90.0, abs=0.2)
    assert adjusted.positions["0"].sigmas_m[2] == pytest.approx(0.1, abs=0.02)
    assert math.hypot(*adjusted.positions["0"].sigmas_m[:2]) > 10


@pytest.mark.parametrize(
    ("known", "said"),
    [
        (Known(from_="0", to="x1", distance_m=3.0), "no leg has station x1"),
        (Known(from_="0", to="1"), "give distance_m"),
    ],
)
def test_a_known_line_that_says_nothing_is_refused(known, said):
    legs = world.readings_of(world.line(np.random.default_rng(4), 3), np.random.default_rng(1))
    with pytest.raises(BuddylineError, match=said):
        adjust(world.project_of(legs, known=[known]))


def test_what_nothing_determines_is_a_known_error():
    with pytest.raises(BuddylineError, match="nothing observes"):
        normal.Normal((np.array([0]), np.array([0])), np.array([1.0]), np.array([1.0]), np.array([0, 1]))


def test_dives_that_all_cross_are_eliminated_with_little_fill():
    rng, n, legs = np.random.default_rng(5), 20, []
    places_m = np.stack(
        [*np.meshgrid(6.0 * np.arange(n), 6.0 * np.arange(n), indexing="ij"), np.full((n, n), 12.0)], -1
    )
    places_m += rng.normal(size=places_m.shape)
    for dive in range(2 * n):
        line = [(dive, k) if dive < n else (k, dive - n) for k in range(n)]
        steps = [(k, k + 1, k % 2) for k in range(n - 1)]
        course = world.SurveyCourse(np.array([places_m[at] for at in line]), steps, [f"{i}x{j}" for i, j in line])
        legs += [replace(leg, dive=dive + 1) for leg in world.readings_of(course, rng)]
    project = world.project_of(legs)
    solved = Survey(project, grid_of(project)).adjust().normal
    assert solved.count > normal.DENSE
    # With each dive's instruments among its stations, as a survey of few loops has them, there are 497,000.
    assert solved._lu.L.nnz < 300_000
