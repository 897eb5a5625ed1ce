"""How nodes without inertial units speed up and turn, step by step, as a dive's smoothed path tells it.

Divers are calm for minutes, and look away within tenths of a second. With one walk for a whole dive either the calm
minutes lose what they know, or the sudden turns are not believed, and lights are then taken wrongly. So each step has
its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.smoother import Path
from buddyline.solver_service.track.walking import FIRST, Walking
from numpy.typing import NDArray

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
# A node whose pictures have shown no light for so long, before and after, may have looked elsewhere.
UNSEEN_S: Final = 0.3


@dataclass(frozen=True, eq=False)
class GuessedMotion:
    """Densities per root s of the velocity (m/s) and of A's and B's turn rates (rad/s), as FIRST has them.

    calm (3,): of most steps. t_s (N,), densities (N, 3): of the steps that end then.
    """

    calm: Floats
    t_s: Floats
    densities: Floats

    @classmethod
    def of(cls, walking: Walking) -> GuessedMotion:
        """Begin with what a filter has learned on its way over a dive."""
        calm = walking.densities[_WALKS]
        return cls(calm, np.zeros(1), calm[None])

    def at(self, t_s: float) -> Floats:
        """Give the densities (3,) of the step that ends at t_s, or after it."""
        found: Floats = self.densities[min(int(self.t_s.searchsorted(t_s - 1e-6)), len(self.t_s) - 1)]
        return found

    def relearned(self, path: Path) -> GuessedMotion:
        """Learn the densities of a path's steps, by the auxiliary residuals that these densities have left.

        A density's square is multiplied by the ratio of the residuals' squares to what is expected: of all steps for
        what is calm, and of the steps near where these say that motion was sudden. While a node sees no light it may
        look elsewhere, and its own turning is told by its compass alone: its turn rate keeps the first value at least,
        and while neither sees one, the velocity does. Nothing is learned of such steps for what is calm.
        """
        unseen = _unseen(path)
        free = _free(path)[..., None]
        squares, expected, walked = np.moveaxis(path.auxiliary * free, 2, 0)
        seen = ~unseen
        ratio = _ratio((squares * seen).sum(axis=0), (expected * seen).sum(axis=0))
        calm = np.clip(self.calm * np.sqrt(np.clip(ratio, 1.0 / LONGEST, LONGEST)), LEAST, MOST)
        # Both nodes' acceleration moves the velocity.
        taken = walked / (np.diff(path.t_s, prepend=-np.inf)[:, None] * (2.0, 1.0, 1.0))
        asked = taken * _ratio(_nearby(squares), _nearby(expected))
        raised = (taken > RAISED * self.calm**2) | (asked > SUDDEN * taken)
        densities = np.sqrt(np.where(raised, asked, 0.0))
        least = np.where(unseen, np.maximum(calm, _FIRST), calm)
        return GuessedMotion(calm, path.t_s, np.clip(densities, least, MOST))


def _free(path: Path) -> NDArray[np.bool_]:
    """Tell (N, 3) of which steps velocity, and A's and B's turn rates, are judged.

    The velocity where both nodes have no unit: one that has adds its samples' noise. Not where a unit stops or comes
    back, for its constants begin anew there.
    """
    without = path.without.copy()
    without[1:] &= path.without[:-1]
    return np.concatenate((without.all(axis=1, keepdims=True), without), axis=1)


def _unseen(path: Path) -> NDArray[np.bool_]:
    """Tell (N, 3) in which steps no node, A, and B may have looked elsewhere: near a picture without a light, or far
    from any with one."""
    elsewhere = np.empty((len(path), 2), dtype=bool)
    for node in (0, 1):
        of_node = [[bool(look.chosen) for look in looks if look.node == node] for looks in path.looks]
        dark = np.array([float(bool(found) and not all(found)) for found in of_node])
        lit_s = path.t_s[[any(found) for found in of_node]]
        after = np.searchsorted(lit_s, path.t_s)
        ends_s = np.concatenate(((-np.inf,), lit_s, (np.inf,)))
        away_s = np.minimum(path.t_s - ends_s[after], ends_s[after + 1] - path.t_s)
        elsewhere[:, node] = (_nearby(dark[:, None])[:, 0] > 0.0) | (away_s > UNSEEN_S)
    return np.concatenate((elsewhere.all(axis=1, keepdims=True), elsewhere), axis=1)


def _ratio(squares: Floats, expected: Floats) -> Floats:
    """Give squares over what is expected, 1 where nothing is."""
    return np.where(expected > 0.0, squares / np.where(expected > 0.0, expected, 1.0), 1.0)


def _nearby(values: Floats) -> Floats:
    """Give the sums over each step (N, ...) and NEAR on either side."""
    padded = np.pad(values, ((NEAR, NEAR), (0, 0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * NEAR + 1, axis=0)
    return np.asarray(windows.sum(axis=-1))
