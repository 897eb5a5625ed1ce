"""Laws of rigid transforms, near the identity and near half a turn too."""

import math

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import quat_to_matrix, rotation_exp
from buddyline.solver_service.geometry.se3 import SE3
from hypothesis import given
from hypothesis import strategies as st

VECTORS = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
DIRECTIONS = VECTORS.filter(lambda v: np.linalg.norm(v) > 1e-2)
ANGLES = st.one_of(st.floats(0, math.pi), st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, 1.1e-4, math.pi - 1e-6, math.pi]))
TURNS = st.builds(lambda axis, angle: angle * axis / np.linalg.norm(axis), DIRECTIONS, ANGLES)
POSES = st.builds(lambda turn, t_m: SE3(rotation_exp(turn), t_m), TURNS, VECTORS)


def assert_same(one, other, atol=1e-9):
    np.testing.assert_allclose(one.R, other.R, atol=atol)
    np.testing.assert_allclose(one.t_m, other.t_m, atol=atol)


@given(POSES, POSES, VECTORS)
def test_letters_cancel(T_a_b, T_b_c, p_c):
    np.testing.assert_allclose((T_a_b @ T_b_c) @ p_c, T_a_b @ (T_b_c @ p_c), atol=1e-9)


@given(POSES)
def test_the_inverse_leads_back(T_a_b):
    assert_same(T_a_b @ T_a_b.inverse(), SE3.identity())
    assert_same(T_a_b.inverse() @ T_a_b, SE3.identity())


@given(POSES, POSES)
def test_minus_is_the_step_that_retract_takes(T_a_b, other):
    assert_same(other.retract(T_a_b.minus(other)), T_a_b)


@given(POSES)
def test_quaternion_and_translation_are_the_pose(T_a_b):
    assert_same(SE3(quat_to_matrix(T_a_b.q_xyzw), T_a_b.t_m), T_a_b)
    np.testing.assert_allclose(np.linalg.norm(T_a_b.q_xyzw), 1.0)


def test_a_batch_gives_what_each_gives_alone():
    rng = np.random.default_rng(1)
    steps, points = rng.standard_normal((7, 6)), rng.standard_normal((7, 3))
    many, each = SE3.identity().retract(steps), [SE3.identity().retract(step) for step in steps]
    assert len(many) == 7
    for k, one in enumerate(each):
        assert_same(many[k], one, 1e-14)
        assert_same((many @ many)[k], one @ one, 1e-14)
        assert_same(many.inverse()[k], one.inverse(), 1e-14)
        assert_same(many.retract(steps)[k], one.retract(steps[k]), 1e-14)
        np.testing.assert_allclose((many @ points)[k], one @ points[k], atol=1e-14)
        np.testing.assert_allclose(many.minus(each[0])[k], one.minus(each[0]), atol=1e-12)


def test_a_quarter_turn_about_z_a_metre_ahead():
    T = SE3(rotation_exp(np.array((0, 0, math.pi / 2))), np.array((1.0, 0, 0)))
    assert T @ np.array((1.0, 0, 0)) == pytest.approx([1, 1, 0])
