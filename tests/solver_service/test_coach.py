"""What to do for a fix: followed, the words bring the other's lights into both pictures."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from buddyline.protocol.codec import decode, encode
from buddyline.protocol.messages import Attitude, NodeInfo, SolverStatus
from buddyline.solver_service.coach import WELL_INSIDE, LastPlace, advise
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.rotation import Floats, matrix_to_quat, quat_to_matrix, rotation_exp
from buddyline.solver_service.geometry.trigger import Settings

from tests.tools.evaluated import FALSE, INFOS, LEFT, RIGHT, frame

FACING = quat_to_matrix(np.array((0.0, 1.0, 0.0, 0.0)))
PAIR = [INFOS["a"], INFOS["b"]]


def stood(
    yaw_a: float, pitch_a: float, yaw_b: float, pitch_b: float, *, range_m: float = 4.0, sigma_m: float = 0.01
) -> LastPlace:
    """Two nodes that face each other, then turned: degrees right and down, each by its own axes."""
    R_a, R_b = turned(yaw_a, pitch_a), turned(yaw_b, pitch_b)
    return LastPlace(R_a.T @ (0.0, 0.0, range_m), R_a.T @ FACING @ R_b, sigma_m, 1.0)


def turned(right_deg: float, down_deg: float) -> Floats:
    """A camera's turn to the right about the vertical, then down about its own x axis."""
    yaw = rotation_exp(np.array((0.0, math.radians(right_deg), 0.0)))
    R: Floats = yaw @ rotation_exp(np.array((-math.radians(down_deg), 0.0, 0.0)))
    return R


def test_nodes_that_see_each_other_have_nothing_to_do() -> None:
    assert advise(PAIR, stood(0, 0, 0, 0)) == []


def test_a_node_that_looks_away_is_told_to_turn_back() -> None:
    assert advise(PAIR, stood(40, 0, 0, 0)) == ["turn a 40 deg left"]
    assert advise(PAIR, stood(0, 0, -30, 0)) == ["turn b 30 deg right"]
    assert advise(PAIR, stood(0, 30, 0, 0)) == ["turn a 30 deg up"]
    assert advise(PAIR, stood(170, 0, 0, 0)) == ["turn a 170 deg left"]


def test_a_turn_since_the_last_place_counts() -> None:
    place = stood(0, 0, 0, 0)
    for turn_a, turn_b, words in (((40, 0), (0, 0), "turn a 40 deg left"), ((0, 0), (0, 30), "turn b 30 deg up")):
        later = LastPlace(place.t_m, place.R, 0.01, 5.0, "ambiguous", (turned(*turn_a), turned(*turn_b)))
        assert advise(PAIR, later) == [words]


