"""Where a pair's four lights are on their rigs: both nodes look at each other, at rest, at taped distances.

From each place of the pair come eight coordinates and a distance for six unknowns; what is left over tells the
twelve coordinates of the lights, the better the more the places differ in distance, turn and tilt. Rulers come
first: the entered positions count as measured to about a centimetre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.rotation import rotation_exp
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LEAST_STATIONS: Final = 5
ROUNDS: Final = 30
MOST_CHI2: Final = 3.0
MOST_BAR_SIGMA_M: Final = 0.003
STEP: Final = 1e-6


class PoorLights(BuddylineError):  # noqa: N818
    """Places that do not tell the lights; the text says what to do."""


@dataclass(frozen=True)
class Station:
    """The pair at rest. pixels_a: (2, 2), B's left and right light in A's picture; pixels_b likewise.

    t_a_b_m, R_a_b: first pose, from the entered lights. distance_m: taped, from camera to camera.
    """

    name: str
    pixels_a: Floats
    pixels_b: Floats
    t_a_b_m: Floats
    R_a_b: Floats
    distance_m: float


@dataclass(frozen=True)
class Noise:
    """What the measurements are good to, 1 sd."""

    pixel_px: float = 0.5
    tape_m: float = 0.005
    ruler_m: float = 0.010


@dataclass(frozen=True)
class LightsFit:
    """Lights (2, 3) left and right in each node's camera frame, with sigma_m likewise.

    bar_sigma_m: of the distance between each node's lights, which ranges hang on. chi2: of a degree of freedom,
    about 1 where the noise is as stated. tape_gaps_m: (n,) fitted minus taped. pixel_rms_px: (n,), of each station.
    """

    lights_a_m: Floats
    lights_b_m: Floats
    sigma_a_m: Floats
    sigma_b_m: Floats
    bar_sigma_m: tuple[float, float]
    chi2: float
    pixel_rms_px: Floats
    tape_gaps_m: Floats


def fit(
    stations: list[Station],
    cameras: tuple[Camera, Camera],
    entered: tuple[Floats, Floats],
    noise: Noise | None = None,
) -> LightsFit:
    """Fit both nodes' lights, from entered (2, 3) each; raise PoorLights where the stations do not tell them."""
    noise = noise or Noise()
    if len(stations) < LEAST_STATIONS:
        raise PoorLights(
            f"{len(stations)} places, {LEAST_STATIONS} are needed, at different distances, turned and tilted"
        )
    problem = _Problem(stations, cameras, entered, noise)
    state = problem.start()
    for _ in range(ROUNDS):
        residuals, J = problem.linearize(state)
        step = np.asarray(np.linalg.lstsq(J, -residuals, rcond=None)[0], dtype=np.float64)
        state = problem.moved(state, step)
        if np.abs(step).max() < 1e-7:
            break
    residuals, J = problem.linearize(state)
    # The rulers' residuals are twelve more, for the twelve lights' coordinates.
    freedom = len(residuals) - J.shape[1]
    chi2 = float(residuals @ residuals) / freedom
    covariance = np.asarray(np.linalg.inv(J.T @ J)[:12, :12], dtype=np.float64)
    sigma = np.sqrt(np.diag(covariance)).reshape(4, 3)
    parts = residuals[: 9 * len(stations)].reshape(-1, 9)
    found = LightsFit(
        lights_a_m=state.lights[:2],
        lights_b_m=state.lights[2:],
        sigma_a_m=sigma[:2],
        sigma_b_m=sigma[2:],
        bar_sigma_m=(
            _bar_sigma(state.lights[:2], covariance[:6, :6]),
            _bar_sigma(state.lights[2:], covariance[6:, 6:]),
        ),
        chi2=chi2,
        pixel_rms_px=np.sqrt((parts[:, :8] ** 2).mean(axis=1)) * noise.pixel_px,
        tape_gaps_m=parts[:, 8] * noise.tape_m,
    )
    _check(found, stations)
    return found


def _check(found: LightsFit, stations: list[Station]) -> None:
    if not np.isfinite(found.chi2) or found.chi2 > MOST_CHI2:
        worst = int(np.abs(found.tape_gaps_m).argmax())
        raise PoorLights(
            f"the places contradict each other: residuals {np.sqrt(found.chi2):.1f} times the noise, "
            f"{found.pixel_rms_px.max():.2f} px, tape off by {found.tape_gaps_m[worst] * 1e3:+.0f} mm at "
            f"{stations[worst].name}: check distances, and that nothing on the rigs moved"
        )
    worst_m = max(found.bar_sigma_m)
    if worst_m > MOST_BAR_SIGMA_M:
        raise PoorLights(
            f"a bar's length would be known to {worst_m * 1e3:.1f} mm only, {MOST_BAR_SIGMA_M * 1e3:.0f} mm at most: "
            "add places, nearer, and tape their distances better"
        )


