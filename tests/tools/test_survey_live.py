"""Legs that are judged while they are measured: the same alarms as afterwards, in time."""

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Depth, Mark
from buddyline.tools.survey.derive import Derived
from buddyline.tools.survey.live import OVER_NS, LiveLegs
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from msgspec.structs import replace

from tests.tools import evaluated, watched
from tests.tools import survey_world as world


def judged(messages):
    """Each leg as it is derived afterwards, and what node a is told of it: meanwhile, or later as of an earlier leg."""
    live = LiveLegs(SurveySettings(), AlarmSettings())
    said = [mark for message in messages for mark in live.handle(message)]
    assert [mark.note for mark in said if mark.node == "a"] == [mark.note for mark in said if mark.node == "b"]
    afterwards, found = Derived(), []
    afterwards.add(of_messages(messages), SurveySettings(), AlarmSettings())
    for leg in afterwards.legs:
        meanwhile = [mark for mark in said if mark.node == "a" and abs(mark.leg_ns - leg.start_ns) < 3 * S_NS]
        for mark in meanwhile:
            assert mark.earlier or mark.stamp_ns <= leg.end_ns + OVER_NS + S_NS
            assert mark.note.startswith(f"leg {leg.name} of ") is mark.earlier
        found.append((leg, meanwhile))
    return found


def test_each_leg_is_judged_at_its_tenth_second():
    rng = np.random.default_rng(11)
    course = world.line(rng, 6)

    def disturb(index, number):
        return 20.0 if (index, number) == (0, 6) else 0.0

    messages = world.dive(course, rng, world.Flaws(compass_deg=0.5), rest_s=12.0, swim_s=3.0, disturb=disturb)
    verdicts = judged(messages)
    assert len(verdicts) == 6
    for leg, said in verdicts:
        # A leg begins with the first fix that it keeps, one or two triggers after the rest's first.
        assert -S_NS <= said[0].stamp_ns - leg.start_ns - 10 * S_NS <= 3 * S_NS
        assert {mark.name for mark in said if mark.kind == "alarm"} == {text.partition(":")[0] for text in leg.alarms}
    kinds = [said[0].kind for _, said in verdicts]
    assert kinds[:5] == ["leg"] * 5
    assert {mark.name for mark in verdicts[5][1]} >= {"sights", "field"}
    assert "m, 1" in verdicts[0][1][0].note


def test_a_station_that_is_seen_again_is_recognized_while_the_nodes_are_there():
    rng = np.random.default_rng(5)
    course = world.loop(rng, 4)
    course.marks.clear()
    *others, (leg, said) = judged(world.dive(course, rng, rest_s=10.5, swim_s=1.0))
    # Nobody has said that the last station is the first: it is asked, and keeps its number.
    assert leg.name == "3-4"
    assert "station 4 may be 0: " in said[0].note
    assert " sd: if it is, mark it" in said[0].note
    assert not any("may be" in mark.note for _, said in others for mark in said)


def test_an_alarm_of_an_earlier_leg_says_which():
    rng = np.random.default_rng(11)
    course = world.line(rng, 5)

    def disturb(index, number):
        return 20.0 if (index, number) == (0, 0) else 0.0

    # The usual field is known only later: then the first leg's alarm comes.
    messages = world.dive(course, rng, world.Flaws(compass_deg=0.5), rest_s=10.5, swim_s=1.0, disturb=disturb)
    tag = Mark(node="b", stamp_ns=world.START_NS, name="T100", tag=100)
    (leg, said), *others = judged([messages[0], tag, *messages[1:]])
    assert leg.name == "0-T100"
    late = [mark for mark in said if mark.earlier]
    assert "field" in {mark.name for mark in late}
    assert all(mark.stamp_ns - mark.leg_ns > 20 * S_NS for mark in late)
    assert not any(mark.earlier for _, said in others for mark in said)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_every_alarm_is_said_in_the_water_and_few_others():
    false = sound = alarmed = 0
    for seed in range(5):
        rng = np.random.default_rng([seed, 9])
        course = world.line(rng, 10)
        flaws = world.Flaws(compass_deg=(1.0, 1.5)[seed % 2], disturbed_share=(0.0, 0.1)[seed % 2])
        for leg, said in judged(
            world.dive(course, rng, flaws, float(rng.uniform(10.5, 16)), float(rng.uniform(3, 10)))
        ):
            signalled = any(mark.kind == "alarm" for mark in said)
            assert signalled or not leg.alarms, leg.name
            alarmed += bool(leg.alarms)
            sound += not leg.alarms
            false += signalled and not leg.alarms
    assert alarmed > 10
    assert false <= 0.02 * sound


def test_two_pairs_are_watched_live():
    rng = np.random.default_rng(11)
    course = world.line(rng, 3)
    messages = world.dive(course, rng, rest_s=8.0, swim_s=2.0)
    wrong = [replace(m, depth_m=m.depth_m + 3.0) if isinstance(m, Depth) and m.node == "b" else m for m in messages]
    live = LiveLegs(SurveySettings(), AlarmSettings())
    said = []
    for message in wrong:
        said += live.handle(message) + live.handle(world.renamed(message, a="c", b="d"))
    assert {mark.node for mark in said if mark.name == "depth"} == {"a", "b", "c", "d"}


def test_in_a_team_of_three_each_verdict_names_its_pair():
    rng = np.random.default_rng(11)
    messages = world.dive(world.line(rng, 2), rng, rest_s=12.0, swim_s=2.0)
    live = LiveLegs(SurveySettings(), AlarmSettings())
    # C is where b is, and does what b does.
    team = [each for message in messages for each in (message, world.renamed(message, b="c"))]
    said = [mark for message in team for mark in live.handle(message)]
    told = {node: {mark.note.partition(": ")[0] for mark in said if mark.node == node} for node in "abc"}
    assert told == {"a": {"a/b", "a/c"}, "b": {"a/b"}, "c": {"a/c"}}


@pytest.mark.parametrize("lost", [lambda k: k % 4 == 0, lambda k: k % 50 < 20], ids=["each fourth", "for two seconds"])
def test_nodes_that_swim_while_some_poses_are_refused_do_not_rest(lost):
    """B swims past a with 0.5 m/s for 24 s; of the first half some poses are refused, one by one or for seconds."""
    live, said = LiveLegs(SurveySettings(), AlarmSettings()), []
    for node in "ab":
        live.handle(evaluated.info(node))
    for k in range(240):
        for node in "ab":
            said += live.handle(watched.attitude(node, watched.at(k)))
            said += live.handle(watched.depth(node, watched.at(k)))
        x_m = -6.0 + 0.05 * k
        refused = replace(evaluated.rejection(k), reason="ambiguous")
        found = evaluated.pose(k, (x_m, 0.0, 4.0), range_m=float(np.hypot(x_m, 4.0)))
        said += live.handle(refused if k < 120 and lost(k) else found)
    assert [mark.note for mark in said] == []
