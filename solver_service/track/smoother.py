"""Backward over a track's steps: what came later corrects what came before (Rauch, Tung and Striebel)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log, skew
from buddyline.solver_service.track.lights import COLUMNS
from buddyline.solver_service.track.output import TrackRow, rows_of
from buddyline.solver_service.track.shaking import SHAKEN_S
from buddyline.solver_service.track.state import (
    CLOCK_COLUMN,
    GYRO_BIAS,
    MOVING,
    NAV,
    PHI,
    R_,
    ROW,
    SHAKE,
    SHOVE,
    SIZE,
    V_,
    State,
)
from buddyline.solver_service.track.strapdown import predicted
from buddyline.solver_service.track.trail import Look, Step, Trail
from numpy.typing import NDArray

# What rows and pictures need of a covariance: of COLUMNS, half.
_UPPER: Final = np.triu_indices(len(COLUMNS))
_BLOCK_UPPER: Final = COLUMNS[_UPPER[0]], COLUMNS[_UPPER[1]]
# The numbers of Q that Path.drawn is made of. For A's attitude, B's attitude and the velocity each: its variance, the
# variance of what is shaken, and the nine covariances of both.
_SHAKING: Final = ((PHI[0], SHAKE[0]), (PHI[1], SHAKE[1]), (V_, SHOVE))
_DRAWN: Final = (
    np.array([(by.start, off.start, *np.repeat(np.r_[by], 3)) for by, off in _SHAKING]),
    np.array([(by.start, off.start, *np.tile(np.r_[off], 3)) for by, off in _SHAKING]),
)
# The columns of the errors that change as divers like, where no unit tells: velocity, A's and B's turn rates.
_FREE: Final = np.eye(SIZE)[:, np.r_[V_, GYRO_BIAS[0], GYRO_BIAS[1]]]
# So many rows are made at once.
TOGETHER: Final = 256
# Over so many steps a turn rate's swings are averaged.
SWINGS: Final = 20


@dataclass(frozen=True, eq=False)
class Path:
    """Smoothed steps as columns, in order of time.

    t_s, light_s (N,), lights (N,), rates_radps (N, 2, 3): of the steps. states: State.row of each. halves: of the
    covariance of COLUMNS, its upper half. drawn (N, 5): variances that noise added in the step before: of A's and B's
    attitude by shaking, of both by their samples, and of the velocity by shaking. without (N, 2): which node had no
    inertial unit in that step. oldest (SIZE, SIZE): the whole covariance at the first step. auxiliary (N, 3, 3), where
    it was asked for: of the step before, for the velocity and for A's and B's turn rates, the auxiliary residual's
    square (the sum of its axes), what that is expected to be, and the variance that noise added (one axis).
    """

    t_s: Floats
    light_s: Floats
    lights: NDArray[np.int64]
    rates_radps: Floats
    states: Floats
    halves: Floats
    drawn: Floats
    without: NDArray[np.bool_]
    looks: Sequence[tuple[Look, ...]]
    oldest: Floats
    auxiliary: Floats

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.t_s)

    def after(self, earlier: Path) -> Path:
        """Give this path with an earlier one before it, whose last step is its first."""
        columns = ("t_s", "light_s", "lights", "rates_radps", "states", "halves", "drawn", "without", "auxiliary")
        both = {name: np.concatenate((getattr(earlier, name)[:-1], getattr(self, name))) for name in columns}
        return Path(**both, looks=[*earlier.looks[:-1], *self.looks], oldest=earlier.oldest)

    def later(self, clock_s: float) -> Path:
        """Give the path for one who believes B's clock to be so much further ahead."""
        states = self.states.copy()
        states[:, CLOCK_COLUMN] -= clock_s
        looks = [
            tuple(replace(look, t_s=look.t_s - clock_s) if look.node else look for look in seen) for seen in self.looks
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

    def covariance(self, k: NDArray[np.intp] | int) -> Floats:
        """Give the covariance (..., C, C) of COLUMNS at steps."""
        halves = self.halves[k]
        P = np.empty((*halves.shape[:-1], len(COLUMNS), len(COLUMNS)))
        P[..., _UPPER[0], _UPPER[1]] = P[..., _UPPER[1], _UPPER[0]] = halves
        return P


def smoothed(steps: Trail, about: Path | None = None, *, auxiliary: bool = False) -> Path:
    """Give the state and covariance of each step by all steps' measurements.

    Backward, C = P F^T (P-)^-1 with P- = F P F^T + Q; the state is off its filtered one by C (x+1 - x-), its covariance
    P + C (P+1 - P-) C^T. about: the path that these steps are linear about: errors are then taken against it, where
    they add up exactly. auxiliary: whether to give auxiliary residuals (Harvey and Koopman 1992),
    s = (P-)^-1 (x+1 - x-): the noise was off by Q s. The covariance of s is (P-)^-1 (P- - P+1) (P-)^-1.
    """
    count = len(steps)
    looks: list[tuple[Look, ...]] = [()] * count
    found: list[Floats] = [np.zeros(0)] * count
    path = Path(
        t_s=np.empty(count),
        light_s=np.empty(count),
        lights=np.empty(count, np.int64),
        rates_radps=np.empty((count, 2, 3)),
        states=np.empty((count, ROW)),
        halves=np.empty((count, len(_UPPER[0]))),
        drawn=np.empty((count, 5)),
        without=np.empty((count, 2), dtype=bool),
        looks=looks,
        oldest=np.empty((SIZE, SIZE)),
        auxiliary=np.zeros((count, 3, 3)),
    )
    drawn, later = np.empty((count, *_DRAWN[0].shape)), None
    # A state's row, or the error against the path.
    here = np.zeros(0)
    for k, step in zip(range(count - 1, -1, -1), steps.backward(), strict=True):
        if later is None:
            here, P = step.after, step.covariance
        else:
            P_before = predicted(step.covariance, later.F, later.Q, later.walk)
            across = step.covariance.copy()
            across[:, :MOVING] = step.covariance @ later.F.T
            error = State(here).minus(State(later.before)) if about is None else here - later.before
            solved = np.linalg.solve(P_before, np.hstack((across.T, _FREE)) if auxiliary else across.T).T
            gain, by_free = solved[:SIZE], solved[SIZE:]
            if auxiliary:
                squares, expected = (by_free @ error) ** 2, ((by_free @ (P_before - P)) * by_free).sum(axis=1)
                path.auxiliary[k + 1] = np.stack((squares, expected, _walked(later))).reshape(3, 3, 3).sum(axis=2).T
            moved = gain @ error
            here = State(step.after).plus(moved).row if about is None else step.after + moved
            P = step.covariance + gain @ (P - P_before) @ gain.T
            P = 0.5 * (P + P.T)
        path.t_s[k], path.light_s[k], path.lights[k] = step.t_s, step.light_s, step.lights
        found[k], path.halves[k] = here, P[_BLOCK_UPPER]
        drawn[k] = step.Q[_DRAWN]
        path.rates_radps[k] = step.rates_radps
        looks[k] = step.looks
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
    before, after = State(path.states[one]), State(path.states[two])
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
    between = before.moved(r, v, R)
    return rows_of(
        stamps_ns,
        between,
        (1.0 - b3) * path.covariance(one) + b3 * path.covariance(two) + _unseen(path, between, two, span, b),
        (1.0 - b3) * path.rates_radps[one] + b3 * path.rates_radps[two],
        path.lights[near],
        np.maximum(times_s - path.light_s[near], 0.0),
    )


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
    return np.concatenate((shaken[:, :2], of[:, :2, 0] - shaken[:, :2], shaken[:, 2:]), axis=1), without


def _unseen(path: Path, states: State, two: NDArray[np.intp], span_s: Floats, share: Floats) -> Floats:
    """Give what states between two steps may be off by, whatever is known at both, (M, C, C) of COLUMNS.

    share (M,): of the span that has passed since the first. Of what noise does in a step h, white noise leaves
    s (h - s) / h^2, a walk of the turn rate the cube of that, and shaking
    (1 - e^(-2 s / t)) (1 - e^(-2 (h - s) / t)) / (1 - e^(-2 h / t))^2, but no more than what the interpolation takes
    from the rates at both ends, which are shaken too.
    """
    gone = [-np.expm1(-2.0 * passed * span_s / SHAKEN_S) for passed in (share, 1.0 - share, np.ones_like(share))]
    shaken = path.drawn[two] * (gone[0] * gone[1] / gone[2] ** 2)[:, None]
    left = (share * (1.0 - share))[:, None]
    white = path.drawn[two, 2:4] * np.where(path.without[two], left**3, left)
    slopes = span_s**2 * ((share * (1.0 - share) ** 2) ** 2 + (share**2 * (1.0 - share)) ** 2)
    most = slopes[:, None] * path.swings[two]
    variances = np.zeros((len(two), NAV))
    variances[:, PHI[0]] = (np.minimum(shaken[:, 0], most[:, 0]) + white[:, 0])[:, None]
    variances[:, PHI[1]] = (np.minimum(shaken[:, 1], most[:, 1]) + white[:, 1])[:, None]
    variances[:, V_] = shaken[:, 4:5]
    T = np.zeros((len(two), NAV, NAV))
    T[:] = np.eye(NAV)
    T[:, R_, PHI[1]], T[:, V_, PHI[0]] = skew(states.r_m), skew(states.v_mps)
    out = np.zeros((len(two), len(COLUMNS), len(COLUMNS)))
    out[:, :NAV, :NAV] = (T * variances[:, None, :]) @ np.swapaxes(T, -1, -2)
    return out
