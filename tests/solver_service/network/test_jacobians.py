"""Every Jacobian of the network against differences of the function that it belongs to."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.observation import STAMP_SIGMA_S
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log, skew
from buddyline.solver_service.network.belief import Member, within
from buddyline.solver_service.network.estimate import Bar, NetEstimate, PairFix
from buddyline.solver_service.network.filter import inverted
from buddyline.solver_service.network.motion import Move, moved_members
from buddyline.solver_service.network.sights import WIDTH, columns, light_positions
from buddyline.solver_service.network.state import (
    ACCEL_BIAS,
    BLOCK,
    CLOCK,
    CLOCK_S,
    COMMON,
    DATUM,
    DEPTH_SCALE,
    GAUGE,
    GAUGE_M,
    GYRO_BIAS,
    LEVER,
    MOUNT,
    MOVING,
    P_,
    PHI,
    SHAKE,
    SHOVE,
    V_,
    NetState,
    block,
    common_variances,
)
from buddyline.solver_service.track.inputs import DepthSeen, TrackNode
from buddyline.solver_service.track.intake import TrackIntake
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.strapdown import Noise, SampleGrid, integrate

STEP = 1e-6
LIGHTS_M = np.array(((-0.44, 0.01, 0.02), (0.44, -0.02, 0.01)))
PINHOLE = Camera("pinhole", 820, 616, 900.0, 900.0, 409.5, 307.5, np.zeros(5))


def a_state(seed: int, n: int = 3) -> NetState:
    rng = np.random.default_rng(seed)
    level = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    away = np.array(((0.0, 0.0, 3.0), (5.0, 0.4, 2.5), (4.5, -0.9, 3.3)))[:n]
    turned = [rotation_exp(np.array((0.0, 0.0, np.pi * (i > 0)))) @ level for i in range(n)]
    return NetState(
        p_m=away,
        v_mps=rng.normal(0.0, 0.5, (n, 3)),
        R=np.array([rotation_exp(rng.normal(0.0, 0.1, 3)) @ R for R in turned]),
        shake_rad=rng.normal(0.0, 1e-3, (n, 3)),
        shove_mps=rng.normal(0.0, 0.05, (n, 3)),
        gyro_bias_radps=rng.normal(0.0, 0.02, (n, 3)),
        accel_bias_mps2=rng.normal(0.0, 0.2, (n, 3)),
        mount_rad=rng.normal(0.0, 0.05, (n, 3)),
        lever_m=rng.normal(0.0, 0.1, (n, 3)),
        delay_s=rng.normal(0.0, 0.003, n),
        clock_s=rng.normal(0.0, 0.003, n),
        gauge_m=rng.normal(0.0, 0.1, n),
        datum_m=2.0,
        depth_scale=0.01,
    )


def differences(function: Callable[[Floats], Floats], size: int) -> Floats:
    """Differentiate function(error (size,)) at zero by all errors."""
    out = []
    for column in range(size):
        error = np.zeros(size)
        error[column] = STEP
        out.append((function(error) - function(-error)) / (2.0 * STEP))
    return np.stack(out, axis=-1)


def test_plus_and_minus_are_inverse() -> None:
    state, rng = a_state(1), np.random.default_rng(2)
    error = rng.normal(0.0, 0.1, COMMON + 3 * BLOCK)
    assert state.plus(error).minus(state) == pytest.approx(error, abs=1e-9)


@pytest.mark.parametrize("pair", [(0, 1), (2, 0)])
def test_lights(pair: tuple[int, int]) -> None:
    observer, other = pair
    state, rates = a_state(3), np.random.default_rng(4).normal(0.0, 0.3, (3, 3))
    dt_s = np.array((-0.004, 0.006))
    D = light_positions(state, [observer], [other], LIGHTS_M[None], rates, dt_s[None])[1][0]
    whole = np.zeros((*D.shape[:3], COMMON + 3 * BLOCK))
    whole[..., columns([observer], [other])[0]] = D[..., :-1]

    def seen(error: Floats) -> Floats:
        return light_positions(state.plus(error), [observer], [other], LIGHTS_M[None], rates, dt_s[None])[0][0]

    assert whole == pytest.approx(differences(seen, COMMON + 3 * BLOCK), abs=1e-6)
    before, after = (
        light_positions(state, [observer], [other], LIGHTS_M[None], rates, dt_s[None] + step)[0][0]
        for step in (-1e-4, 1e-4)
    )
    assert D[..., -1] == pytest.approx((after - before) / 2e-4, abs=1e-6)


def samples(state: NetState, member: int, at_s: float) -> tuple[Floats, Floats, Floats]:
    """Give a grid of 0.1 s, what a unit with the member's delay says there, and its turn rates at both ends."""
    grid = np.linspace(0.0, 0.1, 11)
    t = (grid + at_s)[:, None]
    force = np.hstack((0.3 * np.sin(3 * t), 0.2 * np.cos(2 * t) - 9.8, 0.5 * np.sin(t + 1)))
    rate = np.hstack((0.2 * np.cos(2 * t), 0.3 * np.sin(3 * t), 0.1 * np.cos(t)))
    return grid, np.hstack((force, rate)), rate[[0, -1]]


