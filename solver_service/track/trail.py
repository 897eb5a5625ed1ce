"""The steps of a track in their order: the newest as they are, the older packed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.state import MOVING, SIZE
from numpy.typing import NDArray

Chosen: TypeAlias = tuple[tuple[int, int, float], ...]
"""The lights of one picture that are used: (candidate, light, variance)."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """How far the lights of one picture are off the path that a pass is linear about.

    y (2 n,), S (2 n, 2 n) and H (2 n, C): residuals, their noise R, and their Jacobian by COLUMNS. Once the pass is
    smoothed, y is what the smoothed errors leave of them, and S the covariance of that, R - H P H^T.
    """

    y: Floats
    S: Floats
    H: Floats

    def left_by(self, error: Floats, P: Floats) -> Residuals:
        """Give what smoothed errors (C,) of covariance P (C, C) leave of them."""
        return Residuals(self.y - self.H @ error, self.S - self.H @ P @ self.H.T, self.H)


class Look(NamedTuple):
    """One picture within a step, and the lights that were used.

    residuals: of these, in a pass about a path, where motion is guessed. Samples tell so much of the motion between two
    pictures that each picture can be taken out of a path without them.
    """

    node: int
    stamp_ns: int
    t_s: float
    chosen: Chosen
    residuals: Residuals | None = None


class EstimateStatus(NamedTuple):
    """What rows tell of an estimate at one time, beside its state.

    light_s: when a light was last used; lit_m: the range then, inf where none has been used. lights: how many the last
    trigger's pictures told. north_doubt: the variance, rad^2, that north has beside the covariance.
    """

    light_s: float
    lit_m: float = math.inf
    lights: int = 0
    north_doubt: float = 0.0


class Step(NamedTuple):
    """One step of a track as the smoother needs it.

    before: predicted; after, covariance: with what was seen at t_s. Both are a state's row (ROW,), or the error (SIZE,)
    against the path that a pass is linear about. F (MOVING, SIZE), Q (MOVING, MOVING), walk: how it came here from the
    step before. rates_radps (2, 3). status: as the estimate was after it.
    """

    t_s: float
    before: Floats
    after: Floats
    covariance: Floats
    F: Floats
    Q: Floats
    walk: Floats
    rates_radps: Floats
    status: EstimateStatus
    looks: tuple[Look, ...] = ()


# So many steps are packed at once.
PACK = 128


def halved(size: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Give where a symmetric matrix (size, size) has its upper half, and where in that half each of its numbers is.

    The first counts along its rows, one after the other.
    """
    upper = np.triu_indices(size)
    whole = np.empty((size, size), np.intp)
    whole[upper] = whole.T[upper] = np.arange(len(upper[0]))
    return np.ravel_multi_index(upper, whole.shape), whole


_UPPER, _WHOLE = halved(SIZE)
_MOVING_UPPER, _MOVING_WHOLE = halved(MOVING)
_HALVES = _UPPER.shape, _MOVING_UPPER.shape
_SHAPES = ((), (), (), (), (), (2, 3), *_HALVES, (MOVING, SIZE), (SIZE - MOVING,))
_ENDS = np.cumsum([math.prod(shape) for shape in _SHAPES]).tolist()
_PARTS = list(zip([0, *_ENDS], _ENDS, _SHAPES, strict=False))


@dataclass(frozen=True, eq=False)
class _Pack:
    """Steps as rows of numbers: the first row (W,), and of the others the columns (N, V) in which any differs from it.

    Half of each covariance and noise is kept, and nothing of what never changes: zeros of the transition, constants.
    """

    first: Floats
    changes: NDArray[np.bool_]
    rows: Floats
    looks: tuple[tuple[Look, ...], ...]

    def steps(self) -> list[Step]:
        """Give the steps again, in their order."""
        whole = np.repeat(self.first[None], len(self.rows), axis=0)
        whole[:, self.changes] = self.rows
        return [_step_of(row, looks) for row, looks in zip(whole, self.looks, strict=True)]


def _packed(steps: list[Step]) -> _Pack:
    rows = np.array([_row_of(step) for step in steps])
    changes = (rows != rows[0]).any(axis=0)
    return _Pack(rows[0].copy(), changes, rows[:, changes], tuple(step.looks for step in steps))


def _row_of(step: Step) -> Floats:
    numbers = np.array((step.t_s, *step.status))
    halves = step.covariance.take(_UPPER), step.Q.take(_MOVING_UPPER)
    matrices = step.rates_radps.ravel(), *halves, step.F.ravel()
    return np.concatenate((numbers, *matrices, step.walk, step.before, step.after))


def _step_of(row: Floats, looks: tuple[Look, ...]) -> Step:
    parts = (row[start:end].reshape(shape) for start, end, shape in _PARTS)
    t_s, light_s, lit_m, lights, doubt, rates, half, of_Q, F, walk = parts
    covariance, Q = half.take(_WHOLE), of_Q.take(_MOVING_WHOLE)
    before, after = row[_ENDS[-1] :].reshape(2, -1)
    status = EstimateStatus(float(light_s), float(lit_m), int(lights), float(doubt))
    return Step(float(t_s), before, after, covariance, F, Q, walk, rates, status, looks)


class Trail:
    """Steps of one estimate in order of time."""

    def __init__(self) -> None:
        self._packs: list[_Pack] = []
        self._new: list[Step] = []

    def __len__(self) -> int:
        """Return the number of steps."""
        return sum(len(pack.rows) for pack in self._packs) + len(self._new)

    def copy(self) -> Trail:
        """Return another with the same steps so far."""
        copy = Trail()
        copy._packs, copy._new = list(self._packs), list(self._new)
        return copy

    def append(self, step: Step) -> None:
        """Add the newest step."""
        self._new.append(step)

    @property
    def last(self) -> Step:
        """The newest step."""
        return self._new[-1]

    @last.setter
    def last(self, step: Step) -> None:
        self._new[-1] = step

    def pack(self) -> None:
        """Pack what is older than the last PACK steps; the newest may yet be replaced."""
        while len(self._new) >= 2 * PACK:
            self._packs.append(_packed(self._new[:PACK]))
            del self._new[:PACK]

    def drop_before(self, t_s: float) -> None:
        """Drop the steps before t_s; of a trail that is not packed."""
        while self._new and self._new[0].t_s < t_s:
            self._new.pop(0)

    def drop_after(self, t_s: float) -> None:
        """Drop the steps later than t_s."""
        self._new = [step for step in self._new if step.t_s <= t_s]
        while self._packs and not self._new:
            self._new = [step for step in self._packs.pop().steps() if step.t_s <= t_s]

    def backward(self) -> Iterator[Step]:
        """Yield the steps, the newest first."""
        yield from reversed(self._new)
        for pack in reversed(self._packs):
            yield from reversed(pack.steps())

    def used_up(self) -> Iterator[Step]:
        """Yield the steps, the newest first, and let go of them: of a long dive they take more memory than all else."""
        while self._new:
            yield self._new.pop()
        while self._packs:
            yield from reversed(self._packs.pop().steps())
