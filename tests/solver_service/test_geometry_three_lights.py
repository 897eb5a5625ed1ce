"""One light short: a pose where the sensors support it, its own covariance, and no pose where they do not."""

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.batch import Batch
from buddyline.solver_service.geometry.evidence import GROSS_PX, GROSS_SHARE, MISSING_ODDS
from buddyline.solver_service.geometry.four_lights import read_four_lights
from buddyline.solver_service.geometry.observation import Heading, Observation
from buddyline.solver_service.geometry.past import Past
from buddyline.solver_service.geometry.rotation import rotation_exp, skew
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.three_lights import read_three_lights
from buddyline.solver_service.geometry.trigger import Fix, NoFix, Prior, Sensed, Settings
from buddyline.solver_service.geometry.weighing import weigh_readings

from tests.solver_service.scenes import IDEAL, ODD_A, ODD_B, PairScene, random_scene, solve_trigger, view

SETTINGS = Settings()


def without(scene, missing, rng, sigma_px=1.0):
    """Both views, of four lights all but one: 0, 1 are B's left and right in A's view."""
    views = [v for v, _ in scene.views(rng, sigma_px)]
    node, light = divmod(missing, 2)
    views[node] = view(np.delete(views[node].pixels, light, axis=0), sigma_px)
    return views


def solve(scene, views, sensed, settings=SETTINGS, prior=None):
    return solve_trigger(views, (scene.rig_a, scene.rig_b), sensed, settings, prior)


def followed(scene, rng, sigma=(0.1, 0.05)):
    """What a pair that was seen just before is foretold to be; sigma: m, rad."""
    sigma = np.repeat(sigma, 3)
    off = sigma * rng.standard_normal(6)
    R = rotation_exp(off[3:]) @ scene.R
    return Prior(SE3(R, scene.t + off[:3]), np.diag(sigma**2))


def log_ratio(views, scene, sensed, *, three):
    """Give the best log ratio of three or of four lights, without a past."""
    batch = Batch.of([Observation(*views, *sensed)], (scene.rig_a, scene.rig_b), SETTINGS)
    past = Past.of(None, None, batch.candidates.variance_of(0), batch.rigs, SETTINGS)
    with np.errstate(all="ignore"):
        read = read_three_lights(batch, np.ones(1, dtype=bool)) if three else read_four_lights(batch).read
        return weigh_readings(read, 0, past, SETTINGS, three=three).log_ratio.max()


def error(fix, scene):
    return SE3(scene.R, scene.t).minus(fix.T_a_b)