def test_a_step() -> None:
    """The transition of one member; the delay's column is of slow rates, and is tested with the track's integration."""
    state, member, span_s = a_state(5), 1, 0.1

    def after(error: Floats) -> NetState:
        whole = np.zeros(COMMON + 3 * BLOCK)
        whole[block(member)] = error
        moved = state.plus(whole)
        grid, values, slow = samples(moved, member, 0.0)
        told = np.ones((1, len(grid) - 1), dtype=bool)
        own = moved.chosen([member])
        parts = integrate(own, SampleGrid(grid[None], values[None], told, values[None, -1, 3:], slow[None]))
        end, F, _, _ = moved_members(own, parts, [Noise(1e-3, 1e-2)], np.full((1, 2), 1e-6), span_s)
        found["F"] = F[0]
        return moved.replaced([member], end)

    found: dict[str, Floats] = {}
    still = after(np.zeros(BLOCK))
    F = found["F"]
    numeric = differences(lambda error: after(error).minus(still)[block(member)], BLOCK)
    off = np.abs(F - numeric).max(axis=0)
    assert off[np.r_[P_, V_, PHI, SHOVE, ACCEL_BIAS, LEVER, CLOCK:BLOCK]].max() < 1e-6
    # The integration takes the mount and the bias of the gyroscope out of the lever arm's part (track/strapdown.py).
    assert off[SHAKE].max() < 2e-2
    assert off[np.r_[GYRO_BIAS, MOUNT]].max() < 0.1
    assert np.abs(F[:MOVING]).max() > 1.0


def test_a_frame_that_moves_with_a_node() -> None:
    state = a_state(6)

    def anchored(one: NetState) -> NetState:
        return replace(one, p_m=one.p_m - one.p_m[1], v_mps=one.v_mps - one.v_mps[1])

    still = np.broadcast_to(np.eye(BLOCK), (3, BLOCK, BLOCK))
    move = Move(still, np.zeros((3, BLOCK, BLOCK)), 1, state.p_m[1], state.v_mps[1])
    N = COMMON + 3 * BLOCK
    numeric = differences(lambda error: anchored(state.plus(error)).minus(anchored(state)), N)
    assert move.onward(np.eye(N)) == pytest.approx(numeric, abs=1e-6)


def test_residuals_that_do_not_fit_those_before_them_are_left_out() -> None:
    """As if each updated the estimate before the next one is judged."""
    rng = np.random.default_rng(5)
    H, noise = rng.normal(0.0, 1.0, (5, 3)), np.full(5, 0.01)
    y = H @ rng.normal(0.0, 1.0, 3) + rng.normal(0.0, 0.1, 5)
    y[2] += 3.0
    P, state, kept = np.eye(3), np.zeros(3), []
    for row in range(5):
        h, left = H[row], y[row] - H[row] @ state
        S = h @ P @ h + noise[row]
        if left**2 < 16.0 * S:
            kept.append(row)
            gain = P @ h / S
            state, P = state + gain * left, P - np.outer(gain, h @ P)
    assert within(y, H @ H.T + np.diag(noise)) == kept
    assert len(kept) == 4


def an_estimate(state: NetState) -> NetEstimate:
    intake = TrackIntake([TrackNode(name, Rig(PINHOLE, LIGHTS_M)) for name in "abc"])
    estimate = NetEstimate(intake)
    estimate.members = [Member(i, 0.0, confirmed=True, light_s=0.0) for i in range(3)]
    estimate.state, estimate.t_s = state, 0.0
    estimate.covariance = np.eye(COMMON + 3 * BLOCK)
    estimate.rates_radps = np.zeros((3, 3))
    return estimate


