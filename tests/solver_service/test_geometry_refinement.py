"""The refinement: exact without noise, at its own covariance with it."""

from dataclasses import dataclass

import numpy as np
import pytest
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.four_lights import refine_lights
from buddyline.solver_service.geometry.past import Motion
from buddyline.solver_service.geometry.refinement import at_one_instant, least_squares
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import rotation_exp
from buddyline.solver_service.geometry.se3 import SE3

from tests.solver_service.scenes import IDEAL, ODD_A, ODD_B, PairScene, project, random_scene

STILL = Motion(np.zeros(6), np.zeros((6, 6)), 0.0, 0.0)
DISTORTED = Camera("pinhole", 1640, 1232, 1800.0, 1795.0, 830.0, 610.0, (-0.2, 0.08, 5e-4, -4e-4, 0.01))
FISHEYE = Camera("fisheye", 1640, 1232, 900.0, 905.0, 815.0, 620.0, (-0.02, 0.006, -0.003, 0.0004))
RIGS = {
    "ideal": (IDEAL, IDEAL),
    "odd": (ODD_A, ODD_B),
    "distorted": (Rig(DISTORTED, ODD_A.lights_m), Rig(FISHEYE, ODD_B.lights_m)),
}


@dataclass
class RefinedPoses:
    T_a_b: SE3
    covariance: np.ndarray
    chi2: np.ndarray
    sound: np.ndarray


def poses(scenes):
    return SE3(np.array([s.R for s in scenes]), np.array([s.t for s in scenes]))


def refine(T_a_b, frames, rig_a, rig_b, motion=STILL, dt_s=(0.0, 0.0, 0.0, 0.0)):
    """Refine by the pictures alone, then bring all sightings to one instant."""
    found = refine_lights(T_a_b, frames, np.array((rig_a.lights_m, rig_b.lights_m)))
    times_s = np.tile(np.repeat(dt_s, 2), (len(frames), 1))
    solved = least_squares(*at_one_instant(found.rows, times_s, np.repeat((1.0, -1.0), 4), motion))
    return RefinedPoses(found.T_a_b.retract(solved.step), solved.covariance, solved.chi2, found.sound)


def sightings(scenes, rng=None, sigma_px=1.0):
    pixels = np.array([np.concatenate((s.clear_a, s.clear_b)) for s in scenes])
    if rng is not None:
        pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
    a, b = scenes[0].rig_a.camera, scenes[0].rig_b.camera
    of_each = a.frames(pixels[:, :2].reshape(-1, 2)), b.frames(pixels[:, 2:].reshape(-1, 2))
    frames = np.concatenate([of_one.reshape(-1, 2, 3, 3) for of_one, _ in of_each], axis=1)
    frames[:, :, 1:] /= sigma_px
    return frames


def errors(refined, scenes):
    """Position and small rotation (K, 6), truth minus estimate."""
    return poses(scenes).minus(refined.T_a_b)


def nees(refined, scenes):
    e = errors(refined, scenes)
    return np.einsum("ki,kij,kj->k", e, np.linalg.inv(refined.covariance), e)


@pytest.mark.parametrize("rigs", RIGS.values(), ids=list(RIGS))
def test_exact_without_noise_from_a_poor_start(rigs):
    rng = np.random.default_rng(1)
    scenes = [random_scene(rng, (1.5, 20.0), *rigs) for _ in range(100)]
    true = poses(scenes)
    poor = SE3(rotation_exp(0.03 * rng.standard_normal((len(scenes), 3))) @ true.R, 1.05 * true.t_m)
    refined = refine(poor, sightings(scenes), *rigs)
    assert refined.sound.all()
    assert np.abs(errors(refined, scenes)).max() < 1e-6
    assert refined.chi2.max() < 1e-6


