"""One trigger: the right four lights, the right pose, or a reason."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.fix import in_metres
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.trigger import Fix, NoFix, Prior, Sensed, Settings, View

from tests.solver_service.scenes import (
    HD,
    IDEAL,
    ODD_A,
    ODD_B,
    PairScene,
    project,
    quaternion,
    random_scene,
    rotation,
    solve_trigger,
    view,
)

BLIND = (Sensed(), Sensed())
DEFAULT = Settings()


def solve(scene, views, sensed=BLIND, settings=DEFAULT, prior=None):
    return solve_trigger(views, (scene.rig_a, scene.rig_b), sensed, settings, prior)


def error(fix, scene):
    return SE3(scene.R, scene.t).minus(fix.T_a_b)


def facing(range_m=4.0, rig_a=IDEAL, rig_b=IDEAL):
    """Two upright nodes, face to face, heading north and south, a little turned."""
    R_ned_a = rig_a.R_body_camera
    R = rotation((0, 1, 0), math.pi + 0.1) @ rotation((0, 0, 1), 0.07)
    return PairScene(rig_a, rig_b, np.array([0.1, 0.2, range_m]), R, R_ned_a)


EXACT_STAMPS = Settings(stamp_sigma_s=0.0)


def test_the_covariance_of_sharp_lights_is_true():
    rng = np.random.default_rng(5)
    nees = []
    for _ in range(150):
        scene = random_scene(rng, (1.5, 9.0))
        (a, _), (b, _) = scene.views(rng, 0.01)
        fix = solve(scene, (a, b), settings=EXACT_STAMPS)
        off = error(fix, scene)
        nees.append(off @ np.linalg.solve(fix.covariance, off))
    # The mean of 150 chi^2 of six degrees, over six: 1 +- 0.05.
    assert np.mean(nees) / 6 == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("rigs", [(IDEAL, IDEAL), (ODD_A, ODD_B)], ids=["ideal", "odd"])
@pytest.mark.parametrize("method", ["refined", "exact"])
def test_perfect_pixels_give_the_pose(rigs, method):
    rng = np.random.default_rng(2)
    for _ in range(60):
        scene = random_scene(rng, (1.5, 20.0), *rigs)
        (a, _), (b, _) = scene.views(rng)
        fix = solve(scene, (a, b), settings=Settings(method=method))
        assert isinstance(fix, Fix), fix
        assert np.abs(error(fix, scene)).max() < 1e-6
        assert (fix.pair_a, fix.pair_b) == ((0, 1), (0, 1))
        assert fix.method == method
        assert abs(fix.range_gap_m) < 1e-5
        assert abs(fix.twist_gap_rad) < 1e-5


def test_normalized_error_squared_is_what_the_covariance_says():
    rng = np.random.default_rng(4)
    total, count = 0.0, 0
    for _ in range(300):
        scene = random_scene(rng, (2.0, 15.0), ODD_A, ODD_B)
        (a, _), (b, _) = scene.views(rng, 0.7)
        fix = solve(scene, (a, b), settings=EXACT_STAMPS)
        if isinstance(fix, Fix):
            e = error(fix, scene)
            total += e @ np.linalg.solve(fix.covariance, e)
            count += 6
    assert count > 6 * 290
    assert total / count == pytest.approx(1.0, abs=0.1)


def test_each_candidates_own_noise_counts():
    """Where one light is known worse, the covariance grows, and the pose leans on the others."""
    rng = np.random.default_rng(5)
    scene = random_scene(rng, 5.0)
    (a, _), (b, _) = scene.views(rng, 0.0)
    worse = replace(a, table=a.table.copy())
    worse.sigma_px[0] = 5.0
    assert np.trace(solve(scene, (worse, b)).covariance) > 1.5 * np.trace(solve(scene, (a, b)).covariance)


def choices(false, count, sensors, seed=6, **kwargs):
    rng = np.random.default_rng(seed)
    right = wrong = 0
    for _ in range(count):
        scene = random_scene(rng, (2.0, 12.0))
        (a, pair_a), (b, pair_b) = scene.views(rng, 1.0, false)
        fix = solve(scene, (a, b), scene.sensed(rng, **kwargs) if sensors else BLIND)
        if isinstance(fix, Fix):
            good = (fix.pair_a, fix.pair_b) == (pair_a, pair_b)
            right += good
            wrong += not good
    return right / count, wrong / count


def test_the_right_lights_among_false_ones_by_the_picture_alone():
    right, wrong = choices(4, 150, sensors=False)
    assert right >= 0.9
    assert wrong <= 0.01


def test_the_right_lights_among_many_false_ones_with_sensors():
    right, wrong = choices(12, 100, sensors=True)
    assert right >= 0.95
    assert wrong <= 0.01


def test_one_trigger_cannot_tell_a_heading_that_is_a_quarter_turn_off_from_a_thirds_bar():
    right, wrong = choices(4, 60, sensors=True, heading_error_rad=math.pi / 2)
    assert right == 0.0
    assert wrong == 0.0


def test_a_stuck_depth_sensor_costs_little():
    right, wrong = choices(4, 60, sensors=True, depth_error_m=3.0)
    assert right >= 0.9
    assert wrong <= 0.02


def test_what_is_too_unlikely_never_reads_as_likely_enough():
    rng = np.random.default_rng(8)
    found = set()
    for required in (0.9, 0.98, 0.999, 0.9999, 0.999999):
        for _ in range(8):
            scene = random_scene(rng, (2.0, 6.0))
            (a, _), (b, _) = scene.views(rng, 1.0, 3)
            result = solve(scene, (a, b), settings=replace(DEFAULT, min_probability=required))
            if isinstance(result, NoFix) and result.reason == "ambiguous":
                likely, asked = re.search(
                    r"is ([\d.]+)% likely, where ([\d.]+)% is asked for: ", result.detail
                ).groups()
                assert float(asked) == pytest.approx(100.0 * required)
                assert float(likely) < float(asked)
                found.add(likely)
    assert max(map(float, found)) > 99.0


def test_false_candidates_alone_give_no_pose():
    rng = np.random.default_rng(7)
    fixes = 0
    for _ in range(80):
        views = [view(rng.uniform((0, 0), (1640, 1232), (6, 2))) for _ in range(2)]
        fixes += isinstance(solve(facing(), views), Fix)
    assert fixes <= 1


def test_sensors_name_themselves_among_the_checks():
    scene = facing()
    (a, _), (b, _) = scene.views()
    assert solve(scene, (a, b)).checks == ("range", "twist", "upright_assumed")
    assert solve(scene, (a, b), scene.sensed()).checks == ("range", "twist", "attitude", "depth", "heading")
    without_depth = [replace(s, depth_m=None) for s in scene.sensed()]
    assert solve(scene, (a, b), without_depth).checks == ("range", "twist", "attitude", "heading")


def test_gravity_tells_left_from_right():
    """A diver hangs upside down: with attitude the pose is right, without it is taken for upright."""
    scene = facing()
    rolled = PairScene(IDEAL, IDEAL, scene.t, scene.R @ rotation((0, 0, 1), math.pi), scene.R_ned_a)
    (a, _), (b, _) = rolled.views()
    fix = solve(rolled, (a, b), rolled.sensed())
    assert np.abs(error(fix, rolled)).max() < 1e-6
    assumed = solve(rolled, (a, b))
    assert "upright_assumed" in assumed.checks
    assert quat_to_matrix(assumed.q_a_b_xyzw)[1, 1] > 0


def test_a_wrong_tilt_is_refused_by_its_name():
    scene = facing()
    (a, _), (b, _) = scene.views()
    sensed_a, sensed_b = scene.sensed()
    tilted = quat_to_matrix(sensed_a.q_ned_body_xyzw) @ rotation((0, 1, 0), math.radians(40))
    found = solve(
        scene,
        (view(np.concatenate((a.pixels, [[300.0, 300.0], [900.0, 1000.0]]))), b),
        (replace(sensed_a, q_ned_body_xyzw=quaternion(tilted)), sensed_b),
    )
    assert isinstance(found, NoFix)
    assert found.reason == "attitude"
    assert "sigma" in found.detail


def test_a_mirrored_pair_is_refused():
    """A reflection in the water's surface: both nodes see the other's lights mirrored, ranges and twists agree."""
    scene = random_scene(np.random.default_rng(8), 6.0, roll_rad=0.02)
    up = scene.R_ned_a.T @ [0.0, 0.0, -1.0]
    surface = 3.0
    mirror = np.eye(3) - 2 * np.outer(up, up)
    to_a = (scene.R @ scene.rig_b.lights_m.T).T + scene.t
    image_in_a = to_a @ mirror + 2 * surface * up
    image_in_b = (scene.rig_a.lights_m @ mirror + 2 * surface * up - scene.t) @ scene.R
    wide = Rig(Camera("pinhole", 1640, 1232, 500.0, 500.0, 819.5, 615.5), IDEAL.lights_m)
    views = [view(project(wide.camera, image)) for image in (image_in_a, image_in_b)]
    found = solve_trigger(views, (wide, wide), scene.sensed(), Settings())
    assert isinstance(found, NoFix), found


def test_the_same_input_gives_the_same_output_whatever_came_before():
    rng = np.random.default_rng(9)
    scene = random_scene(rng, 5.0)
    (a, _), (b, _) = scene.views(rng, 1.0, 8)
    sensed = scene.sensed(rng)
    first = solve(scene, (a, b), sensed)
    for _ in range(20):
        other = random_scene(rng, (2.0, 10.0), ODD_A, ODD_B)
        solve(other, [v for v, _ in other.views(rng, 1.0, 5)], other.sensed(rng))
    again = solve(scene, (a, b), sensed)
    assert first.t_a_b_m.tobytes() == again.t_a_b_m.tobytes()
    assert first.covariance.tobytes() == again.covariance.tobytes()
    assert first.probability == again.probability


def test_a_prior_helps_and_a_wrong_one_does_not_hurt():
    rng = np.random.default_rng(10)
    blind, helped, misled = 0, 0, 0
    for _ in range(60):
        scene = random_scene(rng, (2.0, 8.0))
        (a, pair_a), (b, pair_b) = scene.views(rng, 1.0, 7)
        near = Prior(SE3(scene.R, scene.t + 0.05), np.diag([0.1**2] * 3 + [0.05**2] * 3))
        far = Prior(SE3(scene.R @ rotation((0, 1, 0), 0.5), scene.t * 1.7), near.covariance)
        for prior in (None, near, far):
            fix = solve(scene, (a, b), prior=prior)
            good = isinstance(fix, Fix) and (fix.pair_a, fix.pair_b) == (pair_a, pair_b)
            blind += good and prior is None
            helped += good and prior is near
            misled += good and prior is far
    assert helped >= 57
    assert misled >= blind - 15


BAD_VIEWS = {
    "empty": view(np.empty((0, 2))),
    "one": view([[800.0, 600.0]]),
    "identical": view([[800.0, 600.0]] * 6),
    "on one line": view([[100.0 * i, 600.0] for i in range(1, 12)]),
    "on one column": view([[800.0, 100.0 * i] for i in range(1, 12)]),
    "not finite": view([[math.nan, 600.0], [math.inf, 1.0], [700.0, -math.inf]]),
    "no noise": view([[700.0, 600.0], [900.0, 600.0]], sigma_px=0.0),
    "noise not finite": view([[700.0, 600.0], [900.0, 600.0]], sigma_px=math.nan),
    "huge noise": view([[700.0, 600.0], [900.0, 600.0]], sigma_px=1e9),
    "far outside": view([[1e12, 600.0], [-1e12, 600.0]]),
}


@pytest.mark.parametrize("name", BAD_VIEWS)
def test_bad_views_end_as_a_reason_or_a_pose_but_never_as_an_error(name):
    good = facing().views()[0][0]
    for views in ((BAD_VIEWS[name], good), (good, BAD_VIEWS[name]), (BAD_VIEWS[name],) * 2):
        for sensed in (BLIND, facing().sensed()):
            found = solve(facing(), views, sensed)
            if isinstance(found, Fix):
                assert np.isfinite(found.covariance).all()
                assert np.linalg.eigvalsh(found.covariance)[0] > 0
            else:
                assert found.detail


BAD_RIGS = {
    "no length": np.array([[0.2, 0.0, 0.0], [0.2, 0.0, 0.0]]),
    "not finite": np.array([[math.nan, 0.0, 0.0], [0.4, 0.0, 0.0]]),
}


@pytest.mark.parametrize("name", BAD_RIGS)
def test_rigs_without_a_bar_are_degenerate(name):
    scene = facing()
    (a, _), (b, _) = scene.views()
    found = solve_trigger((a, b), (IDEAL, Rig(HD, BAD_RIGS[name])), BLIND, Settings())
    assert isinstance(found, NoFix)
    assert found.reason == "degenerate"
    assert "B" in found.detail


def test_a_rig_described_with_left_and_right_swapped_gives_the_same_pose():
    scene = facing()
    (a, _), (b, _) = scene.views()
    swapped = Rig(HD, IDEAL.lights_m[::-1].copy())
    fix = solve_trigger((a, b), (IDEAL, swapped), BLIND, Settings())
    assert np.abs(error(fix, scene)).max() < 1e-6
    assert fix.pair_a == (1, 0)


@pytest.mark.parametrize(
    "sensed",
    [
        Sensed(np.full(4, math.nan), np.zeros(3), math.nan, 0.0),
        Sensed(np.zeros(4), np.full(3, math.inf), math.inf, math.nan),
        Sensed(np.array([0.5, 0.5, 0.5, 0.5]), np.zeros(3), 1.0, 0.0),
        Sensed(np.array([0.0, 0.0, 0.0, 1.0]), None, None, None),
    ],
    ids=["nan", "zero", "no noise", "level"],
)
def test_bad_sensors_never_end_as_an_error(sensed):
    scene = facing()
    (a, _), (b, _) = scene.views()
    for pair in ((sensed, sensed), (sensed, Sensed()), (scene.sensed()[0], sensed)):
        found = solve(scene, (a, b), pair)
        assert isinstance(found, Fix) or found.detail


@pytest.mark.parametrize("covariance", [np.zeros((6, 6)), np.diag([1e12] * 6)], ids=["none", "huge"])
def test_bad_priors_never_end_as_an_error(covariance):
    scene = facing()
    (a, _), (b, _) = scene.views()
    found = solve(scene, (a, b), prior=Prior(SE3(scene.R, scene.t), covariance))
    assert isinstance(found, Fix)


def reason(views, settings=DEFAULT, scene=None):
    return solve(scene or facing(), views, settings=settings).reason


def test_reasons_are_told_apart():
    scene = facing()
    (a, _), (b, _) = scene.views()
    assert reason((a, view(b.pixels[:1]))) == "too_few_candidates"
    assert reason((a, b), Settings(range_max_m=2.0)) == "out_of_range"
    middle = b.pixels.mean(0)
    apart = (b.pixels - middle) * 1.6 + middle
    assert reason((a, view(apart))) == "range_gap"
    turned = (b.pixels - middle) @ rotation((0, 0, 1), 0.6)[:2, :2] + middle
    assert reason((a, view(turned))) == "twist_gap"
    rng = np.random.default_rng(3)
    crowded = [view(np.concatenate((v.pixels, rng.uniform((0, 0), (1640, 1232), (40, 2))))) for v in (a, b)]
    assert reason(crowded) == "ambiguous"


def test_side_by_side_the_lights_are_not_there():
    """Nothing but what is no light in view: a reason."""
    found = solve(
        facing(), [view([[100.0, 100.0], [1500.0, 1100.0], [800.0, 30.0]]), view([[20.0, 700.0], [820.0, 30.0]])]
    )
    assert isinstance(found, NoFix)


@pytest.mark.parametrize(
    "bad",
    [
        {"checks": frozenset({"luck"})},
        {"range_min_m": 0.0},
        {"range_max_m": 0.5},
        {"min_probability": 1.0},
        {"min_oriented_probability": 1.0},
        {"gate_sigma": 0.0},
        {"range_max_m": math.inf},
    ],
)
def test_settings_that_cannot_work_are_refused(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Settings(**bad)


def test_no_more_candidates_are_weighed_than_a_message_holds():
    rng = np.random.default_rng(11)
    pixels = rng.uniform((0, 0), (1640, 1232), (500, 2))
    found = solve(facing(), (view(pixels), view(pixels)))
    assert isinstance(found, NoFix)


def test_scores_help_to_choose():
    """Among false candidates more triggers give a pose where the lamps score higher."""
    rng = np.random.default_rng(12)
    with_scores = without = 0
    for _ in range(40):
        scene = random_scene(rng, (2.0, 4.0))
        views, scored = [], []
        for v, pair in scene.views(rng, 1.0, 6):
            score = np.full(len(v.pixels), 0.2)
            score[list(pair)] = 0.9
            views.append(v)
            scored.append(View.of(v.pixels, v.sigma_px, score, v.area_px, v.dt_s, v.stamp_ns))
        without += isinstance(solve(scene, views), Fix)
        with_scores += isinstance(solve(scene, scored), Fix)
    assert with_scores > without


def test_no_pose_of_four_lights_is_beyond_what_noise_explains():
    scene = facing()
    (a, _), (b, _) = scene.views(np.random.default_rng(1), 1.0)
    methods = set()
    for shift_px in np.linspace(2.0, 12.0, 21):
        off = replace(a, table=a.table.copy())
        off.pixels[0] += (0.0, shift_px)
        found = solve(scene, (off, b), scene.sensed())
        if isinstance(found, Fix):
            methods.add(found.method)
            assert found.method == "three_lights" or found.chi2 < 18.43
    assert "refined" in methods


@pytest.mark.parametrize(("shift_px", "reason"), [((30.0, 0.0), "range_gap"), ((0.0, 30.0), "twist_gap")])
def test_lights_that_do_not_fit_each_other_give_no_pose(shift_px, reason):
    """One light is hidden, and a false candidate stands beside its place."""
    scene = facing()
    (a, _), (b, _) = scene.views(np.random.default_rng(1), 1.0)
    assert isinstance(solve(scene, (a, b)), Fix)
    off = replace(a, table=a.table.copy())
    off.pixels[0] += shift_px
    for sensed in (None, scene.sensed()):
        found = solve(scene, (off, b)) if sensed is None else solve(scene, (off, b), sensed)
        assert isinstance(found, NoFix)
        assert found.reason == reason


@pytest.mark.parametrize(
    ("range_m", "words"), [(4.2137, "4.21 m"), (999.4, "999 m"), (999.6, "1000 m or more"), (5.38e12, "1000 m or more")]
)
def test_a_range_reads_as_metres_however_far_it_is(range_m, words):
    assert in_metres(range_m) == words
