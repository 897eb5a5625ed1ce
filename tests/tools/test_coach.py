"""What to do for a fix: followed, the words bring the other's lights into both pictures."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats, matrix_to_quat, quat_to_matrix, rotation_exp
from buddyline.tools.health.coach import WELL_INSIDE, lights_in_a, lights_in_b, turns
from buddyline.tools.health.pair import findings
from buddyline.tools.monitor.picture import PairPicture

from tests.tools.evaluated import INFOS, frame, rejection, track
from tests.tools.watched import at, solver_status, take

FACING = quat_to_matrix(np.array((0.0, 1.0, 0.0, 0.0)))


def stood(yaw_a: float, pitch_a: float, yaw_b: float, pitch_b: float, sigma_m: float = 0.01) -> PairPicture:
    """Two nodes 4 m apart that face each other, then turned: degrees right and down, each by its own axes."""
    R_a, R_b = turned(yaw_a, pitch_a), turned(yaw_b, pitch_b)
    x, y, z = (R_a.T @ (0.0, 0.0, 4.0)).tolist()
    qx, qy, qz, qw = matrix_to_quat(R_a.T @ FACING @ R_b).tolist()
    picture = PairPicture()
    for node in "ab":
        take(picture, INFOS[node], at(0))
    take(picture, track(0, (x, y, z), sigma_m, q_a_b_xyzw=(qx, qy, qz, qw)), at(0))
    return picture


def turned(right_deg: float, down_deg: float) -> Floats:
    """A camera's turn to the right about the vertical, then down about its own x axis."""
    yaw = rotation_exp(np.array((0.0, math.radians(right_deg), 0.0)))
    R: Floats = yaw @ rotation_exp(np.array((-math.radians(down_deg), 0.0, 0.0)))
    return R


def test_nodes_that_see_each_other_have_nothing_to_do() -> None:
    assert turns(stood(0, 0, 0, 0), at(1)) == []


def test_a_node_that_looks_away_is_told_to_turn_back() -> None:
    assert turns(stood(40, 0, 0, 0), at(1)) == ["turn a 40 deg left"]
    assert turns(stood(0, 0, -30, 0), at(1)) == ["turn b 30 deg right"]
    assert turns(stood(0, 30, 0, 0), at(1)) == ["turn a 30 deg up"]
    assert turns(stood(170, 0, 0, 0), at(1)) == ["turn a 170 deg left"]


@pytest.mark.parametrize("seed", range(60))
def test_followed_the_words_bring_the_lights_into_both_pictures(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ways = {node: [float(rng.uniform(-150, 150)), float(rng.uniform(-40, 40))] for node in "ab"}
    # In a few steps, as a diver turns: roll makes right and down depend on each other.
    for _ in range(5):
        picture = stood(*ways["a"], *ways["b"])
        said = turns(picture, at(1))
        if not said:
            break
        for words in said:
            node = words.split()[1]
            for amount, side in re.findall(r"(\d+) deg (\w+)", words):
                ways[node][side in ("down", "up")] += int(amount) * (1 if side in ("right", "down") else -1)
    estimate = picture.track
    assert estimate is not None
    limit = WELL_INSIDE * math.atan(410 / 904)
    for lights_m in (lights_in_a(estimate, INFOS["b"]), lights_in_b(estimate, INFOS["a"])):
        assert (lights_m[:, 2] > 0).all()
        assert np.abs(np.arctan2(lights_m[:, 0], lights_m[:, 2])).max() < limit + math.radians(5)


def test_an_old_or_vague_place_tells_no_direction() -> None:
    assert turns(stood(40, 0, 0, 0), at(0) + 21 * 10**9) == []
    assert turns(stood(40, 0, 0, 0, sigma_m=1.0), at(1)) == []
    assert turns(PairPicture(), at(0)) == []


def test_the_words_are_the_advice_where_there_is_no_pose() -> None:
    picture = stood(40, 0, 0, 0)
    for k in range(1, 40):
        for message in (frame("a", k, ()), frame("b", k), rejection(k, "too_few_candidates")):
            take(picture, message, at(k))
        if k % 10 == 0:
            take(picture, solver_status(at(k)), at(k))
    (said,) = [finding for finding in findings(picture, at(40)) if finding.name == "pair"]
    assert said.advice == "turn a 40 deg left"
