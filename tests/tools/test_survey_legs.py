"""From messages to legs, through the true solver: rests, stations, sigmas, alarms, points."""

import math

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Imu, Mark, Rejected, RelativePose, Track
from buddyline.tools.survey.averages import effective_count, inliers, mean_of_slow, mean_of_white, unwrapped, wrap
from buddyline.tools.survey.chain import Stop, find_standings
from buddyline.tools.survey.derive import Derived, ranges
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.project import Leg
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.rests import rests
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from buddyline.tools.survey.sights import sights
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from tests.tools import survey_world as world

COURSE = world.line(np.random.default_rng(2), 5)


@pytest.fixture(scope="module")
def messages():
    return world.dive(COURSE, np.random.default_rng(7), rest_s=8.0, swim_s=2.0)


def derived(messages, **settings):
    result = Derived()
    result.add(of_messages(messages), SurveySettings(**settings), AlarmSettings())
    return result


def test_a_leapfrog_dive_gives_its_legs(messages):
    found = derived(messages)
    assert [(leg.from_, leg.to) for leg in found.legs] == [(str(k), str(k + 1)) for k in range(5)]
    assert [leg.from_node for leg in found.legs] == ["a", "b", "a", "b", "a"]
    assert not found.problems
    for leg, (start, end, _) in zip(found.legs, COURSE.legs, strict=True):
        way = COURSE.stations_m[end] - COURSE.stations_m[start]
        azimuth = math.degrees(math.atan2(way[1], way[0]))
        assert abs(leg.distance_m - np.linalg.norm(way)) < 4 * leg.distance_sigma_m
        assert abs(leg.distance_m - np.linalg.norm(way)) < 0.15
        for angle, turn in ((leg.azimuth_deg, 0), (leg.back_azimuth_deg, 180)):
            assert abs((angle - azimuth - turn + 180) % 360 - 180) < 4 * leg.azimuth_sigma_deg
        assert abs(leg.depth_from_m - COURSE.stations_m[start][2]) < 4 * leg.depth_from_sigma_m
        assert abs(leg.depth_to_m - COURSE.stations_m[end][2]) < 4 * leg.depth_to_sigma_m
        # A compass of 1.5 degrees that errs slowly is not made better by averaging.
        assert 1.2 < leg.azimuth_sigma_deg < 1.8
        assert leg.fixes >= 8
        assert leg.fixes_used
    assert [station.name for station in found.stations({})] == [str(k) for k in range(6)]


def test_every_fix_of_a_rest_is_used_or_its_reason_is_given(messages):
    (readings,) = of_messages(messages)
    for leg in derived(messages).legs:
        within = [
            m.trigger for m in messages if isinstance(m, RelativePose) and leg.start_ns <= m.stamp_ns <= leg.end_ns
        ]
        named = set()
        for text in [leg.fixes_used, *leg.unused.values()]:
            for part in text.split():
                first, _, last = part.partition("-")
                named |= set(range(int(first), int(last or first) + 1))
        assert set(within) <= named
    assert len(readings.triggers) > 0


def test_marks_name_stations_and_keep_their_notes(messages):
    second = derived(messages).legs[1]
    mark = Mark(node=second.from_node, stamp_ns=second.start_ns + 10**9, name="T1", note="big flake")
    found = derived([*messages, mark])
    assert [(leg.from_, leg.to) for leg in found.legs][:3] == [("0", "T1"), ("T1", "2"), ("2", "3")]
    assert next(station for station in found.stations({}) if station.name == "T1").notes == ["big flake"]


def test_a_mark_of_an_earlier_station_closes_the_loop(messages):
    last = derived(messages).legs[-1]
    mark = Mark(node=last.to_node, stamp_ns=last.start_ns, name="0")
    assert derived([*messages, mark]).legs[-1].to == "0"


def test_a_mark_with_an_invalid_name_is_reported_and_ignored(messages):
    mark = Mark(node="a", stamp_ns=world.START_NS, name="not a name!")
    found = derived([*messages, mark])
    assert found.legs == derived(messages).legs
    assert "no station's name" in found.problems[0].text


