"""What earlier fixes say of the present one: a prediction that fades, is lost, and is found again."""

from __future__ import annotations

from typing import Final

import numpy as np

from protocol.clock import S_NS
from solver_service.geometry.trigger import Fix, Prior

LIFETIME_NS: Final = 2 * S_NS
# How fast two divers may part, drift and turn (1 sd).
SPEED_MPS: Final = 0.7
TURN_RADPS: Final = 0.7


class PosePrior:
    """Holds the last fix and widens it with time; no velocity, so that one bad fix cannot run away."""

    def __init__(self) -> None:
        self._stamp_ns = 0
        self._fix: Fix | None = None

    def update(self, stamp_ns: int, fix: Fix) -> None:
        """Take a new fix."""
        self._stamp_ns, self._fix = stamp_ns, fix

    def lose(self) -> None:
        """Forget it."""
        self._fix = None

    def at(self, stamp_ns: int) -> Prior | None:
        """Return the prediction for stamp_ns, None where the last fix is too old."""
        age_ns = stamp_ns - self._stamp_ns
        if self._fix is None or not 0 <= age_ns <= LIFETIME_NS:
            return None
        age_s = age_ns / S_NS
        walk = np.array([SPEED_MPS * age_s] * 3 + [TURN_RADPS * age_s] * 3) ** 2
        return Prior(self._fix.t_a_b_m, self._fix.q_a_b_xyzw, self._fix.covariance + np.diag(walk))
