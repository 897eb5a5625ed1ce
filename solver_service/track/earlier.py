"""What a smoothed track tells of the time before its start: backward over the inertial samples alone."""

from __future__ import annotations

import heapq
from typing import Final

import numpy as np
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.lights import Sight
from buddyline.solver_service.track.smoother import Path, smoothed
from buddyline.solver_service.track.start import broad_covariance
from buddyline.solver_service.track.trail import Step

# Backward for no longer than this: by inertial units alone the state is too uncertain beyond.
EARLIER_S: Final = 10.0


class EarlierFilter(TrackFilter):
    """A filter that holds the samples and pictures of the time before a track, and has passed none of them."""

    def path_before(self, path: Path, since_s: float) -> Path | None:
        """Give the path from since_s to the start of another, with a look of no light at each picture.

        None where a node has no inertial unit then, or was gone.
        """
        start_s, state = float(path.t_s[0]), path.state(0)
        at_start = Estimate(start_s, state, np.zeros((0, 0)), start_s)
        begun = self._rewound(at_start, since_s)
        P = broad_covariance(self.nodes, begun, self.clock_sigma_s)
        estimate = Estimate(since_s, begun, P, since_s, confirmed=True, light_s=since_s)
        self._open(estimate)
        while self._events and self._events[0][0] < start_s - 1e-6:
            t_s, _, _, what = heapq.heappop(self._events)
            if isinstance(what, Sight) and t_s > since_s:
                # Which light is which is decided by the next pass.
                estimate.given[what.node, what.stamp_ns] = ()
                self._step(estimate, t_s, what)
                if any(estimate.without):
                    return None
        F, Q, walk = self._move(estimate, start_s)
        rates_radps = path.rates_radps[min(1, len(path) - 1)]
        last = Step(start_s, estimate.state.row, path.states[0], path.oldest, F, Q, walk, rates_radps, estimate.status)
        estimate.steps.append(last)
        return smoothed(estimate.steps)
