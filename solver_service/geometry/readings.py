"""Readings of a trigger: hypotheses with their poses and what speaks for them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from numpy.typing import NDArray


@dataclass(eq=False, slots=True)
class Readings:
    """K poses between the level frames, and the candidates they read as lights.

    lights: (K, 4) B's left and right in A's picture, A's left and right in B's; -1: not seen. t_a_b_m (K, 3), R_a_b
    (K, 3, 3), covariance (K, 6, 6), chi2 (K,). log_ratio: (K,) against chance, -inf where the pose is not sound.
    tilt_chi2, depth_chi2: (K,) of the sensors. range_m: (K, 2) by A's bar and by B's, twist_gap_rad (K,); both by
    the closed form. clutter: (K,) candidates that chance puts in the place of one of the lights, per variance of its
    position, 0 where all would be missed. log_prior: (K,) the prediction's part in log_ratio. lone_odds: (K,) that the
    only light of a node is another lamp, 0 where both are seen.
    """

    lights: NDArray[np.intp]
    t_a_b_m: Floats
    R_a_b: Floats
    covariance: Floats
    chi2: Floats
    log_ratio: Floats
    tilt_chi2: Floats
    depth_chi2: Floats
    range_m: Floats
    twist_gap_rad: Floats
    clutter: Floats
    log_prior: Floats
    lone_odds: Floats

    def __len__(self) -> int:
        """Count them."""
        return len(self.log_ratio)

    def joined(self, other: Readings) -> Readings:
        """Give both together, these first."""
        return Readings(*(np.concatenate((mine, others)) for mine, others in zip(self._all, other._all, strict=True)))

    @property
    def _all(self) -> tuple[NDArray[np.generic], ...]:
        return tuple(getattr(self, name) for name in self.__dataclass_fields__)
