"""Three blinks of a node's lamps, seen by the other node, as a mark."""

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Blob, Candidates, Mark, NodeInfo, RelativePose
from buddyline.tools.survey.blinks import find_blinks, new_blinks
from buddyline.tools.survey.live import LiveLegs
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from msgspec.structs import replace

from tests.tools import survey_world as world

PERIOD_NS = S_NS // 10
PLACES = np.array([(300.0, 250.0), (420.0, 255.0)])


@pytest.fixture(scope="module")
def a_pose():
    messages = world.dive(world.line(np.random.default_rng(2), 1), np.random.default_rng(7), rest_s=4.0, swim_s=0.0)
    return next(message for message in messages if isinstance(message, RelativePose))


def watched(rng, a_pose, lit, missed=0.03):
    """Candidates of a, and poses, of lamps that are lit as said for each trigger."""
    seen, poses = [], {}
    for k, on in enumerate(lit):
        stamp_ns = world.START_NS + k * PERIOD_NS
        here = PLACES + rng.normal(0, 3.0, (2, 2))
        lamps = [tuple(place) for place in here.tolist() if on and rng.random() > missed]
        others = [tuple(place) for place in rng.uniform((0, 0), (819, 615), (2, 2)).tolist()]
        blobs = [
            Blob(u_px=u, v_px=v, sigma_px=0.7, area_px=60.0, peak=255.0, elongation=1.0) for u, v in lamps + others
        ]
        seen.append(
            Candidates(
                node="a",
                stamp_ns=stamp_ns,
                trigger=k,
                seq=k,
                boot="x",
                width_px=world.WIDTH,
                height_px=world.HEIGHT,
                blobs=blobs,
            )
        )
        if len(lamps) == 2:
            poses[k] = replace(a_pose, stamp_ns=stamp_ns, trigger=k, blobs_a=(0, 1))
    return seen, poses


def pattern(*seconds):
    """Lit, dark, lit ... for so long each."""
    return [k % 2 == 0 for k, span_s in enumerate(seconds) for _ in range(round(10 * span_s))]


@pytest.mark.parametrize("seed", range(5))
def test_three_blinks_are_a_mark_of_the_node_that_blinked(a_pose, seed):
    rng = np.random.default_rng(seed)
    spans_s = rng.uniform(0.4, 0.8, 5).tolist()
    lit = pattern(5, *spans_s, 4)
    seen, poses = watched(rng, a_pose, lit)
    begin_ns = world.START_NS + 50 * PERIOD_NS
    (mark,) = find_blinks(seen, poses)
    assert mark == Mark(node="b", stamp_ns=mark.stamp_ns, kind="point", note="by three blinks")
    assert abs(mark.stamp_ns - begin_ns) <= 2 * PERIOD_NS
    # Of pictures that lack some triggers nothing is said.
    assert not find_blinks(seen[:55] + seen[60:], poses)


@pytest.mark.parametrize(
    "lit",
    [
        pattern(5, 0.5, 0.5, 0.5, 5),  # two
        pattern(5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.5, 5),  # four
        pattern(5, 2, 0.5, 0.5, 0.5, 0.5, 5),  # one is too long
        pattern(5, 0.3, 0.5, 1.1, 0.5, 0.5, 5),  # not alike
        pattern(5, 0.5, 0.5, 0.5, 0.5, 0.5, 0.6),  # not steady afterwards
        pattern(9),
    ],
)
def test_other_changes_are_no_mark(a_pose, lit):
    for seed in range(3):
        assert not find_blinks(*watched(np.random.default_rng(seed), a_pose, lit, missed=0.0))


def test_lamps_that_are_hidden_at_random_mark_nothing(a_pose):
    rng = np.random.default_rng(3)
    for _ in range(10):
        spans_s = [span for _ in range(15) for span in (rng.exponential(3.0), rng.exponential(0.8))]
        assert not find_blinks(*watched(rng, a_pose, pattern(*spans_s)))


def test_three_blinks_are_said_once_while_they_are_seen(a_pose):
    seen, poses = watched(
        np.random.default_rng(1), a_pose, pattern(8, 0.5, 0.5, 0.5, 0.5, 0.5, 9, 0.6, 0.6, 0.6, 0.6, 0.6, 30)
    )
    infos = [
        one
        for one in world.dive(world.line(np.random.default_rng(2), 1), np.random.default_rng(7), rest_s=1.0)
        if isinstance(one, NodeInfo)
    ]
    live = LiveLegs(SurveySettings(), AlarmSettings())
    said, stream = [], [*infos]
    for one in seen:
        stream += [one, *([poses[one.trigger]] if one.trigger in poses else [])]
    for message in stream:
        said += [(mark, message.stamp_ns) for mark in live.handle(message) if mark.kind == "point"]
    assert [mark for mark, _ in said] == find_blinks(seen, poses)
    assert [mark.node for mark, _ in said] == ["b", "b"]
    for mark, now_ns in said:
        assert now_ns - mark.stamp_ns < 6 * S_NS
    # A dive that was recorded with these marks has each of them once, also where its log begins them a picture later.
    recorded = [replace(mark, stamp_ns=mark.stamp_ns + PERIOD_NS) for mark, _ in said]
    (readings,) = of_messages([*stream, *recorded])
    assert readings.marks == recorded
    assert new_blinks(recorded, []) == recorded


def test_three_blinks_that_two_nodes_see_are_one_mark(a_pose):
    seen, poses = watched(np.random.default_rng(1), a_pose, pattern(8, 0.5, 0.5, 0.5, 0.5, 0.5, 9), missed=0.0)
    dive = world.dive(world.line(np.random.default_rng(2), 1), np.random.default_rng(7), rest_s=1.0)
    infos = [one for one in dive if isinstance(one, NodeInfo)]
    stream = [*infos, world.renamed(infos[0], a="c", b="c")]
    for one in seen:
        told = [one, *([poses[one.trigger]] if one.trigger in poses else [])]
        stream += [*told, *(world.renamed(message, a="c") for message in told)]
    live = LiveLegs(SurveySettings(), AlarmSettings())
    said = [mark for message in stream for mark in live.handle(message) if mark.kind == "point"]
    assert said == find_blinks(seen, poses)
    assert [mark.node for mark in said] == ["b"]
