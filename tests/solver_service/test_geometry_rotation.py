"""Laws of rotations, near the identity and near half a turn too."""

import math

import numpy as np
from buddyline.solver_service.geometry.rotation import (
    matrix_to_quat,
    quat_to_matrix,
    rotation_exp,
    rotation_log,
    skew,
)
from hypothesis import given
from hypothesis import strategies as st

DIRECTIONS = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-2)
ANGLES = st.one_of(st.floats(0, math.pi), st.sampled_from([0.0, 1e-12, 1e-8, 1e-4, math.pi - 1e-6, math.pi]))


def vector(direction, angle):
    return np.array(direction) / np.linalg.norm(direction) * angle


@given(DIRECTIONS, ANGLES)
def test_exp_gives_a_rotation_and_log_takes_it_back(direction, angle):
    w = vector(direction, angle)
    R = rotation_exp(w)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0
    back = rotation_log(R)
    np.testing.assert_allclose(rotation_exp(back), R, atol=1e-9)
    assert np.linalg.norm(back) <= math.pi + 1e-9


@given(DIRECTIONS, ANGLES)
def test_quaternion_and_matrix_are_one_rotation(direction, angle):
    R = rotation_exp(vector(direction, angle))
    q = matrix_to_quat(R)
    assert abs(np.linalg.norm(q) - 1) < 1e-12
    np.testing.assert_allclose(quat_to_matrix(q), R, atol=1e-12)
    np.testing.assert_allclose(quat_to_matrix(-3.0 * q), R, atol=1e-12)


def test_a_quarter_turn_about_z_takes_x_to_y():
    q = np.array([0, 0, math.sqrt(0.5), math.sqrt(0.5)])
    np.testing.assert_allclose(quat_to_matrix(q) @ [1, 0, 0], [0, 1, 0], atol=1e-15)
    np.testing.assert_allclose(rotation_exp(np.array([0, 0, math.pi / 2])) @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@given(st.lists(st.tuples(DIRECTIONS, ANGLES), min_size=1, max_size=5))
def test_a_batch_gives_what_each_gives_alone(turns):
    w = np.array([vector(*turn) for turn in turns])
    R = rotation_exp(w)
    np.testing.assert_allclose(R, [rotation_exp(each) for each in w], atol=1e-15)
    np.testing.assert_allclose(rotation_log(R), [rotation_log(each) for each in R], atol=1e-15)
    np.testing.assert_allclose(quat_to_matrix(matrix_to_quat(R)), R, atol=1e-12)


@given(DIRECTIONS, DIRECTIONS)
def test_skew_is_the_cross_product(a, b):
    np.testing.assert_allclose(skew(np.array(a)) @ b, np.cross(a, b), atol=1e-14)


def test_many_rotations_are_turned_back_as_each_alone():
    rng = np.random.default_rng(5)
    angles = np.array([0.0, 1e-14, 1e-9, 1e-4, 1.0, 2.0, 3.0, math.pi - 1e-7, math.pi])
    directions = rng.normal(size=(5, len(angles), 3))
    R = rotation_exp(directions / np.linalg.norm(directions, axis=-1, keepdims=True) * angles[:, None])
    one_by_one = [matrix_to_quat(each) for each in R.reshape(-1, 3, 3)]
    np.testing.assert_allclose(matrix_to_quat(R).reshape(-1, 4), one_by_one, atol=1e-15)
    one_by_one = [rotation_log(each) for each in R.reshape(-1, 3, 3)]
    np.testing.assert_allclose(rotation_log(R).reshape(-1, 3), one_by_one, atol=1e-15)


def test_an_endless_turn_has_no_matrix_however_many_are_asked_for():
    endless = np.full(3, 1e200)
    with np.errstate(all="ignore"):
        assert np.isnan(rotation_exp(endless)).all()
        assert np.isnan(rotation_exp(np.tile(endless, (40, 1)))).all()
