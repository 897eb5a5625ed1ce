"""How much the inertial units' biases walk, learned from the residuals.

Good units' biases walk a sixth as far as those of poor ones, or less. If the assumed walk is too small, tilt, mount and
north-east-down seem better known than they are; if it is too large, what the units tell is wasted. A walk shows only
over seconds, in how the residuals' means change. So the likelihood's whole slope is followed: its part by the
covariance, and its part by the state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.shaking import LONGEST_STEP, MOST_CHI2
from buddyline.solver_service.track.state import ACCEL_BIAS, GYRO_BIAS, MOVING, SIZE

# Densities of the gyros' (rad/s) and the accelerometers' (m/s^2) biases, per root s, before anything is learned: those
# of poor units, which fins shake and water cools. With steadier biases to begin with, the offset of clocks that are far
# apart may not be found. 1 sd is a factor of e, by FIRST_INFORMATION.
FIRST: Final = np.array((5e-4, 8e-3))
FIRST_INFORMATION: Final = 0.25
LEAST: Final = 2.0 * np.log(0.1 * FIRST)
MOST: Final = 2.0 * np.log(10.0 * FIRST)
WALKS: Final = 2
_IDENTITY: Final = np.eye(SIZE)
_BIASES: Final = (GYRO_BIAS, ACCEL_BIAS)


@dataclass(frozen=True, eq=False)
class Walking:
    """The logs (2,) of both walks' variances per s, of gyros and accelerometers, and their information (2, 2).

    spread (2, SIZE, SIZE), moved (SIZE, 2): derivatives of the track's covariance and state by the logs.
    """

    logs: Floats = field(default_factory=lambda: 2.0 * np.log(FIRST))
    information: Floats = field(default_factory=lambda: FIRST_INFORMATION * np.eye(WALKS))
    spread: Floats = field(default_factory=lambda: np.zeros((WALKS, SIZE, SIZE)))
    moved: Floats = field(default_factory=lambda: np.zeros((SIZE, WALKS)))

    @property
    def densities(self) -> tuple[float, float]:
        """Densities of the gyros' (rad/s) and the accelerometers' (m/s^2) biases, per root s."""
        gyro, accel = np.exp(0.5 * self.logs).tolist()
        return gyro, accel

    def stepped(self, F: Floats, walk: Floats, walking: tuple[bool, bool]) -> Walking:
        """Go on by a step with the transition's rows F (MOVING, SIZE).

        walk (SIZE - MOVING,): the variances that the step adds to the constants. walking: which nodes have a unit.
        """
        spread, moved = self.spread.copy(), self.moved.copy()
        across = F @ self.spread
        spread[:, :MOVING, :MOVING] = across @ F.T
        spread[:, :MOVING, MOVING:] = across[:, :, MOVING:]
        spread[:, MOVING:, :MOVING] = np.swapaxes(across[:, :, MOVING:], 1, 2)
        moved[:MOVING] = F @ self.moved
        for k, biases in enumerate(_BIASES):
            for walks, of_node in zip(walking, biases, strict=True):
                if walks:
                    at = range(of_node.start, of_node.stop)
                    spread[k, at, at] += walk[of_node.start - MOVING : of_node.stop - MOVING]
        return Walking(self.logs, self.information, spread, moved)

    def taught(self, y: Floats, S_inverse: Floats, H: Floats, gain: Floats) -> Walking:
        """Go on by an update with residuals y (m,), H (m, SIZE) and the filter's gain (SIZE, m), by Fisher's scoring.

        With D = dP / dlog, G = H D H^T, u = dx / dlog and z = S^-1 y the likelihood's slope is
        (z^T G z - tr(S^-1 G)) / 2 + z^T H u, its information tr(S^-1 G S^-1 G) / 2 + u^T H^T S^-1 H u. After the
        update u = (I - K H)(u + D H^T z), D = (I - K H) D (I - K H)^T.
        """
        z = S_inverse @ y
        chi2 = float(y @ z)
        z = z * math.sqrt(min(1.0, MOST_CHI2 * len(y) / max(chi2, 1e-9)))
        across = self.spread @ H.T
        D = H @ across
        W = S_inverse @ D
        y_moved = H @ self.moved
        slope = 0.5 * (D @ z @ z - np.trace(W, axis1=1, axis2=2)) + y_moved.T @ z
        fisher = 0.5 * (W.reshape(WALKS, -1) @ np.swapaxes(W, 1, 2).reshape(WALKS, -1).T)
        information = self.information + fisher + y_moved.T @ S_inverse @ y_moved
        step = np.minimum(np.maximum(np.linalg.solve(information, slope), -LONGEST_STEP), LONGEST_STEP)
        rest = _IDENTITY - gain @ H
        moved = rest @ (self.moved + (across @ z).T)
        less = gain @ np.swapaxes(across, 1, 2)
        spread = self.spread - less - np.swapaxes(less, 1, 2) + gain @ D @ gain.T
        # Rounding must not make it asymmetric: that part would grow.
        spread = 0.5 * (spread + np.swapaxes(spread, 1, 2))
        return Walking(np.minimum(np.maximum(self.logs + step, LEAST), MOST), information, spread, moved)


def joint(all_told: Sequence[Walking]) -> Walking:
    """Give what several tracks, at least one, have learned together."""
    information = np.sum([told.information for told in all_told], axis=0)
    weighed = np.sum([told.information @ told.logs for told in all_told], axis=0)
    return Walking(np.linalg.solve(information, weighed), information)
