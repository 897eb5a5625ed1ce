"""Rigid transforms between frames, one type: T_a_c = T_a_b @ T_b_c, p_a = T_a_b @ p_b."""

from __future__ import annotations

from dataclasses import dataclass
from typing import overload

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, Index, matrix_to_quat, rotation_exp, rotation_log


@dataclass(eq=False, slots=True)
class SE3:
    """T_a_b: rotation R (..., 3, 3) and translation t_m (..., 3); leading axes are a batch."""

    R: Floats
    t_m: Floats

    @staticmethod
    def identity() -> SE3:
        """One transform that moves nothing."""
        return SE3(np.eye(3), np.zeros(3))

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

    def retract(self, step: Floats) -> SE3:
        """Add a step (..., 6), m and rad, in a's axes as covariances: t + step[:3] and exp(step[3:]) R."""
        return SE3(rotation_exp(step[..., 3:]) @ self.R, self.t_m + step[..., :3])

    def minus(self, other: SE3) -> Floats:
        """Give the step (..., 6) with other.retract(step) = self."""
        turn = rotation_log(self.R @ other.R.swapaxes(-1, -2))
        return np.concatenate((self.t_m - other.t_m, turn), axis=-1)
