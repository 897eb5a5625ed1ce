"""What lights' residuals tell of how much an inertial unit is shaken in its mount."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from buddyline.solver_service.geometry.evidence import GROSS_PX
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.association import associate, doubt_of, variance_of
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.state import NAV, PHI

FOCAL_PX, SIGMA_PX = 900.0, 0.7
# A light's residual (2,) by the errors of the observer's attitude.
H = np.zeros((2, NAV))
H[:, PHI[0].start], H[:, PHI[0].start + 1] = (0.0, FOCAL_PX), (FOCAL_PX, 0.0)


def learned(
    shaken_rad: Callable[[int], float], pictures: int, rng: np.random.Generator, *, censored: bool = False
) -> Floats:
    """Return what is learned (N,) of the angle of a unit whose camera sees one light, 1 sd, rad, picture by picture.

    The light is found and weighed as a track does. censored: learn from the variance that moves the track.
    """
    shaking, found = Shaking(), np.zeros(pictures)
    nowhere = np.full(2, np.inf)
    for n in range(pictures):
        parts = np.zeros((3, NAV, NAV))
        parts[0, PHI[0], PHI[0]] = shaking.variances[0] * np.eye(3)
        y = rng.normal(0.0, np.hypot(SIGMA_PX, FOCAL_PX * shaken_rad(n)), 2)
        sigma_px = np.array((SIGMA_PX,))
        seen = associate(
            np.array([[y, nowhere]]), np.array([[H, H]]), parts[0], sigma_px, np.array((0.9, 0.9)), 8.0 / (1640 * 1232)
        )
        if seen.chosen:
            variances = np.array([variance for *_, variance in seen.chosen])
            noise_px2 = variances - (0.0 if censored else doubt_of(variances[0], SIGMA_PX))
            S_inverse = np.linalg.inv(H @ parts[0] @ H.T + noise_px2 * np.eye(2))
            shaking = shaking.taught(y, S_inverse, H, parts)
        found[n] = np.sqrt(shaking.variances[0])
    return found


def test_large_residuals_tell_of_shaking_too() -> None:
    """With the variance that moves a track, which may hold a gross error, a quarter of the angle would be lost."""
    true_rad = 1.4e-3
    of_all = learned(lambda _: true_rad, 3000, np.random.default_rng(1))[500:]
    censored = learned(lambda _: true_rad, 3000, np.random.default_rng(1), censored=True)[500:]
    assert np.median(of_all) == pytest.approx(true_rad, rel=0.1)
    assert np.median(censored) < 0.85 * true_rad


@pytest.mark.parametrize("seed", range(5))
def test_shaking_that_begins_or_ends_is_believed_soon(seed: int) -> None:
    """A pair sees twenty pictures a second, and a diver who was at rest swims off."""
    true_rad = 1.4e-3
    begins = learned(lambda n: true_rad if n >= 400 else 0.0, 800, np.random.default_rng(seed))
    assert np.median(begins[300:400]) < 0.3 * true_rad
    assert np.median(begins[460:520]) > 0.75 * true_rad
    ends = learned(lambda n: true_rad if n < 400 else 0.0, 800, np.random.default_rng(seed))
    assert np.median(ends[300:400]) > 0.7 * true_rad
    assert np.median(ends[700:800]) < 0.45 * true_rad


def test_what_is_rather_a_gross_error_tells_nothing_of_shaking() -> None:
    for sigma_px, gross, left_px2 in ((0.7, 0.0, 0.49), (0.7, 0.2, 0.49), (0.5, 0.4, 0.25), (0.5, 0.9, 44.35)):
        variance = variance_of(sigma_px, 1.0 - gross, gross)
        assert variance - doubt_of(variance, sigma_px) == pytest.approx(left_px2)
        assert variance == pytest.approx(sigma_px**2 + gross * GROSS_PX**2)
