"""A node's inertial samples between any two times."""

from __future__ import annotations

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track.moving import increments
from buddyline.solver_service.track.samples import Samples, false_ones

from tests.solver_service.track.test_track_jacobians import a_state

TIMES_S = np.array((1.0, 1.01, 1.02, 1.03))


@pytest.mark.parametrize(("start_s", "end_s"), [(1.01, 1.01), (1.015, 1.015), (1.02, 1.005), (2.0, 2.0), (0.5, 0.5)])
def test_no_time_and_time_backwards_are_one_interval(start_s: float, end_s: float) -> None:
    samples = Samples()
    samples.add(TIMES_S, np.outer(TIMES_S, np.ones(6)))
    grid, at, told = samples.between(start_s, end_s, known_s=3.0)
    assert grid.tolist() == [start_s, end_s]
    assert at[:, :6] == pytest.approx(np.outer(np.clip(grid, 1.0, 1.03), np.ones(6)))
    assert told.shape == (1,)


def test_the_samples_between_are_points_of_the_grid() -> None:
    samples = Samples()
    samples.add(TIMES_S, np.outer(TIMES_S, np.ones(6)))
    grid, at, told = samples.between(1.005, 1.03, known_s=3.0)
    assert grid.tolist() == [1.005, 1.01, 1.02, 1.03]
    assert at[:, 0] == pytest.approx(grid)
    assert told.all()


def swum(count: int = 400) -> tuple[Floats, Floats]:
    """Return samples (N,), (N, 6) of a unit at 100 Hz that swims, with their noise."""
    rng = np.random.default_rng(5)
    t: Floats = 0.01 * np.arange(count, dtype=np.float64)
    force = np.array((0.0, 0.0, -9.8)) + 0.5 * np.sin(3.0 * t)[:, None] + rng.normal(0.0, 0.1, (count, 3))
    rate = 0.8 * np.sin(2.0 * t)[:, None] + rng.normal(0.0, 0.01, (count, 3))
    return t, np.asarray(np.hstack((force, rate)), np.float64)


FALSE = [7, 90, 91, 92, 250, 399]


def spoiled() -> tuple[Floats, Floats]:
    """Return samples of which those of FALSE are false, each in its own way."""
    t, values = swum()
    values[7, 3:], values[90], values[91:93], values[250, 4] = 9.0, 0.0, -30.0, 4.36
    values[399, :3] = 60.0, -60.0, 60.0
    return t, values


@pytest.mark.parametrize("at_once", [1, 3, 400])
def test_a_false_sample_is_left_out_and_counted(at_once: int) -> None:
    """One message holds one sample, or some, and says nothing of the next."""
    t, values = spoiled()
    samples = Samples()
    for first in range(0, len(t), at_once):
        samples.add(t[first : first + at_once], values[first : first + at_once])
    np.testing.assert_array_equal(samples.times_s, np.delete(t, FALSE))
    np.testing.assert_array_equal(samples.values, np.delete(values, FALSE, axis=0))
    assert samples.rejected == len(FALSE)


def test_a_false_sample_that_comes_late_is_left_out() -> None:
    t, values = spoiled()
    samples = Samples()
    order = np.r_[0:80, 85:100, 80:85, 100:399]
    order[92:95] = order[92:95][::-1]
    for k in order.tolist():
        samples.add(t[k : k + 1], values[k : k + 1])
    np.testing.assert_array_equal(samples.times_s, np.delete(t[:399], FALSE[:-1]))
    assert samples.rejected == len(FALSE) - 1


@pytest.mark.parametrize("at_once", [1, 400])
def test_what_lasts_is_true_after_two_samples(at_once: int) -> None:
    """A housing that is struck, a unit that has been turned over while its log had a gap."""
    t, values = swum()
    values[200:] += 7.0
    t = np.concatenate((t[:300], t[300:] + 0.2))
    values[300:, :3] -= 30.0
    samples = Samples()
    for first in range(0, len(t), at_once):
        samples.add(t[first : first + at_once], values[first : first + at_once])
    np.testing.assert_array_equal(samples.times_s, np.delete(t, (200, 201)))


def test_a_false_sample_that_is_sent_twice_is_false() -> None:
    t, values = spoiled()
    samples = Samples()
    for k in range(len(t)):
        samples.add(t[[k]], values[[k]])
        samples.add(t[[k]], values[[k]])
    np.testing.assert_array_equal(samples.times_s, np.delete(t, FALSE))
    assert samples.rejected == len(t) + len(FALSE)


def test_motion_and_noise_are_not_false() -> None:
    """A head turned by half a radian within 0.6 s, blows of fins, and noise ten times that of a cheap unit."""
    t, values = swum(1000)
    rng = np.random.default_rng(6)
    values[:, :3] += rng.normal(0.0, 0.3, (1000, 3))
    values[:, 3:] += rng.normal(0.0, 0.04, (1000, 3))
    values[500:560, 3:] += 1.6 * np.sin(np.linspace(0.0, np.pi, 60))[:, None]
    values[600:620, :3] += 8.0 * np.sin(np.linspace(0.0, np.pi, 20))[:, None]
    assert not false_ones(t, values).any()


@pytest.mark.parametrize("at_once", [1, 1000])
def test_of_a_unit_that_vibrates_torn_samples_alone_are_false(at_once: int) -> None:
    """A thruster beside the accelerometer: what is far for others is common there."""
    t, values = swum(1000)
    values[:, :3] += np.random.default_rng(7).normal(0.0, 2.0, (1000, 3))
    values[600], values[700, 3:] = 60.0, 9.0
    samples = Samples()
    for first in range(0, len(t), at_once):
        samples.add(t[first : first + at_once], values[first : first + at_once])
    left_out = np.setdiff1d(t, samples.times_s)
    assert {6.0, 7.0} <= set(np.round(left_out, 2).tolist())
    assert len(left_out[left_out > 0.4]) < 8


def test_a_node_is_carried_on_by_its_mean_turn_rate_in_the_cameras_axes() -> None:
    """Over two thirds of 30 ms, on for B and back for A, at a constant acceleration; by 2 ms it keeps its rate."""
    state, t_s = a_state(2), np.arange(0.0, 2.0, 0.01)
    rate, faster = np.array((0.3, -0.2, 0.4)), np.array((2.0, 1.5, -2.5))
    samples = Samples()
    samples.add(t_s, np.hstack((np.zeros((len(t_s), 3)), rate + t_s[:, None] * faster)))
    for carried_s, mean_s in ((0.03, 0.01), (0.002, 0.0)):
        parts = increments([samples, samples], state, 1.0, 1.1, carried_s=(-carried_s, carried_s))
        for node, sign in enumerate((-1.0, 1.0)):
            raw = rate + (1.1 + state.delay_s[node] + sign * mean_s) * faster
            true = rotation_exp(state.mount_rad[node]) @ (raw - state.gyro_bias_radps[node])
            assert parts.rate_radps[node] == pytest.approx(true, abs=1e-9)