def _bar_sigma(lights_m: Floats, covariance: Floats) -> float:
    """Return the 1 sd of the distance between two lights (2, 3), of their covariance (6, 6)."""
    along = lights_m[1] - lights_m[0]
    along = along / np.linalg.norm(along)
    slope = np.concatenate((-along, along))
    return float(np.sqrt(slope @ covariance @ slope))


@dataclass(frozen=True)
class _State:
    """lights: (4, 3), A's left and right, then B's. t (n, 3), R (n, 3, 3): the poses T_a_b."""

    lights: Floats
    t: Floats
    R: Floats


class _Problem:
    def __init__(
        self, stations: list[Station], cameras: tuple[Camera, Camera], entered: tuple[Floats, Floats], noise: Noise
    ) -> None:
        self._noise = noise
        self._entered = np.vstack(entered)
        self._stations = stations
        self._distances_m = np.array([station.distance_m for station in stations])
        rays_a = [cameras[0].rays(station.pixels_a) for station in stations]
        rays_b = [cameras[1].rays(station.pixels_b) for station in stations]
        self._bearings = np.array([np.vstack((a[0], b[0])) for a, b in zip(rays_a, rays_b, strict=True)])
        self._tangents = np.array([np.vstack((a[1], b[1])) for a, b in zip(rays_a, rays_b, strict=True)])
        if not np.isfinite(self._bearings).all():
            raise PoorLights("a light's picture is outside of what the camera's calibration covers")

    def start(self) -> _State:
        """Return the entered lights and first poses."""
        return _State(
            self._entered,
            np.array([station.t_a_b_m for station in self._stations]),
            np.array([station.R_a_b for station in self._stations]),
        )

    def moved(self, state: _State, step: Floats) -> _State:
        """Return the state moved by a step: lights (12), then shift (3) and turn (3) of each pose."""
        poses = step[12:].reshape(-1, 6)
        turned = np.array([rotation_exp(turn) @ R for turn, R in zip(poses[:, 3:], state.R, strict=True)])
        return _State(state.lights + step[:12].reshape(4, 3), state.t + poses[:, :3], turned)

    def residuals(self, state: _State) -> tuple[Floats, Floats]:
        """Return the stations' residuals (n, 9), in sigmas: eight pixels and the tape; and the rulers' (12,)."""
        from_a = np.einsum("nij,kj->nki", state.R, state.lights[2:]) + state.t[:, None, :]
        from_b = np.einsum("nji,nkj->nki", state.R, state.lights[None, :2] - state.t[:, None, :])
        seen = np.concatenate((from_a, from_b), axis=1)
        along = np.einsum("nki,nki->nk", self._bearings, seen)
        off_px = np.einsum("nkij,nkj->nki", self._tangents, seen) / along[..., None]
        tape = (np.linalg.norm(state.t, axis=1) - self._distances_m) / self._noise.tape_m
        stations = np.column_stack((off_px.reshape(len(tape), 8) / self._noise.pixel_px, tape))
        return stations, (state.lights - self._entered).ravel() / self._noise.ruler_m

    def linearize(self, state: _State) -> tuple[Floats, Floats]:
        """Return all residuals (9 n + 12,) and their derivatives, by central differences."""
        n = len(self._stations)
        base, rulers = self.residuals(state)
        J = np.zeros((9 * n + 12, 12 + 6 * n))
        for i in range(12):
            step = np.zeros(12 + 6 * n)
            step[i] = STEP
            J[: 9 * n, i] = self._slope(state, step).ravel()
        J[9 * n :, :12] = np.eye(12) / self._noise.ruler_m
        for i in range(6):
            step = np.zeros(12 + 6 * n)
            step[12 + i :: 6] = STEP  # each station has its own pose: all of them at once
            slopes = self._slope(state, step)
            for station in range(n):
                J[9 * station : 9 * station + 9, 12 + 6 * station + i] = slopes[station]
        return np.concatenate((base.ravel(), rulers)), J

    def _slope(self, state: _State, step: Floats) -> Floats:
        ahead, _ = self.residuals(self.moved(state, step))
        behind, _ = self.residuals(self.moved(state, -step))
        slope: Floats = (ahead - behind) / (2 * STEP)
        return slope
