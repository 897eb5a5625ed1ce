"""The motion prior: a prediction of the pose from earlier fixes.

A constant-velocity filter on T_a_b, twelve error states: position (m), small rotation (rad), velocity (m/s) and
turn rate (rad/s), all in A's camera frame. A fix outside the gate resets the filter; the prior never
overrides a measurement.

Why the track does not replace it: the track starts from fixes and restarts where fixes contradict it, so a fix must not
depend on the track. Without the prior, as it was when this was measured, 28 dives (10 Hz, 30 to 60 s) gave 7,619
poses in place of 9,364, and 9 wrong ones in place of 2: hardly a pose of three lights is sure enough without it. The
track was the same in most of them, but had nothing to start from in one.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.fix import Fix
from buddyline.solver_service.geometry.observation import Prior
from buddyline.solver_service.geometry.rotation import Floats, skew
from buddyline.solver_service.geometry.se3 import SE3

LIFETIME_NS: Final = 2 * S_NS
# Motion of divers and of the cameras they hold: spectral densities of white acceleration between them, (m/s^2)^2/Hz,
# and of each one's white angular acceleration, (rad/s^2)^2/Hz. A's turns move B in A's frame, the more the further away
# it is. Over half a second the demo's divers have, as roots of densities, 0.5 m/s^2 per root Hz along the line of
# sight, 1.1 across it at 5.6 m, and 0.15 rad/s^2 per root Hz of turning.
ACCELERATION_DENSITY: Final = 0.3**2
TURN_DENSITY: Final = 0.25**2
# Initial 1 sd of the pair's velocity and turn rate.
SPEED_MPS: Final = 0.5
TURN_RADPS: Final = 0.5
# Gate on the innovation's chi² (six degrees of freedom; 1 in 10^6 true fixes is above it).
GATE_CHI2: Final = 38.0


# The transition of the state over dt_s is _IDENTITY + dt_s * _RATES.
_IDENTITY: Final = np.eye(12)
_RATES: Final = np.eye(12, k=6)


class PosePrior:
    """Filters the fixes and predicts the next pose."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._T_a_b = SE3.identity()
        self._rates = np.zeros(6)
        self._P = np.zeros((12, 12))
        self._agreed = 0
        self._last: tuple[tuple[int, int], tuple[SE3, Floats]] | None = None

    def reset(self) -> None:
        """Forget all fixes."""
        self._stamp_ns = self._last = None

    def predict(self, stamp_ns: int) -> Prior | None:
        """Return the prediction for stamp_ns; None if the last fix is later, or older than LIFETIME_NS."""
        if self._stamp_ns is None or not 0 <= stamp_ns - self._stamp_ns <= LIFETIME_NS:
            return None
        T_a_b, P = self._predicted(self._stamp_ns, stamp_ns)
        return Prior(T_a_b, P[:6, :6], self._rates, P[6:, 6:], self._agreed, (stamp_ns - self._stamp_ns) / S_NS)

    def update(self, stamp_ns: int, fix: Fix) -> None:
        """Update the filter with a fix; restart it with the fix if that is outside the gate."""
        if self._stamp_ns is None or not 0 <= stamp_ns - self._stamp_ns <= LIFETIME_NS:
            self._start(stamp_ns, fix)
            return
        T_a_b, P = self._predicted(self._stamp_ns, stamp_ns)
        innovation = fix.T_a_b.minus(T_a_b)
        solved = np.linalg.solve(P[:6, :6] + fix.covariance, np.concatenate((P[:6], innovation[:, None]), axis=1))
        gain = solved[:, :12].T
        if innovation @ solved[:, 12] > GATE_CHI2:
            self._start(stamp_ns, fix)
            return
        step = gain @ innovation
        self._stamp_ns, self._last = stamp_ns, None
        self._agreed += 1
        self._T_a_b = T_a_b.retract(step[:6])
        self._rates = self._rates + step[6:]
        P = P - gain @ P[:6]
        self._P = (P + P.T) / 2

    def _start(self, stamp_ns: int, fix: Fix) -> None:
        self._stamp_ns, self._last, self._agreed = stamp_ns, None, 0
        self._T_a_b, self._rates = fix.T_a_b, np.zeros(6)
        self._P = np.diag((0.0,) * 6 + (SPEED_MPS**2,) * 3 + (TURN_RADPS**2,) * 3)
        self._P[:6, :6] = fix.covariance

    def _predicted(self, since_ns: int, stamp_ns: int) -> tuple[SE3, Floats]:
        """Return T_a_b and P at stamp_ns; the last result is kept, because each trigger asks twice."""
        if self._last is None or self._last[0] != (since_ns, stamp_ns):
            self._last = (since_ns, stamp_ns), self._predict((stamp_ns - since_ns) / S_NS)
        return self._last[1]

    def _predict(self, dt_s: float) -> tuple[SE3, Floats]:
        """Return T_a_b after dt_s at constant rates, and P with the noise of a white acceleration added."""
        F = _IDENTITY + dt_s * _RATES
        over_time = np.array(((dt_s**3 / 3, dt_s**2 / 2), (dt_s**2 / 2, dt_s)))
        noise = np.kron(over_time, _density(self._T_a_b.t_m))
        return self._T_a_b.retract(dt_s * self._rates), F @ self._P @ F.T + noise


def _density(t_m: Floats) -> Floats:
    """Give the spectral density (6, 6) of both rates' white accelerations, with B at t_m (3,) in A's frame."""
    density = np.diag([ACCELERATION_DENSITY] * 3 + [2.0 * TURN_DENSITY] * 3)
    # A turn of A by w moves B by t x w, and turns it by -w.
    by_a = skew(t_m)
    density[:3, :3] += TURN_DENSITY * by_a @ by_a.T
    density[:3, 3:] = -TURN_DENSITY * by_a
    density[3:, :3] = density[:3, 3:].T
    return density