def test_a_point_is_measured_from_the_other_nodes_station(messages):
    leg = derived(messages).legs[2]
    mark = Mark(node=leg.to_node, stamp_ns=leg.end_ns - 10**9, kind="point", name="amphora", note="neck up")
    found = derived([*messages, mark])
    (point,) = found.points
    assert (point.from_, point.to, point.note) == (leg.from_, "amphora", "neck up")
    project = world.project_of(found.legs, points=found.points)
    adjusted = adjust(project)
    station = adjusted.positions[leg.to]
    assert np.linalg.norm(adjusted.points[0].position_m - station.position_m) < 0.3
    assert adjusted.points[0].ellipse[0] > 0.02


def test_a_station_that_is_swum_past_is_measured_by_the_track():
    course = world.line(np.random.default_rng(2), 2)
    messages = world.dive(course, np.random.default_rng(7), rest_s=8.0, swim_s=50.0)
    first, second = derived(messages).legs
    at_ns = (first.end_ns + second.start_ns) // 2
    pose = next(m for m in messages if isinstance(m, RelativePose) and m.stamp_ns > first.start_ns)
    # As if a were still at station 0; where the track has no row there, nothing is made up.
    row = Track(
        node_a="a",
        node_b="b",
        stamp_ns=at_ns + 5 * 10**7,
        t_a_b_m=pose.t_a_b_m,
        q_a_b_xyzw=pose.q_a_b_xyzw,
        covariance=pose.covariance,
        v_a_b_mps=(0.0, 0.0, 0.0),
        v_covariance=[0.0] * 9,
        mode="smooth",
        lights=4,
        age_s=0.0,
        range_m=1.0,
    )
    mark = Mark(node="a", stamp_ns=at_ns, name="M", note="flake")
    found = derived([*messages, row, mark])
    assert not found.faults
    assert "M" not in found.numbered
    leg = found.legs[2]
    assert (leg.from_, leg.from_node, leg.to, leg.note) == ("1", "b", "M", "swum past flake")
    assert abs(leg.distance_m - first.distance_m) < 0.15
    assert abs((leg.azimuth_deg - first.back_azimuth_deg + 180) % 360 - 180) < 5.0
    assert abs(leg.depth_to_m - first.depth_from_m) < 0.2
    assert 0.2 < leg.distance_sigma_m < 0.25
    for wrong, why in (([mark], "no track"), ([row, replace(mark, node="b")], "where node a stood")):
        found = derived([*messages, *wrong])
        assert len(found.legs) == 2
        assert found.faults == 1
        assert why in found.problems[0].text


def test_a_point_without_fixes_is_reported(messages):
    mark = Mark(node="b", stamp_ns=world.START_NS - 10**12, kind="point", name="wreck")
    found = derived([*messages, mark])
    assert not found.points
    assert "wreck" in found.problems[0].text


def test_a_station_mark_that_names_nothing_is_said_beside_a_point_too(messages):
    early_ns = world.START_NS - 10**12
    marks = [
        Mark(node="b", stamp_ns=early_ns, kind=kind, name=name)
        for kind, name in (("point", "wreck"), ("station", "T4"))
    ]
    texts = [problem.text for problem in derived([*messages, *marks]).problems]
    assert any(text.startswith("point wreck") for text in texts)
    assert any(text.startswith("mark T4") and "no rest near it" in text for text in texts)


def test_moving_round_a_fixed_node_keeps_its_station():
    rng = np.random.default_rng(4)
    places = np.array([[0.0, 0, 10], [5, 1, 9.0], [4, -3, 11.0], [6, 2, 10.2]])
    course = world.SurveyCourse(places, [(0, 1, 0), (0, 2, 0), (0, 3, 0)], ["0", "1", "2", "3"])
    found = derived(world.dive(course, rng, rest_s=6.0, swim_s=2.0), procedure="stay")
    assert [(leg.from_, leg.to) for leg in found.legs] == [("0", "1"), ("0", "2"), ("0", "3")]