def test_lights_of_one_picture_share_the_error_of_its_stamp_whosever_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Member 0 sees both others in one picture, member 1 one of them in another, whose errors last for two more."""
    estimate, rng = an_estimate(a_state(7)), np.random.default_rng(8)
    sigma_px, dt_s = np.ones(1), np.zeros(1)
    one, two = (
        Sight(0, 0.0, node, np.zeros((1, 3)), np.zeros((1, 2, 3)), sigma_px, dt_s, np.array((lasting_s,)))
        for node, lasting_s in enumerate((0.0, 0.2))
    )
    bars = [Bar(0, 1, one), Bar(0, 2, one), Bar(1, 2, two)]
    which = columns([bar.observer for bar in bars], [bar.other for bar in bars])
    y, H = rng.normal(0.0, 1.0, (3, 1, 2, 2)), rng.normal(0.0, 300.0, (3, 1, 2, 2, WIDTH + 1))
    applied: list[tuple[Floats, Floats]] = []
    monkeypatch.setattr(NetEstimate, "_apply", lambda _, rows, __, noise, *___: applied.append((rows, noise)))
    estimate.lit_s[1, 2, 0] = -0.1
    estimate._update(bars, which, y, H, [(n, 0, n % 2, 0.5) for n in range(3)], np.zeros(3))
    [(rows, noise)] = applied
    late = STAMP_SIGMA_S * np.concatenate([H[n, 0, n % 2, :, -1] for n in range(3)])
    expected = 0.5 * np.eye(6) + np.outer(late, late)
    expected[:4, 4:] = expected[4:, :4] = 0.0
    estimate.members[2].without = True
    estimate._update(bars, which, y, H, [(n, 0, n % 2, 0.5) for n in range(3)], np.zeros(3))
    assert applied[1][1] == pytest.approx(expected)
    expected[4:, 4:] += 2.0 * 0.5 * np.eye(2)
    assert noise == pytest.approx(expected)
    assert rows[4:, which[2]] == pytest.approx(H[2, 0, 0, :, :-1])


def test_gauges(monkeypatch: pytest.MonkeyPatch) -> None:
    port_m, age_s = np.array((0.1, -0.2, 0.3)), 0.2
    rig = Rig(PINHOLE, LIGHTS_M, depth_port_m=port_m)
    estimate = an_estimate(a_state(12))
    estimate.intake.nodes = [TrackNode(name, rig) for name in "abc"]
    applied: list[tuple[Floats, Floats]] = []
    monkeypatch.setattr(NetEstimate, "_apply", lambda _, H, y, __: applied.append((H, y)))
    seen = [(member, age_s, DepthSeen(0, 2.0 + member, 0.02)) for member in range(3)]

    def residuals(error: Floats) -> Floats:
        estimate.state = a_state(12).plus(error)
        estimate._take_gauges(seen)
        return applied[-1][1]

    numeric = differences(residuals, COMMON + 3 * BLOCK)
    estimate.state = a_state(12)
    estimate._take_gauges(seen)
    assert applied[-1][0] == pytest.approx(-numeric, abs=1e-6)


def test_gauges_that_take_the_sea_for_fresh_water_do_not_move_a_network() -> None:
    """Node 0 stands 12 m deep, and is known to. Node 1 rises 10 m above it, which lights show to 5 cm. Both gauges show
    2.8 % too much, and that of node 1 0.1 m more."""
    estimate = an_estimate(a_state(13))
    P = np.diag(np.concatenate((common_variances(), np.zeros(3 * BLOCK))))
    for gauge in (block(member).start + GAUGE for member in (0, 1)):
        P[gauge, gauge] = GAUGE_M**2
    place = slice(block(1).start + P_.start, block(1).start + P_.stop)
    port = estimate.nodes[0].rig.depth_port_m
    for height_m in np.linspace(0.0, 10.0, 41).tolist():
        assert estimate.state is not None
        p_m = np.array(((0.0, 0.0, 0.0), (3.0, 0.0, -height_m), (0.0, 0.0, 0.0)))
        estimate.state = state = replace(estimate.state, p_m=p_m)
        P[place] = P[:, place] = 0.0
        P[place, place] = 0.05**2 * np.eye(3)
        estimate.covariance = P
        ports_m = [float((state.R[member] @ port)[2]) for member in (0, 1)]
        shown_m = 1.028 * (12.0 + ports_m[0]), 1.028 * (12.0 - height_m + ports_m[1]) + 0.1
        for member in (0, 1):
            estimate._take_gauges([(member, 0.0, DepthSeen(0, shown_m[member], 0.02))])
        P = estimate.covariance
        assert abs(estimate.state.p_m[1, 2] + height_m) < 3.0 * np.sqrt(P[place, place][2, 2])
    known = {"depth_scale": (0.028 / 1.028, DEPTH_SCALE, 0.02), "datum_m": (12.0, DATUM, 0.3)}
    for name, (true, error, most) in known.items():
        assert abs(getattr(estimate.state, name) - true) < 3.0 * np.sqrt(P[error, error]) < most, name


def relative(state: NetState) -> tuple[Floats, Floats]:
    """Where member 2 is from member 1."""
    return state.R[1].T @ (state.p_m[2] - state.p_m[1]), state.R[1].T @ state.R[2]


def test_the_gap_of_a_pose_counts_both_nodes_errors() -> None:
    state = a_state(7)
    t, R = relative(state)
    estimate = an_estimate(state)
    gap, chi2 = estimate.gap(0.0, PairFix(0, t + np.array((0.1, 0.0, 0.0)), R, 1e-6 * np.eye(6), 1, 2), 1, 2)
    assert gap == pytest.approx([0.1, 0, 0, 0, 0, 0], abs=1e-12)

    def seen(error: Floats) -> Floats:
        t_now, R_now = relative(state.plus(error))
        return np.concatenate((t_now - t, rotation_log(R_now @ R.T)))

    H = differences(seen, COMMON + 3 * BLOCK)
    # The pictures of a pose may have been taken apart, by both clocks' errors, while nodes move by 0.3 m/s and rad/s.
    apart_s2 = 2.0 + float(np.sum(state.clock_s[1:] ** 2))
    S = H @ H.T + 1e-6 * np.eye(6) + np.diag([1e-4] * 3 + [1e-5] * 3) + 0.09 * apart_s2 * np.eye(6)
    assert chi2 == pytest.approx(gap @ np.linalg.solve(S, gap), rel=1e-6)


def test_a_pose_the_other_way_round_has_the_same_covariance() -> None:
    rng = np.random.default_rng(8)
    root = rng.normal(0.0, 1e-3, (6, 6))
    fix = PairFix(0, np.array((0.3, -0.2, 4.0)), rotation_exp(np.array((0.1, 3.0, 0.2))), root @ root.T, 1, 2)
    back = inverted(fix)

    def turned(error: Floats) -> Floats:
        R, t = rotation_exp(error[3:]) @ fix.R_a_b, fix.t_a_b_m + error[:3]
        return np.concatenate((-R.T @ t - back.t_a_b_m, rotation_log(R.T @ back.R_a_b.T)))

    J = differences(turned, 6)
    assert (back.node, back.other) == (2, 1)
    assert back.covariance == pytest.approx(J @ fix.covariance @ J.T, rel=1e-6, abs=1e-12)


def test_a_node_that_joins_has_the_errors_of_who_sees_it() -> None:
    state = a_state(9)
    estimate = an_estimate(state)
    root = np.random.default_rng(10).normal(0.0, 0.3, (COMMON + 3 * BLOCK, COMMON + 3 * BLOCK))
    estimate.covariance = P = 1e-4 * root @ root.T
    t, R = relative(state)
    estimate.intake.nodes = [*estimate.intake.nodes, TrackNode("d", Rig(PINHOLE, LIGHTS_M))]
    estimate.intake.attitudes.append([])
    fix = PairFix(0, t, R, 1e-8 * np.eye(6), 1, 3)
    estimate.join(0.0, fix, 1, 3)
    assert estimate.state is not None
    assert estimate.state.p_m[3] == pytest.approx(state.p_m[2])

    def place(error: Floats) -> Floats:
        now = state.plus(error)
        p, R_now = now.p_m[1] + now.R[1] @ t, now.R[1] @ R
        phi = rotation_log(R_now @ estimate.state.R[3].T)
        return np.concatenate((p - rotation_exp(phi) @ estimate.state.p_m[3], phi))

    J = differences(place, len(P))
    own = estimate.covariance[block(3), block(3)]
    which = np.r_[0:3, 6:9]
    cross = skew(estimate.state.p_m[3])
    small = np.zeros((6, 6))
    # The pictures of a pose may have been taken apart, by both clocks' errors, while nodes move by 0.3 m/s and rad/s.
    clock = block(1).start + CLOCK
    moved = 0.09 * (CLOCK_S**2 + P[clock, clock] + state.clock_s[1] ** 2)
    small[:3, :3] = (1e-4 + 1e-8 + moved) * np.eye(3) + (1e-5 + 1e-8 + moved) * cross @ cross.T
    assert own[np.ix_(which, which)][:3, :3] == pytest.approx((J @ P @ J.T)[:3, :3] + small[:3, :3], abs=1e-7)
    assert estimate.covariance[: len(P), block(3)][:, which] == pytest.approx(P @ J.T, abs=1e-7)
