"""Gauss-Newton on the eight image coordinates, with calibrated light positions, for many readings at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.past import Motion
from buddyline.solver_service.geometry.rotation import Floats, Index, inner, skew
from buddyline.solver_service.geometry.se3 import SE3
from numpy.typing import NDArray

_MAX_STEPS: Final = 12
# A step this small, relative to the range and in rad, leaves less than its square.
_SMALL: Final = 5e-4
# The error that a step may leave, as a share of the noise; the noise is estimated by chi^2 after the step.
_LEFT: Final = 0.01
# A combination of coordinates that the picture determines this much worse than each alone is not determined.
_UNDETERMINED: Final = 1e10
# The normal matrix times this, element by element, can always be inverted.
_DAMPED: Final = 1.0 + 1e-13 * np.eye(6)
# How the vectors to B's two lights and back to A's two change with a step dt, in A's axes (4, 3, 3).
_BY_POSITION: Final = np.array((1.0, 1.0, -1.0, -1.0))[:, None, None] * np.eye(3)
# Eight picture coordinates and three of the sensors.
_UNIT_NOISE: Final = np.eye(11)


@dataclass(eq=False, slots=True)
class Solved:
    """The least squares of K poses: steps (K, 6) to take, covariance (K, 6, 6) of T_a_b.retract, chi2 (K,) after it.

    lost: (K,) by how much the step lowers chi^2. open: (K, 6) how much worse each coordinate is known beside the others
    than alone (variances). log_noise: (K,) half the log determinant of the residuals' covariance.
    """

    step: Floats
    covariance: Floats
    chi2: Floats
    lost: Floats
    open: Floats
    log_noise: Floats

    def __getitem__(self, index: Index) -> Solved:
        """Choose some."""
        return Solved(*(getattr(self, each.name)[index] for each in fields(self)))


@dataclass(eq=False, slots=True)
class Refined:
    """K poses where they were last linearized, and what is left to take there: the last step.

    rows: (K, n, 7) residuals of unit noise there: derivatives by a step, then the residuals themselves. sound: (K,),
    False where the pose is not determined or lies behind a camera.
    """

    T_a_b: SE3
    rows: Floats
    solved: Solved
    sound: NDArray[np.bool_]


def refine(T_a_b: SE3, rows_at: Callable[[SE3, Index], tuple[Floats, Floats]], max_steps: int = _MAX_STEPS) -> Refined:
    """Refine K poses, each until the last step leaves little of the noise.

    rows_at: gives rows (K, n, 7), and the distances of the lights along their bearings (K, 4), at the poses chosen by
    an index.
    """
    rows, depth = rows_at(T_a_b, slice(None))
    solved = least_squares(rows)
    (left,) = _is_large(solved, T_a_b.t_m).nonzero()
    if len(left):
        T_a_b = SE3(T_a_b.R.copy(), T_a_b.t_m.copy())
    R, t = T_a_b.R, T_a_b.t_m
    for _ in range(max_steps - 1):
        if not len(left):
            break
        moved = SE3(R[left], t[left]).retract(solved.step[left])
        R[left], t[left] = moved.R, moved.t_m
        rows[left], depth[left] = rows_at(moved, left)
        part = least_squares(rows[left])
        solved.step[left], solved.covariance[left], solved.chi2[left] = part.step, part.covariance, part.chi2
        solved.open[left] = part.open
        left = left[_is_large(part, moved.t_m)]
    # A step that is not finite makes chi^2 not finite either.
    sound = (
        (np.maximum.reduce(solved.open, 1) < _UNDETERMINED)
        & (np.minimum.reduce(depth, 1) > 0.0)
        & np.isfinite(solved.chi2)
    )
    return Refined(T_a_b, rows, solved, sound)


def least_squares(rows: Floats, covariance: Floats | None = None) -> Solved:
    """Solve K times for the step that makes rows (K, n, 7) least; covariance: (K, n, n) of the residuals."""
    weighted = rows if covariance is None else np.asarray(np.linalg.solve(covariance, rows))
    normal = rows.swapaxes(1, 2) @ weighted
    H, g = normal[:, :6, :6], normal[:, :6, 6:]
    of_step = np.asarray(np.linalg.inv(H * _DAMPED), dtype=np.float64)
    back = of_step @ g
    lost = (back.swapaxes(1, 2) @ g)[:, 0, 0]
    chi2 = np.maximum(normal[:, 6, 6] - lost, 0.0)
    log_noise = np.zeros(len(rows)) if covariance is None else 0.5 * np.asarray(np.linalg.slogdet(covariance)[1])
    return Solved(-back[:, :, 0], of_step, chi2, lost, of_step.diagonal(0, 1, 2) * H.diagonal(0, 1, 2), log_noise)


def _is_large(solved: Solved, t: Floats) -> NDArray[np.bool_]:
    """Tell which steps leave an error that matters; t: (K, 3) before them."""
    moved = np.abs(solved.step)
    moved[:, :3] /= np.sqrt(inner(t, t))[:, None]
    size = np.maximum.reduce(moved, 1)
    # The geometry changes by about this share over the step, and so the step: in sd, the root of what chi^2 loses.
    large: NDArray[np.bool_] = (size > _SMALL) & (size * size * solved.lost > _LEFT**2 * solved.chi2)
    return large


def light_rows(T_a_b: SE3, frames: Floats, lights_m: Floats) -> tuple[Floats, Floats]:
    """Linearize the eight coordinates at K poses: give rows (K, 8, 7) and the lights' distances (K, 4).

    frames: (K, 4, 3, 3) of B's left and right light in A's picture, A's left and right in B's: bearing, then both
    tangents in pixels per radian over sigma_px, in the frame of the camera that sees it. lights_m: (2, 2, 3) A's and
    B's left and right light. T_a_b is between the frames of both.

    From a camera to a light, in A's axes, q = R l_b + t, and back from B to A's lights, q = R^T (l_a - t). A step moves
    the first by dt + dw x R l_b, the second by R^T (-dt - dw x (l_a - t)).
    """
    R, t = T_a_b.R, T_a_b.t_m
    back = R.swapaxes(1, 2)
    about_b = lights_m[1] @ back
    to_a = lights_m[0] - t[:, None]
    # (K, 4, 3, 7): derivatives by dt and dw, then q itself, in A's axes.
    q = np.empty((len(t), 4, 3, 7))
    q[..., :3] = _BY_POSITION
    q[..., 3:6] = skew(np.concatenate((-about_b, to_a), axis=1))
    q[:, :2, :, 6], q[:, 2:, :, 6] = about_b + t[:, None], to_a
    # How q and its derivatives extend along the bearing and along both tangents.
    extent = np.concatenate((frames[:, :2], frames[:, 2:] @ back[:, None]), axis=1) @ q
    along, across = extent[:, :, :1], extent[:, :, 1:]
    depth = along[..., 6:]
    r = across[..., 6:] / depth
    rows = (across - r * along) / depth
    rows[..., 6:] = r
    return rows.reshape(-1, 8, 7), depth[:, :, 0, 0]


def at_one_instant(rows: Floats, dt_s: Floats, skew_sign: Floats, motion: Motion) -> tuple[Floats, Floats]:
    """Give rows again, and the covariance (K, n, n) of residuals, for what is known of the motion between sightings.

    dt_s: (K, n) of each residual. skew_sign: (n,) which way half of the clocks' disagreement moves it in time: 1 in A's
    picture, -1 in B's, 0 in none. The residuals of a picture share the error of its stamp.
    """
    J = rows[:, :, :6]
    by_rate = J * dt_s[:, :, None]
    total = by_rate @ motion.covariance @ by_rate.swapaxes(1, 2)
    in_a, in_b = (motion.stamp_sigma_s * (skew_sign == sign) for sign in (1.0, -1.0))
    squares = motion.covariance + np.outer(motion.rates, motion.rates)
    for late_s in (in_a, in_b, 0.5 * motion.skew_sigma_s * skew_sign):
        by_time = J * late_s[:, None]
        total += by_time @ squares @ by_time.swapaxes(1, 2)
    total += _UNIT_NOISE[: rows.shape[1], : rows.shape[1]]
    shifted = rows.copy()
    shifted[:, :, 6] += by_rate @ motion.rates
    return shifted, total
