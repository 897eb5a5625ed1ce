"""Errors, pairs and detection figures on made-up dives whose answers are known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buddyline.node.sim.camera import project as sim_project
from buddyline.protocol.messages import Attitude, CameraModel
from buddyline.tools.evaluation.lights import project
from buddyline.tools.evaluation.poses import nees
from buddyline.tools.evaluation.recorded import Recorded
from buddyline.tools.evaluation.result import Result, evaluate
from buddyline.tools.evaluation.rotation import from_rotation_vector, multiply, normalized, rotate, rotation_vector
from buddyline.tools.evaluation.truth import inverted
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec import UNSET

from tests.tools.evaluated import (
    COVARIANCE,
    FACING,
    FALSE,
    FIRST,
    INFOS,
    LEFT,
    OFFSET_PX,
    PERIOD_NS,
    RIGHT,
    frame,
    info,
    light_truth,
    pose,
    rejection,
    truth,
)

angles = st.floats(-1.8, 1.8)


def q_exp(w_rad: np.ndarray) -> np.ndarray:
    """Return the quaternion of a rotation vector."""
    angle = float(np.linalg.norm(w_rad))
    axis = w_rad / angle if angle else w_rad
    return np.array([*(axis * math.sin(angle / 2)), math.cos(angle / 2)])


def measure(poses=(), rejected=(), truths=(), candidates=(), light_truths=(), infos=INFOS, attitudes=()) -> Result:
    recorded = Recorded(
        nodes=("a", "b"),
        poses=list(poses),
        rejected=list(rejected),
        truths=list(truths),
        candidates=list(candidates),
        light_truths=list(light_truths),
        attitudes_a=list(attitudes),
        infos=infos,
    )
    return evaluate(recorded)


@settings(max_examples=50, deadline=None)
@given(angles, angles, angles)
def test_rotation_vector_undoes_the_exponential(x, y, z):
    w = np.array([x, y, z])
    if np.linalg.norm(w) < math.pi - 1e-6:
        assert rotation_vector(q_exp(w)) == pytest.approx(w, abs=1e-9)
        assert rotation_vector(-q_exp(w)) == pytest.approx(w, abs=1e-9)
        assert rotation_vector(from_rotation_vector(w)) == pytest.approx(w, abs=1e-9)


def test_rotate_agrees_with_product_of_quaternions():
    p, q = q_exp(np.array([0.3, -1.0, 0.2])), q_exp(np.array([1.1, 0.4, -0.9]))
    v = np.array([1.0, 2.0, 3.0])
    assert rotate(multiply(p, q), v) == pytest.approx(rotate(p, rotate(q, v)))
    assert rotate(q_exp(np.array([0.0, 0.0, math.pi / 2])), np.array([1.0, 0, 0])) == pytest.approx([0, 1, 0])


def test_covariance_convention_known_answer():
    """R_true = exp(w) R_est with w in A's frame; position first; their correlation is felt."""
    d, w = np.array([0.02, -0.01, 0.03]), np.array([0.002, 0.004, -0.003])
    q_est = normalized(np.array([0.1, 0.97, -0.05, 0.2]))
    spread = np.random.default_rng(5).normal(size=(6, 6)) * [0.02, 0.01, 0.03, 0.002, 0.001, 0.004]
    P = spread.T @ spread
    e = np.concatenate([d, w])
    q_true = multiply(q_exp(w), q_est)
    t_est = np.array([0.3, -0.2, 3.0])
    result = measure(
        [pose(0, tuple(t_est), q_a_b_xyzw=tuple(q_est), covariance=P.ravel().tolist())],
        truths=[truth(0, tuple(t_est + d), q_a_b_xyzw=tuple(q_true))],
    )
    assert result.errors.translation_m[0] == pytest.approx(math.sqrt(0.0014))
    assert result.errors.rotation_rad[0] == pytest.approx(np.linalg.norm(w))
    assert result.errors.nees6[0] == pytest.approx(e @ np.linalg.inv(P) @ e, rel=1e-6)
    assert result.errors.nees3[0] == pytest.approx(d @ np.linalg.inv(P[:3, :3]) @ d, rel=1e-6)
    assert result.errors.range_m[0] == pytest.approx(np.linalg.norm(t_est) - np.linalg.norm(t_est + d))


