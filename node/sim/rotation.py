"""Rotations of the simulated world: 3x3 matrices and x, y, z, w quaternions."""

from __future__ import annotations

import math
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Vector: TypeAlias = NDArray[np.float64]
Matrix: TypeAlias = NDArray[np.float64]


def from_euler(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Matrix:
    """Return R_ned_body, (3, 3), for aerospace angles: yaw about down, then pitch, then roll."""
    sr, cr = math.sin(roll_rad), math.cos(roll_rad)
    sp, cp = math.sin(pitch_rad), math.cos(pitch_rad)
    sy, cy = math.sin(yaw_rad), math.cos(yaw_rad)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def from_quaternion(q_xyzw: tuple[float, float, float, float]) -> Matrix:
    """Return the matrix of a unit quaternion."""
    x, y, z, w = q_xyzw
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def to_quaternion(R: Matrix) -> tuple[float, float, float, float]:
    """Return the unit quaternion of R with w >= 0, from the largest of its four components (Shepperd)."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    squares = np.array([R[0, 0], R[1, 1], R[2, 2], trace])
    i = int(np.argmax(squares))
    q = np.empty(4)
    if i == 3:
        q[:] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[j] = R[j, i] + R[i, j]
        q[k] = R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    q /= np.linalg.norm(q)
    if q[3] < 0:
        q = -q
    return float(q[0]), float(q[1]), float(q[2]), float(q[3])


def to_vector(R: Matrix) -> Vector:
    """Return the rotation vector of R, (3,), rad. Accurate near the identity, where it is used."""
    x, y, z, w = to_quaternion(R)
    norm = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if norm < 1e-12 else 2.0 * math.atan2(norm, w) / norm
    return np.array([x, y, z]) * scale
