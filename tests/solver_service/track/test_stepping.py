"""What a step and a picture count as unknown: a sudden turn, and the clock while the velocity is unknown.

And when the biases' walk is learned.
"""

from __future__ import annotations

import copy
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from buddyline.solver_service.geometry.observation import STAMP_SIGMA_S
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track import seeing
from buddyline.solver_service.track.association import Association, associate
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import FrameSeen
from buddyline.solver_service.track.lights import COLUMNS, Sight, light_positions, residuals, sights_of
from buddyline.solver_service.track.moving import HOLD_S, KNOWN_CLOCK_S
from buddyline.solver_service.track.records import last_ns
from buddyline.solver_service.track.seeing import _widened, light_rows, noise_of, stacked
from buddyline.solver_service.track.state import CLOCK, MOVING, PHI, R_, SIZE, V_, State, of_place
from buddyline.solver_service.track.strapdown import Noise
from buddyline.solver_service.track.trail import Chosen
from buddyline.solver_service.track.walking import Walking

from tests.solver_service.track.dives import Setting, filter_of, make
from tests.solver_service.track.test_track_jacobians import LIGHTS_M, PINHOLE, a_state

SIGMA_RAD = 0.02
STEP_S = 0.05


def of_light(state: State, sight: Sight) -> tuple[Floats, Floats]:
    """Give the residual (2,) and Jacobian (2, SIZE) of one light in A's picture, nobody turning."""
    X, D = light_positions(state, 0, LIGHTS_M, np.zeros((2, 3)), sight.dt_s)
    y, H = residuals(sight.bearings, sight.tangents, X, D)
    full = np.zeros((2, SIZE))
    full[:, COLUMNS] = H[0, 0, :, :-1]
    return y[0, 0], full


def test_a_picture_of_a_counts_the_product_of_clock_and_velocity_errors() -> None:
    """Gauss-Hermite's three points are exact for the squares of such products."""
    state = a_state(2).with_parts(clock_s=0.0)
    rig = make(1, Setting(seconds=1.0)).records[0].node.rig
    X, D = light_positions(state, 0, LIGHTS_M, np.zeros((2, 3)), np.zeros(1))
    pixel = np.array((409.5, 307.5)) + 900.0 * X[0, 0, :2] / X[0, 0, 2]
    [sight] = sights_of(rig, 0, [0.0], [FrameSeen(0, pixel[None], np.array((0.7,)))])
    y0, H0 = of_light(state, sight)
    of_errors = np.r_[CLOCK, V_]
    P = np.zeros((SIZE, SIZE))
    root = np.diag((0.02, 0.4, 0.6, 0.5))
    root[1:, 0] = 0.3, -0.2, 0.4
    P[np.ix_(of_errors, of_errors)] = root @ root.T
    left_out, weights = [], []
    for points in product(((-np.sqrt(3.0), 1 / 6), (0.0, 2 / 3), (np.sqrt(3.0), 1 / 6)), repeat=4):
        error = np.zeros(SIZE)
        error[of_errors] = root @ np.array([point for point, _ in points])
        left_out.append(of_light(state.plus(error), sight)[0] - y0 + H0 @ error)
        weights.append(np.prod([weight for _, weight in points]))
    mean = np.average(left_out, axis=0, weights=weights)
    variance = float(np.average((np.array(left_out) - mean) ** 2, axis=0, weights=weights).mean())
    H = residuals(sight.bearings, sight.tangents, X, D)[1]
    widened = _widened(sight, H, P)
    assert widened.sigma_px**2 - 0.7**2 == pytest.approx(variance, rel=0.03)
    assert variance > 1.0
    of_b = replace(sight, node=1)
    assert _widened(of_b, H, P) is of_b


def test_a_start_is_weighed_without_the_doubt_of_its_clock_and_moved_with_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """With it a start would explain more than one that believes its clock; without it, it would believe a wrong one."""
    dive = make(1, Setting(seconds=3.0))
    track = filter_of(dive.records, dive.fixes)
    weighed: list[tuple[bool, float]] = []
    moved: list[tuple[bool, float]] = []
    found: list[Association] = []

    def confirmed() -> bool:
        assert track.main is not None
        return track.main.confirmed

    def noted_weighing(y: Floats, H: Floats, P: Floats, sigma_px: Floats, *how_likely: Any) -> object:
        weighed.append((confirmed(), float(sigma_px.max(initial=Setting().sigma_px))))
        found.append(associate(y, H, P, sigma_px, *how_likely))
        return found[-1]

    def noted_moving(chosen: Chosen, y: Floats, H: Floats) -> object:
        more = [after[2] - before[2] for after, before in zip(chosen, found[-1].chosen, strict=True)]
        moved.append((confirmed(), max(more)))
        return light_rows(chosen, y, H)

    monkeypatch.setattr(seeing, "associate", noted_weighing)
    monkeypatch.setattr(seeing, "light_rows", noted_moving)
    frames = sorted(frame.stamp_ns for record in dive.records for frame in record.frames)
    track.advance(frames[4])
    assert track.main is not None
    assert track.main.lit_pictures != [0, 0]
    assert not track.main.confirmed
    track.advance(frames[-1])
    assert {sigma_px for known, sigma_px in weighed if not known} == {Setting().sigma_px}
    assert max(more_px2 for known, more_px2 in moved if not known) > 0.1 * Setting().sigma_px ** 2
    assert {more_px2 for known, more_px2 in moved if known} == {0.0}
    assert max(sigma_px for known, sigma_px in weighed if known) > 1.01 * Setting().sigma_px


