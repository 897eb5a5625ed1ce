"""Rigid transforms between frames, one type: T_a_c = T_a_b @ T_b_c, p_a = T_a_b @ p_b."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, overload

import numpy as np
from buddyline.solver_service.geometry.rotation import (
    Floats,
    Index,
    inner,
    matrix_to_quat,
    quat_to_matrix,
    rotation_exp,
    rotation_log,
    skew,
)

_IDENTITY: Final[Floats] = np.eye(3)
# Below this angle (rad) the series of the angle's functions are used: their next term is less than 1e-17.
_SERIES: Final = 1e-4


@dataclass(eq=False, slots=True)
class SE3:
    """T_a_b: rotation R (..., 3, 3) and translation t_m (..., 3); leading axes are a batch.

    Tangents (..., 6): translation (m), then rotation (rad).
    """

    R: Floats
    t_m: Floats

    @staticmethod
    def identity() -> SE3:
        """One transform that moves nothing."""
        return SE3(np.eye(3), np.zeros(3))

    @staticmethod
    def from_quat(q_xyzw: Floats, t_m: Floats) -> SE3:
        """Take quaternions (..., 4), of any length but zero, and translations (..., 3)."""
        return SE3(quat_to_matrix(q_xyzw), t_m)

    @property
    def q_xyzw(self) -> Floats:
        """The rotation as unit quaternions (..., 4), the largest component positive."""
        return matrix_to_quat(self.R)

    @overload
    def __matmul__(self, other: SE3) -> SE3: ...

    @overload
    def __matmul__(self, other: Floats) -> Floats: ...

    def __matmul__(self, other: SE3 | Floats) -> SE3 | Floats:
        """Chain two transforms, or map points (..., 3)."""
        if isinstance(other, SE3):
            return SE3(self.R @ other.R, self @ other.t_m)
        moved: Floats = (self.R @ other[..., None])[..., 0] + self.t_m
        return moved

    def inverse(self) -> SE3:
        """T_b_a."""
        back = self.R.swapaxes(-1, -2)
        return SE3(back, -(back @ self.t_m[..., None])[..., 0])

    def __getitem__(self, index: Index) -> SE3:
        """Choose from a batch."""
        return SE3(self.R[index], self.t_m[index])

    def __len__(self) -> int:
        """Count a batch."""
        return len(self.t_m)

    @staticmethod
    def exp(tangent: Floats) -> SE3:
        """Move along a constant twist (..., 6) for one unit of time."""
        w_rad = tangent[..., 3:]
        return SE3(rotation_exp(w_rad), (_left_jacobian(w_rad) @ tangent[..., :3, None])[..., 0])

    def log(self) -> Floats:
        """Give the twist (..., 6) that leads here in one unit of time, its rotation at most pi."""
        w_rad = rotation_log(self.R)
        along = np.linalg.solve(_left_jacobian(w_rad), self.t_m[..., None])[..., 0]
        return np.concatenate((along, w_rad), axis=-1)

    def adjoint(self) -> Floats:
        """Give the (..., 6, 6) that turns twists in b into the same twists in a: T exp(x) = exp(adjoint @ x) T."""
        matrix = np.zeros((*self.t_m.shape[:-1], 6, 6))
        matrix[..., :3, :3] = matrix[..., 3:, 3:] = self.R
        matrix[..., :3, 3:] = skew(self.t_m) @ self.R
        return matrix

    def retract(self, step: Floats) -> SE3:
        """Add a small step (..., 6): t + step[:3] and exp(step[3:]) R, both in a's axes, as covariances have them."""
        return SE3(rotation_exp(step[..., 3:]) @ self.R, self.t_m + step[..., :3])

    def minus(self, other: SE3) -> Floats:
        """Give the step (..., 6) with other.retract(step) = self."""
        turn = rotation_log(self.R @ other.R.swapaxes(-1, -2))
        return np.concatenate((self.t_m - other.t_m, turn), axis=-1)


def _left_jacobian(w_rad: Floats) -> Floats:
    """Give the (..., 3, 3) mean of the rotations exp(s w), s from 0 to 1 (Barfoot 2017, eq. 7.77b)."""
    angle2 = inner(w_rad, w_rad)[..., None, None]
    angle = np.sqrt(angle2)
    safe = np.maximum(angle, _SERIES)
    first = np.where(angle < _SERIES, 0.5 - angle2 / 24.0, 2.0 * (np.sin(0.5 * safe) / safe) ** 2)
    second = np.where(angle < _SERIES, 1.0 / 6.0 - angle2 / 120.0, (safe - np.sin(safe)) / safe**3)
    K = skew(w_rad)
    mean: Floats = _IDENTITY + first * K + second * (K @ K)
    return mean
