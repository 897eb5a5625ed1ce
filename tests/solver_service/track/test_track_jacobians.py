"""Every Jacobian of the track against differences of the function that it belongs to."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log
from buddyline.solver_service.track.anchors import attitude_residual, depth_residual, kalman
from buddyline.solver_service.track.lights import BLOCK, COLUMNS, light_positions, residuals
from buddyline.solver_service.track.output import (
    as_a_fix_sees_it,
    at_one_time,
    at_one_time_jacobian,
    fix_chi2,
    pose_jacobian,
    rows_of,
)
from buddyline.solver_service.track.start import DEPTH_OFFSET_M, DEPTH_SCALE_SIGMA
from buddyline.solver_service.track.state import (
    CLOCK,
    DELAY,
    DEPTH_OFFSET,
    DEPTH_SCALE,
    MOVING,
    NAV,
    PHI,
    R_,
    SHAKE,
    SIZE,
    State,
    invariant_of_plain,
    of_place,
    place_covariance,
    plain_of_invariant,
)
from buddyline.solver_service.track.strapdown import Increments, SampleGrid, integrate, propagate
from buddyline.solver_service.track.trail import EstimateStatus
from numpy.typing import NDArray

from tests.solver_service.track.dives import EPOCH_NS, RestlessPair, Setting, make

STEP = 1e-6
PINHOLE = Camera("pinhole", 820, 616, 900.0, 905.0, 409.5, 307.5, (-0.2, 0.05, 1e-3, -1e-3, 0.0))
FISHEYE = Camera("fisheye", 820, 616, 400.0, 402.0, 409.5, 307.5, (0.02, -0.01, 0.002, 0.0))
LIGHTS_M = np.array(((-0.44, 0.01, 0.02), (0.44, -0.02, 0.01)))


def a_state(seed: int) -> State:
    rng = np.random.default_rng(seed)
    R_a = rotation_exp(rng.normal(0.0, 0.3, 3)) @ np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    t_a_b = np.array((0.3, -0.2, 4.0)) + rng.normal(0.0, 0.2, 3)
    R_b = R_a @ rotation_exp(np.array((0.0, np.pi, 0.0))) @ rotation_exp(rng.normal(0.0, 0.1, 3))
    return State.at_rest(R_a @ t_a_b, np.stack((R_a, R_b))).with_parts(
        v_mps=rng.normal(0.0, 0.5, 3),
        shake_rad=rng.normal(0.0, 1e-3, (2, 3)),
        shove_mps=rng.normal(0.0, 0.05, 3),
        gyro_bias_radps=rng.normal(0.0, 0.02, (2, 3)),
        accel_bias_mps2=rng.normal(0.0, 0.2, (2, 3)),
        mount_rad=rng.normal(0.0, 0.05, (2, 3)),
        lever_m=rng.normal(0.0, 0.1, (2, 3)),
        delay_s=rng.normal(0.0, 0.003, 2),
        clock_s=0.002,
        depth_offset_m=0.1,
        depth_scale=0.03,
    )


def differences(function: Callable[[Floats], Floats], columns: NDArray[np.int64] | range) -> Floats:
    """Differentiate function(error (SIZE,)) at zero by the named columns."""
    out = []
    for column in columns:
        error = np.zeros(SIZE)
        error[column] = STEP
        out.append((function(error) - function(-error)) / (2.0 * STEP))
    return np.stack(out, axis=-1)


@pytest.mark.parametrize("seed", range(3))
def test_plus_and_minus_are_inverse(seed: int) -> None:
    state = a_state(seed)
    error = np.random.default_rng(seed + 100).normal(0.0, 0.05, SIZE)
    assert state.plus(error).minus(state) == pytest.approx(error, abs=1e-5)
    T, back = plain_of_invariant(state), invariant_of_plain(state)
    assert np.allclose(T @ back, np.eye(MOVING))


def test_a_turn_of_all_together_changes_nothing_that_pictures_show() -> None:
    """However large: half a radian about the vertical beside errors of the rest."""
    state = a_state(1)
    error = 0.1 * np.random.default_rng(2).normal(0.0, 1.0, SIZE)
    error[PHI[0]] = 0.0
    turned = error.copy()
    turned[PHI[0]], turned[PHI[1]] = (0.0, 0.0, 0.5), error[PHI[1]] + (0.0, 0.0, 0.5)
    one, two = state.plus(error), state.plus(turned)
    for vector in ("r_m", "v_mps", "shove_mps"):
        assert two.R[0].T @ getattr(two, vector) == pytest.approx(one.R[0].T @ getattr(one, vector), abs=1e-9)
    assert two.R[0].T @ two.R[1] == pytest.approx(one.R[0].T @ one.R[1], abs=1e-9)


@pytest.mark.parametrize("observer", [0, 1])
def test_what_one_nodes_pictures_leave_open_stays_on_an_arc(observer: int) -> None:
    """A lamp at the centre of the camera that is seen stays where it is seen, however far B is turned about it."""
    state, still = a_state(4), np.zeros((2, 3))
    about = state.r_m if observer == 0 else np.zeros(3)
    psi = np.array((0.3, -0.2, 0.4))
    error = np.zeros(SIZE)
    error[PHI[1]], error[R_] = psi, -np.cross(psi, about)
    seen, _ = light_positions(state, observer, np.zeros((1, 3)), still, np.zeros(1))
    turned, _ = light_positions(state.plus(error), observer, np.zeros((1, 3)), still, np.zeros(1))
    assert turned == pytest.approx(seen, abs=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_plain_errors_follow_from_the_states_own(seed: int) -> None:
    state = a_state(seed)

    def plain(error: Floats) -> Floats:
        moved = state.plus(error)
        return np.concatenate((moved.r_m, moved.v_mps, moved.shove_mps))

    rows = [*range(6), *range(18, 21)]
    assert np.allclose(differences(plain, range(MOVING)), plain_of_invariant(state)[rows], atol=1e-6)


@pytest.mark.parametrize("camera", [PINHOLE, FISHEYE])
@pytest.mark.parametrize("observer", [0, 1])
@pytest.mark.parametrize("dt_s", [0.0, 0.012])
def test_lights(camera: Camera, observer: int, dt_s: float) -> None:
    state = a_state(7)
    rates = np.array(((0.1, -0.3, 0.2), (-0.4, 0.1, 0.3)))
    times = np.array((dt_s, -dt_s))
    X, D = light_positions(state, observer, LIGHTS_M, rates, times)
    pixels = np.array(((300.0, 250.0), (500.0, 350.0)))
    bearings, tangents = camera.rays(pixels)
    y, H = residuals(bearings, tangents, X, D)

    def seen(error: Floats) -> Floats:
        moved = light_positions(state.plus(error), observer, LIGHTS_M, rates, times)
        return residuals(bearings, tangents, *moved)[0]

    # The residual is measured minus foretold.
    numeric = -differences(seen, COLUMNS)
    scale = float(np.abs(H[..., :-1]).max())
    assert np.allclose(H[..., :-1], numeric, atol=2e-3 * scale if dt_s else 1e-5 * scale)
    assert y.shape == (2, 2, 2)
    before, after = (
        residuals(bearings, tangents, *light_positions(state, observer, LIGHTS_M, rates, times + step))[0]
        for step in (-1e-4, 1e-4)
    )
    assert np.allclose(H[..., -1], (before - after) / 2e-4, atol=1e-4 * float(np.abs(H[..., -1]).max()))


def test_lights_are_where_the_camera_model_says() -> None:
    """A candidate exactly where a light stands has no residual."""
    state = a_state(3)
    X, D = light_positions(state, 0, LIGHTS_M, np.zeros((2, 3)), np.zeros(1))
    pixel = PINHOLE.cx_px + 900.0 * X[0, 0, 0] / X[0, 0, 2], PINHOLE.cy_px + 905.0 * X[0, 0, 1] / X[0, 0, 2]
    plain = Camera("pinhole", 820, 616, 900.0, 905.0, 409.5, 307.5)
    y, _ = residuals(*plain.rays(np.array((pixel,))), X, D)
    assert np.abs(y[0, 0]).max() < 1e-9


def samples(seed: int) -> tuple[Floats, Floats, Floats]:
    """Smooth motion's samples, over a quarter of a second before and after, at 400 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(-40, 80) / 400.0
    phase, rate = rng.uniform(0.0, 6.0, (2, 3)), rng.uniform(2.0, 6.0, (2, 3))
    force = np.array((0.3, -9.7, 0.5)) + 0.8 * np.sin(t[:, None] * rate[0] + phase[0])
    turn = 0.4 * np.sin(t[:, None] * rate[1] + phase[1])
    return t, force, turn


