"""What a pose says in north-east-down: its sigmas against numeric differences and against drawn errors.

And what the solver makes of candidates at the border of a picture.
"""

import math

import numpy as np
import pytest
from buddyline.protocol.messages import Blob, Candidates
from buddyline.solver_service.geometry.direction import ANY_AZIMUTH_RAD, direction_of
from buddyline.solver_service.geometry.rotation import matrix_to_quat, rotation_exp
from buddyline.solver_service.results import in_ned, view_of
from buddyline.solver_service.track.anchors import attitude_covariance
from msgspec import UNSET

from tests.tools.evaluated import pose

SIGMA_RAD = np.array([0.01, 0.015, 0.07])
R_BODY_CAMERA = rotation_exp(np.array([0.02, -0.03, 0.01])) @ np.array(
    [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
)
T_M = (0.7, -1.9, 3.6)


def attitude(roll, pitch, yaw):
    """Return R_ned_body = Rz(yaw) Ry(pitch) Rx(roll), one or many (..., 3, 3)."""
    zero = np.zeros_like(yaw)
    turns = [np.stack(parts, axis=-1) for parts in ((zero, zero, yaw), (zero, pitch, zero), (roll, zero, zero))]
    first, second, third = map(rotation_exp, turns)
    return first @ second @ third


def covariance(rng):
    scale = np.array([0.02, 0.03, 0.06, 0.004, 0.004, 0.006])
    mixed = np.eye(6) + 0.4 * rng.standard_normal((6, 6))
    return (mixed * scale[:, None]) @ (mixed * scale[:, None]).T


def angles(t_ned):
    """Return north, east, down, azimuth, inclination (..., 5)."""
    north, east, down = np.moveaxis(t_ned, -1, 0)
    return np.stack([north, east, down, np.arctan2(east, north), np.arctan2(-down, np.hypot(north, east))], axis=-1)


def said(attitude_rad, P, t_m=T_M, sigma_rad=SIGMA_RAD):
    R = attitude(*np.array(attitude_rad))
    made = in_ned(pose(0, t_m, covariance=P.ravel().tolist()), R_BODY_CAMERA, matrix_to_quat(R), sigma_rad)
    return made, np.array([*made.sigma_ned_m, made.sigma_azimuth_rad, made.sigma_inclination_rad])


@pytest.mark.parametrize(
    "attitude_rad", [(0.0, 0.0, 0.0), (0.3, -0.4, 2.5), (-1.2, 0.9, -1.0), (3.0, 0.2, 0.4), (0.3, 1.5, 2.0)]
)
def test_sigmas_are_those_of_numeric_differences(attitude_rad):
    P = covariance(np.random.default_rng(1))
    made, sigmas = said(attitude_rad, P)

    R = attitude(*np.array(attitude_rad))
    # Roll is about the level line ahead, pitch about that across, also where a node looks up.
    level = attitude(0.0, 0.0, np.arctan2(R[1, 0], R[0, 0]))

    def at(x):
        return angles(rotation_exp(level @ x[3:]) @ R @ R_BODY_CAMERA @ (np.array(T_M) + x[:3]))

    assert np.allclose(at(np.zeros(6))[:3], made.t_ned_m, atol=1e-12)
    step = 1e-6
    J = np.stack([(at(step * e) - at(-step * e)) / (2 * step) for e in np.eye(6)], axis=1)
    of_both = np.zeros((6, 6))
    of_both[:3, :3], of_both[3:, 3:] = P[:3, :3], np.diag(SIGMA_RAD**2)
    assert np.allclose(sigmas, np.sqrt(np.diag(J @ of_both @ J.T)), rtol=1e-3)


def test_errors_drawn_from_covariance_and_attitude_spread_as_said():
    rng = np.random.default_rng(2)
    P = covariance(rng)
    told = np.array([0.3, -0.4, 2.5])
    made, sigmas = said(told, P)
    count = 40_000
    t_m = rng.multivariate_normal(T_M, P[:3, :3], count)
    turns = rotation_exp(SIGMA_RAD * rng.standard_normal((count, 3)) @ attitude(0.0, 0.0, told[2]).T)
    R = turns @ attitude(*told)
    spread = angles((R @ R_BODY_CAMERA @ t_m[:, :, None])[:, :, 0]) - angles(np.array(made.t_ned_m))
    # First order, with a heading of 4 degrees: within a few per cent.
    assert np.sqrt((spread**2).mean(axis=0)) == pytest.approx(sigmas, rel=0.03)


@pytest.mark.parametrize("pitch_rad", [0.0, 0.8, 1.5, math.pi / 2, -1.5])
def test_no_level_axis_of_an_attitude_is_known_better_than_another_where_a_node_looks_up(pitch_rad):
    """A filter does not know better which way is down there, and states the same sigmas."""
    R = attitude(0.4, pitch_rad, -2.0)
    known = attitude_covariance(R, np.array([0.02, 0.02, 0.07]), 1.0, 1.0)
    assert np.allclose(known, np.diag([0.02, 0.02, 0.07]) ** 2, rtol=1e-9)


def test_a_compass_that_is_worse_widens_the_azimuth_and_hardly_the_inclination():
    P = covariance(np.random.default_rng(3))
    _, good = said((0.0, 0.0, 1.0), P)
    _, poor = said((0.0, 0.0, 1.0), P, sigma_rad=np.array([0.01, 0.015, 0.35]))
    assert poor[3] == pytest.approx(0.35, rel=0.01)
    assert poor[4] == pytest.approx(good[4], rel=1e-6)


def test_straight_above_any_azimuth_is_as_likely():
    found = direction_of(np.array([0.0, 0.0, -4.0]), 1e-4 * np.eye(3))
    assert found.sigma_azimuth_rad == ANY_AZIMUTH_RAD
    assert found.inclination_rad == pytest.approx(np.pi / 2)
    assert found.sigma_inclination_rad == pytest.approx(0.01 / 4.0)


def test_absurd_sigmas_of_an_attitude_say_nothing():
    made = in_ned(pose(0), R_BODY_CAMERA, np.array([0.0, 0.0, 0.0, 1.0]), np.array([0.01, 0.01, 1e200]))
    assert made.t_ned_m is UNSET
    assert made.sigma_ned_m is UNSET


def test_a_candidate_that_the_border_cuts_is_worse_known_by_as_deep_as_the_cut():
    area_px = math.pi * 20.0**2

    def blob(u_px, v_px):
        return Blob(u_px=u_px, v_px=v_px, sigma_px=0.6, area_px=area_px, peak=255.0, elongation=1.0, dt_ns=0)

    blobs = [blob(400.0, 300.0), blob(21.0, 300.0), blob(8.0, 300.0), blob(400.0, 615.0 - 2.0)]
    frame = Candidates(node="a", stamp_ns=1, trigger=0, seq=0, boot="t", width_px=820, height_px=616, blobs=blobs,
                       truncated=0)  # fmt: skip
    sigmas = [math.hypot(0.6, cut_px / math.sqrt(3.0)) for cut_px in (0.0, 0.0, 12.0, 18.0)]
    assert view_of(frame).sigma_px == pytest.approx(sigmas)
