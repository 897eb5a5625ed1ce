"""The track a second later and better: backward over the last steps."""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.solver_service.track.between import rows_between
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.lights import COLUMNS
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.smoother import smoothed

LAG_S: Final = 1.0
# A pass backward serves all rows that have come due; so seldom it is cheap.
EVERY_S: Final = 0.5
# What the filter keeps: a lost picture may put a pass off once more, and a row stands between two steps.
KEPT_S: Final = LAG_S + 4.0 * EVERY_S


class TrackLag:
    """Rows of a filter, LAG_S after their stamps. The filter must keep KEPT_S of steps."""

    def __init__(self, track: TrackFilter) -> None:
        self._track = track
        self._due: list[int] = []
        self._done_s = -np.inf

    def ask(self, stamps_ns: list[int]) -> None:
        """Ask for rows at stamps, in order."""
        self._due += stamps_ns

    def rows(self) -> list[TrackRow]:
        """Return the rows that have come due; call it after `TrackFilter.advance`, at least every EVERY_S."""
        return self._rows(LAG_S, EVERY_S)

    def finish(self) -> list[TrackRow]:
        """Return the rows that are left at the end of a dive, which no later picture will better."""
        return self._rows(0.0, 0.0)

    def _rows(self, lag_s: float, every_s: float) -> list[TrackRow]:
        main = self._track.main
        if main is None or not main.confirmed or len(main.steps) < 2 or not self._due or self._track.withheld():
            return []
        ready_s = main.t_s - lag_s
        ready = [stamp for stamp in self._due if self._track.pair_seconds(stamp) <= ready_s]
        if not ready or ready_s - self._done_s < every_s:
            return []
        self._done_s = ready_s
        self._due = self._due[len(ready) :]
        times_s = np.array([self._track.pair_seconds(stamp) for stamp in ready])
        gap = main.scale.share if main.scale.found else 0.0
        rows = list(rows_between(smoothed(main.steps), times_s, ready, gap, main.by_scale[COLUMNS]))
        main.steps.drop_before(ready_s - EVERY_S)
        return rows
