"""What a picture tells while it is not certain which candidate is a light, or whether its node has begun to turn."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log
from buddyline.solver_service.track import seeing
from buddyline.solver_service.track.association import LIKELY, SURE, Association, associate
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import FrameSeen
from buddyline.solver_service.track.lights import (
    Sight,
    in_picture,
    light_positions,
    pixels_of,
    sights_of,
)
from buddyline.solver_service.track.state import GYRO_BIAS, MOVING, PHI, SIZE, invariant_of_plain
from buddyline.solver_service.track.sudden import SuddenTurn, with_sudden
from buddyline.solver_service.track.visible import share_before, share_within

from tests.solver_service.track.dives import Setting, bare_of, filter_of, make, project

WIDTH_PX, HEIGHT_PX = 800.0, 600.0
AREA_PX2 = WIDTH_PX * HEIGHT_PX
SIGMA_PX = 0.7
# Only the left lamp is lit, and found in three of four pictures.
LEFT_LIT = np.array((0.75, 0.0))
# Both lights are moved alike, by an error in two directions.
ALIKE = np.eye(2)


def seen(candidates_px: Floats, P: Floats, predicted_px: Floats) -> Association:
    """Decide which candidates (K, 2) are a light that is predicted there, with covariance P (2, 2)."""
    y = np.stack((candidates_px - predicted_px, candidates_px - predicted_px), axis=1)
    H = np.broadcast_to(ALIKE, (len(y), 2, 2, 2))
    clutter = max(len(y) - 1.0, 1.0) / AREA_PX2
    return associate(y, H, P, np.full(len(y), SIGMA_PX), LEFT_LIT, clutter, least=LIKELY)


def test_likely_lights_tell_no_more_than_is_true() -> None:
    """A light's place is known to 40 px; candidates by chance are among those near it, and it may not be found."""
    rng = np.random.default_rng(3)
    P = 40.0**2 * np.eye(2)
    chi2, doubtful = [], 0
    for _ in range(3000):
        true = rng.normal(0.0, 40.0, 2)
        corner = np.array((WIDTH_PX, HEIGHT_PX)) * -0.5
        candidates = rng.uniform(corner, -corner, (rng.poisson(4.0), 2))
        if rng.uniform() < LEFT_LIT[0]:
            candidates = np.concatenate((candidates, true + rng.normal(0.0, SIGMA_PX, (1, 2))))
        if not len(candidates):
            continue
        for k, light, variance in seen(candidates, P, np.zeros(2)).chosen:
            assert light == 0
            gain = P @ np.linalg.inv(P + variance * np.eye(2))
            off = true - gain @ candidates[k]
            # A sure light has at most a gross error's doubt, 7 px.
            if variance > 7.0**2:
                doubtful += 1
                chi2.append(off @ np.linalg.solve(P - gain @ P, off))
    assert doubtful > 300
    assert 0.5 < np.mean(chi2) / 2.0 < 1.3
    # Of a Gaussian one in a thousand is above 13.8.
    assert np.mean(np.array(chi2) > 13.8) < 0.01


def test_a_likely_light_at_most_halves_the_variance_and_is_sure_when_it_comes_again() -> None:
    P, place = 60.0**2 * np.eye(2), np.array((30.0, -40.0))
    predicted, told = np.zeros(2), []
    candidates = np.stack((place, np.array((300.0, 200.0)), np.array((-350.0, 100.0)), np.array((-200.0, -250.0))))
    for _ in range(6):
        ((k, light, variance),) = seen(candidates, P, predicted).chosen
        assert (k, light) == (0, 0)
        gain = P @ np.linalg.inv(P + variance * np.eye(2))
        told.append(float(np.trace(gain)) / 2.0)
        predicted, P = predicted + gain @ (place - predicted), P - gain @ P
    assert 0.2 < told[0] <= 0.5
    assert any(gain > 0.99 for gain in told)
    assert math.sqrt(P[0, 0]) < 1.0