def test_a_handled_node_is_not_at_rest(messages):
    third = derived(messages).legs[2]
    shaken = [
        replace(m, gyro_radps=(2.0, 0.0, 0.0))
        if isinstance(m, Imu) and m.node == "a" and third.start_ns <= m.stamp_ns <= third.end_ns
        else m
        for m in messages
    ]
    assert len(derived(shaken).legs) == 4


def test_a_rest_too_short_for_a_leg_is_reported(messages):
    third = derived(messages).legs[2]
    middle = (third.start_ns + third.end_ns) // 2
    cut = [
        message
        for message in messages
        if not (isinstance(message, RelativePose) and middle <= message.stamp_ns <= third.end_ns)
    ]
    found = derived(cut)
    assert len(found.legs) == 4
    assert any("NO LEG" in problem.text for problem in found.problems)
    assert any(alarm.startswith("stations: a rest before") for alarm in found.legs[2].alarms)


def test_a_rest_with_rejected_poses_is_reported(messages):
    third = derived(messages).legs[2]
    kept = 0
    refused = []
    for message in messages:
        if isinstance(message, RelativePose) and third.start_ns - 10**9 <= message.stamp_ns <= third.end_ns + 10**9:
            kept += 1
            if kept > 2:
                a, b = message.node_a, message.node_b
                rejected = Rejected(
                    node_a=a, node_b=b, stamp_ns=message.stamp_ns, trigger=message.trigger, reason="range_gap"
                )
                refused.append(rejected)
                continue
        refused.append(message)
    found = derived(refused)
    assert len(found.legs) == 4
    (problem,) = found.problems
    assert "NO LEG" in problem.text
    assert "refused: range_gap" in problem.text
    assert any(alarm.startswith("stations: a rest before") for alarm in found.legs[2].alarms)


def test_a_compass_that_states_more_may_wander_more_while_its_node_rests():
    course = world.line(np.random.default_rng(11), 8)
    found = derived(world.dive(course, np.random.default_rng(11), world.Flaws(compass_deg=5.0), rest_s=8.0, swim_s=2.0))
    assert len(found.legs) == 8


def test_consecutive_rests_are_two_legs():
    messages = world.dive(COURSE, np.random.default_rng(3), rest_s=8.0, swim_s=0.0)
    shorter = [m for m in messages if not _approaching(m)]
    assert [(leg.from_, leg.to) for leg in derived(shorter).legs] == [(str(k), str(k + 1)) for k in range(5)]


def _approaching(message):
    """Tell whether a pose is of the three seconds in which a node swims up to its station."""
    second = (message.stamp_ns - world.START_NS) / 1e9 % 11.0 if isinstance(message, RelativePose) else 10.0
    return second < 3.0


def test_swimming_is_not_rest(messages):
    (readings,) = of_messages(messages)
    for rest in rests(readings, sights(readings, SurveySettings()), SurveySettings()):
        assert (rest.end_ns - rest.start_ns) / 1e9 < 10.5


def test_true_headings_give_the_same_magnetic_legs(messages):
    turn = math.radians(10)
    half = np.array([0, 0, math.sin(turn / 2), math.cos(turn / 2)])

    def turned(message):
        if hasattr(message, "q_ned_body_xyzw"):
            x, y, z, w = message.q_ned_body_xyzw
            s, c = half[2], half[3]
            q = (c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z)
            return replace(message, q_ned_body_xyzw=tuple(float(v) for v in q))
        if hasattr(message, "declination_rad"):
            return replace(message, declination_rad=turn)
        return message

    for one, other in zip(derived(messages).legs, derived(map(turned, messages)).legs, strict=True):
        assert one.azimuth_deg == pytest.approx(other.azimuth_deg, abs=2e-3)


