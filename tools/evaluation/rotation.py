"""Unit quaternions (x, y, z, w), many at once. The evaluation has its own, apart from the code that it evaluates."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]


def normalized(q_xyzw: Floats) -> Floats:
    """Return quaternions (..., 4) at unit length."""
    unit: Floats = q_xyzw / np.linalg.norm(q_xyzw, axis=-1, keepdims=True)
    return unit


def conjugate(q_xyzw: Floats) -> Floats:
    """Return the inverse rotations of unit quaternions (..., 4)."""
    return q_xyzw * (-1.0, -1.0, -1.0, 1.0)


def multiply(p_xyzw: Floats, q_xyzw: Floats) -> Floats:
    """Return the products p q (..., 4): the rotation q first, then p."""
    p, q = p_xyzw[..., :3], q_xyzw[..., :3]
    pw, qw = p_xyzw[..., 3:], q_xyzw[..., 3:]
    vector = pw * q + qw * p + np.cross(p, q)
    return np.concatenate([vector, pw * qw - (p * q).sum(-1, keepdims=True)], axis=-1)


def rotate(q_xyzw: Floats, points: Floats) -> Floats:
    """Return points (..., 3) rotated by unit quaternions (..., 4)."""
    axis, w = q_xyzw[..., :3], q_xyzw[..., 3:]
    across = np.cross(axis, points)
    turned: Floats = points + 2.0 * (w * across + np.cross(axis, across))
    return turned


def rotation_vector(q_xyzw: Floats) -> Floats:
    """Return the rotation vectors w (..., 3), rad, of length pi at most, with exp(w) = q."""
    q = np.where(q_xyzw[..., 3:] < 0.0, -q_xyzw, q_xyzw)
    sine = np.linalg.norm(q[..., :3], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, q[..., 3:])
    scale: Floats = np.where(sine > 1e-12, angle / np.maximum(sine, 1e-12), 2.0)
    return q[..., :3] * scale


def from_rotation_vector(w_rad: Floats) -> Floats:
    """Return exp(w) (4,) of a rotation vector (3,), rad."""
    half = 0.5 * float(np.linalg.norm(w_rad))
    return np.append(0.5 * np.sinc(half / np.pi) * w_rad, np.cos(half))
