"""How far the headings disagree: learned from poses, lost with time, moved by no single wrong one."""

import math

import msgspec
import numpy as np
import pytest
from buddyline.protocol.messages import Attitude, Candidates, RelativePose
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.compasses import MOST_APART_RAD
from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.sensors import heading_offset
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.headings import ENOUGH, LIFETIME_NS, HeadingOffset

from tests.solver_service.scenes import IDEAL, random_scene, rotation

STEP_NS = 100_000_000
POSE_VARIANCE = math.radians(0.3) ** 2


def fed(offsets_rad, headings=None, start=0):
    headings = headings or HeadingOffset()
    for k, offset_rad in enumerate(offsets_rad, start):
        headings.update(k * STEP_NS, offset_rad, POSE_VARIANCE)
    return headings


def test_a_drifting_bias_is_followed_and_the_variance_is_true():
    rng = np.random.default_rng(1)
    squares = []
    for sigma_deg in (1.5, 3.0, 6.0):
        headings = HeadingOffset()
        for k in range(1500):
            bias_rad = 1.4 + math.radians(8.0) * math.sin(0.02 * k)
            told_rad = math.remainder(bias_rad + math.radians(sigma_deg) * rng.normal(), 2.0 * math.pi)
            heading = headings.predict(k * STEP_NS)
            if k > 100:
                off_rad = math.remainder(told_rad - heading.offset_rad, 2.0 * math.pi)
                squares.append(off_rad * off_rad / heading.variance)
            headings.update(k * STEP_NS, told_rad, POSE_VARIANCE)
        assert heading.variance < 2.0 * math.radians(sigma_deg) ** 2
    assert np.mean(squares) == pytest.approx(1.0, abs=0.15)


def test_a_few_poses_and_an_old_one_tell_nothing():
    assert fed([0.3] * (ENOUGH - 1)).predict(ENOUGH * STEP_NS) is None
    headings = fed([0.3] * ENOUGH)
    assert headings.predict(ENOUGH * STEP_NS).offset_rad == pytest.approx(0.3, abs=0.01)
    assert headings.predict(-1) is None
    assert headings.predict((ENOUGH - 1) * STEP_NS + LIFETIME_NS + 1) is None


def test_one_wrong_pose_moves_nothing_and_steel_is_followed():
    headings = fed([0.1] * 50)
    fed([1.5], headings, 50)
    assert headings.predict(51 * STEP_NS).offset_rad == pytest.approx(0.1, abs=0.01)
    fed([0.1] * 20, headings, 51)
    fed([1.5] * 10, headings, 71)
    assert headings.predict(81 * STEP_NS).offset_rad == pytest.approx(1.5, abs=0.1)


def test_half_a_turn_is_not_learned():
    for start in ([], [0.1] * 50):
        headings = fed([3.0] * 500, fed(start), len(start))
        assert abs(headings.predict((500 + len(start)) * STEP_NS).offset_rad) <= MOST_APART_RAD


def test_what_a_pose_tells_is_the_error_of_the_heading():
    rng = np.random.default_rng(2)
    for error_rad in (0.0, 0.4, -2.8):
        scene = random_scene(rng, 5.0)
        q_a, q_b = (one.q_ned_body_xyzw for one in scene.sensed())
        R_ned_a, R_ned_b = (quat_to_matrix(q) @ IDEAL.R_body_camera for q in (q_a, q_b))
        turned = rotation((0, 0, 1), error_rad) @ R_ned_b
        offset_rad, variance = heading_offset(SE3(scene.R, scene.t), 1e-4 * np.eye(6), R_ned_a, turned)
        assert offset_rad == pytest.approx(-error_rad, abs=1e-9)
        assert variance == pytest.approx(1e-4)


def test_with_a_compass_that_is_known_to_be_far_off_three_lights_still_give_poses(dive):
    messages, world = dive
    seen = {result.trigger: result for result in solved(messages) if isinstance(result, RelativePose)}
    short = set(sorted(seen)[20::3])

    def without_a_light(message):
        if not isinstance(message, Candidates) or message.node != "b" or message.trigger not in short:
            return message
        lost = seen[message.trigger].blobs_b[0]
        return msgspec.structs.replace(message, blobs=[b for i, b in enumerate(message.blobs) if i != lost])

    lacking = [without_a_light(message) for message in messages]
    lacking_turned = [turned(message) for message in lacking]
    known = min(found.trigger for found in solved(lacking_turned) if isinstance(found, RelativePose))
    true, off = three_lights(lacking, world, known), three_lights(lacking_turned, world, known)
    assert true > 5
    assert off > 0.7 * true


def test_the_solver_says_that_compasses_disagree(dive):
    messages, _ = dive
    problems = []
    for said in (messages, [turned(message) for message in messages]):
        core = SolverCore(Settings(), [("a", "b")])
        for message in said:
            core.handle(message)
        problems.append(core.report(0, 0, 0, [])[0].problem)
    assert "compasses" not in problems[0]
    assert "compasses of a and b disagree by 8" in problems[1]


def turned(message, node="b", off_deg=80.0):
    """A node's compass is off."""
    if not isinstance(message, Attitude) or message.node != node:
        return message
    R = rotation((0, 0, 1), math.radians(off_deg)) @ quat_to_matrix(np.array(message.q_ned_body_xyzw))
    return msgspec.structs.replace(message, q_ned_body_xyzw=tuple(matrix_to_quat(R).tolist()))


def solved(messages):
    core = SolverCore(Settings(), [("a", "b")])
    return [result for message in messages for result in core.handle(message)] + core.flush()


def three_lights(messages, world, first):
    """Count the poses of three lights from a trigger on, all of them right."""
    count = 0
    for pose in solved(messages):
        if isinstance(pose, RelativePose) and pose.method == "three_lights" and pose.trigger >= first:
            truth = world.truth(pose.stamp_ns, pose.trigger)
            assert np.linalg.norm(np.subtract(pose.t_a_b_m, truth.t_a_b_m)) < 0.1 * pose.range_m
            count += 1
    return count
