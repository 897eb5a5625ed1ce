"""Rows between two smoothed steps, by Hermite interpolation."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp, rotation_log
from buddyline.solver_service.track.lights import COLUMNS
from buddyline.solver_service.track.output import TrackRow, rows_of
from buddyline.solver_service.track.scale import with_gap
from buddyline.solver_service.track.shaking import SHAKEN_S
from buddyline.solver_service.track.smoother import Path
from buddyline.solver_service.track.state import NAV, PHI, R_, V_, State, invariant_of_plain, plain_of_invariant
from numpy.typing import NDArray

# So many rows are made at once.
TOGETHER: Final = 256
NO_GAP: Final[Floats] = np.zeros(len(COLUMNS))


def rows_between(
    path: Path, times_s: Floats, stamps_ns: Sequence[int], gap: float = 0.0, by_gap: Floats = NO_GAP
) -> Iterator[TrackRow]:
    """Yield the smoothed steps' rows at times (N,) within them.

    gap: between both bars, by_gap (C,): how one of 1 moves the rows' errors; as of `scale.with_gap`.
    """
    if len(path) < 2:
        return
    within = np.flatnonzero((times_s >= path.t_s[0] - 1e-3) & (times_s <= path.t_s[-1] + 1e-3))
    for start in range(0, len(within), TOGETHER):
        some = within[start : start + TOGETHER]
        with np.errstate(all="ignore"):
            rows = _rows_together(path, times_s[some], [stamps_ns[i] for i in some.tolist()], gap, by_gap)
        yield from (row for row in rows if row is not None)


def _rows_together(
    path: Path, times_s: Floats, stamps_ns: Sequence[int], gap: float, by_gap: Floats
) -> list[TrackRow | None]:
    one = np.clip(np.searchsorted(path.t_s, times_s, side="right") - 1, 0, len(path) - 2)
    two = one + 1
    span_s = np.maximum(path.t_s[two] - path.t_s[one], 1e-6)
    # The first step has no turn rates of its own.
    weights = Weights.at((times_s - path.t_s[one]) / span_s, span_s, rated=one > 0)
    before, after = State(path.states[one]), State(path.states[two])
    between = weights.state(before, after, path.rates_radps[one], path.rates_radps[two])
    share = np.clip(weights.share, 0.0, 1.0)
    if path.across is None:
        P = _mixed(share, path.covariance(one), path.covariance(two))
    else:
        by_one, by_two = weights.jacobians(before, after, between)
        across = by_one @ path.across[two] @ by_two.swapaxes(1, 2)
        P = across + across.swapaxes(1, 2)
        for J, k in ((by_one, one), (by_two, two)):
            P += J @ path.covariance(k) @ J.swapaxes(1, 2)
    if gap:
        P = with_gap(P, gap, by_gap, between)
    near = np.where(share < 1.0, one, two)
    return rows_of(
        stamps_ns,
        times_s,
        between,
        P + _unseen(path, between, two, span_s, weights),
        _mixed(share, path.rates_radps[one], path.rates_radps[two]),
        [
            path.statuses[i]._replace(north_doubt=path.statuses[j].north_doubt, lit_m=lit_m)
            for i, j, lit_m in zip(near.tolist(), two.tolist(), path.nearest_lit_m[near].tolist(), strict=True)
        ],
    )


def _mixed(share: Floats, one: Floats, two: Floats) -> Floats:
    """Give (1 - share) one + share two, of values (M, a, b)."""
    by = share[:, None, None]
    return (1.0 - by) * one + by * two


@dataclass(frozen=True, eq=False)
class Weights:
    """How states between two steps are made of both: velocities go straight, the others by Hermite's cubics, each (M,).

    share: of the span that has passed. end: how much of the way from the first place to the second counts; slopes
    (2, M), s: how much both velocities do. turned (M,), rated (2, M): the same of the attitude. Where the first turn
    rates are unknown, they are taken to be those of the whole turn.
    """

    share: Floats
    end: Floats
    slopes: Floats
    turned: Floats
    rated: Floats

    @classmethod
    def at(cls, share: Floats, span_s: Floats, rated: NDArray[np.bool_]) -> Weights:
        """Give them at shares of spans; rated: whether the first turn rates are known."""
        end = share * share * (3.0 - 2.0 * share)
        slopes = span_s * np.stack((share * (1.0 - share) ** 2, share * share * (share - 1.0)))
        by_rates = slopes.copy()
        by_rates[0] = np.where(rated, slopes[0], 0.0)
        return cls(share, end, slopes, end + (slopes[0] - by_rates[0]) / span_s, by_rates)

    def state(self, before: State, after: State, rates_before: Floats, rates_after: Floats) -> State:
        """Give the states between; rates (M, 2, 3): turn rates at both steps."""
        r = before.r_m + self.end[:, None] * (after.r_m - before.r_m)
        r += self.slopes[0, :, None] * before.v_mps + self.slopes[1, :, None] * after.v_mps
        v = before.v_mps + self.share[:, None] * (after.v_mps - before.v_mps)
        turn = self.turned[:, None, None] * rotation_log(before.R.swapaxes(-1, -2) @ after.R)
        turn += self.rated[0, :, None, None] * rates_before + self.rated[1, :, None, None] * rates_after
        return before.moved(r, v, before.R @ rotation_exp(turn))

    def jacobians(self, before: State, after: State, between: State) -> tuple[Floats, Floats]:
        """Give the errors of COLUMNS of the states between by those before and after, (M, C, C) each.

        Samples, or the turn rates of both steps, tell how nodes turn between two steps. So errors of attitudes go
        straight from those of one step to those of the other, whatever the turn. (What noise does is in `_unseen`.)
        Plain errors of places and velocities add up by the weights. The state's own errors are a screw's
        (`State.plus`): T makes plain ones of them at both steps, and its inverse brings them back between.
        """
        back = invariant_of_plain(between)[:, :NAV, :NAV]
        both = []
        for k, state in enumerate((before, after)):
            of_place, of_share = (w if k else 1.0 - w for w in (self.end, self.share))
            J = of_share[:, None, None] * np.eye(len(COLUMNS))
            J[:, range(3), range(3)] = of_place[:, None]
            J[:, range(3), range(3, 6)] = self.slopes[k, :, None]
            J[:, :, :NAV] = J[:, :, :NAV] @ plain_of_invariant(state)[:, :NAV, :NAV]
            J[:, :NAV] = back @ J[:, :NAV]
            both.append(J)
        return both[0], both[1]


def _unseen(path: Path, states: State, two: NDArray[np.intp], span_s: Floats, weights: Weights) -> Floats:
    """Give what states between two steps may be off by, whatever is known at both, (M, C, C) of COLUMNS.

    Of the variance that noise adds in a step h this is left after s of it, with a = s (h - s) / h^2. White noise: a. A
    walk of the turn rate: a^3 of the turn. A walk of the velocity: a of the velocity, and h^2 a^3 / 3 of that for the
    place. Shaking: (1 - e^(-2 s / t)) (1 - e^(-2 (h - s) / t)) / (1 - e^(-2 h / t))^2, but no more than what the
    interpolation takes from the rates at both ends, which are shaken too.
    """
    share = np.clip(weights.share, 0.0, 1.0)
    gone = [-np.expm1(-2.0 * passed * span_s / SHAKEN_S) for passed in (share, 1.0 - share, np.ones_like(share))]
    shaken = path.drawn[two, :3] * (gone[0] * gone[1] / gone[2] ** 2)[:, None]
    left = (share * (1.0 - share))[:, None]
    white = path.drawn[two, 3:5] * np.where(path.without[two], left**3, left)
    walked = path.drawn[two, 5:]
    most = (weights.slopes**2).sum(axis=0)[:, None] * path.swings[two]
    variances = np.zeros((len(two), NAV))
    variances[:, PHI[0]] = (np.minimum(shaken[:, 0], most[:, 0]) + white[:, 0])[:, None]
    variances[:, PHI[1]] = (np.minimum(shaken[:, 1], most[:, 1]) + white[:, 1])[:, None]
    variances[:, V_] = shaken[:, 2:] + walked * left
    variances[:, R_] = walked * (span_s**2)[:, None] * left**3 / 3.0
    T = invariant_of_plain(states)[:, :NAV, :NAV]
    out = np.zeros((len(two), len(COLUMNS), len(COLUMNS)))
    out[:, :NAV, :NAV] = (T * variances[:, None, :]) @ T.swapaxes(-1, -2)
    return out