def test_a_likely_light_at_most_halves_the_variance_in_each_direction() -> None:
    c = math.sqrt(0.5)
    for P in (
        np.diag((200.0**2, 20.0**2)),
        np.array(((c, c), (-c, c))) @ np.diag((160.0**2, 25.0**2)) @ np.array(((c, -c), (c, c))),
    ):
        place = 0.2 * P[0] / math.sqrt(P[0, 0])
        others = np.array(((300.0, 200.0), (-350.0, 100.0), (-200.0, -250.0)))
        ((k, _, variance),) = seen(np.concatenate((place[None], others)), P, np.zeros(2)).chosen
        assert k == 0
        assert variance > 7.0**2
        left = P - P @ np.linalg.inv(P + variance * np.eye(2)) @ P
        assert (np.linalg.eigvals(np.linalg.inv(P) @ left) > 0.499).all()


def test_a_light_that_may_well_be_another_is_left_out() -> None:
    near = np.array(((10.0, 0.0), (-10.0, 5.0)))
    assert not seen(near, 40.0**2 * np.eye(2), np.zeros(2)).chosen
    assert 0.5 < LIKELY < SURE


@pytest.mark.parametrize(("apart_px", "known"), [(60.0, False), (130.0, False), (300.0, True)])
def test_a_lone_light_must_be_sure_not_to_be_the_other_of_its_bar(apart_px: float, known: bool) -> None:
    """Pictures that are alike tell it no better, and so one after the other must not tell which lamp is hidden."""
    H, P = np.broadcast_to(ALIKE, (1, 2, 2, 2)), 60.0**2 * np.eye(2)
    y = np.array((((30.0, 0.0), (30.0 + apart_px, 0.0)),))
    lit, lone = np.array((0.75, 0.75)), np.full(1, SIGMA_PX)
    found = associate(y, H, P, lone, lit, 1.0 / AREA_PX2, least=LIKELY)
    assert found.seen[0] > 0.5 * found.seen.sum()
    assert found.ambiguous is not known
    assert [one[:2] for one in found.chosen] == ([(0, 0)] if known else [])
    # Where the other one is known to be dark nothing is ambiguous.
    assert not associate(y, H, P, lone, LEFT_LIT, 1.0 / AREA_PX2, least=LIKELY).ambiguous


def test_a_light_that_may_be_outside_of_the_picture_is_found_less_surely_and_missed_less() -> None:
    y, H = np.zeros((1, 2, 2)), np.broadcast_to(ALIKE, (1, 2, 2, 2))
    P, sigma, found = 20.0**2 * np.eye(2), np.full(1, SIGMA_PX), np.array((0.9, 0.0))
    sure, half = (associate(y, H, P, sigma, found, 1.0 / AREA_PX2, np.array((within, 1.0))) for within in (1.0, 0.5))
    # Where it is found, it was in the picture; where it is not, it may have been outside.
    odds = [np.exp(one.evidence) * np.array((one.seen[0], 1.0 - one.seen[0])) for one in (sure, half)]
    assert odds[0][0] == pytest.approx(odds[1][0])
    assert odds[0][1] == pytest.approx(0.1)
    assert odds[1][1] == pytest.approx(0.55)


@pytest.mark.parametrize(
    "camera",
    [
        Camera("pinhole", 820, 616, 900.0, 900.0, 409.5, 307.5),
        Camera("pinhole", 820, 616, 700.0, 710.0, 400.0, 300.0, (-0.2, 0.05, 0.0, 0.0, 0.0)),
        Camera("fisheye", 820, 616, 400.0, 400.0, 409.5, 307.5, (0.02, -0.01, 0.0, 0.0)),
    ],
)
@pytest.mark.parametrize("pixel", [(400.0, 300.0), (10.0, 200.0), (-15.0, 580.0), (830.0, 630.0)])
def test_the_share_of_a_light_within_the_picture(camera: Camera, pixel: tuple[float, float]) -> None:
    rng = np.random.default_rng(5)
    X = 6.0 * camera.bearings(np.array((pixel,)))
    root = rng.normal(0.0, 0.08, (3, 3))
    D = np.eye(3)[None]
    share = share_within(camera, pixels_of(camera, X), X, D, root @ root.T, 2.0)
    drawn = X[0] + rng.normal(0.0, 1.0, (4000, 3)) @ root.T
    inside = in_picture(camera, pixels_of(camera, drawn), 2.0)
    assert share[0] == pytest.approx(inside.mean(), abs=0.06)


