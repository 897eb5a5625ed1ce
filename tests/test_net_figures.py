"""What `net_figures` and `track_figures --told` tell estimates of each grade of units; those programs take minutes."""

import math

import numpy as np
import pytest
from buddyline.node.sim.inertial import GRADES, WALK_S
from buddyline.node.sim.randomness import Sway
from buddyline.solver_service.network import shaking, state
from buddyline.solver_service.track import start
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.samples import Samples
from buddyline.solver_service.track.walking import Walking

from tests.net_figures import told
from tests.solver_service.track.dives import Setting, make
from tests.told_units import WALKED
from tests.track_figures import KNOWN_S, told_units


def sigmas():
    return state.LEVER_TOLD_M, float(np.exp(0.5 * shaking._FIRST[0])), Samples().noise(0.0).gyro_bias_radps


@pytest.mark.parametrize("name", GRADES)
def test_the_simulators_own_sigmas_are_told_and_taken_back(name):
    lever_m, shake_rad, _ = before = sigmas()
    grade = GRADES[name]
    with told(grade):
        shaken_rad = shake_rad if grade.shake_radps else 1e-6
        assert sigmas() == pytest.approx((grade.lever_sigma_m, shaken_rad, WALKED * grade.gyro_walk_radps))
    assert lever_m != grade.lever_sigma_m
    assert sigmas() == before


def of_track(nodes):
    return (
        start.LEVER_TOLD_M,
        *Walking().densities[:2],
        *Walking().cautious().densities[:2],
        TrackFilter(*nodes).clock_sigma_s,
    )


@pytest.mark.parametrize("name", GRADES)
def test_a_track_is_told_them_and_they_are_taken_back(name):
    nodes = [record.node for record in make(1, Setting(seconds=1.0)).records]
    before, grade = of_track(nodes), GRADES[name]
    walks = WALKED * grade.gyro_walk_radps, WALKED * grade.accel_walk_mps2
    with told_units(grade):
        assert of_track(nodes) == pytest.approx((grade.lever_sigma_m, *walks, *walks, KNOWN_S), rel=0.01)
    assert of_track(nodes) == before


def test_the_walk_told_is_that_of_the_simulators_biases():
    """Over 10 s, of 300 biases' wandering parts of 1 sd."""
    rng = np.random.default_rng(1)
    sways = [Sway(rng, *WALK_S, 6) for _ in range(300)]
    changes = [(sway(t_s + 10.0) - sway(t_s)) / sway.sd for sway in sways for t_s in np.arange(0.0, 600.0, 20.0)]
    assert np.std(changes) == pytest.approx(WALKED * math.sqrt(10.0), rel=0.1)