def test_a_disturbed_field_is_noticed_and_its_compass_not_used():
    rng = np.random.default_rng(11)
    course = world.line(rng, 5)
    flaws = world.Flaws(compass_deg=0.5)

    def disturb(index, number):
        return 15.0 if (index, number) == (1, 3) else 0.0

    found = derived(world.dive(course, rng, flaws, rest_s=7.0, swim_s=1.0, disturb=disturb))
    # Node b stands at station 3 in legs 2-3 and 3-4.
    assert [leg.disturbed for leg in found.legs] == [[], [], ["b"], ["b"], []]
    leg = found.legs[2]
    assert any(alarm.startswith("sights") for alarm in leg.alarms)
    assert any(alarm.startswith("field: at node b") for alarm in leg.alarms)
    assert leg.grade == 2
    adjusted = adjust(world.project_of(found.legs))
    end = world.enu(course.stations_m[-1] - course.stations_m[0])
    assert np.linalg.norm((adjusted.positions["5"].position_m - adjusted.positions["0"].position_m - end)[:2]) < 1.0


def stop(line, a=10.0, b=10.0):
    return Stop(np.array(line, dtype=float), {"a": a, "b": b})


def test_depths_show_which_node_has_moved():
    stops = [stop((5, 0, 0)), stop((4, 2, 0), b=12.0), stop((-4, 1, 0), a=14.0, b=12.0), stop((3, 3, 1), a=9, b=9)]
    standings = find_standings(stops, "leapfrog", "a")
    assert [s.station["a"] + s.station["b"] for s in standings] == ["01", "02", "32", "54"]
    assert [bool(s.problem) for s in standings] == [False, False, False, True]


def test_without_other_evidence_the_procedure_decides():
    level = [stop((5, 0, 0)), stop((-5, 0, 0)), stop((5, 1, 0))]
    assert [s.station["a"] + s.station["b"] for s in find_standings(level, "leapfrog", "a")] == ["01", "21", "23"]
    assert [s.station["a"] + s.station["b"] for s in find_standings(level, "leapfrog", "b")] == ["10", "12", "32"]
    assert [s.station["a"] + s.station["b"] for s in find_standings(level, "stay", "a")] == ["01", "02", "03"]
    again = [stop((5, 0, 0)), stop((5.02, 0, 0))]
    assert [s.station["a"] + s.station["b"] for s in find_standings(again, "leapfrog", "a")] == ["01", "01"]


def test_marks_take_precedence_over_depths():
    moved = Stop(np.array([-4.0, 0.0, 0.0]), {"a": 13.0, "b": 10.0}, {"b": "X"})
    standing = find_standings([stop((5, 0, 0)), moved], "leapfrog", "a")[1]
    assert standing.station == {"a": "2", "b": "X"}


@given(st.floats(-50, 50))
def test_wrapping_keeps_the_direction(angle):
    assert math.cos(wrap(angle)) == pytest.approx(math.cos(angle), abs=1e-9)
    assert -math.pi <= wrap(angle) <= math.pi
    turned = unwrapped(np.array([angle, angle + 0.1, angle - 0.1]))
    assert np.ptp(turned) == pytest.approx(0.2, abs=1e-9)


def test_outliers_are_left_out_and_a_lone_step_is_not():
    values = np.array([1.0, 1.01, 0.99, 1.0, 5.0])
    assert inliers(values, 0.01).tolist() == [True, True, True, True, False]
    assert inliers(np.array([1.0, 1.0, 1.0, 1.001]), 0.01).all()


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_sigma_of_slow_readings_is_the_error_of_their_mean(share):
    rng = np.random.default_rng(0)
    stamps = np.arange(40) * 0.5
    chi = []
    for _ in range(300):
        values = math.sqrt(share) * rng.normal() + math.sqrt(1 - share) * rng.normal(size=40)
        mean = mean_of_slow(stamps, values, 1.0, 0.0)
        chi.append(mean.value / mean.sigma)
    # Never too certain; if all noise is new, the sample's own variance underestimates it slightly.
    assert 0.3 < np.std(chi) < 1.1
    if share == 1.0:
        assert np.std(chi) > 0.9


