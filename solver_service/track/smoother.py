"""Backward over a track's steps: what came later corrects what came before (Rauch, Tung and Striebel)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log
from buddyline.solver_service.track.lights import COLUMNS
from buddyline.solver_service.track.output import TrackRow, rows_of
from buddyline.solver_service.track.state import NAV, ROW, SIZE, State
from buddyline.solver_service.track.strapdown import predicted
from buddyline.solver_service.track.trail import Look, Trail
from numpy.typing import NDArray

# What rows and pictures need of a covariance: of COLUMNS, half.
_UPPER: Final = np.triu_indices(len(COLUMNS))
_BLOCK_UPPER: Final = COLUMNS[_UPPER[0]], COLUMNS[_UPPER[1]]
# So many rows are made at once.
TOGETHER: Final = 256


@dataclass(frozen=True, eq=False)
class Path:
    """Smoothed steps as columns, in order of time.

    t_s, light_s (N,), lights (N,), rates_radps (N, 2, 3): of the steps. states: rows of State.to_row. halves: of the
    covariance of COLUMNS, its upper half. oldest (SIZE, SIZE): the whole covariance at the first step.
    """

    t_s: Floats
    light_s: Floats
    lights: NDArray[np.int64]
    rates_radps: Floats
    states: Floats
    halves: Floats
    looks: Sequence[tuple[Look, ...]]
    oldest: Floats

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.t_s)

    def state(self, k: int) -> State:
        """Give the state at a step."""
        return State.of_row(self.states[k])

    def covariance(self, k: NDArray[np.intp] | int) -> Floats:
        """Give the covariance (..., C, C) of COLUMNS at steps."""
        halves = self.halves[k]
        P = np.empty((*halves.shape[:-1], len(COLUMNS), len(COLUMNS)))
        P[..., _UPPER[0], _UPPER[1]] = P[..., _UPPER[1], _UPPER[0]] = halves
        return P


def smoothed(steps: Trail) -> Path:
    """Give the state and covariance of each step by all steps' measurements.

    Backward, C = P F^T (P-)^-1 with P- = F P F^T + Q; the state is off its filtered one by C (x+1 - x-), its covariance
    P + C (P+1 - P-) C^T.
    """
    count = len(steps)
    looks: list[tuple[Look, ...]] = [()] * count
    path = Path(
        t_s=np.empty(count),
        light_s=np.empty(count),
        lights=np.empty(count, np.int64),
        rates_radps=np.empty((count, 2, 3)),
        states=np.empty((count, ROW)),
        halves=np.empty((count, len(_UPPER[0]))),
        looks=looks,
        oldest=np.empty((SIZE, SIZE)),
    )
    later = None
    for k, step in zip(range(count - 1, -1, -1), steps.backward(), strict=True):
        if later is None:
            state, P = step.after, step.covariance
        else:
            P_before = predicted(step.covariance, later.F, later.Q, later.walk)
            across = step.covariance.copy()
            across[:, :NAV] = step.covariance @ later.F.T
            gain = np.linalg.solve(P_before, across.T).T
            error = gain @ state.minus(later.before)
            P = step.covariance + gain @ (P - P_before) @ gain.T
            P = 0.5 * (P + P.T)
            state = step.after.plus(error)
        path.t_s[k], path.light_s[k], path.lights[k] = step.t_s, step.light_s, step.lights
        path.rates_radps[k], path.states[k], path.halves[k] = step.rates_radps, state.to_row(), P[_BLOCK_UPPER]
        looks[k] = step.looks
        later = step
    if count:
        path.oldest[:] = P
    return path


def rows_between(path: Path, times_s: Floats, stamps_ns: Sequence[int]) -> Iterator[TrackRow]:
    """Yield the smoothed steps' rows at times (N,) within them, by Hermite interpolation."""
    if len(path) < 2:
        return
    within = np.flatnonzero((times_s >= path.t_s[0] - 1e-3) & (times_s <= path.t_s[-1] + 1e-3))
    for start in range(0, len(within), TOGETHER):
        some = within[start : start + TOGETHER]
        with np.errstate(all="ignore"):
            rows = _rows_together(path, times_s[some], [stamps_ns[i] for i in some.tolist()])
        yield from (row for row in rows if row is not None)


def _rows_together(path: Path, times_s: Floats, stamps_ns: Sequence[int]) -> list[TrackRow | None]:
    one = np.clip(np.searchsorted(path.t_s, times_s, side="right") - 1, 0, len(path) - 2)
    two = one + 1
    span = np.maximum(path.t_s[two] - path.t_s[one], 1e-6)
    a = (times_s - path.t_s[one]) / span
    # Cubic Hermite polynomials: of the end point, and of the slopes at both ends.
    end, slope0, slope1 = a * a * (3.0 - 2.0 * a), span * a * (1.0 - a) ** 2, span * a * a * (a - 1.0)
    before, after = State.of_row(path.states[one]), State.of_row(path.states[two])
    r = before.r_m + end[:, None] * (after.r_m - before.r_m)
    r += slope0[:, None] * before.v_mps + slope1[:, None] * after.v_mps
    v = before.v_mps + a[:, None] * (after.v_mps - before.v_mps)
    turn = rotation_log(np.swapaxes(before.R, -1, -2) @ after.R)
    # The first step has no turn rates of its own.
    first = (one == 0)[:, None, None]
    mean_rate = turn / span[:, None, None]
    rates = [np.where(first, mean_rate, path.rates_radps[k]) for k in (one, two)]
    R = before.R @ rotation_exp(
        end[:, None, None] * turn + slope0[:, None, None] * rates[0] + slope1[:, None, None] * rates[1]
    )
    b = np.clip(a, 0.0, 1.0)
    b3 = b[:, None, None]
    near = np.where(b < 1.0, one, two)
    return rows_of(
        stamps_ns,
        before.moved(r, v, R),
        (1.0 - b3) * path.covariance(one) + b3 * path.covariance(two),
        (1.0 - b3) * path.rates_radps[one] + b3 * path.rates_radps[two],
        path.lights[near],
        np.maximum(times_s - path.light_s[near], 0.0),
    )
