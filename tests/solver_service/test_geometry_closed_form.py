"""The closed form: geometry.md's known answers, and exactness as a law."""

import math

import numpy as np
import pytest
from buddyline.solver_service.geometry.closed_form import closed_form, eq1_range_m
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.solver_service.scenes import HD, IDEAL, ODD_A, ODD_B, random_scene

# B's L and R in A's image, A's L and R in B's, normalized; t_a_b; q_a_b; mm off with the bisector, and literally.
KNOWN = [
    (
        ((0.146666667, 0), (-0.146666667, 0), (0.146666667, 0), (-0.146666667, 0)),
        (0, 0, 3),
        (0, 1, 0, 0),
        (0.0, 0.0),
    ),
    (
        (
            (0.213946836, -0.065641060),
            (-0.130688691, -0.107801620),
            (-0.027276404, 0.066572102),
            (-0.391258192, 0.022986838),
        ),
        (0.086917, -0.217889, 2.488970),
        (-0.068008, 0.991236, 0.015693, -0.112158),
        (14.6, 18.4),
    ),
    (
        (
            (-0.140747047, 0.098411310),
            (-0.213026419, 0.115301572),
            (0.280244394, -0.167743946),
            (0.204346354, -0.150186560),
        ),
        (-2.072363, 1.254342, 11.752954),
        (0.088540, 0.972430, 0.021367, 0.214670),
        (3.7, 109.6),
    ),
]


def solve(normalized, variant="exact", rig_a=IDEAL, rig_b=IDEAL):
    rays = np.array([(x, y, 1.0) for x, y in normalized])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return closed_form(rays[::2, :, None], rays[1::2, :, None], rig_a, rig_b, variant)


@pytest.mark.parametrize(("normalized", "t", "q", "off_mm"), KNOWN)
def test_known_answers(normalized, t, q, off_mm):
    found = solve(normalized)
    np.testing.assert_allclose(found.T_a_b.t_m[0], t, atol=1e-6)
    np.testing.assert_allclose(found.T_a_b.R[0], quat_to_matrix(np.array(q)), atol=3e-6)
    assert abs(found.twist_gap_rad[0]) < 1e-7
    assert abs(found.range_m[0, 0] - found.range_m[1, 0]) < 1e-6


@pytest.mark.parametrize(("normalized", "t", "q", "off_mm"), KNOWN)
def test_the_papers_readings_are_off_by_what_is_known(normalized, t, q, off_mm):
    for variant, expected in zip(("paper", "paper_literal"), off_mm, strict=True):
        off = 1e3 * np.linalg.norm(solve(normalized, variant).T_a_b.t_m[0] - t)
        assert off == pytest.approx(expected, abs=0.05)


def bearings_of(scenes):
    """Left and right (2, 3, K), from the scenes' own directions."""
    ends = []
    for side in (0, 1):
        rows = []
        for s in scenes:
            a = s.R @ s.rig_b.lights_m[side] + s.t
            b = s.R.T @ (s.rig_a.lights_m[side] - s.t)
            rows.append((a / np.linalg.norm(a), b / np.linalg.norm(b)))
        ends.append(np.transpose(rows, (1, 2, 0)))
    return ends


@pytest.mark.parametrize(("rig_a", "rig_b"), [(IDEAL, IDEAL), (ODD_A, ODD_B)], ids=["ideal", "odd"])
def test_exact_where_the_lights_are_exact(rig_a, rig_b):
    rng = np.random.default_rng(3)
    scenes = [random_scene(rng, (1.5, 20.0), rig_a, rig_b) for _ in range(150)]
    found = closed_form(*bearings_of(scenes), rig_a, rig_b)
    np.testing.assert_allclose(found.T_a_b.t_m, [s.t for s in scenes], atol=1e-9)
    np.testing.assert_allclose(found.T_a_b.R, [s.R for s in scenes], atol=1e-9)
    np.testing.assert_allclose(found.twist_gap_rad, 0, atol=1e-9)
    np.testing.assert_allclose(found.range_m[0], found.range_m[1], atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_swapping_the_nodes_inverts_the_pose(seed):
    scene = random_scene(np.random.default_rng(seed), (1.5, 10.0), ODD_A, ODD_B)
    left, right = bearings_of([scene])
    there = closed_form(left, right, ODD_A, ODD_B)
    back = closed_form(left[::-1], right[::-1], ODD_B, ODD_A)
    R = there.T_a_b.R[0]
    np.testing.assert_allclose(back.T_a_b.R[0], R.T, atol=1e-9)
    np.testing.assert_allclose(back.T_a_b.t_m[0], -R.T @ there.T_a_b.t_m[0], atol=1e-9)
    np.testing.assert_allclose(back.range_m[::-1], there.range_m, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10_000))
def test_a_rig_that_names_its_lights_the_other_way_sees_the_same_pose(seed):
    scene = random_scene(np.random.default_rng(seed), (1.5, 10.0), ODD_A, ODD_B)
    left, right = bearings_of([scene])
    named = Rig(HD, ODD_B.lights_m[::-1].copy())
    found = closed_form(np.stack((right[0], left[1])), np.stack((left[0], right[1])), ODD_A, named)
    np.testing.assert_allclose(found.T_a_b.t_m[0], scene.t, atol=1e-9)
    np.testing.assert_allclose(found.T_a_b.R[0], scene.R, atol=1e-9)


def test_eq1_head_on_is_half_the_bar_over_the_half_angle():
    alpha = np.array([0.2])
    range_m = eq1_range_m(np.cos(alpha), np.sin(alpha), np.zeros(1), np.array([0.88]))
    assert range_m[0] == pytest.approx(0.44 / math.tan(0.1), rel=1e-12)


def test_eq1_is_the_median_of_a_triangle():
    """A bar of length d at distance l, turned by beta: measured back from the angle it is seen under."""
    d, true_m, beta = 0.7, 2.3, 0.4
    ends = [np.array([s * d / 2 * math.cos(beta), true_m + s * d / 2 * math.sin(beta)]) for s in (-1, 1)]
    cosine = ends[0] @ ends[1] / np.linalg.norm(ends[0]) / np.linalg.norm(ends[1])
    found = eq1_range_m(np.array(cosine), np.array(math.sqrt(1 - cosine**2)), np.array(math.sin(beta)), np.array(d))
    assert found == pytest.approx(true_m, rel=1e-12)
