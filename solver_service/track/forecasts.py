"""Tracks at coming times, for what is told of them: noted where the filter stands, and worked out together.

What is told of a track changes nothing in it. So what a row is made of is noted when its turn comes, and the rows of
several times, and of all pairs that are told of at once, are worked out in one set of arrays.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.lights import BLOCK
from buddyline.solver_service.track.moving import Excerpt, integrated
from buddyline.solver_service.track.output import TrackRow, rows_of
from buddyline.solver_service.track.state import CLOCK, MOVING, NAV, State
from buddyline.solver_service.track.strapdown import (
    Increments,
    Noise,
    guessed_noise,
    noise_of_steps,
    of_nodes,
    of_pairs,
    propagate,
    sampled,
)
from buddyline.solver_service.track.trail import EstimateStatus

# So many are worked out at once at most, and at least, of tracks and of rows: few rotations are worked out otherwise
# (geometry/rotation.py), and a row is to be the same to the last bit whichever others are made with it.
TOGETHER: Final = 256
LEAST_TRACKS: Final = 3
LEAST_ROWS: Final = 9
Many = TypeVar("Many")


@dataclass(frozen=True, eq=False)
class StateNow:
    """A track at one time: its state as a row (ROW,), the covariance (C, C) of COLUMNS, and turn rates (2, 3)."""

    row: Floats
    covariance: Floats
    rates_radps: Floats


@dataclass(frozen=True, eq=False)
class Way:
    """What leads to a track's state from that of span_s before, whose covariance is (SIZE, SIZE).

    samples, noises: of both nodes in between. shares (2,): as `kept_shares` gives them. shaking (3,): its variances.
    """

    span_s: float
    state: State
    covariance: Floats
    samples: tuple[Excerpt, Excerpt]
    noises: tuple[Noise, Noise]
    shares: Floats
    shaking: Floats


class Forecast:
    """A track at t_s, or the way to there, until it is asked for."""

    def __init__(self, t_s: float, found: Way | StateNow) -> None:
        self.t_s = t_s
        self._found = found

    @property
    def now(self) -> StateNow:
        """The track at that time."""
        if isinstance(self._found, Way):
            work_out((self,))
        assert isinstance(self._found, StateNow)
        return self._found

    @property
    def way(self) -> Way | None:
        """What is still to be worked out."""
        return self._found if isinstance(self._found, Way) else None

    def take(self, now: StateNow) -> None:
        """Keep what was worked out."""
        self._found = now


def work_out(forecasts: Iterable[Forecast]) -> None:
    """Work out those of some forecasts that are not yet known."""
    left = [(one, one.way) for one in dict.fromkeys(forecasts)]
    waiting = [(one, way) for one, way in left if way is not None]
    for start in range(0, len(waiting), TOGETHER):
        some = waiting[start : start + TOGETHER]
        for (one, _), now in zip(some, _after(_enough([way for _, way in some], LEAST_TRACKS)), strict=False):
            one.take(now)


def _enough(few: Sequence[Many], least: int) -> list[Many]:
    """Give so many things at least: the last one again."""
    return [*few, *([few[-1]] * (least - len(few)))]


def _after(ways: Sequence[Way]) -> list[StateNow]:
    """Give where some ways end, as a filter's steps would bring it there."""
    states = State(np.array([way.state.row for way in ways]))
    span_s = np.array([way.span_s for way in ways])
    parts = of_pairs(integrated(of_nodes(states), [samples for way in ways for samples in way.samples]))
    after, F = propagate(states, parts, span_s, np.array([way.shares for way in ways]))
    densities = np.stack([sampled(way.noises) for way in ways], axis=1)
    shaking = np.array([way.shaking for way in ways])
    Q, walk, _ = noise_of_steps(after, parts, densities, shaking, span_s, _guessed(parts, ways))
    P = _block_after(np.array([way.covariance for way in ways]), F, Q, walk)
    return list(map(StateNow, after.row, P, parts.rate_radps))


def _guessed(parts: Increments, ways: Sequence[Way]) -> Floats | None:
    """Give what nodes without a unit add to the covariances."""
    if not parts.without.any():
        return None
    of_each = [
        replace(parts, without=without, gap_s=gap) for without, gap in zip(parts.without, parts.gap_s, strict=True)
    ]
    return np.array(
        [
            guessed_noise(one, way.noises, way.span_s, way.shares).sum(axis=0)
            for one, way in zip(of_each, ways, strict=True)
        ]
    )


def _block_after(P: Floats, F: Floats, Q: Floats, walk: Floats) -> Floats:
    """Give, of what `predicted` gives, the covariances (..., C, C) of COLUMNS: of the first errors and the clock's."""
    onward = F[..., :NAV, :]
    across = onward @ P
    after = np.empty((*P.shape[:-2], NAV + 1, NAV + 1))
    after[..., :NAV, :NAV] = across @ onward.swapaxes(-1, -2) + Q[..., :NAV, :NAV]
    after[..., :NAV, NAV] = after[..., NAV, :NAV] = across[..., CLOCK]
    after[..., NAV, NAV] = P[..., CLOCK, CLOCK] + walk[..., CLOCK - MOVING]
    return after


class DueRow:
    """A row that is to be told, and what it is made of: the track at its time, and how its lights were.

    status: of the track's last step.
    """

    def __init__(self, stamp_ns: int, forecast: Forecast, status: EstimateStatus) -> None:
        self.stamp_ns, self.forecast, self.status = stamp_ns, forecast, status
        self._rows: list[TrackRow | None] = []

    @property
    def row(self) -> TrackRow | None:
        """The row; None where the place is known too poorly."""
        if not self._rows:
            make_rows((self,))
        return self._rows[0]

    @property
    def is_made(self) -> bool:
        """Whether it was asked for before."""
        return bool(self._rows)

    def take(self, row: TrackRow | None) -> None:
        """Keep the row that was made."""
        self._rows = [row]


def make_rows(due: Iterable[DueRow]) -> None:
    """Make those of some rows that are not made yet."""
    waiting = [one for one in due if not one.is_made]
    for start in range(0, len(waiting), TOGETHER):
        some = waiting[start : start + TOGETHER]
        work_out(one.forecast for one in some)
        every = _enough(some, LEAST_ROWS)
        now = [one.forecast.now for one in every]
        rows = rows_of(
            [one.stamp_ns for one in some],
            [one.forecast.t_s for one in every],
            State(np.array([each.row for each in now])),
            np.array([each.covariance for each in now]),
            np.array([each.rates_radps for each in now]),
            [one.status for one in every],
        )
        for one, row in zip(some, rows, strict=True):
            one.take(row)


def of_state(t_s: float, state: State, P: Floats, rates_radps: Floats) -> Forecast:
    """Give a forecast of the present: nothing leads further. P (SIZE, SIZE)."""
    return Forecast(t_s, StateNow(state.row, P[BLOCK], rates_radps))
