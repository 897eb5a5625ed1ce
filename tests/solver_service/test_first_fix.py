"""What to do before the first fix: words from what each camera sees, and from where it looks."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from buddyline.solver_service.coach import LastPlace, advise
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.first_fix import NodeLook, advise_first, look_of
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.streams import NodeStream

from tests.solver_service.test_coach import FACING, PAIR, oriented
from tests.tools.evaluated import FALSE, LEFT, RIGHT, frame

HALF = np.array((math.atan(410 / 904), math.atan(308 / 904)))


def look(
    heading: float,
    lights: tuple[tuple[float, float], ...] = (),
    down: float = 0.0,
    *,
    oriented: bool = True,
    radius: float = 0.003,
    path: tuple[float, ...] = (),
) -> NodeLook:
    """A look by degrees; path: earlier headings, half a second apart, the newest first."""
    rows = np.array([(np.radians(h), 0.0, 100.0 - 0.5 * k) for k, h in enumerate(path)]).reshape(-1, 3)
    seen = np.array([(*np.radians(one), radius) for one in lights]).reshape(-1, 3)
    return NodeLook(seen, np.radians((heading, down)), HALF, oriented, float(len(lights)), rows)


def said(a: NodeLook, b: NodeLook) -> list[str]:
    return advise_first(PAIR, (a, b))


def test_who_sees_the_other_tells_it_where_to_turn() -> None:
    # A looks north and sees B's bar 10 degrees to the right; B looks east, and must look back along that sight.
    seen = look(0.0, ((7.0, 4.0), (13.0, 4.0)))
    assert said(seen, look(90.0)) == ["turn b 100 deg right"]
    assert said(seen, look(-170.0)) == ["b sees no lamp of a", "come 2.0 m closer"]
    assert said(look(0.0, ((7.0, -40.0), (13.0, -40.0))), look(190.0)) == ["turn a 40 deg up", "turn b 40 deg down"]


def test_a_lamp_beyond_the_border_is_turned_to() -> None:
    # Without a compass the lamp's side of the picture tells.
    assert said(look(0.0, ((-20.0, 0.0),), oriented=False), look(0.0, oriented=False)) == ["turn a 30 deg left"]
    # With one, the other's view of this node tells on which side of the lamp the second one is, and how far.
    bar = ((160.0, 0.0), (184.0, 0.0))
    assert said(look(0.0, ((2.0, 0.0),)), look(172.0, bar)) == ["turn a 10 deg left"]


def test_a_stranger_s_lamp_does_not_lead_astray() -> None:
    words = said(look(0.0, ((-3.0, 0.0), (3.0, 0.0))), look(100.0, ((90.0, 10.0),)))
    assert words == ["turn b 80 deg right"]


def test_of_two_bars_that_contradict_each_other_the_level_one_counts() -> None:
    # B looks up, and sees A's lamps mirrored in the surface; A sees B.
    seen, mirrored = look(0.0, ((-3.0, 2.0), (3.0, 2.0))), look(180.0, ((177.0, -50.0), (183.0, -48.0)), down=-45.0)
    assert said(seen, mirrored) == ["turn b 45 deg down"]
    assert said(mirrored, seen) == ["turn a 45 deg down"]
    # What they see of each other agrees: nothing is left out.
    assert said(seen, look(180.0, ((177.0, -2.0), (183.0, -2.0)))) == []


def test_lights_that_fill_the_picture_are_too_near_and_faint_ones_too_far() -> None:
    wide = ((-21.0, 0.0), (21.0, 0.0))
    assert said(look(0.0, wide), look(180.0, ((159.0, 0.0), (201.0, 0.0)))) == ["move 0.5 m apart"]
    near = said(look(0.0, ((2.0, 0.0),), radius=0.03), look(180.0, ((181.0, 0.0),), radius=0.03))
    assert near == ["move 1.0 m apart"]
    far = said(look(0.0, ((2.0, 0.0),)), look(180.0, ((181.0, 0.0),)))
    assert far == ["a sees one lamp of b", "b sees one lamp of a", "come 1.0 m closer"]


def test_two_that_see_nothing_search_the_shortest_way() -> None:
    blind = "a and b do not see each other"
    # Face to face but for what lies between: turning the same way they stay so.
    sides = [one.rsplit(" ", 1)[1] for one in said(look(0.0), look(180.0))[1:]]
    assert sides in (["left", "left"], ["right", "right"])
    # They have looked to the right of where A looks now: they go on to the left, and not back.
    along, back = (10.0, 10.0, 30.0, 60.0), (190.0, 190.0, 210.0, 240.0)
    words = said(look(10.0, path=along), look(190.0, path=back))
    assert words == [blind, "turn a 180 deg left", "turn b 180 deg left"]
    assert said(look(0.0, oriented=False), look(0.0)) == [blind, "turn a slowly left"]
    assert "45 deg up" in said(look(0.0, down=45.0), look(180.0))[1]


def search(seed: int, turn_deg: float) -> int:
    """Return how many words it takes until both look at each other, whose headings and line are anything."""
    rng = np.random.default_rng(seed)
    line, headings = float(rng.uniform(0, 360)), rng.uniform(0, 360, 2)
    paths: list[list[float]] = [[], []]
    for count in range(40):
        lines = (line, line + 180.0)
        off = [(to - heading + 180) % 360 - 180 for to, heading in zip(lines, headings, strict=True)]
        if max(map(abs, off)) < 20.0:
            return count
        seen = [((to - 3.0, 0.0), (to + 3.0, 0.0)) if abs(o) < 20 else () for to, o in zip(lines, off, strict=True)]
        a, b = (look(h, s, path=(h, *p)) for h, s, p in zip(headings, seen, paths, strict=True))
        for node, path in enumerate(paths):
            path.insert(0, float(headings[node]))
        for words in said(a, b):
            if turned := re.match(r"turn (.) (\d+) deg (left|right)", words):
                amount = min(float(turned[2]), turn_deg)
                headings["ab".index(turned[1])] += amount if turned[3] == "right" else -amount
    return 40


def test_a_search_finds_the_other_within_a_turn() -> None:
    # With 20 degrees a time, and half a second each as in a look's path, nobody turns more than once around.
    counts = [search(seed, 20.0) for seed in range(200)]
    assert max(counts) <= 18
    assert np.mean(counts) < 10


def test_a_lone_light_that_the_other_does_not_answer_is_searched_for_but_not_trusted() -> None:
    # A sees one light. B has searched all but where A would then be, so it turns there.
    words = said(look(0.0, ((10.0, 0.0),)), look(120.0, path=tuple(np.arange(120.0, -120.0, -20.0))))
    assert (words[0], words[-1]) == ("a sees one light", "turn b 180 deg right")
    # B looks along it and sees nothing: near as it is, it is a stranger's lamp, and the search goes on.
    near = look(0.0, ((2.0, 0.0),), radius=0.03)
    assert any(one.startswith("turn") for one in said(near, look(180.0)))
    # A faint one may be too far for B to see A's.
    assert said(look(0.0, ((2.0, 0.0),)), look(180.0))[-1] == "come 1.0 m closer"


def test_almost_half_a_turn_is_told_to_the_same_side_again() -> None:
    bar = ((177.0, 0.0), (183.0, 0.0))
    assert said(look(180.0, bar), look(170.0)) == ["turn b 190 deg right"]
    assert said(look(180.0, bar), look(190.0)) == ["turn b 170 deg right"]
    # Who turns left already goes on so.
    assert said(look(180.0, bar), look(190.0, path=(190.0, 200.0))) == ["turn b 190 deg left"]
    assert said(look(180.0, bar), look(150.0)) == ["turn b 150 deg left"]


def test_a_crowd_of_lights_is_named() -> None:
    crowded = NodeLook(np.zeros((0, 3)), np.zeros(2), HALF, False, 40.0)
    assert said(crowded, look(0.0))[0] == "a sees 40 lights: cover other lamps, keep away from silt"


def test_steady_lights_are_told_from_noise_and_remembered_while_a_node_turns() -> None:
    stream, rng = NodeStream("a"), np.random.default_rng(5)
    stream.add_info(PAIR[0])
    calibration = stream.calibration(frame("a", 0).stamp_ns)
    assert calibration is not None
    for k in range(30):
        noise = tuple((float(u), float(v)) for u, v in rng.uniform((0, 0), (819, 615), (4, 2)))
        # It faces B's lamps for a second and a half, then turns to the right by 40 degrees a second.
        turned = 4.0 * max(k - 14, 0)
        stream.add_sample(oriented(PAIR[0], k, turned))
        lamps = [] if turned > 30 else [
            (409.5 + 904 * math.tan(math.atan((u - 409.5) / 904) - math.radians(turned)), v) for u, v in (LEFT, RIGHT)
        ]  # fmt: skip
        inside = tuple((u, v) for u, v in lamps if 0 <= u < 820)
        stream.add_frame(frame("a", k, (*noise, *inside)), (), None)
    found = look_of(stream, *calibration)
    assert math.degrees(found.axis[0]) == pytest.approx(60.0)
    right = sorted(np.degrees(found.lights[:, 0]).tolist())
    expected = [math.degrees(math.atan((u - 409.5) / 904)) for u in (RIGHT[0], LEFT[0])]
    assert right == pytest.approx(expected, abs=2.0)
    assert 3.0 <= found.shown <= 6.0


def test_an_old_place_gives_way_to_what_is_seen() -> None:
    looks = look(0.0, ((7.0, 4.0), (13.0, 4.0))), look(90.0)
    place = LastPlace(np.array((0.0, 0.0, 4.0)), FACING, 0.01, 1.0)
    assert advise(PAIR, place, looks=looks) == []
    old = LastPlace(place.t_m, place.R, 0.01, 21.0)
    assert advise(PAIR, old, [(1, 0)], looks) == ["left lamp of b is dark", "turn b 100 deg right"]
    assert advise(PAIR, None) == []


def test_the_status_has_the_words_before_there_is_a_pose() -> None:
    core = SolverCore(Settings(checks=frozenset(("range", "twist"))), [("a", "b")])
    for info in PAIR:
        core.handle(info)
    for k in range(15):
        for info, away_deg, seen in ((PAIR[0], 0.0, (LEFT, RIGHT)), (PAIR[1], 90.0, (FALSE,))):
            core.handle(oriented(info, k, away_deg))
            core.handle(frame(info.node, k, seen))
    assert core.counts["solved"] == 0
    assert core.report(0, 0, 0, [])[0].advice == ["turn b 90 deg left"]
