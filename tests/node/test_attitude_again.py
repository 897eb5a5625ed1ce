"""Attitudes once more: both directions of time are better than one, and as sure as they say."""

import numpy as np
import pytest
from buddyline.node.attitude import VqfAttitude, attitudes, quaternion_to_matrix
from buddyline.node.attitude_again import attitudes_again

from tests.node import swell
from tests.node.test_attitude import HERE, SOUND

pytest.importorskip("vqf", reason="vqf is not installed: make install EXTRAS=pi")


def errors_of(found, dive):
    """Errors in NED (n, 3) and sigmas (n, 3), rad."""
    index = [round((one.stamp_ns - swell.START_NS) / 1e9 * swell.RATE_HZ) for one in found]
    R = np.array([quaternion_to_matrix(np.array([one.q_ned_body_xyzw[k] for k in (3, 0, 1, 2)])) for one in found])
    errors = swell.matrix_to_vector(np.einsum("nij,nkj->nik", R, dive.R_ned_body[index]))
    return errors, np.array([one.sigma_rad for one in found])


def rms_deg(values):
    return float(np.degrees(np.sqrt((values**2).mean())))


def estimator():
    return VqfAttitude(SOUND, HERE)


@pytest.mark.parametrize(
    ("conditions", "heading", "tilt"),
    [
        ({"cooling_radps": np.radians(1.25) * np.array([1.0, -1.0, 1.0])}, 0.95, 0.95),
        ({"rest_s": 0.0}, 0.5, 0.5),
        ({}, 1.3, 1.3),
    ],
    ids=["cooling", "no rest", "sound"],
)
def test_both_ways_are_better_than_one_or_as_good(conditions, heading, tilt):
    """By the given factors; where one way is good, both are about as good."""
    dive = swell.simulate(60.0, seed=2, **conditions)
    log = swell.log_of(dive)
    once, _ = errors_of(list(attitudes(log, estimator())), dive)
    found = attitudes_again(log, estimator())
    both, sigmas = errors_of(found, dive)
    assert rms_deg(both[:, 2]) < heading * rms_deg(once[:, 2])
    assert rms_deg(both[:, :2]) < tilt * rms_deg(once[:, :2])
    assert np.mean(np.abs(both) < 2 * sigmas) > 0.95
    # Also before the start was over, and without the sample at which it turns back.
    assert found[0].stamp_ns == log[0].stamp_ns
    assert len(log) - len(found) <= 1


def test_stamps_rise_and_nothing_comes_of_nothing():
    assert attitudes_again([], estimator()) == []
    log = swell.log_of(swell.simulate(8.0))
    stamps = [one.stamp_ns for one in attitudes_again(log, estimator())]
    assert np.all(np.diff(stamps) > 0)
    assert attitudes_again(log[:5], estimator()) == []
