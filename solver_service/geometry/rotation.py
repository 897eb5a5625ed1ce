"""Rotations: unit quaternions (x, y, z, w), matrices, rotation vectors."""

from __future__ import annotations

import math
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]

# v @ _CROSS, reshaped to (3, 3), is the matrix of the cross product v x .
_CROSS: Final[Floats] = np.zeros((3, 3, 3))
for _i, _j, _k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _CROSS[_i, _k, _j] = 1.0
    _CROSS[_i, _j, _k] = -1.0
_CROSS_FLAT: Final[Floats] = _CROSS.reshape(3, 9)
_EYE: Final[Floats] = np.eye(3)
# An angle whose sine is itself.
_TINY: Final = 1e-100


def skew(v: Floats) -> Floats:
    """Give the (..., 3, 3) matrices of the cross products with v (..., 3)."""
    return (v @ _CROSS_FLAT).reshape(*v.shape, 3)


def matrix_of(q_xyzw: Floats) -> Floats:
    """Turn one quaternion (4,), of any length but zero, into its matrix (3, 3)."""
    x, y, z, w = np.asarray(q_xyzw, dtype=np.float64).tolist()
    s = 2.0 / (x * x + y * y + z * z + w * w)
    return np.array(_rodrigues(x, y, z, s * w, s))


def _rodrigues(x: float, y: float, z: float, first: float, second: float) -> tuple[tuple[float, float, float], ...]:
    """Give the rows of 1 + first K + second K^2, K the matrix of the cross product (x, y, z) x."""
    a, b, c = first * x, first * y, first * z
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    xx, yy, zz = second * x * x, second * y * y, second * z * z
    return (1.0 - yy - zz, xy - c, xz + b), (xy + c, 1.0 - xx - zz, yz - a), (xz - b, yz + a, 1.0 - xx - yy)


def quaternion_of(R: Floats) -> Floats:
    """Turn one rotation matrix (3, 3) into its quaternion (4,), the largest component positive.

    Which component is divided by follows from the matrix (Shepperd 1978), so that no rotation is near a
    singularity.
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    # Four times the outer product of the quaternion with itself, row by row.
    rows = (
        (1.0 + a - e - i, b + d, c + g, h - f),
        (b + d, 1.0 - a + e - i, f + h, c - g),
        (c + g, f + h, 1.0 - a - e + i, d - b),
        (h - f, c - g, d - b, 1.0 + a + e + i),
    )
    squares = rows[0][0], rows[1][1], rows[2][2], rows[3][3]
    x, y, z, w = rows[squares.index(max(squares))]
    norm = math.sqrt(x * x + y * y + z * z + w * w)
    return np.array((x / norm, y / norm, z / norm, w / norm))


def rotation_exp(w_rad: Floats) -> Floats:
    """Turn rotation vectors (..., 3) into matrices (..., 3, 3) (Rodrigues)."""
    # sin(x)/x and (1 - cos x)/x^2, without a division by zero.
    if w_rad.ndim == 1:
        x, y, z = w_rad.tolist()
        angle = max(0.5 * math.sqrt(x * x + y * y + z * z), _TINY)
        sinc = math.sin(angle) / angle
        return np.array(_rodrigues(x, y, z, sinc * math.cos(angle), 0.5 * sinc * sinc))
    half = np.maximum(0.5 * np.sqrt((w_rad * w_rad).sum(-1)), _TINY)
    sine = np.sin(half) / half
    first, second = sine * np.cos(half), 0.5 * sine * sine
    K = skew(w_rad)
    R: Floats = _EYE + first[..., None, None] * K + second[..., None, None] * (K @ K)
    return R


def rotation_near(w_rad: Floats) -> Floats:
    """Turn small rotation vectors (..., 3) into matrices (..., 3, 3), like exp to within |w|^3 / 12 (Cayley)."""
    rows = []
    for x, y, z in w_rad.reshape(-1, 3).tolist():
        scale = 2.0 / (4.0 + x * x + y * y + z * z)
        rows.append(_rodrigues(x, y, z, 2.0 * scale, scale))
    return np.array(rows).reshape(*w_rad.shape, 3)


def rotation_log(R: Floats) -> Floats:
    """Turn one rotation matrix (3, 3) into its rotation vector (3,), at most pi long."""
    q = quaternion_of(R)
    if q[3] < 0.0:
        q = -q
    sine = math.sqrt(float(q[:3] @ q[:3]))
    if sine < 1e-12:
        return 2.0 * q[:3]
    vector: Floats = q[:3] * (2.0 * math.atan2(sine, float(q[3])) / sine)
    return vector