def test_a_walk_is_learned_only_once_the_clock_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    dive = make(1, Setting(seconds=12.0))
    track = filter_of(dive.records, dive.fixes)
    learned: list[Floats] = []
    taught = Walking.taught

    def noted(walking: Walking, y: Floats, S_inverse: Floats, H: Floats, gain: Floats, *, learns: bool) -> Walking:
        if learns:
            learned.append(y)
        return taught(walking, y, S_inverse, H, gain, learns=learns)

    monkeypatch.setattr(Walking, "taught", noted)
    unknown = 0
    for stamp_ns in sorted(frame.stamp_ns for record in dive.records for frame in record.frames):
        before = len(learned)
        track.advance(stamp_ns)
        main = track.main
        if main is not None and main.confirmed and main.covariance[CLOCK, CLOCK] > KNOWN_CLOCK_S**2:
            unknown += 1
            assert len(learned) == before
    assert unknown > 0
    assert learned


class ToldAttitudes:
    """Attitude messages of one node: one of a certain attitude at every time."""

    def __init__(self, R_level_camera: Floats) -> None:
        self.R_level_camera = R_level_camera

    def at(self, t_s: float, known_s: float) -> tuple[Floats, Floats]:
        assert known_s == t_s + HOLD_S
        return self.R_level_camera, np.full(3, SIGMA_RAD**2)


def startled(offs: Floats) -> list[bool]:
    """Say after which attitudes of B, off their prediction by offs (N, 3) sigmas, it is taken to have begun to turn."""
    dive = make(1, Setting(seconds=1.0))
    track = TrackFilter(dive.records[0].node, dive.records[1].node)
    state = a_state(4).with_parts(mount_rad=0.0, shake_rad=0.0)
    estimate = Estimate(0.0, state, np.zeros((SIZE, SIZE)), 0.0, without=[False, True])
    still = Noise(0.0, 0.0, gap_rate_radps=0.0, gap_tilt_rad=0.0, gap_heading_rad=0.0)
    F = np.eye(SIZE)[:MOVING]
    found = []
    for off in offs:
        track.turning[1] = ToldAttitudes(rotation_exp(SIGMA_RAD * off) @ state.R[1])  # type: ignore[call-overload]
        found.append(track._startled(estimate, state, F, 1, still, STEP_S).gap_rate_radps > 0.0)
    return found


def test_a_turn_that_each_attitude_hides_is_found_by_their_sum() -> None:
    off = np.array((2.4, 0.0, 0.0))
    assert startled(np.array((off, off, off))) == [False, False, True]
    assert startled(np.array((off, -off, off, -off, off, -off))) == [False] * 6
    # What a turn has explained is not counted again.
    assert startled(np.array(((8.0, 0.0, 0.0), (0.0, 0.0, 0.0)))) == [True, False]


def test_attitudes_that_are_only_noisy_seldom_startle() -> None:
    """A single one does by a chance of 0.01, their sum by another."""
    rng = np.random.default_rng(6)
    assert 0.005 < np.mean(startled(rng.normal(0.0, 1.0, (4000, 3)))) < 0.025


def known_pair() -> tuple[TrackFilter, Estimate, list[Sight]]:
    """Give a filter, its track of both nodes, and each node's picture of the other's lights, exactly where they are."""
    dive = make(1, Setting(seconds=3.0))
    track = filter_of(dive.records, dive.fixes)
    track.advance(last_ns(dive.records))
    assert track.main is not None
    known = track.main
    known.rates_radps = np.zeros((2, 3))
    sights = []
    for node in (0, 1):
        rig, lights_m = track.nodes[node].rig, track.nodes[1 - node].rig.lights_m
        X, _ = light_positions(known.state, node, lights_m, known.rates_radps, np.zeros(1))
        pixels = np.array((409.5, 307.5)) + 900.0 * X[0, :, :2] / X[0, :, 2:]
        sights += sights_of(rig, node, [known.t_s], [FrameSeen(0, pixels, np.full(2, 0.7))])
    return track, known, sights


