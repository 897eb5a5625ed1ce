"""How nodes without inertial units speed up and turn, step by step, as a dive's smoothed path tells it.

Divers are calm for minutes, and look away within tenths of a second. With one walk for a whole dive either the calm
minutes lose what they know, or the sudden turns are not believed, and lights are then taken wrongly. So each step has
its own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.smoother import Path
from buddyline.solver_service.track.walking import FIRST, Walking

# Densities per root s before anything is learned: of the velocity (m/s), of A's and of B's turn rate (rad/s); and which
# shares and multiples of these are taken at least and at most.
_WALKS: Final = [2, 3, 3]
_FIRST: Final = FIRST[_WALKS]
LEAST: Final = np.array((0.1, 0.3, 0.3)) * _FIRST
MOST: Final = 10.0 * _FIRST
# A step is judged with so many on either side. They count as two independent residuals of three axes: beyond SUDDEN
# times what is expected, a chance of 0.001, the motion was sudden.
NEAR: Final = 2
SUDDEN: Final = 3.75
# A step whose variance is this much above the calm ones' is already taken for sudden, and keeps what its residual asks.
RAISED: Final = 1.5
# What is calm is changed by so much at most from one path to the next, of its variance.
LONGEST: Final = np.e


@dataclass(frozen=True, eq=False)
class GuessedMotion:
    """Densities per root s of the velocity (m/s) and of A's and B's turn rates (rad/s), as FIRST has them.

    calm (3,): of most steps. t_s (N,), densities (N, 3): of the steps that end then.
    """

    calm: Floats
    t_s: Floats = field(default_factory=lambda: np.zeros(1))
    densities: Floats = field(default_factory=lambda: _FIRST[None])

    @classmethod
    def of(cls, walking: Walking) -> GuessedMotion:
        """Begin with what a filter has learned on its way over a dive."""
        return cls(walking.densities[_WALKS])

    def at(self, t_s: float) -> Floats:
        """Give the densities (3,) of the step that ends at t_s, or after it."""
        found: Floats = self.densities[min(int(self.t_s.searchsorted(t_s - 1e-6)), len(self.t_s) - 1)]
        return found

    def relearned(self, path: Path) -> GuessedMotion:
        """Learn the densities of a path's steps, by auxiliary residuals that these densities, or the first, have left.

        A density's square is multiplied by the ratio of the residuals' squares to what is expected: of all steps
        for what is calm, and of the steps near where these say that motion was sudden. While a node sees no lamp it may
        look elsewhere, and its own turning is told by its compass alone: it keeps the first value at least.
        """
        squares, expected, walked = np.moveaxis(path.auxiliary * _free(path)[..., None], 2, 0)
        spans_s = np.diff(path.t_s, prepend=-np.inf)[:, None]
        ratio = np.clip(_ratio(squares.sum(axis=0), expected.sum(axis=0)), 1.0 / LONGEST, LONGEST)
        calm = np.clip(self.calm * np.sqrt(ratio), LEAST, MOST)
        # The velocity has the noise of each node that has no unit.
        walkers = np.maximum(path.without.sum(axis=1), 1)[:, None] * (1, 0, 0) + (0, 1, 1)
        taken = walked / (spans_s * walkers)
        asked = taken * _ratio(_nearby(squares), _nearby(expected))
        raised = (taken > RAISED * self.calm**2) | (asked > SUDDEN * taken)
        densities = np.clip(np.sqrt(np.where(raised, asked, 0.0)), calm, MOST)
        blind = _nearby(_blind(path)) > 0.0
        densities[:, 1:] = np.where(blind, np.maximum(densities[:, 1:], _FIRST[1:]), densities[:, 1:])
        return GuessedMotion(calm, path.t_s, densities)


def _free(path: Path) -> Floats:
    """Tell (N, 3) whether a step's velocity, and A's and B's turn rates, were free: 1 without a unit, else 0."""
    return np.concatenate((path.without.any(axis=1, keepdims=True), path.without), axis=1).astype(np.float64)


def _blind(path: Path) -> Floats:
    """Tell (N, 2) whether a step has a picture of A, or B, without any light of the other: 1 or 0."""
    dark = [{look.node for look in looks if not look.chosen} for looks in path.looks]
    return np.array([[float(node in nodes) for node in (0, 1)] for nodes in dark])


def _ratio(squares: Floats, expected: Floats) -> Floats:
    """Give squares over what is expected, 1 where nothing is."""
    return np.where(expected > 0.0, squares / np.where(expected > 0.0, expected, 1.0), 1.0)


def _nearby(values: Floats) -> Floats:
    """Give the sums over each step (N, ...) and NEAR on either side."""
    padded = np.pad(values, ((NEAR, NEAR), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEAR + 1, axis=0)
    return np.asarray(windows.sum(axis=-1))
