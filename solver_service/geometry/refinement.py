"""Gauss-Newton on the eight image coordinates, with calibrated light positions, for many readings at once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.past import Motion
from buddyline.solver_service.geometry.rotation import Floats, Indices, skew
from buddyline.solver_service.geometry.se3 import SE3
from numpy.typing import NDArray

_MAX_STEPS: Final = 12
# A step this small, relative to the range and in rad, leaves less than its square.
_SMALL: Final = 5e-4
# What a step may leave of the noise, as chi^2 after it shows that.
_LEFT: Final = 0.01
# A combination of coordinates that the picture determines this much worse than each alone is not determined.
_UNDETERMINED: Final = 1e10
_DAMPING: Final = 1e-13 * np.eye(6)


@dataclass(eq=False, slots=True)
class Rows:
    """Residuals of unit noise at K poses: derivatives J (K, n, 6) by the pose's step, residuals r (K, n).

    depth: (K, 4) distances of the lights along their bearings.
    """

    J: Floats
    r: Floats
    depth: Floats


@dataclass(eq=False, slots=True)
class Solved:
    """The least squares of K poses: steps (K, 6) to take, covariance (K, 6, 6) of T_a_b.retract, chi2 (K,) after it.

    determined: (K,).
    """

    step: Floats
    covariance: Floats
    chi2: Floats
    determined: NDArray[np.bool_]


@dataclass(eq=False, slots=True)
class Refined:
    """K poses where they were last linearized, and what is left to take there: the last step.

    T_a_b, J (K, n, 6), r (K, n), solved: as in Rows and Solved. sound: (K,), False where the pose is not determined
    or lies behind a camera.
    """

    T_a_b: SE3
    J: Floats
    r: Floats
    solved: Solved
    sound: NDArray[np.bool_]


def refine(T_a_b: SE3, rows_at: Callable[[SE3, Indices], Rows], max_steps: int = _MAX_STEPS) -> Refined:
    """Refine K poses, each until the last step leaves little of the noise.

    rows_at: gives the residuals of the K poses chosen by an index.
    """
    R, t = T_a_b.R.copy(), T_a_b.t_m.copy()
    rows = rows_at(T_a_b, np.arange(len(t)))
    solved = least_squares(rows.J, rows.r)
    left = np.flatnonzero(_is_large(solved, rows.r, t))
    for _ in range(max_steps - 1):
        if not len(left):
            break
        moved = SE3(R[left], t[left]).retract(solved.step[left])
        again = rows_at(moved, left)
        part = least_squares(again.J, again.r)
        R[left], t[left] = moved.R, moved.t_m
        rows.J[left], rows.r[left], rows.depth[left] = again.J, again.r, again.depth
        solved.step[left], solved.covariance[left], solved.chi2[left] = part.step, part.covariance, part.chi2
        solved.determined[left] = part.determined
        left = left[_is_large(part, again.r, moved.t_m)]
    # A step that is not finite makes chi^2 not finite either.
    sound = solved.determined & (rows.depth > 0.0).all(1) & np.isfinite(solved.chi2)
    return Refined(SE3(R, t), rows.J, rows.r, solved, sound)


def least_squares(J: Floats, r: Floats, weight: Floats | None = None) -> Solved:
    """Solve for the steps that make J step + r least; weight: (K, n, n) the residuals' inverse covariance."""
    Jt = J.swapaxes(1, 2)
    if weight is not None:
        Jt = Jt @ weight
    H, g = Jt @ J, Jt @ r[:, :, None]
    # Positions and rotations have their own units: scaled to a unit diagonal before solving.
    unit = 1.0 / np.sqrt(H.diagonal(0, 1, 2))
    scale = unit[:, :, None] * unit[:, None]
    inverse = np.linalg.inv(H * scale + _DAMPING)
    covariance = inverse * scale
    step = -(covariance @ g)
    before = (r * r).sum(1) if weight is None else ((weight @ r[:, :, None])[:, :, 0] * r).sum(1)
    chi2 = np.maximum(before + (step * g).sum((1, 2)), 0.0)
    return Solved(step[:, :, 0], covariance, chi2, inverse.diagonal(0, 1, 2).max(1) < _UNDETERMINED)


def _is_large(solved: Solved, r: Floats, t: Floats) -> NDArray[np.bool_]:
    """Tell which steps leave what matters; t: (K, 3) before them."""
    moved = np.abs(solved.step)
    size = np.maximum(moved[:, :3].max(1) / np.sqrt((t * t).sum(1)), moved[:, 3:].max(1))
    # The geometry changes by about this share over the step, and so the step: in sd, the root of what chi^2 loses.
    lost = (r * r).sum(1) - solved.chi2
    large: NDArray[np.bool_] = (size > _SMALL) & (size * size * lost > _LEFT**2 * solved.chi2)
    return large


def light_rows(T_a_b: SE3, frames: Floats, lights_m: Floats) -> Rows:
    """Linearize the eight coordinates at K poses.

    frames: (K, 4, 3, 3) of B's left and right light in A's picture, A's left and right in B's: bearing, then both
    tangents in pixels per radian over sigma_px. lights_m: (2, 2, 3) A's and B's left and right light.

    From a camera to a light, in A's axes, q = R l_b + t, and back from B to A's lights, q = R^T (l_a - t). A step moves
    the first by dt + dw x R l_b, the second by R^T (-dt - dw x (l_a - t)).
    """
    R, t = T_a_b.R, T_a_b.t_m
    about_b = lights_m[1] @ R.swapaxes(1, 2)
    to_a = lights_m[0] - t[:, None]
    # (K, 4, 3, 7): derivatives by dt and dw, then q itself, in A's axes.
    q = np.empty((len(t), 4, 3, 7))
    q[:, :2, :, :3], q[:, 2:, :, :3] = np.eye(3), -np.eye(3)
    q[:, :2, :, 3:6], q[:, 2:, :, 3:6] = -skew(about_b), skew(to_a)
    q[:, :2, :, 6], q[:, 2:, :, 6] = about_b + t[:, None], to_a
    frames = np.concatenate((frames[:, :2], frames[:, 2:] @ R.swapaxes(1, 2)[:, None]), axis=1)
    # How q and its derivatives extend along the bearing and along both tangents.
    extent = frames @ q
    depth = extent[:, :, :1, 6:]
    r = extent[:, :, 1:, 6:] / depth
    J = (extent[:, :, 1:, :6] - r * extent[:, :, :1, :6]) / depth
    return Rows(J.reshape(-1, 8, 6), r.reshape(-1, 8), depth[:, :, 0, 0])


def at_one_instant(J: Floats, r: Floats, dt_s: Floats, skew_sign: Floats, motion: Motion) -> Solved:
    """Solve again for what is known of the motion between the sightings, by the same linearization.

    dt_s: (K, n) of each residual. skew_sign: (n,) half of the clocks' disagreement moves it so.
    """
    by_rate = J * dt_s[:, :, None]
    total = np.eye(J.shape[1]) + by_rate @ motion.covariance @ by_rate.swapaxes(1, 2)
    if motion.skew_sigma_s > 0.0:
        by_skew = J * (0.5 * motion.skew_sigma_s * skew_sign)[:, None]
        total += by_skew @ (motion.covariance + np.outer(motion.rates, motion.rates)) @ by_skew.swapaxes(1, 2)
    weight = np.asarray(np.linalg.inv(total), dtype=np.float64)
    return least_squares(J, r + by_rate @ motion.rates, weight)