def test_a_light_behind_the_camera_is_not_within_the_picture() -> None:
    camera = Camera("pinhole", 820, 616, 900.0, 900.0, 409.5, 307.5)
    X = np.array(((0.0, 0.0, -3.0), (0.0, 0.0, 3.0)))
    share = share_within(camera, pixels_of(camera, X), X, np.broadcast_to(np.eye(3), (2, 3, 3)), 1e-4 * np.eye(3), 2.0)
    assert share.tolist() == [0.0, 1.0]


def test_where_a_light_was_before_by_where_it_stands_now() -> None:
    camera = Camera("pinhole", 820, 616, 900.0, 900.0, 409.5, 307.5)
    rng = np.random.default_rng(6)
    X, D = np.array((0.42, 0.1, 1.0)), np.eye(3, 4)
    # Errors of the place, and of how far the light has gone since, which is 0.05 to the left.
    P = np.diag((0.15, 0.08, 0.1, 0.03)) ** 2
    drawn = rng.normal(0.0, 1.0, (40_000, 4)) * np.sqrt(np.diag(P))
    H = np.array(((900.0, 0.0, -330.0, -900.0), (0.0, 900.0, -90.0, 0.0)))
    before = in_picture(camera, pixels_of(camera, X + drawn @ D.T), 2.0)
    y = np.array(((-200.0, 30.0), (20.0, 0.0), (np.inf, np.inf)))
    share, if_now = share_before(camera, X, D, P, 2.0, y, np.broadcast_to(H, (3, 2, 4)), np.full(3, 20.0))
    assert share == pytest.approx(before.mean(), abs=0.04)
    for k in (0, 1):
        weights = np.exp(-0.5 * ((y[k] - drawn @ H.T) ** 2).sum(axis=1) / 20.0**2)
        assert if_now[k] == pytest.approx(weights @ before / weights.sum(), abs=0.06)
    assert if_now[0] > 0.95
    behind = share_before(camera, -X, D, P, 2.0, y, np.broadcast_to(H, (3, 2, 4)), np.full(3, 20.0))
    assert behind[0] == 0.0
    assert not behind[1].any()


def test_a_candidate_is_no_light_that_the_last_picture_would_have_shown_there_too() -> None:
    """In darkness many pictures have false candidates: one of them would soon be near where the lamp may be."""
    y, H = np.array((((20.0, 0.0),) * 2, ((60.0, 0.0),) * 2)), np.broadcast_to(ALIKE, (2, 2, 2, 2))
    told = y, H, 80.0**2 * np.eye(2), np.full(2, SIGMA_PX), np.array((0.95, 0.0)), 1.0 / AREA_PX2
    by_last = np.log(np.array(((0.07,) * 2, (2.5,) * 2)))
    alone, last = (associate(*told, np.array((0.7, 0.0)), LIKELY, more) for more in (None, by_last))
    assert alone.seen[0] == pytest.approx(last.seen[0], abs=0.1)
    assert not alone.chosen
    assert [one[:2] for one in last.chosen] == [(1, 0)]


@pytest.fixture(scope="module")
def without_units() -> tuple[TrackFilter, Estimate, Sight]:
    """Give a filter of a dive without units, its confirmed estimate, and A's next picture as that predicts it.

    Both nodes' last pictures show lamps that are surely known.
    """
    dive = make(3, Setting(seconds=6.0, false=0))
    track = filter_of(bare_of(dive), dive.fixes)
    track.advance(dive.stamps_ns[-1])
    known = track.main
    assert known is not None
    assert known.confirmed
    assert not any(known.looks_away)
    later = known.copied()
    track._step(later, known.t_s + 0.1, None)
    return track, known, picture(track, later, np.zeros(3))


