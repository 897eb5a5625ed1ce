"""How much the inertial units are shaken in their mounts: its noise, and what the lights' residuals say of its size.

A unit that fins shake turns and moves against the camera, but never away from it: so its angle in the mount, and what
the shaking adds to the velocity, are themselves noise that lasts for SHAKEN_S (Gauss-Markov, of first order), and what
its samples are off by is their rate, which has nothing slow in it. White noise on the samples would let the track
drift away without light, and count ten pictures' shaking as ten steps of a walk.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cache
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.state import MOVING, PHI, R_, SHAKE, SHOVE, V_

# Fins beat once or twice a second, and mounts ring faster: what is slower than 1.5 Hz is motion, 1 / (2 pi 1.5 Hz).
SHAKEN_S: Final = 0.1
# Before the dive tells: between a unit that is screwed to its camera and one in a loose housing, 1 sd. It counts as
# much as FIRST residuals.
SHAKE_RAD: Final = 1e-3
SHOVE_MPS: Final = 1e-2
FIRST: Final = 2.0
FIRST_LOGS: Final = 2.0 * np.log(np.array((SHAKE_RAD, SHAKE_RAD, SHOVE_MPS)))
LEAST: Final = np.log(np.array((5e-5, 5e-5, 5e-4)) ** 2)
MOST: Final = np.log(np.array((0.03, 0.03, 0.3)) ** 2)
# A picture's weight is halved after 200 more, which two nodes take in 10 s at 10 Hz: shaking comes and goes.
KEPT: Final = 0.5 ** (1.0 / 200.0)
LONGEST_STEP: Final = 0.5
# Most units are screwed to their cameras. Where lights hardly tell a pair's shaking, it is taken to be small: each
# picture takes so much off the likelihood's slope by the logs.
CALM: Final = 0.02
_SHORTEST: Final = math.exp(-LONGEST_STEP)
# One residual's chi^2 counts at most so much: gross errors are no shaking.
MOST_CHI2: Final = 9.0
# So much of the shaking is taken to be left at least where a share of the samples' fast part is taken off.
LEAST_LEFT: Final = 0.2


@cache
def nothing_learned(count: int) -> Floats:
    """Give the information (2, count, count) of variances whose first values alone are known; not to be changed."""
    information = np.tile(0.5 * FIRST * np.eye(count), (2, 1, 1))
    information.flags.writeable = False
    return information


def learned(
    logs: Floats,
    information: Floats,
    slope: Floats,
    fisher: Floats,
    first_logs: Floats,
    kept: float,
    calm: float = 0.0,
) -> tuple[Floats, Floats]:
    """Go on by the likelihood's slope (n,) and its information (n, n), both by the logs (n,) of variances.

    information (2, n, n): what has been learned of the logs, and of the variances as shares of the first ones; kept: so
    much of it counts on. In calm times the logs gain little information, so that shaking which begins is believed at
    once. But by the logs alone, shaking that has ended would be believed for long. By the variances it is the other way
    round. The longer of both steps is taken. calm: what is taken off the slope by the logs.
    """
    share = np.exp(logs - first_logs)
    both, slopes = np.empty_like(information), np.empty((2, len(logs), 1))
    both[0], both[1] = fisher, fisher / (share[:, None] * share)
    slopes[0, :, 0], slopes[1, :, 0] = slope - calm, slope / share
    information = kept * information + both + (1.0 - kept) * nothing_learned(len(logs))
    by_logs, by_shares = np.linalg.solve(information, slopes)[..., 0]
    by_shares = np.log(np.maximum(1.0 + by_shares / share, _SHORTEST))
    step = np.where(np.abs(by_shares) > np.abs(by_logs), by_shares, by_logs)
    return logs + np.minimum(np.maximum(step, -LONGEST_STEP), LONGEST_STEP), information


def without_doubts(S_inverse: Floats, doubts: Floats) -> Floats:
    """Give S^-1 of residuals without doubts (m,): the part of lights' variances that stands for unlikely gross errors.

    Shaking is learned so (`association.doubt_of`).
    """
    return np.asarray(np.linalg.inv(np.linalg.inv(S_inverse) - np.diag(doubts))) if doubts.any() else S_inverse


@dataclass(frozen=True, eq=False)
class Shaking:
    """Logs of three variances, both units' angles (rad^2) and the velocity between them.

    information (2, 3, 3): of the logs, and of the variances themselves, as `learned` has it.
    """

    logs: Floats = field(default_factory=FIRST_LOGS.copy)
    information: Floats = field(default_factory=lambda: nothing_learned(3))

    @property
    def variances(self) -> Floats:
        """Of A's angle, B's angle, and the velocity."""
        return np.asarray(np.exp(self.logs))

    def less(self, shares: Floats) -> Shaking:
        """Give what to start with where shares (2 nodes, 2: force, rate) of the samples' fast parts are taken off."""
        left = 1.0 - np.array((shares[0, 1], shares[1, 1], shares[:, 0].min()))
        return Shaking(np.maximum(self.logs + 2.0 * np.log(np.maximum(left, LEAST_LEFT)), LEAST))

    def taught(self, y: Floats, S_inverse: Floats, H: Floats, shaken: Floats, moved: Floats) -> Shaking:
        """Go on by one picture's residuals y (m,) and H (m, NAV), by Fisher's scoring.

        shaken (3, NAV, NAV), moved (NAV, 3): derivatives of covariance and state by the logs. With D_j = H shaken_j
        H^T, u_j = H moved_j and z = S^-1 y the likelihood's slope is (z^T D_j z - tr(S^-1 D_j)) / 2 + z^T u_j, and its
        information tr(S^-1 D_j S^-1 D_k) / 2 + u_j^T S^-1 u_k.
        """
        z = S_inverse @ y
        chi2 = float(y @ z)
        z = z * math.sqrt(min(1.0, MOST_CHI2 * len(y) / max(chi2, 1e-9)))
        D = H @ shaken @ H.T
        W, y_moved = S_inverse @ D, H @ moved
        by_row = W.reshape(3, -1)
        slope = 0.5 * (D @ z @ z - by_row[:, :: len(y) + 1].sum(axis=1)) + z @ y_moved
        fisher = 0.5 * (by_row @ W.transpose(0, 2, 1).reshape(3, -1).T) + y_moved.T @ S_inverse @ y_moved
        logs, information = learned(self.logs, self.information, slope, fisher, FIRST_LOGS, KEPT, CALM)
        return Shaking(np.minimum(np.maximum(logs, LEAST), MOST), information)