def test_true_covariances_give_a_mean_nees_of_six_and_three():
    rng = np.random.default_rng(11)
    spread = rng.normal(size=(6, 6)) * [0.02, 0.01, 0.03, 0.002, 0.001, 0.004]
    P = spread.T @ spread
    draws = rng.multivariate_normal(np.zeros(6), P, size=2000)
    result = measure(
        [pose(k, covariance=P.ravel().tolist()) for k in range(2000)],
        truths=[
            truth(k, tuple(np.array([0, 0, 3.0]) + e[:3]), q_a_b_xyzw=tuple(multiply(q_exp(e[3:]), np.array(FACING))))
            for k, e in enumerate(draws)
        ],
    )
    # Chi-square of n degrees of freedom: mean n, variance 2 n; five standard deviations of the mean of 2000.
    assert result.accuracy.nees6.mean == pytest.approx(6, abs=5 * math.sqrt(12 / 2000))
    assert result.accuracy.nees3.mean == pytest.approx(3, abs=5 * math.sqrt(6 / 2000))
    assert result.accuracy.nees6.median == pytest.approx(5.348, abs=0.5)
    assert result.accuracy.honest6 == pytest.approx(0.95, abs=5 * math.sqrt(0.95 * 0.05 / 2000))
    assert result.accuracy.honest3 == pytest.approx(0.95, abs=5 * math.sqrt(0.95 * 0.05 / 2000))


def test_an_invalid_covariance_has_no_normalized_error():
    broken = COVARIANCE.copy()
    broken[0, 1] = broken[1, 0] = 2e-4
    zero = np.zeros((6, 6))
    assert np.isnan(nees(np.ones((2, 6)), np.array([broken, zero]))).all()
    result = measure([pose(0, covariance=[0.0] * 36), pose(1)], truths=[truth(0), truth(1)])
    assert result.accuracy.nees6.count == 1
    assert result.accuracy.translation_m.count == 2


def test_stats_are_median_p95_rmse_and_bias():
    truths = [truth(k) for k in range(4)]
    poses = [pose(k, (0.0, 0.0, 3.0 + off)) for k, off in enumerate((-0.1, 0.2, 0.2, 0.5))]
    stats = measure(poses, truths=truths).accuracy.range_m
    assert (stats.count, stats.median) == (4, pytest.approx(0.2))
    assert stats.rmse == pytest.approx(math.sqrt((0.01 + 0.04 + 0.04 + 0.25) / 4))
    assert stats.mean == pytest.approx(0.2)
    assert stats.p95 == pytest.approx(0.2 + 0.85 * 0.3)


def test_wrong_is_more_than_a_tenth_of_the_range():
    result = measure([pose(0, (0.0, 0.0, 3.29)), pose(1, (0.0, 0.0, 3.31))], truths=[truth(0), truth(1)])
    assert (result.accuracy.wrong, result.accuracy.wrong_share) == (1, 0.5)
    assert result.errors.wrong.tolist() == [False, True]


def test_bins_split_by_true_range():
    poses = [pose(0, (0.0, 0.0, 3.0)), pose(1, (0.0, 0.0, 4.9)), pose(2, (0.0, 0.0, 25.0))]
    truths = [truth(0), truth(1, (0.0, 0.0, 5.0)), truth(2, (0.0, 0.0, 25.0))]
    bins = measure(poses, truths=truths).bins
    assert [(part.from_m, part.to_m, part.accuracy.poses) for part in bins] == [(2, 4, 1), (4, 6, 1), (20, math.inf, 1)]
    assert bins[1].accuracy.translation_m.median == pytest.approx(0.1)


def test_truth_is_matched_by_trigger_whatever_the_stamps():
    shifted = pose(1, stamp_ns=(FIRST + 1) * PERIOD_NS + 40_000_000)
    result = measure([shifted], truths=[truth(0, (0.0, 0.0, 9.0)), truth(1), truth(2, (0.0, 0.0, 9.0))])
    assert result.errors.translation_m == pytest.approx([0.0])


