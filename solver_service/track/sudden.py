"""Nodes without an inertial unit that begin or cease to turn as they have not for minutes, as lights show it at once.

A diver looks away within tenths of a second. Where that is not believed, it is taken for motion, or one lamp for the
other; his compass is too noisy to tell it in time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.association import Association
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.state import GYRO_BIAS, MOVING, PHI, SIZE, State, invariant_of_plain
from buddyline.solver_service.track.strapdown import predicted
from buddyline.solver_service.track.trail import Step

# One step in twenty is taken to be sudden: a picture's log odds must be higher by so much if it is.
LEAD: Final = 3.0
# The turn rate walks by so much from one picture of the node to the next, rad/s per root s, in so long at most.
RATE: Final = 1.5
LONGEST_S: Final = 0.5
_STILL: Final = np.eye(SIZE)[:MOVING]


@dataclass(frozen=True, eq=False)
class SuddenTurn:
    """The noise that a sudden turn adds to a step: Q (MOVING, MOVING) and walk (SIZE - MOVING,), as Step has them."""

    Q: Floats
    walk: Floats

    @classmethod
    def of(cls, state: State, node: int, span_s: float) -> SuddenTurn:
        """Give that of a node over a time."""
        plain, walk = np.zeros((MOVING, MOVING)), np.zeros(SIZE - MOVING)
        plain[PHI[node], PHI[node]] = RATE**2 * span_s**3 / 3.0 * np.eye(3)
        walk[GYRO_BIAS[node].start - MOVING : GYRO_BIAS[node].stop - MOVING] = RATE**2 * span_s
        T = invariant_of_plain(state)
        return cls(T @ plain @ T.T, walk)

    def added_to_step(self, step: Step) -> Step:
        """Give a step with this noise."""
        return step._replace(Q=step.Q + self.Q, walk=step.walk + self.walk)

    def added_to(self, P: Floats) -> Floats:
        """Give a covariance (SIZE, SIZE) with this noise."""
        return predicted(P, _STILL, self.Q, self.walk)


def with_sudden(
    estimate: Estimate, spans_s: Mapping[int, float], likely: Callable[[Floats], Association]
) -> tuple[Association, Floats, SuddenTurn | None]:
    """Give a picture's lights, and the covariance that they go with: the estimate's, or that with a sudden turn.

    spans_s: of each node that may have turned, for how long; likely: what the lights are by a covariance. The third is
    the turn, None for none; the evidence of one is less by LEAD, for it is rare.
    """
    best: tuple[Association, Floats, SuddenTurn | None] = likely(estimate.covariance), estimate.covariance, None
    for node, span_s in spans_s.items():
        turn = SuddenTurn.of(estimate.state, node, min(span_s, LONGEST_S))
        P = turn.added_to(estimate.covariance)
        found = likely(P)
        if found.evidence - LEAD > best[0].evidence:
            best = found._replace(evidence=found.evidence - LEAD), P, turn
    return best