@pytest.mark.parametrize("rigs", RIGS.values(), ids=list(RIGS))
@pytest.mark.parametrize(("range_m", "sigma_px"), [(1.5, 0.3), (4.0, 1.0), (10.0, 0.5), (20.0, 1.0)])
def test_covariance_is_true(rigs, range_m, sigma_px):
    rng = np.random.default_rng(int(100 * range_m))
    scenes = [random_scene(rng, range_m, *rigs) for _ in range(150)] * 4
    refined = refine(poses(scenes), sightings(scenes, rng, sigma_px), *rigs)
    # The mean of 600 chi^2 of six degrees, over six: 1 +- 0.024.
    assert np.mean(nees(refined, scenes)) / 6 == pytest.approx(1.0, abs=0.1)
    assert np.mean(refined.chi2) == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize("rigs", RIGS.values(), ids=list(RIGS))
def test_what_the_last_step_leaves_is_little_of_the_noise(rigs):
    rng = np.random.default_rng(11)
    scenes = [random_scene(rng, (1.5, 20.0), *rigs) for _ in range(100)]
    seen = sightings(scenes, rng, 0.5)
    turns = rotation_exp(0.004 * rng.standard_normal((len(scenes), 3)))
    true = poses(scenes)
    start = SE3(turns @ true.R, true.t_m * (1.0 + 0.004 * rng.standard_normal((len(scenes), 1))))
    once = again = refine(start, seen, *rigs)
    for _ in range(3):
        again = refine(again.T_a_b, seen, *rigs)
    e = again.T_a_b.minus(once.T_a_b)
    assert (np.einsum("ki,kij,kj->k", e, np.linalg.inv(again.covariance), e) / 6.0).max() < 0.02**2


def test_each_pose_is_refined_as_if_alone():
    rng = np.random.default_rng(12)
    scenes = [random_scene(rng, (1.5, 20.0)) for _ in range(20)]
    seen, start = sightings(scenes, rng, 0.5), poses(scenes).retract(0.03 * rng.standard_normal((20, 6)))
    together = refine(start, seen, IDEAL, IDEAL)
    for k in range(20):
        alone = refine(start[k : k + 1], seen[k : k + 1], IDEAL, IDEAL)
        np.testing.assert_allclose(alone.T_a_b.t_m[0], together.T_a_b.t_m[k], rtol=0, atol=1e-12)
        np.testing.assert_allclose(alone.covariance[0], together.covariance[k], rtol=1e-9, atol=1e-18)


def moving(rng, rates, dt_s, count):
    """Scenes, and what is seen of them where each sighting is dt_s (4,) off the instant."""
    scenes = [random_scene(rng, (2.0, 6.0)) for _ in range(count)]
    views = []
    for s in scenes:
        clear = []
        for light, dt in enumerate(dt_s):
            now = PairScene(s.rig_a, s.rig_b, s.t + dt * rates[:3], rotation_exp(dt * rates[3:]) @ s.R, s.R_ned_a)
            clear.append((now.clear_a if light < 2 else now.clear_b)[light % 2])
        moved = PairScene(s.rig_a, s.rig_b, s.t, s.R, s.R_ned_a)
        moved.clear_a, moved.clear_b = np.array(clear[:2]), np.array(clear[2:])
        views.append(moved)
    return scenes, views


RATES = np.array([0.2, -0.1, 0.3, 0.1, 0.3, -0.2])


def test_sightings_of_a_moving_pair_are_brought_to_one_instant():
    rng = np.random.default_rng(5)
    dt_s = np.array([0.025, 0.027, -0.025, -0.026])
    scenes, views = moving(rng, RATES, dt_s, 40)
    seen, true = sightings(views), poses(scenes)
    aware = refine(true, seen, IDEAL, IDEAL, Motion(RATES, 1e-12 * np.eye(6), 0.0, 0.0), dt_s)
    assert np.abs(errors(aware, scenes)).max() < 5e-4
    unaware = refine(true, seen, IDEAL, IDEAL, Motion(np.zeros(6), 1e-12 * np.eye(6), 0.0, 0.0), dt_s)
    assert np.abs(errors(unaware, scenes)).max() > 5e-3