def test_correlated_readings_count_for_less():
    rng = np.random.default_rng(1)
    stamps = np.arange(200) * 2.0
    white = rng.normal(size=200)
    slow = np.convolve(rng.normal(size=219), np.ones(20) / math.sqrt(20), "valid")
    assert effective_count(stamps, white) > 100
    assert effective_count(stamps, slow) < 40
    assert mean_of_white(stamps, slow, 0.1, 0.0).sigma > mean_of_white(stamps, white, 0.1, 0.0).sigma


def test_trigger_numbers_are_written_as_ranges():
    assert ranges([3, 4, 5, 9, 7, 4]) == "3-5 7 9"
    assert ranges([]) == ""


def test_a_leg_is_named_by_its_ends():
    assert "from" in Leg.__struct_encode_fields__


def test_three_nodes_make_one_network(messages):
    # c stands beside b and sees a as b does: the two pairs look at the same stations at the same time.
    both = derived([*messages, *(world.renamed(message, b="c") for message in messages)])
    assert len(both.legs) == 10
    assert {frozenset((leg.from_node, leg.to_node)) for leg in both.legs} == {frozenset("ab"), frozenset("ac")}
    shared = {leg.from_ for leg in both.legs[:5]} | {leg.to for leg in both.legs[:5]}
    # Where a stood is known from its legs with b; where c stood has numbers of its own.
    for first, second in zip(both.legs[:5], both.legs[5:], strict=True):
        at_a = {leg.from_node: leg.from_ for leg in (first,)} | {first.to_node: first.to}
        at_a_too = {second.from_node: second.from_, second.to_node: second.to}
        assert at_a["a"] == at_a_too["a"]
        assert at_a_too["c"] not in shared


def test_a_second_dive_takes_numbers_of_its_own(messages):
    found = Derived()
    for dive in (1, 2):
        found.add(of_messages(messages), SurveySettings(), AlarmSettings(), dive)
    names = [{name for leg in found.legs if leg.dive == dive for name in (leg.from_, leg.to)} for dive in (1, 2)]
    assert not names[0] & names[1]
    # A mark by a number means the first dive's station, and ties the two.
    first = found.legs[0]
    tied = Derived()
    tied.add(of_messages(messages), SurveySettings(), AlarmSettings(), 1)
    mark = Mark(node=first.from_node, stamp_ns=first.start_ns, name="3")
    tied.add(of_messages([*messages, mark]), SurveySettings(), AlarmSettings(), 2)
    assert tied.legs[5].from_ == "3"
    assert {leg.name for leg in tied.legs[6:]}.isdisjoint({leg.name for leg in tied.legs[:5]})
    assert "taken for station 3 of dive 1" in "".join(problem.text for problem in tied.problems)
    assert not any("taken for" in problem.text for problem in found.problems)


def test_a_mark_by_hand_takes_precedence_and_equate_joins_stations(messages):
    plain = derived(messages)
    leg = plain.legs[2]
    wrong = Mark(node=leg.to_node, stamp_ns=leg.end_ns, name="T21")
    right = Mark(node=leg.to_node, stamp_ns=leg.start_ns, name="T12")
    found = Derived()
    found.add(of_messages([*messages, wrong]), SurveySettings(), AlarmSettings(), by_hand=[right])
    assert found.legs[2].to == "T12"
    assert not found.problems
    # Of two in the log the later one counts, and that is said.
    later = derived([*messages, wrong, replace(right, stamp_ns=wrong.stamp_ns + S_NS)])
    assert later.legs[2].to == "T12"
    assert "is at T21 and at T12; T12 counts" in later.problems[0].text
    found.equate(["T12", found.legs[0].from_])
    assert found.legs[0].from_ == "T12"
    assert "T12" in {station.name for station in found.stations({})}
    with pytest.raises(BuddylineError, match="equate of 'T21'"):
        found.equate(["T12", "T21"])
