"""Laws of rigid transforms, near the identity and near half a turn too."""

import math

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import matrix_to_quat
from buddyline.solver_service.geometry.se3 import SE3
from hypothesis import given
from hypothesis import strategies as st

VECTORS = st.tuples(*[st.floats(-3, 3)] * 3).map(np.array)
DIRECTIONS = VECTORS.filter(lambda v: np.linalg.norm(v) > 1e-2)
ANGLES = st.one_of(st.floats(0, math.pi), st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, 1.1e-4, math.pi - 1e-6, math.pi]))
TURNS = st.builds(lambda axis, angle: angle * axis / np.linalg.norm(axis), DIRECTIONS, ANGLES)
TWISTS = st.builds(lambda along, turn: np.concatenate((along, turn)), VECTORS, TURNS)
POSES = TWISTS.map(SE3.exp)


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


@given(TWISTS)
def test_log_takes_back_what_exp_did(twist):
    T = SE3.exp(twist)
    assert_same(SE3.exp(T.log()), T)
    if np.linalg.norm(twist[3:]) < math.pi - 1e-3:
        np.testing.assert_allclose(T.log(), twist, atol=1e-7)


@given(TWISTS, st.floats(0, 1))
def test_a_twist_may_be_walked_in_parts(twist, share):
    assert_same(SE3.exp(share * twist) @ SE3.exp((1 - share) * twist), SE3.exp(twist))


@given(POSES, TWISTS)
def test_the_adjoint_carries_a_twist_to_the_other_frame(T_a_b, twist_b):
    assert_same(T_a_b @ SE3.exp(twist_b), SE3.exp(T_a_b.adjoint() @ twist_b) @ T_a_b, atol=1e-8)


@given(POSES, POSES)
def test_minus_is_the_step_that_retract_takes(T_a_b, other):
    assert_same(other.retract(T_a_b.minus(other)), T_a_b)


@given(POSES)
def test_quaternion_and_translation_are_the_pose(T_a_b):
    assert_same(SE3.from_quat(matrix_to_quat(T_a_b.R), T_a_b.t_m), T_a_b)
    np.testing.assert_allclose(np.linalg.norm(T_a_b.q_xyzw), 1.0)


def test_a_batch_gives_what_each_gives_alone():
    rng = np.random.default_rng(1)
    twists, points = rng.standard_normal((7, 6)), rng.standard_normal((7, 3))
    many, each = SE3.exp(twists), [SE3.exp(twist) for twist in twists]
    assert len(many) == 7
    for k, one in enumerate(each):
        assert_same(many[k], one, 1e-14)
        assert_same((many @ many)[k], one @ one, 1e-14)
        assert_same(many.inverse()[k], one.inverse(), 1e-14)
        assert_same(many.retract(twists)[k], one.retract(twists[k]), 1e-14)
        np.testing.assert_allclose((many @ points)[k], one @ points[k], atol=1e-14)
        np.testing.assert_allclose(many.log()[k], one.log(), atol=1e-12)
        np.testing.assert_allclose(many.adjoint()[k], one.adjoint(), atol=1e-14)


def test_a_quarter_turn_about_z_a_metre_ahead():
    T = SE3.from_quat(np.array((0, 0, math.sqrt(0.5), math.sqrt(0.5))), np.array((1.0, 0, 0)))
    assert T @ np.array((1.0, 0, 0)) == pytest.approx([1, 1, 0])
