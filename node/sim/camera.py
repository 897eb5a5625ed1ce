"""The forward camera model: points in the camera frame to pixels of the distorted image.

Written from the equations that OpenCV documents for cv2.projectPoints and cv2.fisheye.projectPoints. The
solver has the inverse model of its own; neither is derived from the other.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from buddyline.protocol.messages import CameraModel
from numpy.typing import NDArray

Array = NDArray[np.float64]


def project(points_c_m: Array, camera: CameraModel) -> Array:
    """Project (n, 3) points to (n, 2) pixels, pixel centres at integers; NaN behind the camera.

    The distortion polynomial folds back far outside its calibrated field; points beyond the fold are NaN too.
    """
    points = np.asarray(points_c_m, dtype=np.float64)
    ahead = points[:, 2] > 1e-6
    z = np.where(ahead, points[:, 2], 1.0)
    normalized = points[:, :2] / z[:, None]
    if camera.model == "fisheye":
        distorted, sound = _fisheye(normalized, camera.distortion)
    else:
        distorted, sound = _pinhole(normalized, camera.distortion)
    pixels = distorted * (camera.fx_px, camera.fy_px) + (camera.cx_px, camera.cy_px)
    pixels[~(ahead & sound)] = np.nan
    return pixels


def _pinhole(normalized: Array, distortion: list[float]) -> tuple[Array, NDArray[np.bool_]]:
    k1, k2, p1, p2, k3 = distortion
    fold2 = _fold_squared((1.0, 3 * k1, 5 * k2, 7 * k3))
    x, y = normalized[:, 0], normalized[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    distorted = np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )
    return distorted, r2 < fold2


def _fisheye(normalized: Array, distortion: list[float]) -> tuple[Array, NDArray[np.bool_]]:
    k1, k2, k3, k4 = distortion
    r = np.hypot(normalized[:, 0], normalized[:, 1])
    theta = np.arctan(r)
    t2 = theta * theta
    theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    scale = np.where(r > 1e-12, theta_d / np.maximum(r, 1e-12), 1.0)
    return normalized * scale[:, None], t2 < _fold_squared((1.0, 3 * k1, 5 * k2, 7 * k3, 9 * k4))


@lru_cache(maxsize=16)
def _fold_squared(slope: tuple[float, ...]) -> float:
    """Return the smallest squared field (r or theta) at which d(distorted)/d(undistorted) is 0; inf for none.

    slope: coefficients of that derivative in powers of the squared field, from the power 0 up.
    """
    if not any(slope[1:]):
        return math.inf
    roots = np.roots(slope[::-1])
    positive = roots.real[(np.abs(roots.imag) < 1e-12) & (roots.real > 0)]
    return float(positive.min()) if positive.size else math.inf


def pinhole(width_px: int, height_px: int) -> CameraModel:
    """Return the default camera in water: 48.8 degrees across, no distortion, principal point in the centre."""
    f_px = 904.0 / 820.0 * width_px
    return CameraModel(
        model="pinhole",
        fx_px=f_px,
        fy_px=f_px,
        cx_px=(width_px - 1) / 2,
        cy_px=(height_px - 1) / 2,
        distortion=[0.0] * 5,
    )
