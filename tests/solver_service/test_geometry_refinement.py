"""The refinement: exact without noise, at its own covariance with it."""

import numpy as np
import pytest
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.refinement import Motion, Sightings, refine
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import rotation_exp, rotation_log

from tests.solver_service.scenes import IDEAL, ODD_A, ODD_B, Scene, project, random_scene

STILL = Motion(np.zeros(6), np.zeros((6, 6)))
DISTORTED = Camera("pinhole", 1640, 1232, 1800.0, 1795.0, 830.0, 610.0, (-0.2, 0.08, 5e-4, -4e-4, 0.01))
FISHEYE = Camera("fisheye", 1640, 1232, 900.0, 905.0, 815.0, 620.0, (-0.02, 0.006, -0.003, 0.0004))
RIGS = {
    "ideal": (IDEAL, IDEAL),
    "odd": (ODD_A, ODD_B),
    "distorted": (Rig(DISTORTED, ODD_A.lights_m), Rig(FISHEYE, ODD_B.lights_m)),
}


def sightings(scenes, rng=None, sigma_px=1.0, dt_s=None):
    pixels = np.array([np.concatenate((s.clear_a, s.clear_b)) for s in scenes])
    if rng is not None:
        pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
    a, b = scenes[0].rig_a.camera, scenes[0].rig_b.camera
    of_each = a.frames(pixels[:, :2].reshape(-1, 2)), b.frames(pixels[:, 2:].reshape(-1, 2))
    frames = np.concatenate([of_one.reshape(-1, 2, 3, 3) for of_one, _ in of_each], axis=1)
    frames[:, :, 1:] /= sigma_px
    return Sightings(frames, np.zeros((len(scenes), 4)) if dt_s is None else dt_s)


def errors(refined, scenes):
    """Position and small rotation (K, 6), truth minus estimate."""
    turns = [rotation_log(s.R @ R.T) for s, R in zip(scenes, refined.R_a_b, strict=True)]
    return np.concatenate((np.array([s.t for s in scenes]) - refined.t_a_b_m, turns), axis=1)


def nees(refined, scenes):
    e = errors(refined, scenes)
    return np.einsum("ki,kij,kj->k", e, np.linalg.inv(refined.covariance), e)


@pytest.mark.parametrize("rigs", RIGS.values(), ids=list(RIGS))
def test_exact_without_noise_from_a_poor_start(rigs):
    rng = np.random.default_rng(1)
    scenes = [random_scene(rng, (1.5, 20.0), *rigs) for _ in range(100)]
    t = np.array([s.t for s in scenes]) * 1.05
    R = rotation_exp(0.03 * rng.standard_normal((len(scenes), 3))) @ np.array([s.R for s in scenes])
    refined = refine(t, R, sightings(scenes), *rigs, STILL)
    assert refined.sound.all()
    assert np.abs(errors(refined, scenes)).max() < 1e-6
    assert refined.chi2.max() < 1e-6


@pytest.mark.parametrize("rigs", RIGS.values(), ids=list(RIGS))
@pytest.mark.parametrize(("range_m", "sigma_px"), [(1.5, 0.3), (4.0, 1.0), (10.0, 0.5), (20.0, 1.0)])
def test_covariance_is_true(rigs, range_m, sigma_px):
    rng = np.random.default_rng(int(100 * range_m))
    scenes = [random_scene(rng, range_m, *rigs) for _ in range(150)] * 4
    t, R = np.array([s.t for s in scenes]), np.array([s.R for s in scenes])
    refined = refine(t, R, sightings(scenes, rng, sigma_px), *rigs, STILL)
    # The mean of 600 chi^2 of six degrees, over six: 1 +- 0.024.
    assert np.mean(nees(refined, scenes)) / 6 == pytest.approx(1.0, abs=0.1)
    assert np.mean(refined.chi2) == pytest.approx(2.0, abs=0.3)


@pytest.mark.parametrize("rigs", RIGS.values(), ids=list(RIGS))
def test_what_the_last_step_leaves_is_little_of_the_noise(rigs):
    rng = np.random.default_rng(11)
    scenes = [random_scene(rng, (1.5, 20.0), *rigs) for _ in range(100)]
    seen = sightings(scenes, rng, 0.5)
    # One by one: among many, the poorest start decides how often all are linearized.
    for k, scene in enumerate(scenes):
        of_one = Sightings(seen.frames[k : k + 1], seen.dt_s[k : k + 1])
        R = rotation_exp(0.004 * rng.standard_normal((1, 3))) @ scene.R
        once = refine((1.0 + 0.004 * rng.standard_normal()) * scene.t[None], R, of_one, *rigs, STILL)
        again = once
        for _ in range(3):
            again = refine(again.t_a_b_m, again.R_a_b, of_one, *rigs, STILL)
        e = np.concatenate((again.t_a_b_m[0] - once.t_a_b_m[0], rotation_log(again.R_a_b[0] @ once.R_a_b[0].T)))
        assert e @ np.linalg.inv(again.covariance[0]) @ e / 6.0 < 0.02**2


