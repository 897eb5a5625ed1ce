"""What lights' residuals tell of how much an inertial unit is shaken in its mount."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from buddyline.solver_service.geometry.evidence import GROSS_PX
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track import shaking
from buddyline.solver_service.track.association import associate, doubt_of, variance_of
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.seeing import told_by
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.state import MOVING, NAV, PHI, SIZE, State
from buddyline.solver_service.track.strapdown import predicted

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
    told, found = Shaking(), np.zeros(pictures)
    nowhere = np.full(2, np.inf)
    for n in range(pictures):
        parts = np.zeros((3, NAV, NAV))
        parts[0, PHI[0], PHI[0]] = told.variances[0] * np.eye(3)
        y = rng.normal(0.0, np.hypot(SIGMA_PX, FOCAL_PX * shaken_rad(n)), 2)
        sigma_px = np.array((SIGMA_PX,))
        seen = associate(
            np.array([[y, nowhere]]), np.array([[H, H]]), parts[0], sigma_px, np.array((0.9, 0.9)), 8.0 / (1640 * 1232)
        )
        if seen.chosen:
            variances = np.array([variance for *_, variance in seen.chosen])
            noise_px2 = variances - (0.0 if censored else doubt_of(variances[0], SIGMA_PX))
            S_inverse = np.linalg.inv(H @ parts[0] @ H.T + noise_px2 * np.eye(2))
            told = told.taught(y, S_inverse, H, parts, np.zeros((NAV, 3)))
        found[n] = np.sqrt(told.variances[0])
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


def test_the_slope_is_that_of_the_likelihood(monkeypatch: pytest.MonkeyPatch) -> None:
    """Along a track: by what its shaking's logs change in the covariance, and in the state."""
    rng = np.random.default_rng(2)
    steps, m = 12, 4
    drawn = np.zeros((3, MOVING, MOVING))
    for part in drawn:
        root = 0.1 * rng.normal(size=(MOVING, 6))
        part[:] = root @ root.T
    F = np.eye(MOVING, SIZE) + 0.05 * rng.normal(size=(MOVING, SIZE)) * (np.arange(SIZE) < MOVING)
    H = np.zeros((steps, m, SIZE))
    H[:, :, :NAV] = rng.normal(size=(steps, m, NAV))
    seen = rng.normal(0.0, 3.0, (steps, m))
    slopes: list[Floats] = []

    def kept(logs: Floats, information: Floats, slope: Floats, *_: object) -> tuple[Floats, Floats]:
        slopes.append(slope)
        return logs, information

    monkeypatch.setattr(shaking, "learned", kept)

    def log_likelihood(logs: Floats) -> float:
        track = Estimate(0.0, State.at_rest(np.ones(3), np.stack([np.eye(3)] * 2)), np.eye(SIZE), 0.0, learns=False)
        error, log_l = np.zeros(SIZE), 0.0
        noises = np.exp(logs)[:, None, None] * drawn
        for n in range(steps):
            error[:MOVING] = F @ error
            onward = F[:, :MOVING]
            track.covariance = predicted(track.covariance, F, noises.sum(axis=0), np.zeros(SIZE - MOVING))
            track.shaken = onward @ track.shaken @ onward.T + noises
            track.by_shaking = onward @ track.by_shaking
            y, S = seen[n] - H[n] @ error, H[n] @ track.covariance @ H[n].T + np.eye(m)
            log_l -= 0.5 * (y @ np.linalg.solve(S, y) + np.linalg.slogdet(S)[1])
            error = error + told_by(track, H[n], y, np.eye(m), doubts=np.zeros(m))[0]
        return log_l

    logs, step = np.array((0.3, -0.5, 0.1)), 1e-4
    log_likelihood(logs)
    found = np.sum(slopes, axis=0)
    expected = [(log_likelihood(logs + step * e) - log_likelihood(logs - step * e)) / (2.0 * step) for e in np.eye(3)]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_what_is_rather_a_gross_error_tells_nothing_of_shaking() -> None:
    for sigma_px, gross, left_px2 in ((0.7, 0.0, 0.49), (0.7, 0.2, 0.49), (0.5, 0.4, 0.25), (0.5, 0.9, 44.35)):
        variance = variance_of(sigma_px, 1.0 - gross, gross)
        assert variance - doubt_of(variance, sigma_px) == pytest.approx(left_px2)
        assert variance == pytest.approx(sigma_px**2 + gross * GROSS_PX**2)