def picture(track: TrackFilter, estimate: Estimate, turned_rad: Floats) -> Sight:
    """Give A's picture by an estimate, and by its turn about camera axes."""
    rig, lights_m = track.nodes[0].rig, track.nodes[1].rig.lights_m
    X, _ = light_positions(estimate.state, 0, lights_m, estimate.rates_radps, np.zeros(1))
    pixels = project(X[0] @ rotation_exp(turned_rad))
    assert in_picture(rig.camera, pixels, 2.0).all()
    [sight] = sights_of(rig, 0, [estimate.t_s], [FrameSeen(0, pixels, np.full(2, SIGMA_PX))])
    return sight


@pytest.mark.parametrize("turned_rad", [0.0, 0.04])
def test_a_turn_that_lights_show_at_once_is_a_turn_and_no_motion(
    without_units: tuple[TrackFilter, Estimate, Sight], turned_rad: float
) -> None:
    """A turns by two degrees more than it has ever done from one picture to the next."""
    track, known, calm = without_units
    estimate, later = known.copied(), known.copied()
    track._step(later, calm.t_s, None)
    quiet = later.steps.last
    track._step(estimate, calm.t_s, picture(track, later, np.array((0.0, turned_rad, 0.0))))
    step, sudden = estimate.steps.last, turned_rad > 0.0
    rate = slice(GYRO_BIAS[0].start - MOVING, GYRO_BIAS[0].stop - MOVING)
    assert len(step.looks[0].chosen) == 2
    # The smoother is told of the noise that the filter has taken.
    assert (step.walk[rate] > 10.0 * quiet.walk[rate]).all() == sudden
    assert (np.diag(step.Q)[PHI[0]] > 10.0 * np.diag(quiet.Q)[PHI[0]]).all() == sudden
    turn_rad = rotation_log(later.state.R[0].T @ estimate.state.R[0])
    assert turn_rad == pytest.approx((0.0, turned_rad, 0.0), abs=0.008)
    place_m = [one.state.R[0].T @ one.state.r_m for one in (later, estimate)]
    expected = rotation_exp(np.array((0.0, -turned_rad, 0.0))) @ place_m[0]
    assert np.linalg.norm(place_m[1] - expected) < 0.01 * np.linalg.norm(expected)


def test_a_steps_noise_holds_a_sudden_turn_of_one_node(without_units: tuple[TrackFilter, Estimate, Sight]) -> None:
    _, known, _ = without_units
    turn = SuddenTurn.of(known.state, 1, 0.1)
    P = turn.added_to(known.covariance)
    more = P - known.covariance
    T = np.eye(SIZE)
    T[:MOVING, :MOVING] = invariant_of_plain(known.state)
    plain = np.linalg.inv(T) @ more @ np.linalg.inv(T).T
    expected = np.zeros(SIZE)
    expected[PHI[1]], expected[GYRO_BIAS[1]] = 1.5**2 * 0.1**3 / 3.0, 1.5**2 * 0.1
    np.testing.assert_allclose(plain, np.diag(expected), atol=1e-12)


def test_a_node_that_shows_no_light_is_taken_to_turn_more_freely(
    without_units: tuple[TrackFilter, Estimate, Sight],
) -> None:
    track, known, calm = without_units
    walks = []
    for looks_away in (False, True):
        estimate = known.copied(looks_away=[looks_away, False])
        track._step(estimate, calm.t_s, None)
        walks.append(estimate.steps.last.walk[GYRO_BIAS[0].start - MOVING])
    assert walks[1] == pytest.approx(0.45**2 * 0.1)
    assert walks[0] < 0.2 * walks[1]


def test_a_sudden_turn_is_no_better_evidence_than_it_is_rare(
    without_units: tuple[TrackFilter, Estimate, Sight],
) -> None:
    _, known, _ = without_units
    usual = np.trace(known.covariance)
    for by_turn, gained in ((12.9, 0.0), (13.5, 0.5), (19.0, 6.0)):
        sure = {True: Association((), np.zeros(2), 10.0), False: Association((), np.zeros(2), by_turn)}
        found, P, turn = with_sudden(known, {0: 0.1, 1: 0.1}, lambda P, sure=sure: sure[np.trace(P) == usual])
        assert found.evidence == pytest.approx(10.0 + gained)
        assert (turn is not None) == (gained > 0.0) == (np.trace(P) > usual)


