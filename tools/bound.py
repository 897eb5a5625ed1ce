"""The Cramér-Rao bound of a pose from four lights: what the picture's noise allows, and no estimator beats."""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.protocol.messages import NodeInfo
from buddyline.tools.evaluation.lights import project
from buddyline.tools.evaluation.rotation import Floats, conjugate, multiply, normalized, rotate

_STEP: Final = 1e-5


def pose_bounds(t_a_b_m: Floats, q_a_b_xyzw: Floats, info_a: NodeInfo, info_b: NodeInfo, sigma_px: float) -> Floats:
    """Return the smallest covariances (n, 6, 6) of poses (n, 3), (n, 4), in the order that RelativePose has.

    The inverse of J^T J / sigma^2, J the derivatives of the eight image coordinates, by differences. NaN where a
    light has no place in a picture. sigma_px: noise of a coordinate, 1 sd.
    """
    J, _ = _derivatives(t_a_b_m, q_a_b_xyzw, info_a, info_b)
    covariances = np.full((len(t_a_b_m), 6, 6), np.nan)
    seen = np.isfinite(J).all(axis=(1, 2))
    covariances[seen] = np.linalg.inv(J[seen].swapaxes(1, 2) @ J[seen]) * sigma_px**2
    return covariances


def pose_information(
    t_a_b_m: Floats, q_a_b_xyzw: Floats, info_a: NodeInfo, info_b: NodeInfo, sigma_px: float
) -> Floats:
    """Return what both pictures tell of poses (n, 3), (n, 4), (n, 6, 6), by the lights that are inside of them."""
    J, images = _derivatives(t_a_b_m, q_a_b_xyzw, info_a, info_b)
    J[~np.isfinite(J)] = 0.0
    u, v = images[:, 0::2], images[:, 1::2]
    sizes = np.array([[one.width_px, one.height_px] for one in (info_a, info_a, info_b, info_b)])
    with np.errstate(invalid="ignore"):
        inside = (u > 0) & (u < sizes[:, 0] - 1) & (v > 0) & (v < sizes[:, 1] - 1)
    J *= np.repeat(inside, 2, axis=1)[..., None]
    return np.asarray(J.swapaxes(1, 2) @ J / sigma_px**2)


def _derivatives(t_a_b_m: Floats, q_a_b_xyzw: Floats, info_a: NodeInfo, info_b: NodeInfo) -> tuple[Floats, Floats]:
    """Return the derivatives (n, 8, 6) of the eight image coordinates by the pose, and the coordinates (n, 8)."""
    steps = np.concatenate([np.eye(6), -np.eye(6)])[:, None] * _STEP
    turns = np.concatenate([0.5 * steps[..., 3:], np.ones((12, 1, 1))], axis=-1)
    t_m = t_a_b_m + steps[..., :3]
    q = normalized(multiply(turns, q_a_b_xyzw[None]))
    images = light_images(t_m.reshape(-1, 3), q.reshape(-1, 4), info_a, info_b).reshape(12, -1, 8)
    J = np.moveaxis((images[:6] - images[6:]) / (2.0 * _STEP), 0, -1)
    return J, images.mean(axis=0)


def light_images(t_m: Floats, q_xyzw: Floats, info_a: NodeInfo, info_b: NodeInfo) -> Floats:
    """Return the eight image coordinates of each of n poses, (n, 8)."""
    lights_b, lights_a = (np.array([info.light_left_m, info.light_right_m]) for info in (info_b, info_a))
    t, q = t_m[:, None], q_xyzw[:, None]
    seen_by_a = project((rotate(q, lights_b) + t).reshape(-1, 3), info_a.camera)
    seen_by_b = project(rotate(conjugate(q), lights_a - t).reshape(-1, 3), info_b.camera)
    return np.concatenate([seen_by_a.reshape(-1, 4), seen_by_b.reshape(-1, 4)], axis=1)
