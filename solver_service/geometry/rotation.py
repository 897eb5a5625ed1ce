"""Rotations: unit quaternions (x, y, z, w), matrices, rotation vectors; leading axes are a batch."""

from __future__ import annotations

import math
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Indices: TypeAlias = NDArray[np.intp]
Index: TypeAlias = int | slice | NDArray[np.intp] | NDArray[np.bool_]

# v @ _CROSS, reshaped to (3, 3), is the matrix of the cross product v x .
_CROSS: Final[Floats] = np.zeros((3, 9))
for _axis, _row, _column in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
    _CROSS[_axis, 3 * _row + _column] = 1.0
    _CROSS[_axis, 3 * _column + _row] = -1.0
_IDENTITY: Final[Floats] = np.eye(3)
# The products (16,) of a quaternion's components, row by row, times this: the matrix (9,), times the quaternion's
# square length: (w^2 - |v|^2) I + 2 v v^T + 2 w [v x].
_MATRIX_OF_PRODUCTS: Final[Floats] = np.zeros((16, 9))
_by_pair = _MATRIX_OF_PRODUCTS.reshape(4, 4, 9)
_by_pair[:3, :3] = 2.0 * np.eye(9).reshape(3, 3, 9)
_by_pair[range(4), range(4)] += np.outer((-1.0, -1.0, -1.0, 1.0), _IDENTITY.ravel())
_by_pair[3, :3] = 2.0 * _CROSS
# An angle whose sine is itself.
_TINY: Final = 1e-100
# Up to this many rotations, Python's numbers are faster than arrays.
_FEW: Final = 8
_FEWER: Final = 4


def inner(a: Floats, b: Floats) -> Floats:
    """Give the scalar products (...,) of vectors (..., n)."""
    product: Floats = np.add.reduce(a * b, -1)
    return product


def skew(v: Floats) -> Floats:
    """Give the (..., 3, 3) matrices of the cross products with v (..., 3)."""
    return (v @ _CROSS).reshape(*v.shape, 3)


def applied(M: Floats, v: Floats) -> Floats:
    """Give the products (..., m) of matrices (..., m, n) with vectors (..., n)."""
    product: Floats = (M @ v[..., None])[..., 0]
    return product


def quat_to_matrix(q_xyzw: Floats) -> Floats:
    """Turn quaternions (..., 4), of any length but zero, into matrices (..., 3, 3)."""
    products = q_xyzw[..., :, None] * q_xyzw[..., None, :]
    length2 = inner(q_xyzw, q_xyzw)[..., None]
    R: Floats = products.reshape(*q_xyzw.shape[:-1], 16) @ _MATRIX_OF_PRODUCTS / length2
    return R.reshape(*q_xyzw.shape[:-1], 3, 3)


def matrix_to_quat(R: Floats) -> Floats:
    """Turn rotation matrices (..., 3, 3) into quaternions (..., 4), the largest component positive.

    Which component is divided by follows from the matrix (Shepperd 1978), so that no rotation is near a
    singularity.
    """
    if R.size > 9 * _FEW:
        return _quats_of_many(R.reshape(-1, 9)).reshape(*R.shape[:-2], 4)
    if R.ndim > 2:
        return np.array([matrix_to_quat(each) for each in R.reshape(-1, 3, 3)]).reshape(*R.shape[:-2], 4)
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    # Four times the outer product of the quaternion with itself, row by row.
    rows = (
        (1.0 + a - e - i, b + d, c + g, h - f),
        (b + d, 1.0 - a + e - i, f + h, c - g),
        (c + g, f + h, 1.0 - a - e + i, d - b),
        (h - f, c - g, d - b, 1.0 + a + e + i),
    )
    largest = max(range(4), key=lambda row: rows[row][row])
    norm = math.hypot(*rows[largest])
    return np.array(rows[largest]) / norm


def _quats_of_many(R: Floats) -> Floats:
    """The same of rotations (N, 9), without a loop."""
    a, b, c, d, e, f, g, h, i = R.T
    rows = np.array(
        (
            (1.0 + a - e - i, b + d, c + g, h - f),
            (b + d, 1.0 - a + e - i, f + h, c - g),
            (c + g, f + h, 1.0 - a - e + i, d - b),
            (h - f, c - g, d - b, 1.0 + a + e + i),
        )
    )
    largest = np.argmax(rows[range(4), range(4)], axis=0)
    quats: Floats = rows[largest, :, range(len(R))]
    return quats / np.sqrt(inner(quats, quats))[:, None]


