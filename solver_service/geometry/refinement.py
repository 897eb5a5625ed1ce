"""Gauss-Newton on the eight image coordinates, with calibrated light positions, for many hypotheses at once."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats, rotation_near, skew
from buddyline.solver_service.geometry.scalars import ONE, ZERO
from numpy.typing import NDArray

_MAX_STEPS: Final = 12
# A step this small, relative to the range and in rad, leaves less than its square.
_SMALL: Final = 5e-4
# What a step may leave of the noise, as chi^2 after it shows that.
_LEFT: Final = 0.01
# A combination of coordinates that the picture determines this much worse than each alone is not determined.
_UNDETERMINED: Final = 1e10
DAMPING: Final = 1e-13 * np.eye(6)
_EYE: Final = np.eye(8)
# y @ _TURNED, reshaped to (3, 7), is what a turn w of y moves it by, w x y, before w, and y itself in the last column.
_UNTURNED: Final = np.eye(3)
_TURNED: Final = np.concatenate((np.zeros((3, 3, 3)), -skew(_UNTURNED), _UNTURNED[:, :, None]), 2).reshape(3, 21)
# Which sightings a later clock of B moves, and where to.
_SKEW_SIGNS: Final = 0.5 * np.repeat((1.0, 1.0, -1.0, -1.0), 2)[:, None]


@dataclass(eq=False, slots=True)
class Sightings:
    """Four lights as K hypotheses read them: B's left and right in A's image, A's left and right in B's.

    frames: (K, 4, 3, 3) bearing, then both tangents in pixels per radian over sigma_px, so that residuals have unit
    noise. dt_s: (K, 4) time of each sighting after the instant that the pose is for.
    """

    frames: Floats
    dt_s: Floats


@dataclass(eq=False)
class Motion:
    """How the pose moves: d/dt of t_a_b (m/s), then of the small rotation w (rad/s), in A's camera frame.

    rates: (6,), covariance: (6, 6). skew_sigma_s: how well the two clocks agree, 1 sd.
    """

    rates: Floats
    covariance: Floats
    skew_sigma_s: float = 0.0

    @cached_property
    def mean_squares(self) -> tuple[float, float]:
        """Of one component of the velocity, (m/s)^2, and of the turn, (rad/s)^2, as far as both are known."""
        squares = (self.covariance.diagonal() + self.rates**2).tolist()
        return sum(squares[:3]) / 3.0, sum(squares[3:]) / 3.0


@dataclass(eq=False, slots=True)
class Refined:
    """K poses: t_a_b_m (K, 3), R_a_b (K, 3, 3), covariance (K, 6, 6), chi2 (K,) of two degrees of freedom.

    covariance: of position in A's camera frame, then of the small rotation w with R_true = exp(w) R_a_b, in A's
    camera frame. sound: (K,), False where the pose is not determined or lies behind a camera.
    """

    t_a_b_m: Floats
    R_a_b: Floats
    covariance: Floats
    chi2: Floats
    sound: NDArray[np.bool_]


def refine(
    t_a_b_m: Floats,
    R_a_b: Floats,
    seen: Sightings,
    rig_a: Rig,
    rig_b: Rig,
    motion: Motion,
) -> Refined:
    """Refine K poses, t_a_b_m (K, 3) and R_a_b (K, 3, 3)."""
    t, R = t_a_b_m, R_a_b
    lights = rig_a.lights_m, rig_b.lights_m
    timed = bool(np.count_nonzero(seen.dt_s))
    shifts = shifts_of(seen.dt_s, motion.rates) if timed else None
    weight = None
    steps = 0
    while True:
        J, depth = linearize(t, R, seen, lights, shifts)
        if steps == 0 and (timed or motion.skew_sigma_s > 0.0):
            weight = weight_of(J[:, :, :6], seen.dt_s, motion)
        Jt = J.swapaxes(1, 2)
        normal = (Jt if weight is None else Jt @ weight) @ J
        covariance, inverse, move, chi2 = solve_normal(normal)
        if steps == _MAX_STEPS:
            chi2 = normal[:, 6, 6]
            break
        t, R = moved(t, R, move)
        steps += 1
        if not is_large(move, t, normal[:, 6, 6], chi2):
            break
    each = zip(inverse.diagonal(0, 1, 2).tolist(), depth.tolist(), chi2.tolist(), strict=True)
    # A step that is not finite makes chi^2 not finite either.
    sound = [max(openness) < _UNDETERMINED and min(far) > 0.0 and math.isfinite(off) for openness, far, off in each]
    return Refined(t, R, covariance, np.maximum(chi2, ZERO), np.array(sound))


def solve_normal(normal: Floats) -> tuple[Floats, NDArray[np.floating[Any]], Floats, Floats]:
    """Solve normal equations (K, 7, 7) of derivatives by the pose and, in the last row and column, residuals.

    Returns covariances (K, 6, 6), the same over what each coordinate alone would have, the steps (K, 6) and what
    chi^2 is after them (K,).
    """
    H, g = normal[:, :6, :6], normal[:, :6, 6:]
    # Positions and rotations have their own units: scaled to a unit diagonal before solving.
    unit = ONE / np.sqrt(H.diagonal(0, 1, 2))
    scale = unit[:, :, None] * unit[:, None]
    inverse = np.linalg.inv(H * scale + DAMPING)
    covariance = inverse * scale
    move = covariance @ g
    chi2 = normal[:, 6, 6] - (move.swapaxes(1, 2) @ g)[:, 0, 0]
    return covariance, inverse, move[:, :, 0], chi2


def moved(t: Floats, R: Floats, move: Floats) -> tuple[Floats, Floats]:
    """Take steps (K, 6) off K poses."""
    return t - move[:, :3], rotation_near(-move[:, 3:]) @ R


def is_large(move: Floats, t: Floats, before: Floats, chi2: Floats) -> bool:
    """Whether any of the steps (K, 6) leaves what matters; they led to t (K, 3), and from chi^2 before (K,) to chi2."""
    each = zip(move.tolist(), t.tolist(), before.tolist(), chi2.tolist(), strict=True)
    for step, place_m, at_first, at_last in each:
        size = max(max(map(abs, step[:3])) / (math.hypot(*place_m) or 1.0), *map(abs, step[3:]))
        # The geometry changes by about this share over the step, and so the step: in sd, the root of what chi^2 loses.
        if size > _SMALL and size * size * (at_first - at_last) > _LEFT**2 * at_last:
            return True
    return False


def shifts_of(dt_s: Floats, rates: Floats) -> tuple[Floats, Floats] | None:
    """Give how far (K, 4, 3) the pose has moved and turned (K, 4, 3, 3) at each sighting, None where it rests."""
    if not np.count_nonzero(rates):
        return None
    shift = dt_s[:, :, None] * rates
    return shift[:, :, :3], rotation_near(shift[:, :, 3:])


def linearize(
    t: Floats, R: Floats, seen: Sightings, lights: tuple[Floats, Floats], shifts: tuple[Floats, Floats] | None
) -> tuple[Floats, Floats]:
    """Give the derivatives of the residuals by the pose, the residuals as a seventh column (K, 8, 7), and distances.

    shifts: of the pose at each sighting, as by `shifts_of`. The distances (K, 4) are those along the bearings.
    """
    K = len(t)
    Rt = R.swapaxes(1, 2)
    # The lights about the point that the pose turns them about, in A's axes: B's about B, A's seen from B.
    y = np.empty((K, 4, 3))
    np.matmul(lights[1], Rt, out=y[:, :2])
    np.subtract(lights[0], t[:, None], out=y[:, 2:])
    if shifts is not None:
        shift, turn = shifts
        y[:, :2] = (turn[:, :2] @ y[:, :2, :, None])[..., 0]
        y[:, 2:] = ((y[:, 2:] - shift[:, 2:])[:, :, None] @ turn[:, 2:])[:, :, 0]
    # From the camera to the light, q, behind its derivatives. All in A's axes; what B sees is taken backwards, from the
    # light to B: then t moves all four alike, and so does a turn w, by w x y.
    arms = (y @ _TURNED).reshape(K, 4, 3, 7)
    arms[..., :3] = _UNTURNED
    q = arms[..., 6]
    q[:, :2] += t[:, None]
    np.negative(q[:, 2:], out=q[:, 2:])
    if shifts is not None:
        q[:, :2] += shift[:, :2]
    frames = seen.frames.copy()
    np.matmul(seen.frames[:, 2:], -Rt[:, None], out=frames[:, 2:])
    # How q and its derivatives extend along the bearing and along both tangents.
    extent = frames @ arms
    along, across = extent[:, :, :1], extent[:, :, 1:]
    depth = along[..., 6:]
    r = across[..., 6:] / depth
    J = across - r * along
    J /= depth
    J[..., 6:] = r
    return J.reshape(K, 8, 7), depth[:, :, 0, 0]


def weight_of(J: Floats, dt_s: Floats, motion: Motion) -> Floats:
    """Give the inverse covariance (K, 8, 8) of the residuals: pixel noise, and what is not known of the motion."""
    by_rate = J * dt_s.repeat(2, 1)[:, :, None]
    total: Floats = _EYE + by_rate @ motion.covariance @ by_rate.swapaxes(1, 2)
    if motion.skew_sigma_s > 0.0:
        square = motion.covariance + np.outer(motion.rates, motion.rates)
        by_skew = J * (motion.skew_sigma_s * _SKEW_SIGNS)
        total += by_skew @ square @ by_skew.swapaxes(1, 2)
    if not np.isfinite(np.add.reduce(total, None)):
        total[~np.isfinite(total.sum(axis=(1, 2)))] = _EYE
    return np.asarray(np.linalg.inv(total), dtype=np.float64)