def increments(state: State) -> Increments:
    grid = np.linspace(0.0, 0.1, 41)
    values = np.empty((2, 41, 6))
    for node in (0, 1):
        t, force, turn = samples(node)
        for column, of in enumerate((*force.T, *turn.T)):
            values[node, :, column] = np.interp(grid + state.delay_s[node], t, of)
    told = np.ones((2, 40), dtype=bool)
    return integrate(state, SampleGrid(np.stack((grid, grid)), values, told, values[:, -1, 3:], values[:, [0, -1], 3:]))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("arm", [False, True])
def test_transition(seed: int, arm: bool) -> None:
    state = a_state(seed)
    if not arm:
        state = state.with_parts(lever_m=0.0, mount_rad=0.0)
    after, F = propagate(state, increments(state), 0.1)

    def moved(error: Floats) -> Floats:
        start = state.plus(error)
        return propagate(start, increments(start), 0.1)[0].minus(after)[:MOVING]

    names = np.array([column for column in range(SIZE) if column != CLOCK])
    off = np.abs(F[:, names] - differences(moved, names))
    gap = off.max(axis=0)
    exact = np.isin(names, (*range(NAV), *range(18, 21), *range(27, 33), *range(39, 45), DEPTH_OFFSET, DEPTH_SCALE))
    assert gap[exact].max() < 1e-6
    # A mount's error is taken as one more small turn, and sums go by the middles of intervals. The lever arm's ends
    # turn with bias, mount and delay, which is left out: 0.1 m at 0.01 rad/s is 1 mm/s.
    assert gap[np.isin(names, range(21, 27))].max() < (0.3 if arm else 5e-3)
    assert gap[np.isin(names, range(33, 39))].max() < (0.3 if arm else 5e-3)
    # What a delay does by the change of the force in level axes is left out: here 3 m/s^3 and more over 0.1 s.
    delayed = np.isin(names, DELAY)
    assert off[PHI[0].start : PHI[1].stop, delayed].max() < 2e-2
    assert off[:, delayed].max() < 1.0
    # Shaking is first order in its own small angle.
    shaken = np.isin(names, range(SHAKE[0].start, SHAKE[1].stop))
    assert off[:, shaken].max() < 2e-2


