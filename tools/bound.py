"""The Cramér-Rao bound of a pose from four lights: what the picture's noise allows, and no estimator beats."""

from __future__ import annotations

from typing import Final

import numpy as np

from protocol.messages import NodeInfo
from tools.evaluation.lights import project
from tools.evaluation.rotation import Floats, conjugate, multiply, normalized, rotate

_STEP: Final = 1e-5


def pose_bound(t_a_b_m: Floats, q_a_b_xyzw: Floats, info_a: NodeInfo, info_b: NodeInfo, sigma_px: float) -> Floats:
    """Return the smallest covariance (6, 6) of T_a_b, as RelativePose has it; NaN where a light is not in view.

    The inverse of J^T J / sigma^2, J the derivatives of the eight image coordinates by differences. sigma_px: noise
    of a coordinate, 1 sd.
    """
    steps = np.concatenate([np.eye(6), -np.eye(6)]) * _STEP
    turns = np.concatenate([0.5 * steps[:, 3:], np.ones((12, 1))], axis=1)
    images = _images(t_a_b_m + steps[:, :3], normalized(multiply(turns, q_a_b_xyzw)), info_a, info_b)
    J = ((images[:6] - images[6:]) / (2.0 * _STEP)).T
    if not np.isfinite(J).all():
        return np.full((6, 6), np.nan)
    return np.asarray(np.linalg.inv(J.T @ J) * sigma_px**2, dtype=np.float64)


def _images(t_m: Floats, q_xyzw: Floats, info_a: NodeInfo, info_b: NodeInfo) -> Floats:
    """Return the eight image coordinates of each of n poses, (n, 8)."""
    lights_b, lights_a = (np.array([info.light_left_m, info.light_right_m]) for info in (info_b, info_a))
    t, q = t_m[:, None], q_xyzw[:, None]
    seen_by_a = project((rotate(q, lights_b) + t).reshape(-1, 3), info_a.camera)
    seen_by_b = project(rotate(conjugate(q), lights_a - t).reshape(-1, 3), info_b.camera)
    return np.concatenate([seen_by_a.reshape(-1, 4), seen_by_b.reshape(-1, 4)], axis=1)
