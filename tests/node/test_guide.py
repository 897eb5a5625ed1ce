"""Guided search: what is expected is looked at first, and nothing can blind the node for longer than a picture."""

import numpy as np
import pytest
from buddyline.node.detect import Detection, make_detector
from buddyline.node.devices import Frame
from buddyline.node.guide import WHOLE_EVERY_NS, Guide, expected_first
from buddyline.node.pipeline import Pipeline
from buddyline.protocol.blinking import lit
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Blink, Blob, Expect, ExpectedLight
from msgspec import UNSET
from msgspec.structs import replace

from tests.node.rendered import lamp_picture

PERIOD_NS = S_NS // 10
SIZE = 820, 616
LAMPS = [(300.3, 220.6), (430.8, 210.2)]
NOTHING = np.zeros((0, 2))


def light(u_px, v_px, side="left", sigma_px=2.0, rate_pxps=(0.0, 0.0)):
    variance = sigma_px**2
    return ExpectedLight(
        side=side,
        u_px=u_px,
        v_px=v_px,
        covariance_px2=(variance, 0.0, variance),
        rate_pxps=rate_pxps,
        sigma_rate_pxps=10.0,
    )


def expect(k, *lights, node="a", seen="b"):
    return Expect(node=node, seen=seen, stamp_ns=k * PERIOD_NS, valid_ns=S_NS // 2, lights=list(lights))


def of_lamps(lamps=LAMPS, **how):
    return [light(u, v, side, **how) for side, (u, v) in zip(("left", "right"), lamps, strict=False)]


class LampSearch:
    """A node's search of pictures of lamps, ten a second."""

    def __init__(self, *, solver=True):
        self.guide = Guide("a")
        if solver:
            self.guide.saw_process("solver/any", True)
        self.pipeline = Pipeline("a", "boot", PERIOD_NS, make_detector(), self.guide)
        self.k = 10

    def look(self, lamps=LAMPS, *expected, seed=0):
        """Show the next picture; expected: what the solver said of it before. Return its candidates."""
        self.k += 1
        if expected:
            self.guide.expect(expect(self.k, *expected))
        picture = lamp_picture(lamps, size=SIZE, seed=seed)
        return self.pipeline.candidates(Frame(picture, self.k * PERIOD_NS))


def guided(candidates):
    return candidates.elsewhere is not UNSET


def finds(candidates, *lamps):
    return all(any(np.hypot(b.u_px - u, b.v_px - v) < 1.0 for b in candidates.blobs) for u, v in lamps)


def test_expected_lights_are_looked_for_where_they_are_expected():
    eye = LampSearch()
    assert not guided(eye.look(LAMPS, *of_lamps()))
    for _ in range(5):
        candidates = eye.look(LAMPS, *of_lamps())
        assert guided(candidates)
        assert finds(candidates, *LAMPS)


def test_a_lamp_that_is_dark_by_its_code_is_not_lost():
    eye = LampSearch()
    blink = Blink(code=0, lamp="left", slot_ns=PERIOD_NS)
    looks = []
    for _ in range(20):
        shown = lit(blink, (eye.k + 1) * PERIOD_NS)[0]
        eye.guide.expect(replace(expect(eye.k + 1, *of_lamps()), blink=blink))
        looks.append((eye.look(LAMPS if shown else LAMPS[1:]), shown))
    # Once a second the whole picture is searched in any case.
    assert sum(not guided(one) for one, _ in looks) <= 4
    assert sum(not shown for _, shown in looks) == 6
    assert all(finds(one, *(LAMPS if shown else LAMPS[1:])) for one, shown in looks)


def test_candidates_of_a_region_are_those_of_the_whole_picture():
    rng = np.random.default_rng(4)
    compared = same = 0
    for trial in range(30):
        lamps = [tuple(rng.uniform((20, 20), (800, 596))) for _ in range(2)]
        picture = lamp_picture(lamps, size=SIZE, core_px=rng.uniform(1.0, 4.0), glow=rng.uniform(0, 300), seed=trial)
        detector = make_detector()
        # A place on a light's flank, with a sigma of some px, may be found in one search and not in the other.
        whole = [d.blob for d in detector.detect(picture) if d.blob.score > 0.5 and d.blob.sigma_px < 1.0]
        guide = Guide("a")
        guide.learn(0, detector.detect(picture), SIZE[0], whole=True)
        guide.expect(expect(1, *of_lamps([(u + 3.0, v - 4.0) for u, v in lamps])))
        plan = guide.plan(PERIOD_NS, *SIZE)
        found = detector.detect_near(picture, plan.regions) if plan.regions else None
        if found is None:
            continue
        for u, v in lamps:
            there = [b for b in whole if np.hypot(b.u_px - u, b.v_px - v) < 3.0]
            near = [d.blob for d in found if np.hypot(d.blob.u_px - u, d.blob.v_px - v) < 3.0]
            assert len(near) >= len(there)
            for one in there:
                nearest = min(near, key=lambda b: abs(b.u_px - one.u_px) + abs(b.v_px - one.v_px))
                off_px = max(abs(nearest.u_px - one.u_px), abs(nearest.v_px - one.v_px))
                # Two octaves may propose a lamp about equally well.
                assert off_px < 0.05
                compared += 1
                same += off_px < 1e-6
                assert nearest.score == pytest.approx(one.score, abs=0.02)
    assert same >= 0.95 * compared
    assert compared > 40


def test_a_lamp_too_faint_for_the_whole_picture_is_found_where_it_is_expected():
    faint = {"core": 20.0, "core_px": 2.0, "noise": 2.0}
    picture = lamp_picture(LAMPS, size=SIZE, **faint)
    detector = make_detector("source", "auto", {"contrast_min": 12.0})
    assert not finds_both(detector.detect(picture))
    guide = Guide("a")
    bright = make_detector().detect(lamp_picture(LAMPS, size=SIZE))
    guide.learn(0, bright, SIZE[0], whole=True)
    guide.expect(expect(1, *of_lamps()))
    assert finds_both(detector.detect_near(picture, guide.plan(PERIOD_NS, *SIZE).regions))


def finds_both(found):
    return all(any(np.hypot(d.blob.u_px - u, d.blob.v_px - v) < 3.0 for d in found) for u, v in LAMPS)


@pytest.mark.slow
def test_the_whole_picture_is_searched_once_a_second():
    eye = LampSearch()
    looks = [eye.look(LAMPS, *of_lamps()) for _ in range(40)]
    whole = [one.stamp_ns for one in looks if not guided(one)]
    assert max(np.diff(whole)) <= S_NS
    assert len(whole) < 8


@pytest.mark.parametrize(
    "lie",
    [
        of_lamps([(100.0, 500.0), (700.0, 500.0)]),
        of_lamps([(-300.0, 5000.0)]),
        of_lamps([(1e300, -1e300), (0.0, 0.0)]),
        of_lamps(sigma_px=500.0),
        of_lamps(rate_pxps=(1e200, -1e200)),
        of_lamps([LAMPS[0], LAMPS[0]]),
        [],
    ],
    ids=["elsewhere", "outside", "absurd", "too wide", "too fast", "on top of each other", "nothing"],
)
def test_a_lying_expectation_blinds_no_picture(lie):
    eye = LampSearch()
    eye.look(LAMPS)
    eye.look(LAMPS, *of_lamps())
    for _ in range(6):
        assert finds(eye.look(LAMPS, *lie), *LAMPS)


def test_an_expectation_on_a_strange_lamp_does_not_hide_the_lights():
    strange = 600.0, 400.0
    eye = LampSearch()
    eye.look([*LAMPS, strange])
    for _ in range(6):
        candidates = eye.look([*LAMPS, strange], light(*strange))
        assert finds(candidates, *LAMPS, strange)
        assert np.hypot(candidates.blobs[0].u_px - strange[0], candidates.blobs[0].v_px - strange[1]) < 1.0


def test_after_a_jump_the_same_picture_is_searched_as_a_whole():
    eye = LampSearch()
    for _ in range(3):
        eye.look(LAMPS, *of_lamps())
    moved = [(u + 150.0, v + 100.0) for u, v in LAMPS]
    candidates = eye.look(moved, *of_lamps())
    assert not guided(candidates)
    assert finds(candidates, *moved)


def test_one_hidden_light_is_searched_for_in_the_whole_picture():
    eye = LampSearch()
    for _ in range(3):
        eye.look(LAMPS, *of_lamps())
    candidates = eye.look(LAMPS[:1], *of_lamps())
    assert not guided(candidates)
    assert finds(candidates, LAMPS[0])


@pytest.mark.parametrize("late", [PERIOD_NS * 6, -PERIOD_NS * 6], ids=["stale", "of later"])
def test_an_expectation_of_another_time_is_none(late):
    eye = LampSearch()
    for _ in range(3):
        eye.look(LAMPS)
    told = expect(eye.k + 1, *of_lamps())
    eye.guide.expect(replace(told, stamp_ns=told.stamp_ns - late))
    assert not guided(eye.look(LAMPS))


def test_an_expectation_for_another_node_is_refused():
    eye = LampSearch()
    eye.look(LAMPS)
    eye.guide.expect(expect(eye.k + 1, *of_lamps(), node="b", seen="a"))
    assert eye.guide.refused == 1
    assert not guided(eye.look(LAMPS))


def test_an_expectation_follows_its_rate_to_a_later_picture():
    eye = LampSearch()
    for _ in range(2):
        eye.look(LAMPS, *of_lamps())
    moved = [(u + 60.0, v) for u, v in LAMPS]
    early = [(u - 60.0, v) for u, v in LAMPS]
    eye.guide.learn(eye.k * PERIOD_NS + 1, make_detector().detect(lamp_picture(moved, size=SIZE)), SIZE[0], whole=True)
    eye.guide.expect(expect(eye.k - 1, *of_lamps(early, rate_pxps=(600.0, 0.0))))
    candidates = eye.look(moved)
    assert guided(candidates)
    assert finds(candidates, *moved)


def test_without_a_solver_the_last_pictures_guide():
    eye = LampSearch(solver=False)
    looks = []
    for i in range(12):
        lamps = [(u + 5.0 * i, v + 2.0 * i) for u, v in LAMPS]
        looks.append(eye.look(lamps))
        assert finds(looks[-1], *lamps)
    assert sum(map(guided, looks)) >= 6
    assert not any(map(guided, looks[:3]))


def test_a_solver_without_a_track_gets_whole_pictures():
    eye = LampSearch()
    assert not any(guided(eye.look(LAMPS)) for _ in range(6))
    eye.guide.saw_process("solver/any", False)
    assert any(guided(eye.look(LAMPS)) for _ in range(3))


def test_a_new_lamp_is_found_within_a_second_and_then_followed():
    eye = LampSearch()
    for _ in range(4):
        eye.look(LAMPS, *of_lamps())
    new = 650.0, 450.0
    looks = [eye.look([*LAMPS, new], *of_lamps()) for _ in range(18)]
    found = [finds(one, new) for one in looks]
    first = found.index(True)
    assert looks[first].stamp_ns - looks[0].stamp_ns <= WHOLE_EVERY_NS + PERIOD_NS
    assert all(found[first:])
    assert any(guided(one) for one in looks[first:])


def test_what_was_elsewhere_is_told():
    eye = LampSearch()
    first = eye.look(LAMPS, *of_lamps())
    second = eye.look(LAMPS, *of_lamps())
    assert len(second.blobs) + second.elsewhere >= len(first.blobs)


def test_both_lights_come_first_among_eight_strange_lamps():
    rng = np.random.default_rng(8)
    both = 0
    eye = LampSearch()
    strange = [(100.0 + 90.0 * i, 420.0 + 100.0 * (i % 2)) for i in range(8)]
    for _ in range(20):
        shaken = [tuple(np.add(lamp, rng.normal(0.0, 2.0, 2))) for lamp in LAMPS]
        candidates = eye.look([*shaken, *strange], *of_lamps(), seed=int(rng.integers(100)))
        first = candidates.blobs[:3]
        both += all(any(np.hypot(b.u_px - u, b.v_px - v) < 2.0 for b in first) for u, v in shaken)
        scores = [b.score for b in candidates.blobs]
        assert scores == sorted(scores, reverse=True)
    assert both >= 19


def detection(u_px, v_px, score):
    blob = Blob(u_px=u_px, v_px=v_px, sigma_px=0.3, area_px=9.0, peak=250.0, elongation=1.0, score=score)
    return Detection(blob, NOTHING, NOTHING, "")


def test_an_unlikely_candidate_is_not_put_first():
    guide = Guide("a")
    guide.expect(expect(1, light(100.0, 100.0)))
    found = [detection(300.0, 300.0, 0.99), detection(100.0, 100.0, 0.2)]
    assert expected_first(found, guide.plan(PERIOD_NS, *SIZE).foretold) == (found, 0)


def test_of_two_near_an_expected_place_the_nearer_comes_first():
    guide = Guide("a")
    guide.expect(expect(1, light(100.0, 100.0)))
    found = [detection(300.0, 300.0, 0.99), detection(110.0, 100.0, 0.98), detection(101.0, 100.0, 0.97)]
    ordered, expected = expected_first(found, guide.plan(PERIOD_NS, *SIZE).foretold)
    assert expected == 1
    assert [d.blob.u_px for d in ordered] == [101.0, 300.0, 110.0]
    assert ordered[0].blob.score == 0.99


def test_a_detector_without_regions_searches_whole_pictures():
    guide = Guide("a")
    pipeline = Pipeline("a", "boot", PERIOD_NS, make_detector("paper", "cavern"), guide)
    for k in (1, 2, 3):
        guide.expect(expect(k, *of_lamps()))
        assert not guided(pipeline.candidates(Frame(lamp_picture(LAMPS, size=SIZE), k * PERIOD_NS)))


def test_pictures_of_two_sizes_have_their_own_whole_searches():
    eye = LampSearch()
    eye.look(LAMPS, *of_lamps())
    eye.k += 1
    eye.guide.expect(expect(eye.k, *of_lamps()))
    small = lamp_picture(LAMPS, size=(700, 500))
    assert not guided(eye.pipeline.candidates(Frame(small, eye.k * PERIOD_NS)))