def rotation_exp(w_rad: Floats) -> Floats:
    """Turn rotation vectors (..., 3) into matrices (..., 3, 3) (Rodrigues)."""
    if w_rad.size <= 3 * _FEWER:
        turns = [_one_exp(*turn) for turn in w_rad.reshape(-1, 3).tolist()]
        return np.array(turns).reshape(*w_rad.shape, 3)
    half = np.maximum(0.5 * np.sqrt(inner(w_rad, w_rad)), _TINY)[..., None, None]
    # sin(x) / x and (1 - cos x) / x^2, without a division by zero.
    sine = np.sin(half) / half
    K = skew(w_rad)
    R: Floats = _IDENTITY + (sine * np.cos(half)) * K + (0.5 * sine * sine) * (K @ K)
    return R


def _one_exp(x: float, y: float, z: float) -> tuple[float, ...]:
    """The same of one, as nine numbers: a tracker asks for a few at a time."""
    half = max(0.5 * math.sqrt(x * x + y * y + z * z), _TINY)
    # An endless turn has no matrix; math.sin would refuse it.
    half = half if half < math.inf else math.nan
    sine = math.sin(half) / half
    first, second = sine * math.cos(half), 0.5 * sine * sine
    xy, xz, yz = second * x * y, second * x * z, second * y * z
    xx, yy, zz = second * x * x, second * y * y, second * z * z
    a, b, c = first * x, first * y, first * z
    return 1.0 - yy - zz, xy - c, xz + b, xy + c, 1.0 - xx - zz, yz - a, xz - b, yz + a, 1.0 - xx - yy


def left_jacobian(w_rad: Floats) -> Floats:
    """Give J (..., 3, 3) of rotation vectors (..., 3).

    exp(w + dw) = exp(J dw) exp(w), and J t is the way of a screw (w, t).
    """
    K = skew(w_rad)
    if w_rad.ndim == 1:
        angle2 = float(w_rad @ w_rad)
        half = max(0.5 * math.sqrt(angle2), _TINY)
        sine = math.sin(half) / half
        # (x - sin x) / x^3 loses its digits near 0.
        second = 1.0 / 6.0 - angle2 / 120.0 if angle2 < 1e-4 else (1.0 - sine * math.cos(half)) / angle2
        of_one: Floats = _IDENTITY + (0.5 * sine * sine) * K + second * (K @ K)
        return of_one
    angles2 = inner(w_rad, w_rad)[..., None, None]
    halves = np.maximum(0.5 * np.sqrt(angles2), _TINY)
    sines, small = np.sin(halves) / halves, angles2 < 1e-4
    seconds = (1.0 - sines * np.cos(halves)) / np.where(small, 1.0, angles2)
    J: Floats = _IDENTITY + (0.5 * sines * sines) * K + np.where(small, 1.0 / 6.0 - angles2 / 120.0, seconds) * (K @ K)
    return J


def rotation_log(R: Floats) -> Floats:
    """Turn rotation matrices (..., 3, 3) into rotation vectors (..., 3), at most pi long."""
    if R.size > 9 * _FEW:
        quats = matrix_to_quat(R)
        vectors, scalar = quats[..., :3], quats[..., 3]
        sines = np.copysign(np.sqrt(inner(vectors, vectors)), scalar)
        small = np.abs(sines) <= 1e-12
        angles = 2.0 * np.arctan2(np.abs(sines), np.abs(scalar))
        ratios = np.where(small, np.copysign(2.0, scalar), angles / np.where(small, 1.0, sines))
        turns: Floats = ratios[..., None] * vectors
        return turns
    if R.ndim > 2:
        return np.array([rotation_log(each) for each in R.reshape(-1, 3, 3)]).reshape(R.shape[:-1])
    x, y, z, w = matrix_to_quat(R).tolist()
    sine = math.copysign(math.sqrt(x * x + y * y + z * z), w)
    # The angle over the sine of its half; 2 near none.
    ratio = 2.0 * math.atan2(abs(sine), abs(w)) / sine if abs(sine) > 1e-12 else math.copysign(2.0, w)
    return np.array((ratio * x, ratio * y, ratio * z))