def kept_share(span_s: float | Floats) -> Floats:
    """Give the share of the shaking at one time that is left span_s later."""
    return np.asarray(np.exp(-np.asarray(span_s) / SHAKEN_S))


def shaking_noise(R: Floats, variances: Floats, span_s: float | Floats) -> Floats:
    """Give what shaking of these variances (3,) adds to the plain errors' covariance in a step, (3, MOVING, MOVING).

    R (2, 3, 3): attitudes at the end. All may have leading axes, for a batch of steps. A unit's angle goes from q to
    a q + n, and the camera's attitude with it the other way: phi -= R n. The velocity likewise, and the place by what
    it has been meanwhile, m, with
    var n = s^2 (1 - a^2), cov(m, n) = s^2 t (1 - a)^2, var m = s^2 t^2 (2 h / t - 3 + 4 a - a^2).
    """
    a, t, h = kept_share(span_s), SHAKEN_S, np.asarray(span_s)
    out = np.zeros((*R.shape[:-3], 3, MOVING, MOVING))
    by_axis = variances[..., None, None] * np.eye(3)
    fresh = (1.0 - a * a)[..., None, None]
    for node in (0, 1):
        of_node, q = out[..., node, :, :], by_axis[..., node, :, :] * fresh
        of_node[..., PHI[node], PHI[node]] = of_node[..., SHAKE[node], SHAKE[node]] = q
        of_node[..., PHI[node], SHAKE[node]] = across = -q @ R[..., node, :, :]
        of_node[..., SHAKE[node], PHI[node]] = across.swapaxes(-1, -2)
    s, q = out[..., 2, :, :], by_axis[..., 2, :, :]
    s[..., V_, V_] = s[..., SHOVE, SHOVE] = drawn = q * fresh
    s[..., V_, SHOVE] = s[..., SHOVE, V_] = -drawn
    both = q * (t * (1.0 - a) ** 2)[..., None, None]
    s[..., R_, V_] = s[..., V_, R_] = both
    s[..., R_, SHOVE] = s[..., SHOVE, R_] = -both
    s[..., R_, R_] = q * (t * t * np.maximum(2.0 * h / t - 3.0 + 4.0 * a - a * a, 0.0))[..., None, None]
    return out