def test_truth_without_triggers_is_interpolated_between_its_instants():
    turned = tuple(multiply(q_exp(np.array([0.0, 0.2, 0.0])), np.array(FACING)))
    truths = [truth(0, trigger=UNSET), truth(1, (0.4, 0.0, 3.0), q_a_b_xyzw=turned, trigger=UNSET)]
    result = measure([pose(0, stamp_ns=FIRST * PERIOD_NS + PERIOD_NS // 4)], truths=truths)
    assert result.errors.true_t_m[0] == pytest.approx([0.1, 0.0, 3.0])
    assert result.errors.rotation_rad[0] == pytest.approx(0.05)


def test_sparse_truth_is_used_only_near_its_instants():
    near, far = pose(0, stamp_ns=FIRST * PERIOD_NS + 10_000_000), pose(10)
    result = measure([near, far], truths=[truth(0, trigger=UNSET), truth(20, trigger=UNSET)])
    assert (result.poses, result.without_truth, len(result.errors)) == (2, 1, 1)


@settings(max_examples=50, deadline=None)
@given(angles, angles, angles, st.floats(-5, 5), st.floats(-5, 5), st.floats(-5, 5))
def test_inverted_truth_inverts_back(wx, wy, wz, x, y, z):
    there = truth(0, (x, y, z), q_a_b_xyzw=tuple(q_exp(np.array([wx, wy, wz]))))
    back = inverted(there)
    point = np.array([0.3, -0.7, 2.0])
    in_a = rotate(np.array(there.q_a_b_xyzw), point) + there.t_a_b_m
    assert rotate(np.array(back.q_a_b_xyzw), in_a) + back.t_a_b_m == pytest.approx(point, abs=1e-9)
    assert back.trigger == there.trigger


def test_azimuth_and_inclination_against_truth_in_ned():
    """A looks east, b stands ahead and 30 degrees up: azimuth 90, inclination 30 degrees."""
    east = Attitude(
        node="a",
        stamp_ns=FIRST * PERIOD_NS,
        q_ned_body_xyzw=(0.0, 0.0, math.sin(math.pi / 4), math.cos(math.pi / 4)),
        sigma_rad=(0.01, 0.01, 0.05),
    )
    t_m = (0.0, -1.5, 3.0 * math.cos(math.radians(30)))
    published = pose(0, t_m, azimuth_rad=math.radians(91), inclination_rad=math.radians(28), skew_ns=0)
    result = measure([published], truths=[truth(0, t_m)], attitudes=[east])
    assert np.degrees(result.errors.azimuth_rad) == pytest.approx([1.0])
    assert np.degrees(result.errors.inclination_rad) == pytest.approx([-2.0])
    around = pose(0, t_m, azimuth_rad=math.radians(90 + 359), inclination_rad=math.radians(30), skew_ns=0)
    assert np.degrees(measure([around], truths=[truth(0, t_m)], attitudes=[east]).errors.azimuth_rad) == pytest.approx(
        [-1.0]
    )
    assert measure([published], truths=[truth(0, t_m)]).accuracy.azimuth_rad.count == 0


def pair_of(poses, light_truths=(), candidates=None, infos=INFOS, rejected=()):
    if candidates is None:
        candidates = [frame(node, 0) for node in "ab"]
    return measure(poses, rejected, [truth(0)], candidates, light_truths, infos).pairing


MARKED = [light_truth(node, 0) for node in "ab"]


@pytest.mark.parametrize("light_truths", [MARKED, []], ids=["marked", "projected"])
@pytest.mark.parametrize(
    ("blobs_a", "blobs_b", "right"),
    [
        ((0, 1), (0, 1), 1),
        ((1, 0), (0, 1), 0),
        ((1, 0), (1, 0), 0),
        ((0, 2), (0, 1), 0),
        ((0, 1), (-1, 1), 0),
        ((0, 1), (0, 7), 0),
    ],
)
def test_a_right_pair_uses_the_true_lights_left_and_right(light_truths, blobs_a, blobs_b, right):
    pairing = pair_of([pose(0, blobs_a=blobs_a, blobs_b=blobs_b)], light_truths)
    assert pairing.marked == bool(light_truths)
    partial = int(-1 in blobs_b)
    assert (pairing.visible, pairing.right, pairing.detected) == (1, right, 1)
    assert (pairing.partial, pairing.other_pair) == (partial, 1 - right - partial)
    assert pairing.right_share == right


@pytest.mark.parametrize(("width_px", "off_px", "near"), [(820, 8.1, 1), (820, 8.3, 0), (290, 2.9, 1), (290, 3.1, 0)])
def test_tolerance_is_one_percent_of_the_width_and_at_least_3_px(width_px, off_px, near):
    lights = [light_truth(node, 0, left=(150.0, 90.0), right=(60.0, 90.0)) for node in "ab"]
    seen = [frame(node, 0, ((150.0 + off_px, 90.0), (60.0, 90.0)), width_px=width_px) for node in "ab"]
    pairing = pair_of([pose(0)], lights, seen)
    assert (pairing.right, pairing.detected) == (near, near)


def test_only_triggers_with_all_four_lights_count():
    hidden = [light_truth("a", 0), light_truth("b", 0, (True, False))]
    assert pair_of([pose(0)], hidden) is None
    assert pair_of([pose(0)], MARKED[:1], [frame("a", 0)]) is None
    outside = INFOS | {"b": info("b", light_right_m=(1.5, 0.0, 0.0))}
    assert pair_of([pose(0)], [], infos=outside) is None
    assert pair_of([pose(0)], [], [frame("a", 0)]) is None


def test_every_trigger_in_view_has_one_ending():
    lights = [light_truth(node, k) for node in "ab" for k in range(4)]
    frames = [frame(node, k) for node in "ab" for k in range(3)] + [frame("a", 3, (FALSE,)), frame("b", 3)]
    result = measure([pose(0)], [rejection(1), rejection(3, "too_few_candidates")], [truth(0)], frames, lights)
    assert (result.pairing.visible, result.pairing.right, result.pairing.right_share) == (4, 1, 0.25)
    assert result.pairing.ended == {"ambiguous": 1, "no result": 1, "too_few_candidates": 1}
    assert (result.pairing.detected, result.pairing.right_detected) == (3, 1)
    assert result.pairing.right_detected_share == pytest.approx(1 / 3)
    assert result.triggers.unanswered == 1
    assert result.triggers.rejected == {"ambiguous": 1, "too_few_candidates": 1}


def test_unknown_candidates_leave_the_pair_unknown():
    pairing = pair_of([pose(0)], MARKED, [])
    assert (pairing.visible, pairing.right, pairing.right_share, pairing.detected) == (1, None, None, None)
    assert measure([pose(0)], truths=[truth(0)]).triggers.unanswered is None


def test_triggers_are_counted_with_their_rates():
    frames = [frame(node, k) for node in "ab" for k in range(11)]
    poses = [pose(0), pose(1), pose(6)]
    triggers = measure(poses, [rejection(k) for k in (2, 3, 4)], [truth(0)], frames).triggers
    assert (triggers.total, triggers.unanswered, triggers.doubled) == (11, 5, 0)
    assert (triggers.span_s, triggers.triggers_hz) == (pytest.approx(1.0), pytest.approx(10.0))
    assert triggers.poses_hz == pytest.approx(3.0)
    assert triggers.gap_s == pytest.approx(0.5)


def test_skew_and_its_drift():
    poses = [pose(k, skew_ns=1_000_000 + 10_000 * k) for k in range(101)]
    skew = measure(poses, truths=[truth(0)]).skew
    assert skew.median_s == pytest.approx(1.5e-3)
    assert skew.largest_s == pytest.approx(2e-3)
    assert skew.drift_ppm == pytest.approx(100.0)
    assert skew.drift_sd_ppm == pytest.approx(0.0, abs=1e-6)


def test_detection_known_answers():
    near = (LEFT[0] + 3.0, LEFT[1] + 4.0)
    frames = [
        frame("a", 0, (FALSE, (120.0, 60.0), LEFT, RIGHT, (700.0, 20.0)), sigma_px=0.5),
        frame("b", 0, (near, RIGHT), sigma_px=5.0),
        frame("a", 1, (LEFT, FALSE)),
    ]
    lights = [
        light_truth("a", 0),
        light_truth("b", 0),
        light_truth("a", 1, (False, True)),
        light_truth("b", 1),
    ]
    detection = measure(candidates=frames, light_truths=lights).detection
    assert (detection.pictures, detection.lost_pictures, detection.visible_lights) == (4, 1, 7)
    assert detection.recall_close == pytest.approx(3 / 7)
    assert detection.recall_near == pytest.approx(4 / 7)
    assert detection.both_visible == 3
    assert detection.both_first == {
        3: pytest.approx(1 / 3),
        5: pytest.approx(2 / 3),
        8: pytest.approx(2 / 3),
        0: pytest.approx(2 / 3),
    }
    assert detection.candidates_per_picture == pytest.approx(9 / 3)
    # The hidden light's own candidate is not false.
    assert detection.false_per_picture == pytest.approx(4 / 3)
    assert detection.error_median_px == pytest.approx(0.0)
    assert detection.error_p90_px == pytest.approx(np.percentile([0, 0, 0, 5], 90))
    # Eight axes, two of them off by 3 px and 4 px at a sigma of 5 px.
    assert detection.normalized_rms == pytest.approx(math.sqrt((0.36 + 0.64) / 8))


def test_one_candidate_is_not_both_lights():
    lights = [light_truth("a", 0, left=(204.0, 50.0), right=(200.0, 50.0))]
    one = measure(candidates=[frame("a", 0, ((202.0, 50.0),))], light_truths=lights).detection
    two = measure(candidates=[frame("a", 0, ((200.0, 50.0), (204.0, 50.0)))], light_truths=lights).detection
    assert (one.recall_near, one.both_first[3]) == (1.0, 0.0)
    assert (two.recall_near, two.both_first[3]) == (1.0, 1.0)


def test_no_marked_lights_no_detection_figures():
    assert measure([pose(0)], truths=[truth(0)], candidates=[frame("a", 0), frame("b", 0)]).detection is None


PINHOLE = CameraModel(
    model="pinhole", fx_px=900.0, fy_px=880.0, cx_px=410.0, cy_px=300.0, distortion=[-0.3, 0.1, 1e-3, -2e-3, 0.0]
)
FISHEYE = CameraModel(
    model="fisheye", fx_px=400.0, fy_px=400.0, cx_px=410.0, cy_px=300.0, distortion=[0.02, -0.01, 0.003, 0.0]
)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_projection_agrees_with_the_simulators_own(camera):
    points = np.random.default_rng(3).uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 6.0], size=(50, 3))
    assert project(points, camera) == pytest.approx(sim_project(points, camera), abs=1e-6)


def test_projection_stops_at_the_fold_of_the_lens_model():
    assert np.isnan(project(np.array([[0.1, 0.0, -2.0]]), PINHOLE)).all()
    folding = CameraModel(
        model="pinhole", fx_px=900.0, fy_px=900.0, cx_px=410.0, cy_px=300.0, distortion=[-0.3, 0.0, 0.0, 0.0, 0.0]
    )
    # x (1 - 0.3 x^2) turns back at x = 1.054, and 1.7 comes to lie well inside the picture.
    seen = project(np.array([[0.9, 0.0, 1.0], [1.7, 0.0, 1.0]]), folding)
    assert np.isfinite(seen[0]).all()
    assert np.isnan(seen[1]).all()
    assert project(np.empty((0, 3)), PINHOLE).shape == (0, 2)


def test_projected_lights_follow_the_protocols_left_and_right():
    """The other's left light stands to the right in the picture."""
    pixels = project(np.array([[0.44, 0.0, 3.0]]), INFOS["a"].camera)
    assert pixels[0] == pytest.approx([409.5 + OFFSET_PX, 307.5])
