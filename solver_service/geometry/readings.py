"""Readings of triggers: which candidates are the lights, the pose that follows, and what speaks for it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.past import Motion
from buddyline.solver_service.geometry.refinement import Solved, at_one_instant, least_squares
from buddyline.solver_service.geometry.rotation import Floats, Indices
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.sensors import Turn
from numpy.typing import NDArray

# Which residuals a later clock of B moves, and where to: A's picture of B's lights, B's of A's, then the sensors.
_SKEW_SIGN: Final = np.array((1.0,) * 4 + (-1.0,) * 4 + (0.0,) * 3)


@dataclass(eq=False, slots=True)
class Poses:
    """K poses between the cameras' frames, and the log likelihood ratio (K,) of each without the past.

    turn: against the attitudes' headings. sensed_variance, picture_variance: (K,) of that turn, rad^2, by the
    attitudes and by the pictures.
    """

    T_a_b: SE3
    log_ratio: Floats
    turn: Turn
    sensed_variance: Floats
    picture_variance: Floats

    def __getitem__(self, index: slice | Indices) -> Poses:
        """Choose some."""
        turn = Turn(self.turn.level[index], self.turn.cosine[index], self.turn.sine[index])
        return Poses(
            self.T_a_b[index], self.log_ratio[index], turn, self.sensed_variance[index], self.picture_variance[index]
        )


@dataclass(eq=False, slots=True)
class Readings:
    """M readings, ready to be solved for what is known of the motion; poses between the cameras' frames.

    lights: (M, 4) places in the views of B's left and right in A's picture, A's left and right in B's; -1: not seen.
    T_a_b: M poses where they are linearized, with derivatives J (M, n, 6) and residuals r (M, n) of unit noise, and
    dt_s (M, n) after the instant that the pose is for. sound: (M,) whether a pose follows. log_ratio: (M,) against
    chance, without what the residuals and the past say. tilt_chi2, depth_chi2: (M,) of the sensors. gap_chi2: (M,) of
    the gaps that may speak, by the closed form. range_m: (M, 2) by A's bar and by B's, twist_gap_rad (M,); both
    by the closed form. clutter: (M,) candidates that chance puts in the place of one of the lights, per variance of its
    position, 0 where all would be missed. lone_odds: (M,) that the only light of a node is another lamp, without the
    past; 0 where both are seen.
    """

    lights: Indices
    T_a_b: SE3
    J: Floats
    r: Floats
    dt_s: Floats
    sound: NDArray[np.bool_]
    log_ratio: Floats
    tilt_chi2: Floats
    depth_chi2: Floats
    gap_chi2: Floats
    range_m: Floats
    twist_gap_rad: Floats
    clutter: Floats
    lone_odds: Floats

    def __len__(self) -> int:
        """Count them."""
        return len(self.log_ratio)

    def __getitem__(self, index: slice | Indices) -> Readings:
        """Choose some."""
        return Readings(*[getattr(self, name)[index] for name in self.__slots__])

    def solve(self, motion: Motion) -> Solved:
        """Take the last step, for what is known of the motion."""
        if motion.skew_sigma_s == 0.0 and not self.dt_s.any():
            return least_squares(self.J, self.r)
        return at_one_instant(self.J, self.r, self.dt_s, _SKEW_SIGN[: self.r.shape[1]], motion)