def test_only_nodes_without_a_unit_turn_suddenly_and_only_once_confirmed(
    without_units: tuple[TrackFilter, Estimate, Sight],
) -> None:
    track, known, _ = without_units
    assert track._turning_s(known) == pytest.approx({0: 0.1, 1: 0.1}, abs=0.02)
    assert list(track._turning_s(known.copied(without=[False, True]))) == [1]
    assert track._turning_s(known.copied(confirmed=False)) == {}


def test_a_picture_without_a_light_is_one_of_a_node_that_looks_away_until_it_shows_one(
    without_units: tuple[TrackFilter, Estimate, Sight],
) -> None:
    track, known, calm = without_units
    estimate = known.copied()
    [nothing] = sights_of(track.nodes[0].rig, 0, [calm.t_s], [FrameSeen(0, np.zeros((0, 2)), np.zeros(0))])
    track._step(estimate, calm.t_s, nothing)
    assert estimate.looks_away[0]
    track._step(estimate, calm.t_s + 0.001, calm)
    assert not estimate.looks_away[0]


def test_a_start_uses_no_light_that_is_only_likely(without_units: tuple[TrackFilter, Estimate, Sight]) -> None:
    """It knows the only lit lamp to some 70 px, and clutter is all about."""
    track, known, calm = without_units
    columns = {name: getattr(calm, name)[:1] for name in ("bearings", "tangents", "sigma_px", "dt_s", "lasting_s")}
    used = []
    for confirmed in (True, False):
        estimate = known.copied(confirmed=confirmed, detection=np.array(((0.3, 0.0), (0.3, 0.3))))
        estimate.covariance = known.covariance + np.diag(np.isin(np.arange(SIZE), range(3)) * 0.25)
        track._step(estimate, calm.t_s, replace(calm, **columns, elsewhere=30))
        used.append([variance for _, _, variance in estimate.steps.last.looks[0].chosen])
    assert max(used[0]) > 7.0**2
    assert not used[1]


def test_a_light_that_was_not_seen_must_have_come_in_since(without_units: tuple[TrackFilter, Estimate, Sight]) -> None:
    """It stands in the middle of the picture, and a tenth of a second before it was not there."""
    track, known, calm = without_units
    columns = {name: getattr(calm, name)[:1] for name in ("bearings", "tangents", "sigma_px", "dt_s", "lasting_s")}
    lone, used = replace(calm, **columns), []
    for looked in (False, True):
        lit = np.array(((0.95, 0.0), (0.3, 0.3)))
        estimate = known.copied(detection=lit, shown=lit.copy())
        # So much is known of its place that it may well be outside of the picture.
        estimate.covariance = known.covariance + np.diag(np.isin(np.arange(SIZE), range(3)) * 1.5)
        [nothing] = sights_of(track.nodes[0].rig, 0, [calm.t_s - 0.1], [FrameSeen(0, np.zeros((0, 2)), np.zeros(0))])
        if looked:
            track._take_lights(estimate, nothing)
            assert 0.9 < estimate.missing[0, 0] < 0.97
            estimate.shown, estimate.shown_s[0] = lit.copy(), calm.t_s - 0.1
        look, _ = track._take_lights(estimate, lone)
        used.append(len(look.chosen))
    assert used == [1, 0]
    assert not estimate.missing[1].any()


def test_a_picture_of_a_lamp_that_may_be_either_teaches_not_which_is_hidden(
    without_units: tuple[TrackFilter, Estimate, Sight], monkeypatch: pytest.MonkeyPatch
) -> None:
    track, known, calm = without_units
    shown = []
    for ambiguous in (True, False):
        told = Association((), np.array((0.3, 0.7)), 0.0, ambiguous)
        monkeypatch.setattr(seeing, "associate", lambda *_, told=told: told)
        estimate = known.copied(detection=np.full((2, 2), 0.8), shown=np.full((2, 2), 0.8))
        track._step(estimate, calm.t_s, calm)
        shown.append(float(np.ptp(estimate.shown[0])))
    assert shown[0] == pytest.approx(0.0, abs=1e-9)
    assert shown[1] > 0.2