def test_what_is_not_known_of_the_motion_is_in_the_covariance():
    rng = np.random.default_rng(6)
    spread = np.diag([0.2**2] * 3 + [0.2**2] * 3)
    dt_s = np.array([0.02, 0.02, -0.02, -0.02])
    total, aware, unaware = 0, 0.0, 0.0
    for _ in range(60):
        scenes, views = moving(rng, 0.2 * rng.standard_normal(6), dt_s, 5)
        seen = sightings(views, rng, 0.5)
        motion = Motion(np.zeros(6), spread, 0.0, 0.0)
        aware += nees(refine(poses(scenes), seen, IDEAL, IDEAL, motion, dt_s), scenes).sum()
        unaware += nees(refine(poses(scenes), sightings(views, rng, 0.5), IDEAL, IDEAL), scenes).sum()
        total += 6 * len(scenes)
    assert aware / total == pytest.approx(1.0, abs=0.15)
    assert unaware / total > 1.5


def test_clocks_that_disagree_are_in_the_covariance():
    rng = np.random.default_rng(7)
    sigma_s, total, sum_ = 0.02, 0, 0.0
    for _ in range(60):
        skew = sigma_s * rng.standard_normal()
        scenes, views = moving(rng, RATES, np.array([0.5, 0.5, -0.5, -0.5]) * skew, 5)
        motion = Motion(RATES, 1e-12 * np.eye(6), sigma_s, 0.0)
        sum_ += nees(refine(poses(scenes), sightings(views, rng, 0.5), IDEAL, IDEAL, motion), scenes).sum()
        total += 6 * len(scenes)
    assert sum_ / total == pytest.approx(1.0, abs=0.15)


def test_stamps_that_are_off_are_in_the_covariance():
    """Each picture's by itself, and both of its lights alike."""
    rng = np.random.default_rng(9)
    sigma_s, total, sums = 1e-3, 0, np.zeros(2)
    motions = [Motion(5.0 * RATES, 1e-12 * np.eye(6), 0.0, stamps_s) for stamps_s in (sigma_s, 0.0)]
    for _ in range(100):
        scenes, views = moving(rng, motions[0].rates, np.repeat(sigma_s * rng.standard_normal(2), 2), 5)
        seen = sightings(views, rng, 0.1)
        sums += [nees(refine(poses(scenes), seen, IDEAL, IDEAL, motion), scenes).sum() for motion in motions]
        total += 6 * len(scenes)
    assert sums[0] / total == pytest.approx(1.0, abs=0.15)
    assert sums[1] / total > 5.0


def test_of_an_unknown_motion_too_each_picture_alone_has_the_error_of_its_stamp():
    """By the formula in plain numbers, for rows of both pictures and of sensors, which have no stamp."""
    rng = np.random.default_rng(10)
    rows, pictures = rng.standard_normal((1, 11, 7)), np.repeat((1.0, -1.0, 0.0), (4, 4, 3))
    motion = Motion(RATES, np.diag(rng.uniform(0.1, 0.5, 6)), 0.0, 0.7)
    J, noise = rows[0, :, :6], np.eye(11)
    for picture in (1.0, -1.0):
        moved = 0.7 * J * (pictures == picture)[:, None]
        noise += moved @ (motion.covariance + np.outer(RATES, RATES)) @ moved.T
    solved = least_squares(*at_one_instant(rows, np.zeros((1, 11)), pictures, motion))
    np.testing.assert_allclose(solved.covariance[0], np.linalg.inv(J.T @ np.linalg.solve(noise, J)), rtol=1e-9)


def test_a_pose_that_the_lights_do_not_determine_is_not_sound():
    """Both lights of B in one pixel: nothing tells its range."""
    scene = random_scene(np.random.default_rng(8), 5.0)
    frames = sightings([scene])
    frames[:, 1:] = frames[:, :1]
    with np.errstate(all="ignore"):
        refined = refine(SE3(scene.R[None], scene.t[None] * 1e9), frames, IDEAL, IDEAL)
    assert not refined.sound.any()


def test_the_forward_model_of_these_tests_is_its_own():
    """A light straight ahead falls on the principal point."""
    np.testing.assert_allclose(project(FISHEYE, [0.0, 0.0, 2.0]), [815.0, 620.0])
