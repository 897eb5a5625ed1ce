"""Calibrate the positions of a pair's four lights. Both nodes look at each other, at rest, at taped distances.

Each place of the pair gives nine measurements (eight image coordinates and a distance) for the six unknowns of its
pose. The surplus determines the twelve coordinates of the lights, best with places of different distance, turn and
tilt. The entered positions are measurements too, with a sigma of about a centimetre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rotation import rotation_exp
from buddyline.tools.calibration.leastsquares import Floats, PoorCalibration, gauss_newton, require

LEAST_PLACES: Final = 5
MOST_CHI2: Final = 3.0
MOST_BAR_SIGMA_M: Final = 0.003


@dataclass(frozen=True)
class TapedPlace:
    """The pair at rest. pixels_a: (2, 2), B's left and right light in A's picture; pixels_b likewise.

    t_a_b_m, R_a_b: initial pose, solved with the entered lights. distance_m: taped, from camera to camera.
    """

    name: str
    pixels_a: Floats
    pixels_b: Floats
    t_a_b_m: Floats
    R_a_b: Floats
    distance_m: float


@dataclass(frozen=True)
class CalibrationNoise:
    """Standard deviations of the measurements: image coordinates, taped distances, entered light positions."""

    pixel_px: float = 0.5
    tape_m: float = 0.005
    ruler_m: float = 0.010


@dataclass(frozen=True)
class LightsFit:
    """Both nodes' lights (2, 2, 3): A's left and right, then B's, each in its own camera frame; sigma_m likewise.

    bar_sigma_m: 1 sd of each node's baseline, which scales all ranges. chi2: per degree of freedom, about 1 if the
    noise is as stated. tape_gaps_m: (n,), fitted minus taped distance. pixel_rms_px: (n,), of each place.
    """

    lights_m: Floats
    sigma_m: Floats
    bar_sigma_m: tuple[float, float]
    chi2: float
    pixel_rms_px: Floats
    tape_gaps_m: Floats


def fit(
    places: list[TapedPlace],
    cameras: tuple[Camera, Camera],
    entered: tuple[Floats, Floats],
    noise: CalibrationNoise | None = None,
) -> LightsFit:
    """Fit both nodes' lights; raise PoorCalibration if the places do not determine them. entered: (2, 3) each, m."""
    noise = noise or CalibrationNoise()
    n = len(places)
    require((n >= LEAST_PLACES, f"{n} places, {LEAST_PLACES} are needed, at different distances, turned and tilted"))
    first_lights = np.vstack(entered)
    first_t, first_R = np.array([place.t_a_b_m for place in places]), np.array([place.R_a_b for place in places])
    distances_m = np.array([place.distance_m for place in places])
    rays = [
        camera.rays(p) for place in places for camera, p in zip(cameras, (place.pixels_a, place.pixels_b), strict=True)
    ]
    # B's lights as A sees them, then A's as B sees them.
    bearings = np.array([bearing for bearing, _ in rays]).reshape(n, 4, 3)
    tangents = np.array([tangent for _, tangent in rays]).reshape(n, 4, 2, 3)
    if not np.isfinite(bearings).all():
        raise PoorCalibration("a light in a picture is outside the field that the camera's calibration covers")

    def residuals(x: Floats) -> Floats:
        """Return residuals in sigmas: for each place eight pixels and the tape, then twelve entered coordinates.

        x: corrections of the twelve coordinates of the lights, then of each pose: shift (3) and rotation (3).
        """
        moved = x[:12].reshape(4, 3)
        lights, poses = first_lights + moved, x[12:].reshape(n, 6)
        t, R = first_t + poses[:, :3], rotation_exp(poses[:, 3:]) @ first_R
        from_a = np.einsum("nij,kj->nki", R, lights[2:]) + t[:, None]
        from_b = np.einsum("nji,nkj->nki", R, lights[None, :2] - t[:, None])
        seen = np.concatenate((from_a, from_b), axis=1)
        along = np.einsum("nki,nki->nk", bearings, seen)
        off_px = np.einsum("nkij,nkj->nki", tangents, seen) / along[..., None]
        tape = (np.linalg.norm(t, axis=1) - distances_m) / noise.tape_m
        of_places = np.column_stack((off_px.reshape(n, 8) / noise.pixel_px, tape))
        return np.concatenate((of_places.ravel(), moved.ravel() / noise.ruler_m))

    x, J = gauss_newton(residuals, np.zeros(12 + 6 * n))
    left = residuals(x)
    covariance = np.asarray(np.linalg.inv(J.T @ J)[:12, :12], dtype=np.float64)
    lights_m = (first_lights + x[:12].reshape(4, 3)).reshape(2, 2, 3)
    of_places = left[: 9 * n].reshape(n, 9)
    found = LightsFit(
        lights_m=lights_m,
        sigma_m=np.sqrt(np.diag(covariance)).reshape(2, 2, 3),
        bar_sigma_m=(_bar_sigma(lights_m[0], covariance[:6, :6]), _bar_sigma(lights_m[1], covariance[6:, 6:])),
        # The entered coordinates count as measurements: twelve residuals, as many as their unknowns.
        chi2=float(left @ left) / (len(left) - len(x)),
        pixel_rms_px=np.sqrt((of_places[:, :8] ** 2).mean(axis=1)) * noise.pixel_px,
        tape_gaps_m=of_places[:, 8] * noise.tape_m,
    )
    worst = int(np.abs(found.tape_gaps_m).argmax())
    require(
        (
            bool(found.chi2 <= MOST_CHI2),
            f"the places contradict each other: residuals {np.sqrt(found.chi2):.1f} times the noise, "
            f"{found.pixel_rms_px.max():.2f} px, tape off by {found.tape_gaps_m[worst] * 1e3:+.0f} mm at "
            f"{places[worst].name}: check distances, and that nothing on the rigs moved",
        ),
        (
            max(found.bar_sigma_m) <= MOST_BAR_SIGMA_M,
            f"a bar's length would be known to {max(found.bar_sigma_m) * 1e3:.1f} mm only, "
            f"{MOST_BAR_SIGMA_M * 1e3:.0f} mm at most: add places, nearer, and tape their distances better",
        ),
    )
    return found


def _bar_sigma(lights_m: Floats, covariance: Floats) -> float:
    """Return the 1 sd of the distance between two lights (2, 3), from their covariance (6, 6)."""
    along = lights_m[1] - lights_m[0]
    slope = np.concatenate((-along, along)) / np.linalg.norm(along)
    return float(np.sqrt(slope @ covariance @ slope))