@pytest.mark.parametrize("missing", range(4))
@pytest.mark.parametrize("rigs", [(IDEAL, IDEAL), (ODD_A, ODD_B)], ids=["ideal", "odd"])
def test_three_lights_and_perfect_sensors_give_the_pose(missing, rigs):
    rng = np.random.default_rng(missing)
    solved = 0
    for _ in range(8):
        scene = random_scene(rng, (1.5, 3.0), *rigs)
        fix = solve(scene, without(scene, missing, rng, 0.1), scene.sensed())
        if isinstance(fix, NoFix):
            continue
        solved += 1
        assert fix.method == "three_lights"
        expected = [0, 0, 0, 0]
        expected[missing] = -1
        expected[missing ^ 1] = 0
        expected[2 - 2 * (missing // 2) + 1] = 1
        assert (*fix.pair_a, *fix.pair_b) == tuple(expected)
        assert np.linalg.norm(error(fix, scene)[:3]) < 0.01 * np.linalg.norm(scene.t)
        assert fix.checks == ("attitude", "depth", "heading")
    # Which of its two lights the other saw, heading alone cannot always tell.
    assert solved >= 4


def test_beside_last_poses_three_lights_must_be_likelier_than_what_sensors_tell_alone():
    rng = np.random.default_rng(7)
    led, against, alone = [], [], []
    for _ in range(60):
        scene = random_scene(rng, (1.5, 6.0))
        views = without(scene, int(rng.integers(4)), rng, 0.1)
        prior = followed(scene, rng, (0.4, 0.2))
        elsewhere = replace(prior, T_a_b=SE3(prior.T_a_b.R, 1.3 * scene.t))
        for given, found in ((prior, led), (elsewhere, against), (None, alone)):
            fix = solve(scene, views, scene.sensed(), prior=given)
            if isinstance(fix, Fix):
                found.append(fix.probability)
    assert min(len(led), len(against), len(alone)) >= 10
    assert min(led) >= 0.99
    assert min(against) >= 0.99
    assert 0.98 <= min(alone) < 0.99


def test_the_error_is_within_the_covariance_which_is_larger_than_that_of_four():
    rng = np.random.default_rng(4)
    squares, larger = [], []
    for _ in range(60):
        scene = random_scene(rng, (1.5, 4.0))
        sensed = scene.sensed(rng)
        views = [v for v, _ in scene.views(rng, 0.7)]
        four = solve(scene, views, sensed)
        lone = [views[0], view(views[1].pixels[:1], 0.7)]
        three = solve(scene, lone, sensed, prior=followed(scene, rng))
        if isinstance(three, Fix) and isinstance(four, Fix):
            e = error(three, scene)
            squares.append(e @ np.linalg.solve(three.covariance, e) / 6)
            larger.append(np.trace(three.covariance[:3, :3]) / np.trace(four.covariance[:3, :3]))
    assert len(squares) >= 30
    # Widened for gross errors that no gap tells, which these pictures have none of.
    assert 0.15 < np.mean(squares) < 1.1
    assert min(larger) > 1.0


def test_without_attitude_or_depth_three_lights_are_no_pose():
    rng = np.random.default_rng(5)
    scene = random_scene(rng, 2.0)
    views = without(scene, 2, rng, 0.1)
    sensed = scene.sensed()
    poor = (
        (Sensed(), Sensed()),
        (sensed[0], Sensed()),
        tuple(replace(s, depth_m=None) for s in sensed),
        tuple(replace(s, q_ned_body_xyzw=None) for s in sensed),
    )
    for lacking in poor:
        found = solve(scene, views, lacking)
        assert isinstance(found, NoFix)
        assert found.reason == "too_few_candidates"
    assert isinstance(solve(scene, views, sensed, Settings(checks=frozenset({"range", "twist"}))), NoFix)
    assert isinstance(solve(scene, views, sensed, Settings(method="exact")), NoFix)


def test_a_false_candidate_does_not_pass_for_the_missing_light():
    rng = np.random.default_rng(6)
    wrong = poses = 0
    for _ in range(80):
        scene = random_scene(rng, (1.5, 8.0))
        views = without(scene, int(rng.integers(4)), rng, 1.0)
        views = [view(np.concatenate((v.pixels, rng.uniform((0, 0), (1640, 1232), (3, 2))))) for v in views]
        fix = solve(scene, views, scene.sensed(rng), prior=followed(scene, rng))
        if isinstance(fix, Fix):
            poses += 1
            wrong += np.linalg.norm(fix.t_a_b_m - scene.t) > 0.1 * np.linalg.norm(scene.t)
    assert poses >= 5
    assert wrong <= 1


def test_another_lamp_does_not_pass_for_a_light_whose_node_is_not_in_view():
    """B sees a lamp at A's height, 29 degrees off where A is: only heading and earlier poses are against it."""
    rng = np.random.default_rng(8)
    tried = 0
    while tried < 12:
        # Far enough for the angle to be no bar's length.
        scene = random_scene(rng, (5.0, 8.0))
        turn = rotation_exp(np.array([0.0, rng.choice((-0.5, 0.5)), 0.0]))
        elsewhere = PairScene(scene.rig_a, scene.rig_b, scene.t, scene.R @ turn, scene.R_ned_a)
        if not elsewhere.visible:
            continue
        (seen_by_a, _), (lamp_of_b, _) = elsewhere.views(rng, 0.3)
        views = [seen_by_a, view(lamp_of_b.pixels[:1], 0.3)]
        if isinstance(solve(elsewhere, views, elsewhere.sensed(rng), prior=followed(elsewhere, rng)), Fix):
            tried += 1
            sensed = scene.sensed(rng)
            assert isinstance(solve(scene, views, sensed), NoFix)
            assert isinstance(solve(scene, views, sensed, prior=followed(scene, rng)), NoFix)


@pytest.mark.parametrize("sigma_px", [0.01, 0.1, 1.0])
def test_four_lights_that_fit_are_likelier_than_any_three_of_them(sigma_px):
    """However sharp the pictures are: the stamps' error moves all lights of one, and weighs both alike.

    With the lights' own noise alone, three sharp ones counted as likelier than four.
    """
    rng = np.random.default_rng(9)
    for _ in range(20):
        scene = random_scene(rng, (2.0, 6.0))
        seen = [v for v, _ in scene.views(rng, sigma_px)], scene, scene.sensed(rng)
        four, three = log_ratio(*seen, three=False), log_ratio(*seen, three=True)
        # For three alone the fourth stands in its place by chance or by a gross error of 7 px.
        assert four > three + 2.0


@pytest.mark.parametrize("missing", range(4))
def test_a_candidate_beside_the_fourth_lights_place_speaks_for_the_three(missing):
    """It may be that light, off by a gross error, and need not stand there by chance."""
    rng = np.random.default_rng(10 + missing)
    node, light = divmod(missing, 2)
    for _ in range(10):
        scene = random_scene(rng, (2.0, 4.0))
        views = without(scene, missing, rng, 0.05)
        place = (scene.clear_a, scene.clear_b)[node][light]
        found = []
        for off_px in (np.array((0.0, 4.0)), np.array((0.0, 80.0))):
            pixels = views[node].pixels, [place + off_px]
            both = [view(np.concatenate(pixels), 0.05) if k == node else views[k] for k in (0, 1)]
            found.append(log_ratio(both, scene, scene.sensed(), three=True))
        density = np.exp(-0.5 * (4.0 / GROSS_PX) ** 2) / (2.0 * np.pi * GROSS_PX**2)
        odds = GROSS_SHARE / MISSING_ODDS * density * (1640 * 1232)
        assert found[0] - found[1] == pytest.approx(np.log1p(odds), abs=0.3)


def test_only_what_foretells_the_lone_light_speaks_for_it():
    """The other node's two lights agree with where it was foretold whatever lamp the lone one is."""
    rng = np.random.default_rng(11)
    turning, known, by_both = [], [], []
    for _ in range(20):
        scene = random_scene(rng, (3.0, 6.0))
        views = without(scene, 0, rng, 0.5)
        batch = Batch.of([Observation(*views, *scene.sensed(rng))], (scene.rig_a, scene.rig_b), SETTINGS)
        still = np.diag(np.repeat((0.2, 0.02), 3) ** 2)
        # A, that sees one light, has turned nobody knows how: B swings about it, and turns with it.
        swings = np.vstack((skew(scene.t), -np.eye(3)))
        for covariance, found in ((still, known), (still + 0.3**2 * swings @ swings.T, turning)):
            past = Past.of(Prior(SE3(scene.R, scene.t), covariance), None, 3e-7, batch.rigs, SETTINGS)
            with np.errstate(all="ignore"):
                weighed = weigh_readings(
                    read_three_lights(batch, np.ones(1, dtype=bool)), 0, past, SETTINGS, three=True
                )
            best = int(weighed.log_ratio.argmax())
            readings, place = weighed.sources[best]
            if readings.lights[place].tolist() == [-1, 0, 0, 1]:
                found.append(np.log(readings.lone_odds[place]) - weighed.log_false[best])
                if found is turning:
                    by_both.append(weighed.log_prior[best])
    assert min(len(turning), len(known)) >= 10
    assert np.median(known) > 3.0
    assert np.median(turning) < 1.0
    assert np.median(by_both) > 3.0


def test_a_learned_heading_says_no_more_of_a_lone_light_that_is_foretold_better():
    rng = np.random.default_rng(12)
    told = 0
    for _ in range(10):
        scene = random_scene(rng, (3.0, 6.0))
        views = without(scene, 0, rng, 0.5)
        batch = Batch.of([Observation(*views, *scene.sensed())], (scene.rig_a, scene.rig_b), SETTINGS)
        prior = Prior(SE3(scene.R, scene.t), 1e-6 * np.eye(6))
        odds = []
        for heading in (None, Heading(0.0, 1e-4)):
            past = Past.of(prior, heading, 3e-7, batch.rigs, SETTINGS)
            with np.errstate(all="ignore"):
                weighed = weigh_readings(
                    read_three_lights(batch, np.ones(1, dtype=bool)), 0, past, SETTINGS, three=True
                )
            odds.append(weighed.log_false[int(weighed.log_ratio.argmax())])
        told += abs(odds[1] - odds[0]) < 0.1
    assert told >= 9


def test_half_a_turn_from_the_prediction_is_not_foretold():
    rng = np.random.default_rng(13)
    scene = random_scene(rng, (3.0, 6.0))
    batch = Batch.of([Observation(*without(scene, 0, rng, 0.5), *scene.sensed())], (scene.rig_a, scene.rig_b), SETTINGS)
    read = read_three_lights(batch, np.ones(1, dtype=bool))
    T_a_b, rows = read.readings.refined.T_a_b[:1], read.readings.refined.rows[:1]
    u = T_a_b.t_m[0] / np.linalg.norm(T_a_b.t_m[0])
    gains = []
    for turn in (0.0, np.pi):
        prior = Prior(SE3(rotation_exp(turn * u) @ T_a_b.R[0], T_a_b.t_m[0]), 1e-4 * np.eye(6))
        past = Past.of(prior, None, 3e-7, batch.rigs, SETTINGS)
        gains.append(past.weigh_lone(T_a_b, rows, None, np.array([[2, 3]]), np.array([1e-6]))[0])
    assert gains[0] > 5.0
    assert gains[1] == pytest.approx(np.log(0.15))


def test_two_lights_are_no_pose():
    rng = np.random.default_rng(7)
    scene = random_scene(rng, 3.0)
    views = [v for v, _ in scene.views(rng, 0.5)]
    for kept in (([0], [1]), ([0, 1], [])):
        found = solve(scene, [view(v.pixels[k]) for v, k in zip(views, kept, strict=True)], scene.sensed())
        assert isinstance(found, NoFix)