def test_anchors() -> None:
    state = a_state(5)
    ports = np.array(((0.1, 0.2, -0.1), (-0.1, 0.1, 0.05)))
    _, H = depth_residual(state, 0.4, 0.03, ports)
    numeric = -differences(lambda error: depth_residual(state.plus(error), 0.4, 0.03, ports)[0], range(SIZE))
    assert np.allclose(H, numeric, atol=1e-6)
    _, H = attitude_residual(state, 1, state.R[1])
    numeric = -differences(lambda error: attitude_residual(state.plus(error), 1, state.R[1])[0], range(SIZE))
    assert np.allclose(H, numeric, atol=1e-6)


def test_a_places_covariance_there_and_back() -> None:
    state = a_state(6)
    A = np.random.default_rng(1).normal(0.0, 1.0, (SIZE, SIZE))
    P = A @ A.T
    own = of_place(state, P)
    assert place_covariance(state, own) == pytest.approx(P[R_, R_], abs=1e-9)
    assert own == pytest.approx(own.T, abs=1e-9)


def test_a_rows_covariance_holds_how_the_arc_is_bent() -> None:
    """By many states about one whose turn is poorly known: the place's second moment, beyond the first order."""
    state, still = a_state(2).with_parts(clock_s=0.0), np.zeros((2, 3))
    sigma = np.full(NAV, 1e-4)
    sigma[PHI[1]] = 0.1
    P = np.zeros((len(COLUMNS), len(COLUMNS)))
    P[:NAV, :NAV] = np.diag(sigma**2)
    batch = State(state.row[None])
    told = rows_of((0,), (0.0,), batch, P[None], still[None], (EstimateStatus(0.0),))[0]
    assert told is not None
    error = np.zeros((4000, SIZE))
    error[:, :NAV] = np.random.default_rng(5).normal(0.0, 1.0, (4000, NAV)) * sigma
    places = np.array([moved.R[0].T @ moved.r_m for moved in map(state.plus, error)]) - told.t_a_b_m
    along = told.t_a_b_m / told.range_m
    # The arc is thin along the line of sight, where B's turn about A moves it only by being bent.
    assert along @ told.covariance[:3, :3] @ along == pytest.approx(np.mean((places @ along) ** 2), rel=0.2)
    assert np.trace(told.covariance[:3, :3]) == pytest.approx(np.mean((places**2).sum(axis=1)), rel=0.1)