@pytest.mark.parametrize("seed", range(60))
def test_followed_the_words_bring_the_lights_into_both_pictures(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ways = {node: [float(rng.uniform(-150, 150)), float(rng.uniform(-40, 40))] for node in "ab"}
    # In a few steps, as a diver turns: roll makes right and down depend on each other.
    for _ in range(5):
        place = stood(*ways["a"], *ways["b"])
        said = advise(PAIR, place)
        if not said:
            break
        for words in said:
            node = words.split()[1]
            for amount, side in re.findall(r"(\d+) deg (\w+)", words):
                ways[node][side in ("down", "up")] += int(amount) * (1 if side in ("right", "down") else -1)
    limit = WELL_INSIDE * math.atan(410 / 904)
    for lights_m in place.lights(*PAIR):
        assert (lights_m[:, 2] > 0).all()
        assert np.abs(np.arctan2(lights_m[:, 0], lights_m[:, 2])).max() < limit + math.radians(5)


def test_who_looks_and_does_not_find_comes_closer_and_a_poor_fix_gets_better() -> None:
    lost = stood(0, 0, 0, 0, range_m=8.0)
    assert advise(PAIR, LastPlace(lost.t_m, lost.R, 0.1, 3.0, "too_few_candidates")) == ["come 2.0 m closer"]
    assert advise(PAIR, LastPlace(lost.t_m, lost.R, 0.1, 3.0, "range_gap")) == []
    assert advise(PAIR, stood(0, 0, 0, 0, range_m=8.0, sigma_m=0.8)) == ["come 4.0 m closer"]
    assert advise(PAIR, stood(0, 0, 0, 0, range_m=8.0, sigma_m=0.3)) == []
    near = stood(0, 0, 0, 0, range_m=1.5)
    assert advise(PAIR, LastPlace(near.t_m, near.R, 0.1, 3.0, "too_few_candidates")) == []


def test_lights_that_do_not_fit_into_the_picture_are_too_near() -> None:
    assert advise(PAIR, stood(0, 0, 0, 0, range_m=1.0)) == ["move 0.5 m apart"]


def test_a_dark_lamp_is_named() -> None:
    assert advise(PAIR, None, [(1, 0)]) == ["left lamp of b is dark"]


def test_a_lamp_that_is_not_seen_is_named_before_it_is_known_to_be_dark() -> None:
    unseen = [(1, 0), (0, 1)]
    assert advise(PAIR, None, unseen=unseen) == ["left lamp of b is not seen", "right lamp of a is not seen"]
    assert advise(PAIR, None, [(1, 0)], unseen=unseen) == ["left lamp of b is dark", "right lamp of a is not seen"]


@pytest.mark.parametrize(("told", "words"), [(4, []), (3, []), (2, ["come 2.0 m closer"]), (0, ["come 2.0 m closer"])])
def test_where_lights_are_lost_the_reason_for_which_others_are_refused_says_nothing(
    told: int, words: list[str]
) -> None:
    lost = stood(0, 0, 0, 0, range_m=8.0)
    assert advise(PAIR, LastPlace(lost.t_m, lost.R, 0.1, 3.0, "range_gap", told=told)) == words


def test_an_old_or_vague_place_tells_no_direction() -> None:
    place = stood(40, 0, 0, 0)
    assert advise(PAIR, LastPlace(place.t_m, place.R, 0.01, 21.0)) == []
    assert advise(PAIR, stood(40, 0, 0, 0, sigma_m=1.0)) == []
    assert advise(PAIR, None) == []


def oriented(info: NodeInfo, k: int, right_deg: float) -> Attitude:
    """A node's attitude at trigger k: level, turned to the right of north (a) or south (b)."""
    heading = math.radians(right_deg + (0.0 if info.node == "a" else 180.0))
    x, y, z, w = matrix_to_quat(rotation_exp(np.array((0.0, 0.0, heading)))).tolist()
    stamp_ns = frame(info.node, k).stamp_ns
    return Attitude(node=info.node, stamp_ns=stamp_ns, q_ned_body_xyzw=(x, y, z, w), sigma_rad=(0.02, 0.02, 0.05))


def test_the_solver_publishes_the_words_in_the_pair_s_status() -> None:
    core = SolverCore(Settings(checks=frozenset(("range", "twist"))), [("a", "b")])
    for info in PAIR:
        core.handle(info)

    def status() -> SolverStatus:
        (said,) = core.report(0, 0, 0, [])
        again = decode(encode(said), SolverStatus)
        assert again == said
        return again

    assert "advice" not in encode(status()).decode()
    for k in range(60):
        # After two seconds a turns away, as its attitude says; its pictures then show no lights.
        away = max(k - 20, 0)
        seen = {"a": (LEFT, RIGHT) if not away else (FALSE,), "b": (LEFT, RIGHT)}
        for info in PAIR:
            core.handle(oriented(info, k, 2.0 * min(away, 20) if info.node == "a" else 0.0))
            core.handle(frame(info.node, k, seen[info.node]))
        if k == 20:
            assert not status().advice
    assert core.counts["solved"] >= 15
    assert status().advice == ["turn a 40 deg left"]
