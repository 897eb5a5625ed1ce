"""Backward over a track's steps: what came later corrects what came before (Rauch, Tung and Striebel)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.lights import BLOCK, COLUMNS
from buddyline.solver_service.track.state import (
    CLOCK_COLUMN,
    GYRO_BIAS,
    MOVING,
    PHI,
    ROW,
    SHAKE,
    SHOVE,
    SIZE,
    V_,
    State,
)
from buddyline.solver_service.track.strapdown import predicted
from buddyline.solver_service.track.trail import EstimateStatus, Look, Step, Trail, halved
from numpy.typing import NDArray

# What rows and pictures need of a covariance: of COLUMNS, half.
_UPPER, _WHOLE = halved(len(COLUMNS))
_OF_ALL: Final = np.arange(SIZE * SIZE).reshape(SIZE, SIZE)[BLOCK].take(_UPPER)
# The numbers of Q that Path.drawn is made of. For A's attitude, B's attitude and the velocity each: its variance, the
# variance of what is shaken, and the nine covariances of both.
_SHAKING: Final = ((PHI[0], SHAKE[0]), (PHI[1], SHAKE[1]), (V_, SHOVE))
_DRAWN: Final = (
    np.array([(by.start, off.start, *np.repeat(np.r_[by], 3)) for by, off in _SHAKING]),
    np.array([(by.start, off.start, *np.tile(np.r_[off], 3)) for by, off in _SHAKING]),
)
# The columns of the errors that change as divers like, where no unit tells: velocity, A's and B's turn rates.
_FREE: Final = np.eye(SIZE)[:, np.r_[V_, GYRO_BIAS[0], GYRO_BIAS[1]]]
# Over so many steps a turn rate's swings are averaged.
SWINGS: Final = 20


@dataclass(frozen=True, eq=False)
class Path:
    """Smoothed steps as columns, in order of time.

    t_s (N,), rates_radps (N, 2, 3), statuses, looks: of the steps. states: State.row of each. halves: of the covariance
    of COLUMNS, its upper half. drawn (N, 6): variances that noise added in the step before, of A's and B's attitude and
    of the velocity: by shaking, and by all else. without (N, 2): which node had no inertial unit in that step. oldest
    (SIZE, SIZE): the whole covariance at the first step. auxiliary (N, 3, 3), where it was asked for: of the step
    before, for the velocity and for A's and B's turn rates, the auxiliary residual's square (the sum of its axes), what
    that is expected to be, and the variance that noise added (one axis). across (N, C, C), where it was asked for: the
    covariance of COLUMNS of the step before (rows) with each step (columns).
    """

    t_s: Floats
    rates_radps: Floats
    states: Floats
    halves: Floats
    drawn: Floats
    without: NDArray[np.bool_]
    statuses: Sequence[EstimateStatus]
    looks: Sequence[tuple[Look, ...]]
    oldest: Floats
    auxiliary: Floats
    across: Floats | None = None

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.t_s)

    def after(self, earlier: Path) -> Path:
        """Give this path with an earlier one before it, whose last step is its first."""
        columns = "t_s", "rates_radps", "states", "halves", "drawn", "without", "auxiliary"
        both = {name: np.concatenate((getattr(earlier, name)[:-1], getattr(self, name))) for name in columns}
        statuses, looks = [*earlier.statuses[:-1], *self.statuses], [*earlier.looks[:-1], *self.looks]
        return Path(**both, statuses=statuses, looks=looks, oldest=earlier.oldest)

    def later(self, clock_s: float) -> Path:
        """Give the path for one who believes B's clock to be so much further ahead."""
        states = self.states.copy()
        states[:, CLOCK_COLUMN] -= clock_s
        looks = [
            tuple(look._replace(t_s=look.t_s - clock_s) if look.node else look for look in seen) for seen in self.looks
        ]
        return replace(self, states=states, looks=looks)

    def state(self, k: int) -> State:
        """Give the state at a step."""
        return State(self.states[k])

    @cached_property
    def swings(self) -> Floats:
        """The variance of each node's turn rate, one axis, as its changes from step to step show it, (N, 2)."""
        changes = np.zeros((len(self), 2))
        changes[2:] = 0.5 * ((self.rates_radps[2:] - self.rates_radps[1:-1]) ** 2).mean(axis=2)
        near = np.stack([np.convolve(changes[:, node], np.ones(SWINGS) / SWINGS, "full") for node in (0, 1)], axis=1)
        return near[SWINGS // 2 : SWINGS // 2 + len(self)]

    @cached_property
    def nearest_lit_m(self) -> Floats:
        """The range at the light that is nearest in time to each step, (N,); inf where there is none."""
        lit = np.flatnonzero([any(look.chosen for look in seen) for seen in self.looks])
        times_s, ranges_m = np.append(self.t_s[lit], math.inf), np.append(State(self.states[lit]).range_m, math.inf)
        steps = np.arange(len(self))
        after, so_far = np.searchsorted(lit, steps), np.searchsorted(lit, steps, side="right")
        # The last light may be older than the path.
        older = self.statuses[0]
        older_s = self.t_s - older.light_s if math.isfinite(older.lit_m) else math.inf
        since_s = np.where(so_far, self.t_s - times_s[so_far - 1], older_s)
        before_m = np.where(so_far, ranges_m[so_far - 1], older.lit_m)
        nearest_m: Floats = np.where(since_s <= times_s[after] - self.t_s, before_m, ranges_m[after])
        return nearest_m

    def covariance(self, k: NDArray[np.intp] | int) -> Floats:
        """Give the covariance (..., C, C) of COLUMNS at steps."""
        return self.halves[k].take(_WHOLE, axis=-1)


def smoothed(
    steps: Trail,
    about: Path | None = None,
    *,
    auxiliary: bool = False,
    across: bool = False,
    uses_up: bool = False,
) -> Path:
    """Give the state and covariance of each step by all steps' measurements.

    Backward, C = P F^T (P-)^-1 with P- = F P F^T + Q; the state is off its filtered one by C (x+1 - x-), its covariance
    P + C (P+1 - P-) C^T. about: the path that these steps are linear about: errors are then taken against it, where
    they add up exactly, and each look has the residuals that the smoothed errors leave. auxiliary: whether to give
    auxiliary residuals (Harvey and Koopman 1992), s = (P-)^-1 (x+1 - x-): the noise was off by Q s. The covariance of s
    is (P-)^-1 (P- - P+1) (P-)^-1. across: whether to give the covariances of neighbours, C P+1 (de Jong and MacKinnon
    1988). uses_up: whether the steps are let go of.
    """
    count = len(steps)
    statuses = [EstimateStatus(math.nan)] * count
    looks: list[tuple[Look, ...]] = [()] * count
    found: list[Floats] = [np.zeros(0)] * count
    path = Path(
        t_s=np.empty(count),
        rates_radps=np.empty((count, 2, 3)),
        states=np.empty((count, ROW)),
        halves=np.empty((count, len(_UPPER))),
        drawn=np.empty((count, 6)),
        without=np.empty((count, 2), dtype=bool),
        statuses=statuses,
        looks=looks,
        oldest=np.empty((SIZE, SIZE)),
        auxiliary=np.zeros((count, 3, 3)),
        across=np.zeros((count, len(COLUMNS), len(COLUMNS))) if across else None,
    )
    drawn, later = np.empty((count, *_DRAWN[0].shape)), None
    # A state's row, or the error against the path.
    here = np.zeros(0)
    for k, step in zip(range(count - 1, -1, -1), steps.used_up() if uses_up else steps.backward(), strict=True):
        if later is None:
            here, P = step.after, step.covariance
        else:
            P_before = predicted(step.covariance, later.F, later.Q, later.walk)
            moved_on = step.covariance.copy()
            moved_on[:, :MOVING] = step.covariance @ later.F.T
            error = State(here).minus(State(later.before)) if about is None else here - later.before
            solved = np.linalg.solve(P_before, np.hstack((moved_on.T, _FREE)) if auxiliary else moved_on.T).T
            gain, by_free = solved[:SIZE], solved[SIZE:]
            if auxiliary:
                squares, expected = (by_free @ error) ** 2, ((by_free @ (P_before - P)) * by_free).sum(axis=1)
                path.auxiliary[k + 1] = np.stack((squares, expected, _walked(later))).reshape(3, 3, 3).sum(axis=2).T
            moved = gain @ error
            here = State(step.after).plus(moved).row if about is None else step.after + moved
            if path.across is not None:
                path.across[k + 1] = (gain[COLUMNS] @ P)[:, COLUMNS]
            P = step.covariance + gain @ (P - P_before) @ gain.T
            P = 0.5 * (P + P.T)
        path.t_s[k], statuses[k] = step.t_s, step.status
        found[k], path.halves[k] = here, P.take(_OF_ALL)
        drawn[k] = step.Q[_DRAWN]
        path.rates_radps[k] = step.rates_radps
        looks[k] = tuple(
            look._replace(residuals=look.residuals.left_by(here[COLUMNS], P[BLOCK])) if look.residuals else look
            for look in step.looks
        )
        later = step
    if count:
        path.oldest[:] = P
        path.drawn[:], path.without[:] = _drawn(drawn)
        # A path may go on after the last picture, where a pass about it ends.
        states = State(np.array(found) if about is None else about.states[:count])
        states = states if about is None else states.plus(np.array(found))
        path.states[:] = states.row
        # Without a unit the turn rate is estimated, too (strapdown.process_noise).
        np.copyto(path.rates_radps, -states.gyro_bias_radps, where=path.without[..., None])
    return path


def _walked(step: Step) -> Floats:
    """Give a third of the variances (9,) that noise added to _FREE in a step: three axes together give their mean."""
    return np.concatenate((step.Q[V_, V_].diagonal(), step.walk[GYRO_BIAS[0].start - MOVING :][:6])) / 3.0


def _drawn(noted: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Give Path.drawn and Path.without of the numbers (N, 3, 11) that _DRAWN picks out of each step's Q."""
    of = noted[..., :2]
    # Without a unit its shaking is drawn, but moves nothing.
    moved = np.asarray(noted[..., 2:].any(axis=-1))
    shaken = np.where(moved, of[..., 1], 0.0)
    without = np.asarray(~moved[:, :2] & (of[:, :2, 0] > 0.0))
    return np.concatenate((shaken, of[..., 0] - shaken), axis=1), without
