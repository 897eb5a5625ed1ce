"""Bars and cameras that contradict each other: what the lights tell of them, and how a track takes it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.inputs import TrackNode
from buddyline.solver_service.track.lights import light_positions, residuals
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.records import NodeRecord, last_ns
from buddyline.solver_service.track.scale import ScaleGap, by_scale, scaled, with_gap
from buddyline.solver_service.track.seeing import light_rows
from buddyline.solver_service.track.state import NAV

from tests.solver_service.track.dives import KnownDive, Setting, filter_of, make, score
from tests.solver_service.track.test_track_jacobians import a_state


@pytest.fixture(scope="module")
def dive() -> KnownDive:
    return make(11, Setting(seconds=20.0))


def stated(dive: KnownDive, node: int, *, bar: float = 1.0, focal: float = 1.0) -> tuple[NodeRecord, NodeRecord]:
    """Return a dive's records with a node's bar or focal length stated too long or too short."""

    def off(told: TrackNode) -> TrackNode:
        camera = told.rig.camera
        other = replace(camera, fx_px=focal * camera.fx_px, fy_px=focal * camera.fy_px)
        return replace(told, rig=replace(scaled(told.rig, bar - 1.0), camera=other))

    a, b = (replace(one, node=off(one.node)) if k == node else one for k, one in enumerate(dive.records))
    return a, b


@pytest.mark.parametrize("observer", [0, 1])
def test_by_scale_is_what_lights_further_from_their_camera_do(observer: int) -> None:
    rng = np.random.default_rng(4)
    state = a_state(rng)
    lights_m = np.array(((-0.4, 0.1, 0.05), (0.4, 0.08, 0.02)))
    X, D = light_positions(state, observer, lights_m, np.zeros((2, 3)), np.zeros(1))
    bearings = X[0] / np.linalg.norm(X[0], axis=1, keepdims=True)
    tangents = np.tile(900.0 * np.eye(3)[:2], (2, 1, 1)) @ (np.eye(3) - bearings[:, :, None] * bearings[:, None, :])
    y, H = residuals(bearings, tangents, X, D)
    k = [0, 1]
    rows_H, *_ = light_rows(((0, 0, 1.0), (1, 1, 1.0)), y, H)
    h = by_scale(rows_H, state, 1 - observer, lights_m)
    share, sign = 1e-5, (1.0 if observer == 0 else -1.0)
    longer, _ = light_positions(state, observer, (1.0 + 0.5 * sign * share) * lights_m, np.zeros((2, 3)), np.zeros(1))
    moved, _ = residuals(bearings, tangents, longer, D)
    np.testing.assert_allclose(h, (y[k, k] - moved[k, k]).ravel() / share, rtol=1e-3, atol=0.05)


def test_sound_bars_have_no_gap_and_others_are_found(dive: KnownDive) -> None:
    def gap(records: tuple[NodeRecord, NodeRecord]) -> ScaleGap:
        track = filter_of(records, dive.fixes)
        track.advance(last_ns(records), [])
        assert track.main is not None
        return track.main.scale

    assert not gap(dive.records).found
    for node, sign in ((0, 1.0), (1, -1.0)):
        found = gap(stated(dive, node, bar=1.01))
        assert found.found
        assert found.share == pytest.approx(sign * 0.01, abs=0.003)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("node", "bar", "focal"), [(0, 1.01, 1.0), (1, 1.01, 1.0), (1, 0.93, 1.0), (0, 1.0, 1.02), (1, 1.0, 0.99)]
)
def test_the_track_of_a_wrong_bar_is_as_good_as_it_says(dive: KnownDive, node: int, bar: float, focal: float) -> None:
    """No picture tells which of both is wrong: half of the gap is the distance's."""
    records = stated(dive, node, bar=bar, focal=focal)
    found = smooth(records, dive.fixes, dive.stamps_ns)
    judged = score(dive, found.rows)
    assert judged.wrong == 0
    assert judged.covered >= 0.95
    assert judged.nees < 1.5
    assert any("bar of" in problem and "focal length" in problem for problem in found.problems)


def test_a_sound_dive_has_no_word_of_bars(dive: KnownDive) -> None:
    assert not smooth(dive.records, dive.fixes, dive.stamps_ns).problems


def test_a_live_track_of_bars_that_are_far_off_is_not_told(dive: KnownDive) -> None:
    records = stated(dive, 1, bar=1.06)
    track = filter_of(records, dive.fixes)
    rows: Iterable[TrackRow] = track.advance(last_ns(records), dive.stamps_ns)
    late = [row for row in rows if row.stamp_ns > dive.stamps_ns[len(dive.stamps_ns) // 2]]
    assert not late
    assert any("bar of" in problem for problem in track.problems)


def test_a_gap_adds_to_a_covariance_and_takes_nothing_off() -> None:
    state = a_state(np.random.default_rng(6))
    P, U = 1e-4 * np.eye(NAV + 1), np.full(NAV + 1, 0.1)
    more = with_gap(P, 0.02, U, state) - P
    np.testing.assert_allclose(more, more.T, atol=1e-12)
    assert np.linalg.eigvalsh(more).min() > -1e-12
    assert np.sqrt(state.r_m @ more[:3, :3] @ state.r_m) >= 0.01 * float(state.r_m @ state.r_m)
    np.testing.assert_array_equal(with_gap(P, 0.0, U, state), P)
