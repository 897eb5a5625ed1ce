"""How much the inertial units' biases walk, and without units the nodes themselves, learned from the residuals.

Good units' biases walk a sixth as far as those of poor ones, or less. If the assumed walk is too small, tilt, mount and
north-east-down seem better known than they are; if it is too large, what the units tell is wasted. Without a unit the
same is true of a diver's acceleration and turning, and of how fast an attitude's slow error changes. A walk shows only
over seconds, in how the residuals' means change. So the likelihood's whole slope is followed: its part by the
covariance, and its part by the state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.shaking import LONGEST_STEP, MOST_CHI2
from buddyline.solver_service.track.state import ACCEL_BIAS, GYRO_BIAS, MOVING, SIZE

# Densities per root s before anything is learned. Of the gyros' (rad/s) and the accelerometers' (m/s^2) biases: those
# of poor units, which fins shake and water cools; with steadier biases to begin with, the offset of clocks that are far
# apart may not be found. Without units: of the velocity (m/s), of the turn rate (rad/s), and of the attitudes' slow
# error, as a share of their stated sigma: an error with a period of 2 s changes by 0.7 of its sigma in half a second.
# By FIRST_INFORMATION, 1 sd of a bias's walk is a factor of e; the others count as much as seconds of pictures tell, so
# that a dive's first motion is not taken for all of it.
FIRST: Final = np.array((5e-4, 8e-3, 0.3, 0.15, 1.0))
FIRST_LOGS: Final = 2.0 * np.log(FIRST)
FIRST_INFORMATION: Final = np.diag((0.25, 0.25, 30.0, 30.0, 30.0))
# A calm diver may swim off or look away, and without a unit nothing tells it at once: so no walk is taken below this
# share of its first value, that of the turn rate not below the value itself. With less, tracks were wrong while a node
# that had been calm looked away.
LEAST: Final = 2.0 * np.log(np.array((0.1, 0.1, 0.35, 1.0, 0.4)) * FIRST)
MOST: Final = 2.0 * np.log(10.0 * FIRST)
WALKS: Final = len(FIRST)
OF_UNITS: Final = slice(0, 2)
OF_NODES: Final = slice(2, WALKS)
# Seconds of light tell a bias's walk to a factor of three, and too small a walk makes seconds without light look known.
# So what is taken is so many sigmas above what was learned, but no more than the first value.
CAUTIOUS_SIGMAS: Final = 2.0
_BIASES: Final = (GYRO_BIAS, ACCEL_BIAS)


@dataclass(frozen=True, eq=False)
class Walking:
    """The logs (WALKS,) of the walks' variances per s, as FIRST has them, and their information (WALKS, WALKS).

    followed: which of them walk now: those of units, of nodes without one, or all. spread (K, SIZE, SIZE), moved
    (SIZE, K): derivatives of the track's covariance and state by the logs that are followed.
    """

    logs: Floats = field(default_factory=FIRST_LOGS.copy)
    information: Floats = field(default_factory=FIRST_INFORMATION.copy)
    followed: slice = field(default_factory=lambda: OF_UNITS)
    spread: Floats = field(default_factory=lambda: np.zeros((2, SIZE, SIZE)))
    moved: Floats = field(default_factory=lambda: np.zeros((SIZE, 2)))

    @property
    def densities(self) -> Floats:
        """Densities per root s, as FIRST has them."""
        return np.asarray(np.exp(0.5 * self.logs))

    @cached_property
    def cautious_logs(self) -> Floats:
        """The logs, those of units CAUTIOUS_SIGMAS above what was learned, but not above their first values."""
        learned, variances = self.logs[OF_UNITS], np.linalg.inv(self.information).diagonal()[OF_UNITS]
        raised = np.minimum(learned + CAUTIOUS_SIGMAS * np.sqrt(variances), FIRST_LOGS[OF_UNITS])
        return np.concatenate((np.maximum(learned, raised), self.logs[OF_NODES]))

    def cautious(self) -> Walking:
        """Give the walks of `cautious_logs`."""
        return replace(self, logs=self.cautious_logs)

    def following(self, walking: tuple[bool, bool]) -> Walking:
        """Follow the walks that there are if these nodes have a unit; where others were followed, begin at 0."""
        followed = OF_UNITS if all(walking) else slice(0, WALKS) if any(walking) else OF_NODES
        if followed == self.followed:
            return self
        count = followed.stop - followed.start
        return Walking(self.logs, self.information, followed, np.zeros((count, SIZE, SIZE)), np.zeros((SIZE, count)))

    def stepped(
        self,
        F: Floats,
        walk: Floats,
        walking: tuple[bool, bool],
        guessed: Floats | None = None,
        drift: Floats | None = None,
    ) -> Walking:
        """Go on by a step with the transition's rows F (MOVING, SIZE).

        walk (SIZE - MOVING,): the variances that the step adds to the constants. walking: which nodes have a unit.
        guessed (3, SIZE, SIZE): what the step adds by each walk of the nodes that have none. drift (SIZE,): how the
        last of these moves the state.
        """
        now = self.following(walking)
        spread, moved = now.spread.copy(), now.moved.copy()
        across = F @ now.spread
        spread[:, :MOVING, :MOVING] = across @ F.T
        spread[:, :MOVING, MOVING:] = across[:, :, MOVING:]
        spread[:, MOVING:, :MOVING] = across[:, :, MOVING:].swapaxes(1, 2)
        moved[:MOVING] = F @ now.moved
        for k, biases in enumerate(_BIASES):
            for walks, of_node in zip(walking, biases, strict=True):
                if walks:
                    at = range(of_node.start, of_node.stop)
                    spread[k, at, at] += walk[of_node.start - MOVING : of_node.stop - MOVING]
        if guessed is not None:
            spread[-len(guessed) :] += guessed
        if drift is not None:
            moved[:, -1] += drift
        return replace(now, spread=spread, moved=moved)

    def taught(self, y: Floats, S_inverse: Floats, H: Floats, gain: Floats, *, learns: bool = True) -> Walking:
        """Go on by an update with residuals y (m,), H (m, SIZE) and the filter's gain (SIZE, m), by Fisher's scoring.

        With D = dP / dlog, G = H D H^T, u = dx / dlog and z = S^-1 y the likelihood's slope is
        (z^T G z - tr(S^-1 G)) / 2 + z^T H u, its information tr(S^-1 G S^-1 G) / 2 + u^T H^T S^-1 H u. After the
        update u = (I - K H)(u + D H^T z), D = (I - K H) D (I - K H)^T. learns: whether the logs change. The slope is
        that at `cautious_logs`, which were taken: at the logs it is larger by the information times the difference.
        """
        z = S_inverse @ y
        chi2 = float(y @ z)
        z = z * math.sqrt(min(1.0, MOST_CHI2 * len(y) / max(chi2, 1e-9)))
        across = self.spread @ H.T
        D = H @ across
        W = S_inverse @ D
        moved = self.moved + (across @ z).T
        moved -= gain @ (H @ moved)
        # Half of what (I - K H) D (I - K H)^T takes off, the other half is its transpose. Rounding must not make the
        # rest asymmetric: that part would grow.
        spread = self.spread + (gain @ D - 2.0 * across) @ gain.T
        spread = 0.5 * (spread + spread.transpose(0, 2, 1))
        if not learns:
            return Walking(self.logs, self.information, self.followed, spread, moved)
        y_moved = H @ self.moved
        by_row = W.reshape(len(W), -1)
        slope = 0.5 * (D @ z @ z - by_row[:, :: len(y) + 1].sum(axis=1)) + y_moved.T @ z
        fisher = 0.5 * (by_row @ W.transpose(0, 2, 1).reshape(by_row.shape).T)
        at = self.followed, self.followed
        information = self.information.copy()
        information[at] += fisher + y_moved.T @ S_inverse @ y_moved
        step = np.zeros(WALKS)
        above = (self.cautious_logs - self.logs)[self.followed]
        slope = slope + (information - self.information)[at] @ above
        step[self.followed] = np.linalg.solve(information[at], slope)
        step = np.minimum(np.maximum(step, -LONGEST_STEP), LONGEST_STEP)
        logs = np.minimum(np.maximum(self.logs + step, LEAST), MOST)
        return Walking(logs, information, self.followed, spread, moved)


def joint(all_told: Sequence[Walking]) -> Walking:
    """Give what several tracks, at least one, have learned together."""
    information = np.sum([told.information for told in all_told], axis=0)
    weighed = np.sum([told.information @ told.logs for told in all_told], axis=0)
    return Walking(np.linalg.solve(information, weighed), information)
