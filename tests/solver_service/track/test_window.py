"""Starts from single lamps: the Jacobian against numbers, and which lamps, how far, of a made dive."""

import math

import numpy as np
import pytest
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.lone import fits, state_of
from buddyline.solver_service.track.records import feed
from buddyline.solver_service.track.window import PARAMETERS, Fit, Window, gathered

from tests.solver_service.track.dives import EPOCH_NS, KnownDive, Setting, make

SECONDS = 14.0


def window_of(seed: int, dead: tuple[tuple[int, int], ...]) -> tuple[Window, KnownDive]:
    """The first seconds of a dive with dead lamps (node, light)."""
    dive = make(seed, Setting(seconds=SECONDS, dead=dead))
    track = TrackFilter(dive.records[0].node, dive.records[1].node, keep_s=math.inf)
    for node, record in enumerate(dive.records):
        feed(track, node, record)
    sights = [what for *_, what in sorted(track._events, key=lambda event: event[:3]) if isinstance(what, Sight)]
    start_s = track.seconds(0, EPOCH_NS) + 0.15
    found = gathered(track.nodes, track.samples, track.attitudes, track.depths, sights, start_s)
    assert found is not None
    return found, dive


def test_the_jacobian_of_the_lights_is_that_of_numbers() -> None:
    window, _ = window_of(5, ((0, 0), (1, 1)))
    rng = np.random.default_rng(3)
    R = np.stack([window.anchors.R[node][0] for node in (0, 1)])
    fit = Fit(np.array((3.0, 4.0, 0.5)), rng.normal(0.0, 0.3, 3), R, np.zeros((2, 15)))
    at = np.arange(0, len(window.times_s), 20)
    lights_m = np.tile((-0.44, 0.01, 0.02), (len(at), 1))
    for observer in (0, 1):
        _, J = window.lights(observer, at, lights_m, fit)
        for k in range(PARAMETERS):
            step = np.zeros(PARAMETERS)
            step[k] = 1e-5
            ahead, behind = (window.lights(observer, at, lights_m, fit.plus(d))[0] for d in (step, -step))
            assert np.abs((ahead - behind) / 2e-5 - J[:, :, k]).max() < 1e-3 * np.abs(J[:, :, k]).max() + 1e-3


@pytest.mark.parametrize(("seed", "dead_a", "dead_b"), [(5, 0, 1), (6, 1, 1)])
def test_seconds_of_one_lamp_each_tell_which_they_are_and_where(seed: int, dead_a: int, dead_b: int) -> None:
    window, dive = window_of(seed, ((0, dead_a), (1, dead_b)))
    found = fits(window)
    for fit in found:
        assert set(fit.seen[0][:, 2]) == {1 - dead_b}
        assert set(fit.seen[1][:, 2]) == {1 - dead_a}
    state, _ = state_of(window, found[0], 0.1)
    apart_m = np.linalg.norm(state.R[0].T @ state.r_m - dive.t_a_b_m[0])
    ahead = found[0].r / np.linalg.norm(found[0].r)
    sigma_m = math.sqrt(ahead @ np.linalg.inv(found[0].information)[:3, :3] @ ahead)
    assert sigma_m < 0.2 * np.linalg.norm(dive.t_a_b_m[0])
    assert apart_m < 3.0 * sigma_m + 0.05
