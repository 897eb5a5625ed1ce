"""How much each member's inertial unit is shaken in its mount, learned from the lights' residuals.

As the track learns it (track/shaking.py), for any number of nodes: two variances of each, of its angle and of the
velocity that shaking adds. What each variance contributes to the covariance is followed in its node's own block alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.network.state import COMMON, MOVING, P_, PHI, SHAKE, SHOVE, V_
from buddyline.solver_service.track.shaking import (
    FIRST_LOGS,
    LEAST,
    MOST,
    MOST_CHI2,
    SHAKEN_S,
    kept_share,
    learned,
    nothing_learned,
)

# An update's weight is halved after this number of updates times that of members; one update takes all pictures of a
# trigger.
HALVED: Final = 100.0
_FIRST, *_BOUNDS = (np.array((logs[0], logs[2])) for logs in (FIRST_LOGS, LEAST, MOST))
_I: Final = np.eye(3)


@dataclass(frozen=True, eq=False)
class NetShaking:
    """Logs of the variances (n, 2), their information (2, 2 n, 2 n), as `track/shaking.learned` has it, and parts
    (n, 2, MOVING, MOVING): what of each member's covariance comes from each."""

    logs: Floats
    information: Floats
    parts: Floats

    @classmethod
    def of_none(cls) -> NetShaking:
        """Return that of no members."""
        return cls(np.zeros((0, 2)), nothing_learned(0), np.zeros((0, 2, MOVING, MOVING)))

    @property
    def variances(self) -> Floats:
        """Of each member's angle and velocity (n, 2)."""
        return np.asarray(np.exp(self.logs))

    def joined(self, told: Floats | None = None) -> NetShaking:
        """Return it with one more member. told (2,): the logs of its variances by an earlier pass, None where nothing
        is known of it."""
        n = len(self.logs)
        information = nothing_learned(2 * n + 2).copy()
        information[:, : 2 * n, : 2 * n] = self.information
        first = _FIRST if told is None else told
        more = np.zeros((1, 2, MOVING, MOVING))
        return NetShaking(np.concatenate((self.logs, first[None])), information, np.concatenate((self.parts, more)))

    def chosen(self, members: list[int]) -> NetShaking:
        """Return it for some members."""
        which = [2 * member + k for member in members for k in (0, 1)]
        return NetShaking(self.logs[members], self.information[np.ix_((0, 1), which, which)], self.parts[members])

    def moved(self, F: Floats, drawn: Floats) -> NetShaking:
        """Go on by a step of the members: F (n, MOVING, MOVING), and what it adds, (n, 2, MOVING, MOVING)."""
        onward = F[:, None]
        return NetShaking(self.logs, self.information, onward @ self.parts @ onward.swapaxes(-1, -2) + drawn)

    def taught(self, y: Floats, S_inverse: Floats, H: Floats, gain: Floats) -> NetShaking:
        """Go on by one update's residuals y (m,), H (m, N), by Fisher's scoring (Shaking.taught).

        gain (N, m): of the update. S_inverse (m, m): of the residuals, as they are to be learned from.

        A node's part does not follow what an update makes of it in other nodes' errors. Between nodes whose places are
        poorly known, but together, it could grow without an end. It is kept within S: tr(S^-1 D) <= rank D.
        """
        n, m = len(self.logs), len(y)
        H_own = np.swapaxes(H[:, COMMON:].reshape(m, n, -1), 0, 1)[:, :, :MOVING]
        D = (H_own[:, None] @ self.parts @ H_own.swapaxes(1, 2)[:, None]).reshape(2 * n, m, m)
        W = S_inverse @ D
        rank = np.repeat(np.clip(H_own.any(axis=2).sum(axis=1), 1, MOVING), 2)
        share = np.trace(W, axis1=1, axis2=2) / rank
        above = np.maximum(share, 1.0)[:, None, None]
        D, W, own = D / above, W / above, self.parts / above.reshape(n, 2, 1, 1)
        z = S_inverse @ y
        z = z * math.sqrt(min(1.0, MOST_CHI2 * m / max(float(y @ z), 1e-9)))
        slope = 0.5 * (D @ z @ z - np.trace(W, axis1=1, axis2=2))
        fisher = 0.5 * (W.reshape(2 * n, -1) @ W.swapaxes(1, 2).reshape(2 * n, -1).T)
        kept, first = 0.5 ** (1.0 / (HALVED * n)), np.tile(_FIRST, n)
        logs, information = learned(self.logs.ravel(), self.information, slope, fisher, first, kept)
        rest = (np.eye(MOVING) - gain[COMMON:].reshape(n, -1, m)[:, :MOVING] @ H_own)[:, None]
        parts = rest @ own @ rest.swapaxes(-1, -2)
        return NetShaking(np.clip(logs.reshape(n, 2), *_BOUNDS), information, parts)


def shaking_parts(R: Floats, span_s: Floats) -> Floats:
    """Give what shaking of unit variances adds in steps of (n,) to nodes' plain errors, (n, 2, MOVING, MOVING).

    R (n, 3, 3): their attitudes at the end. As track/shaking.shaking_noise, for one node each.
    """
    a, t = kept_share(span_s), SHAKEN_S
    fresh, both = ((share[:, None, None] * _I) for share in (1.0 - a * a, t * (1.0 - a) ** 2))
    out = np.zeros((len(R), 2, MOVING, MOVING))
    angle, velocity = out[:, 0], out[:, 1]
    angle[:, PHI, PHI] = angle[:, SHAKE, SHAKE] = fresh
    angle[:, PHI, SHAKE] = -fresh @ R
    angle[:, SHAKE, PHI] = angle[:, PHI, SHAKE].swapaxes(1, 2)
    velocity[:, V_, V_] = velocity[:, SHOVE, SHOVE] = fresh
    velocity[:, V_, SHOVE] = velocity[:, SHOVE, V_] = -fresh
    velocity[:, P_, V_] = velocity[:, V_, P_] = both
    velocity[:, P_, SHOVE] = velocity[:, SHOVE, P_] = -both
    way = t * t * np.maximum(2.0 * span_s / t - 3.0 + 4.0 * a - a * a, 0.0)
    velocity[:, P_, P_] = way[:, None, None] * _I
    return out