def test_pose_covariance() -> None:
    """The published covariance is the pose's, by differences of the pose."""
    state = a_state(2)
    rate = np.array(((0.3, -0.2, 0.4), (-0.1, 0.5, 0.2)))
    now = at_one_time(state, rate)
    t0, R0 = now.R[0].T @ now.r_m, now.R[0].T @ now.R[1]

    def pose(error: Floats) -> Floats:
        moved = at_one_time(state.plus(error), rate)
        R = moved.R[0].T @ moved.R[1] @ R0.T
        w = 0.5 * np.array((R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]))
        return np.concatenate((moved.R[0].T @ moved.r_m - t0, w, moved.R[0].T @ moved.v_mps))

    J = differences(pose, range(SIZE))
    P = np.diag(np.linspace(0.1, 1.0, SIZE))
    own = pose_jacobian(now) @ at_one_time_jacobian(state, rate)
    covariance = own @ P[BLOCK] @ own.T
    whole = J @ P @ J.T
    assert np.allclose(covariance[:6, :6], whole[:6, :6], atol=3e-3)
    assert np.allclose(covariance[6:9, 6:9], whole[6:, 6:], atol=1e-6)


def test_what_a_fix_sees_errs_as_its_state_does() -> None:
    """To first order of the clocks' offset, by differences of what a fix would tell."""
    state, rate = a_state(2).with_parts(clock_s=0.03), np.array(((0.3, -0.2, 0.4), (-0.1, 0.5, 0.2)))
    seen, J = as_a_fix_sees_it(state, rate)
    t0, R0 = seen.R[0].T @ seen.r_m, seen.R[0].T @ seen.R[1]

    def fix(error: Floats) -> Floats:
        moved, _ = as_a_fix_sees_it(state.plus(error), rate)
        return np.concatenate((moved.R[0].T @ moved.r_m - t0, rotation_log(moved.R[0].T @ moved.R[1] @ R0.T)))

    own = (pose_jacobian(seen) @ J)[:6]
    numeric = differences(fix, np.array(COLUMNS))
    assert np.abs(own[:, NAV]).max() > 0.3
    assert own == pytest.approx(numeric, abs=0.02)


@pytest.mark.parametrize("clock_s", [0.04, -0.06])
def test_a_fix_of_clocks_apart_tells_what_each_picture_showed(clock_s: float) -> None:
    """Taken for what is midway between both clocks, they had a mean chi^2 of 26 and 51, and contradicted true ones."""
    chi2 = []
    for seed in range(4):
        setting = Setting(seconds=12.0, clock_s=clock_s)
        motion = RestlessPair(np.random.default_rng(seed), setting)
        dive = make(seed, setting, motion)
        for fix in dive.fixes:
            of_a = (fix.stamp_ns - EPOCH_NS) * 1e-9
            # When A's picture was taken, and B's; shortly after each, for rates.
            times = np.array((of_a, of_a - clock_s, of_a + 1e-4, of_a - clock_s + 1e-4))
            R_a, R_b = motion.attitudes(0, times), motion.attitudes(1, times)
            rates = 1e4 * np.array((rotation_log(R_a[0].T @ R_a[2]), rotation_log(R_b[1].T @ R_b[3])))
            apart = motion.places(1, times) - motion.places(0, times)
            state = State.at_rest(apart[1], np.stack((R_a[0], R_b[1]))).with_parts(clock_s=clock_s)
            state = state.moved(apart[1], (apart[0] - apart[1]) / clock_s, state.R)
            chi2.append(fix_chi2(state, np.zeros((NAV + 1, NAV + 1)), rates, fix))
    assert len(chi2) > 100
    assert np.mean(chi2) < 4.0


def test_gauges_that_take_the_sea_for_fresh_water_do_not_move_a_track() -> None:
    """B rises 10 m above A, which lights show to 5 cm; both gauges show depths 2.8 % too large, and B's 0.1 m more."""
    state, P = State.at_rest(np.zeros(3), a_state(6).R), np.zeros((SIZE, SIZE))
    P[DEPTH_OFFSET, DEPTH_OFFSET], P[DEPTH_SCALE, DEPTH_SCALE] = DEPTH_OFFSET_M**2, DEPTH_SCALE_SIGMA**2
    for height_m in np.linspace(0.0, 10.0, 41).tolist():
        there = np.array((3.0, 0.0, -height_m))
        P[R_] = P[:, R_] = 0.0
        P[R_, R_] = 0.05**2 * np.eye(3)
        state = state.moved(there, state.v_mps, state.R)
        y, H = depth_residual(state, -1.028 * height_m + 0.1, 0.0, np.zeros((2, 3)))
        error, P, *_ = kalman(P, H, y, np.array(((0.02**2,),)))
        state = state.plus(error)
        assert abs(state.r_m[2] + height_m) < 3.0 * np.sqrt(P[R_.stop - 1, R_.stop - 1])
    assert abs(state.depth_scale - 0.028) < 3.0 * np.sqrt(P[DEPTH_SCALE, DEPTH_SCALE]) < 0.02
    assert abs(state.depth_offset_m - 0.1) < 3.0 * np.sqrt(P[DEPTH_OFFSET, DEPTH_OFFSET]) < 0.1