def off_px(track: TrackFilter, estimate: Estimate, sight: Sight) -> Floats:
    """Give how far (K, L) each candidate of a picture is off each light."""
    *_, y, _ = track._compared(sight, estimate.state, estimate.rates_radps, 0.0)
    return np.linalg.norm(y, axis=2)


def test_lights_after_seconds_of_darkness_are_believed_where_they_are() -> None:
    """One linear step from a prediction that is a metre off ended up to 300 px beside the lights it had used."""
    track, known, sights = known_pair()
    roots = np.zeros(SIZE)
    roots[R_], roots[PHI[0]], roots[PHI[1]] = 0.7, 0.03, 0.06
    rng = np.random.default_rng(7)
    for _ in range(10):
        estimate = copy.deepcopy(known)
        estimate.state = known.state.plus(roots * rng.normal(0.0, 1.0, SIZE))
        estimate.covariance = known.covariance + np.diag(roots**2)
        estimate.given = {(node, 0): ((0, 0, 0.49), (1, 1, 0.49)) for node in (0, 1)}
        for sight in sights:
            track._take_lights(estimate, sight)
        for sight in sights:
            assert np.diag(off_px(track, estimate, sight)).max() < 5.0


def test_a_fork_is_believed_where_its_light_is() -> None:
    """With compasses 17 degrees off one linear step ended 25 px beside the light, and the right lamp was given up."""
    track, known, sights = known_pair()
    at, roots = known.state, np.zeros(SIZE)
    roots[R_], roots[PHI[0]], roots[PHI[1]] = 0.3, (0.02, 0.02, 0.06), (0.02, 0.02, 0.12)
    turned = at.moved(at.r_m, at.v_mps, np.stack((at.R[0], rotation_exp(np.array((0.0, 0.0, 0.3))) @ at.R[1])))
    off = replace(known, state=turned, covariance=of_place(turned, np.diag(roots**2)), unseen_by=1)
    track._fork(off, known.t_s, sights[1])
    forks = [(fork, *fork.used[1, 0]) for fork in track.challengers]
    assert {(k, light) for _, (k, light, _) in forks} >= {(0, 0), (1, 1)}
    for fork, (k, light, _) in forks:
        assert off_px(track, fork, sights[1])[k, light] < 2.0


def test_lights_of_a_picture_share_the_error_of_its_stamp() -> None:
    state, rates = a_state(5), np.array(((0.1, -0.3, 0.2), (-0.4, 0.1, 0.3)))
    bearings, tangents = PINHOLE.rays(np.array(((300.0, 250.0), (500.0, 350.0))))

    def seen(late_s: float) -> tuple[Floats, Floats]:
        return residuals(bearings, tangents, *light_positions(state, 1, LIGHTS_M, rates, np.full(2, late_s)))

    (y, H), (later, _) = seen(0.0), seen(STAMP_SIGMA_S)
    chosen = ((0, 0, 0.49), (1, 1, 0.25))
    rows_H, rows_y, noise = light_rows(chosen, y, H)
    moved = np.concatenate((later[0, 0] - y[0, 0], later[1, 1] - y[1, 1]))
    assert np.abs(moved).max() > 0.2
    assert noise == pytest.approx(np.diag((0.49, 0.49, 0.25, 0.25)) + np.outer(moved, moved), rel=0.01, abs=1e-4)
    assert rows_y == pytest.approx(np.concatenate((y[0, 0], y[1, 1])))
    assert rows_H[2:, COLUMNS] == pytest.approx(H[1, 1, :, :-1])
    others = noise_of(np.array((0.49, 0.25)), H[[0, 1], [0, 1], :, -1], np.array((7, 8)))
    assert others[:2, :2] == pytest.approx(noise[:2, :2])
    assert np.all(others[:2, 2:] == 0.0)


def test_measurements_of_one_step_are_stacked() -> None:
    one = np.ones((1, 3)), np.array((2.0,)), np.array(((4.0,),))
    two = np.zeros((2, 3)), np.array((5.0, 6.0)), np.array(((7.0, 1.0), (1.0, 8.0)))
    H, y, noise = stacked([one, two])
    assert H.tolist() == [[1.0] * 3, [0.0] * 3, [0.0] * 3]
    assert y.tolist() == [2.0, 5.0, 6.0]
    assert noise.tolist() == [[4.0, 0.0, 0.0], [0.0, 7.0, 1.0], [0.0, 1.0, 8.0]]