def moving(rng, rates, dt_s, count):
    """Scenes, and what is seen of them where each sighting is dt_s (4,) off the instant."""
    scenes = [random_scene(rng, (2.0, 6.0)) for _ in range(count)]
    views = []
    for s in scenes:
        clear = []
        for light, dt in enumerate(dt_s):
            now = Scene(s.rig_a, s.rig_b, s.t + dt * rates[:3], rotation_exp(dt * rates[3:]) @ s.R, s.R_ned_a)
            clear.append((now.clear_a if light < 2 else now.clear_b)[light % 2])
        moved = Scene(s.rig_a, s.rig_b, s.t, s.R, s.R_ned_a)
        moved.clear_a, moved.clear_b = np.array(clear[:2]), np.array(clear[2:])
        views.append(moved)
    return scenes, views


RATES = np.array([0.2, -0.1, 0.3, 0.1, 0.3, -0.2])


def test_sightings_of_a_moving_pair_are_brought_to_one_instant():
    rng = np.random.default_rng(5)
    dt_s = np.array([0.025, 0.027, -0.025, -0.026])
    scenes, views = moving(rng, RATES, dt_s, 40)
    seen = sightings(views, dt_s=np.tile(dt_s, (len(views), 1)))
    t, R = np.array([s.t for s in scenes]), np.array([s.R for s in scenes])
    assert np.abs(errors(refine(t, R, seen, IDEAL, IDEAL, Motion(RATES, 1e-12 * np.eye(6))), scenes)).max() < 1e-4
    unaware = refine(t, R, seen, IDEAL, IDEAL, Motion(np.zeros(6), 1e-12 * np.eye(6)))
    assert np.abs(errors(unaware, scenes)).max() > 5e-3


def test_what_is_not_known_of_the_motion_is_in_the_covariance():
    rng = np.random.default_rng(6)
    spread = np.diag([0.2**2] * 3 + [0.2**2] * 3)
    dt_s = np.array([0.02, 0.02, -0.02, -0.02])
    total, aware, unaware = 0, 0.0, 0.0
    for _ in range(60):
        scenes, views = moving(rng, 0.2 * rng.standard_normal(6), dt_s, 5)
        t, R = np.array([s.t for s in scenes]), np.array([s.R for s in scenes])
        seen = sightings(views, rng, 0.5, np.tile(dt_s, (len(views), 1)))
        aware += nees(refine(t, R, seen, IDEAL, IDEAL, Motion(np.zeros(6), spread)), scenes).sum()
        seen = sightings(views, rng, 0.5)
        unaware += nees(refine(t, R, seen, IDEAL, IDEAL, STILL), scenes).sum()
        total += 6 * len(scenes)
    assert aware / total == pytest.approx(1.0, abs=0.15)
    assert unaware / total > 1.5


def test_clocks_that_disagree_are_in_the_covariance():
    rng = np.random.default_rng(7)
    sigma_s, total, sum_ = 0.02, 0, 0.0
    for _ in range(60):
        skew = sigma_s * rng.standard_normal()
        scenes, views = moving(rng, RATES, np.array([0.5, 0.5, -0.5, -0.5]) * skew, 5)
        t, R = np.array([s.t for s in scenes]), np.array([s.R for s in scenes])
        motion = Motion(RATES, 1e-12 * np.eye(6), sigma_s)
        sum_ += nees(refine(t, R, sightings(views, rng, 0.5), IDEAL, IDEAL, motion), scenes).sum()
        total += 6 * len(scenes)
    assert sum_ / total == pytest.approx(1.0, abs=0.15)


def test_a_pose_that_the_lights_do_not_determine_is_not_sound():
    """Both lights of B in one pixel: nothing tells its range."""
    scene = random_scene(np.random.default_rng(8), 5.0)
    seen = sightings([scene])
    frames = seen.frames.copy()
    frames[:, 1:] = frames[:, :1]
    with np.errstate(all="ignore"):
        t, R = scene.t[None] * 1e9, scene.R[None]
        refined = refine(t, R, Sightings(frames, seen.dt_s), IDEAL, IDEAL, STILL)
    assert not refined.sound.any()


def test_the_forward_model_of_these_tests_is_its_own():
    """A light straight ahead falls on the principal point."""
    np.testing.assert_allclose(project(FISHEYE, [0.0, 0.0, 2.0]), [815.0, 620.0])
