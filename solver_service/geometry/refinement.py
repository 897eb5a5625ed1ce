"""Gauss-Newton on the eight image coordinates, with calibrated light positions, for many hypotheses at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from solver_service.geometry.rig import Rig
from solver_service.geometry.rotation import Floats, rotation_exp, skew

_MAX_STEPS: Final = 12
# A step this small (m and rad) leaves an error of its square.
_SMALL: Final = 1e-7
# Where the coordinates determine a pose less than this, relative to the best determined one, they do not.
_SINGULAR: Final = 1e-13
_SIGNS: Final = np.array([1.0, 1.0, -1.0, -1.0])[:, None, None]


@dataclass(frozen=True, eq=False)
class Sightings:
    """Four lights as K hypotheses read them: B's left and right in A's image, A's left and right in B's.

    bearings: (K, 4, 3). tangents: (K, 4, 2, 3), pixels per radian over sigma_px, so that residuals have unit
    noise. dt_s: (K, 4) time of each sighting after the instant that the pose is for.
    """

    bearings: Floats
    tangents: Floats
    dt_s: Floats


@dataclass(frozen=True, eq=False)
class Motion:
    """How the pose moves: d/dt of t_a_b (m/s), then of the small rotation w (rad/s), in A's camera frame.

    rates: (6,), covariance: (6, 6). skew_sigma_s: how well the two clocks agree, 1 sd.
    """

    rates: Floats
    covariance: Floats
    skew_sigma_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Refined:
    """K poses: t_a_b_m (K, 3), R_a_b (K, 3, 3), covariance (K, 6, 6), chi2 (K,) of two degrees of freedom.

    covariance: of position in A's camera frame, then of the small rotation w with R_true = exp(w) R_a_b, in A's
    camera frame. sound: (K,), False where the pose is not determined or lies behind a camera.
    """

    t_a_b_m: Floats
    R_a_b: Floats
    covariance: Floats
    chi2: Floats
    freedom: Floats
    sound: NDArray[np.bool_]


def refine(
    t_a_b_m: Floats, R_a_b: Floats, seen: Sightings, rig_a: Rig, rig_b: Rig, motion: Motion, steps: int | None = None
) -> Refined:
    """Refine K poses, t_a_b_m (K, 3) and R_a_b (K, 3, 3); with no steps, give only covariance and chi2."""
    t, R = t_a_b_m, R_a_b
    steps = _MAX_STEPS if steps is None else steps
    weight = _weight(t, R, seen, rig_a, rig_b, motion)
    lights = (rig_a.lights_m, rig_b.lights_m)
    moved = seen.dt_s.any() and motion.rates.any()
    for step in range(steps + 1):
        r, J, depth = _residuals(t, R, seen, lights, motion.rates if moved else None)
        Jw = J if weight is None else weight @ J
        H = Jw.swapaxes(1, 2) @ J
        scale = H[:, range(6), range(6)]
        # Positions and rotations have their own units: scaled to a unit diagonal before solving.
        unit = 1.0 / np.sqrt(np.where(scale > 0.0, scale, 1.0))
        H = H * (unit[:, :, None] * unit[:, None, :])
        if step == steps:
            break
        H[:, range(6), range(6)] += 1e-12
        g = (Jw.swapaxes(1, 2) @ r[:, :, None]) * unit[:, :, None]
        move = -np.linalg.solve(H, g)[:, :, 0] * unit
        t, R = t + move[:, :3], rotation_exp(move[:, 3:]) @ R
        if not (np.abs(move) > _SMALL).any():
            steps = step + 1
            r, J, depth = _residuals(t, R, seen, lights, motion.rates if moved else None)
            break
    finite = np.isfinite(H.sum(axis=(1, 2)) + r.sum(axis=1))
    H = np.where(finite[:, None, None], H, np.eye(6))
    values, vectors = np.linalg.eigh(H)
    sound = finite & (values[:, 0] > _SINGULAR * values[:, 5]) & (depth > 0.0).all(1)
    vectors = vectors * unit[:, :, None]
    covariance = (vectors / np.maximum(values, _SINGULAR)[:, None, :]) @ vectors.swapaxes(1, 2)
    rw = r if weight is None else (weight @ r[:, :, None])[:, :, 0]
    J4 = J.reshape(-1, 4, 2, 6)
    open_ = np.eye(2) - J4 @ covariance[:, None] @ J4.swapaxes(2, 3)
    freedom = open_[..., 0, 0] * open_[..., 1, 1] - open_[..., 0, 1] * open_[..., 1, 0]
    return Refined(t, R, covariance, (r * rw).sum(1), np.clip(freedom, 0.0, 1.0), sound)


def _residuals(
    t: Floats, R: Floats, seen: Sightings, lights: tuple[Floats, Floats], rates: Floats | None
) -> tuple[Floats, Floats, Floats]:
    """Give residuals (K, 8), their derivatives (K, 8, 6) by the pose, and the distances along the bearings (K, 4).

    A light seen at dt sees the pose moved by rates * dt.
    """
    K = len(t)
    y = np.empty((K, 4, 3))
    q = np.empty((K, 4, 3))
    y[:, :2] = lights[1] @ R.swapaxes(1, 2)
    if rates is None:
        q[:, :2] = y[:, :2] + t[:, None]
        y[:, 2:] = lights[0] - t[:, None]
        q[:, 2:] = y[:, 2:] @ R
    else:
        turn = rotation_exp(seen.dt_s[:, :, None] * rates[3:])
        shift = seen.dt_s[:, :, None] * rates[:3]
        y[:, :2] = (turn[:, :2] @ y[:, :2, :, None])[..., 0]
        q[:, :2] = y[:, :2] + t[:, None] + shift[:, :2]
        y[:, 2:] = ((lights[0] - t[:, None] - shift[:, 2:])[:, :, None] @ turn[:, 2:])[:, :, 0]
        q[:, 2:] = y[:, 2:] @ R
    depth = (seen.bearings * q).sum(2)
    G = seen.tangents / depth[:, :, None, None]
    r = (G @ q[..., None])[..., 0]
    D = G - r[..., None] * (seen.bearings / depth[:, :, None])[:, :, None]
    D[:, 2:] = D[:, 2:] @ R.swapaxes(1, 2)[:, None]
    D *= _SIGNS
    J = np.empty((K, 4, 2, 6))
    J[..., :3] = D
    # d (y x v) = (d x y) v: row d's derivative by the rotation is y x d.
    J[..., 3:] = -D @ skew(y)
    return r.reshape(K, 8), J.reshape(K, 8, 6), depth


def _weight(t: Floats, R: Floats, seen: Sightings, rig_a: Rig, rig_b: Rig, motion: Motion) -> Floats | None:
    """Give the inverse covariance (K, 8, 8) of the residuals where the rates' uncertainty adds to the pixels'."""
    skewed = motion.skew_sigma_s > 0.0
    if not seen.dt_s.any() and not skewed:
        return None
    _, J, _ = _residuals(t, R, seen, (rig_a.lights_m, rig_b.lights_m), None)
    by_rate = J * np.repeat(seen.dt_s, 2, axis=1)[:, :, None]
    total = np.eye(8) + by_rate @ motion.covariance @ by_rate.swapaxes(1, 2)
    if skewed:
        second = motion.covariance + np.outer(motion.rates, motion.rates)
        by_skew = J * (0.5 * motion.skew_sigma_s * np.repeat((1.0, 1.0, -1.0, -1.0), 2))[:, None]
        total = total + by_skew @ second @ by_skew.swapaxes(1, 2)
    total[~np.isfinite(total.sum(axis=(1, 2)))] = np.eye(8)
    inverse: Floats = np.linalg.inv(total)
    return inverse
