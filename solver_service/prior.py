"""What earlier fixes say of the present one: a prediction that fades, is lost, and is found again.

A constant-velocity filter on T_a_b, twelve error states: position (m), small rotation (rad), velocity (m/s) and
turn rate (rad/s), all in A's camera frame. A fix that does not fit starts it anew: it never argues with the light.
"""

from __future__ import annotations

from typing import Final, TypeAlias

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.rotation import matrix_of, quaternion_of, rotation_exp, rotation_log
from buddyline.solver_service.geometry.trigger import Fix, Prior
from numpy.typing import NDArray

LIFETIME_NS: Final = 2 * S_NS
# How divers and the cameras they hold speed up and turn: spectral densities of white acceleration,
# (m/s^2)^2/Hz and (rad/s^2)^2/Hz. A knows no better of the camera's own shaking, which is in T_a_b too.
ACCELERATION_DENSITY: Final = 0.3**2
TURN_DENSITY: Final = 0.6**2
# At first: 1 sd of what a pair may be doing.
SPEED_MPS: Final = 0.5
TURN_RADPS: Final = 0.5
# Innovations beyond this (six degrees of freedom, 1 in 10^6) mean that something else was seen.
GATE_CHI2: Final = 38.0


_State: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]

_DENSITY: Final = np.diag([ACCELERATION_DENSITY] * 3 + [TURN_DENSITY] * 3)


class PosePrior:
    """Follows the fixes and predicts the next."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._t = np.zeros(3)
        self._R = np.eye(3)
        self._rates = np.zeros(6)
        self._P: NDArray[np.float64] = np.zeros((12, 12))
        self._last: tuple[tuple[int, int], _State] | None = None

    def reset(self) -> None:
        """Forget it."""
        self._stamp_ns = None

    def predict(self, stamp_ns: int) -> Prior | None:
        """Return the prediction for stamp_ns, None where the last fix is too old, or later."""
        if self._stamp_ns is None or not 0 <= stamp_ns - self._stamp_ns <= LIFETIME_NS:
            return None
        t, R, P = self._predicted(stamp_ns)
        return Prior(t, quaternion_of(R), P[:6, :6], self._rates.copy(), P[6:, 6:])

    def update(self, stamp_ns: int, fix: Fix) -> None:
        """Take a new fix."""
        R_fix = matrix_of(fix.q_a_b_xyzw)
        if self._stamp_ns is None or not 0 <= stamp_ns - self._stamp_ns <= LIFETIME_NS:
            self._start(stamp_ns, fix, R_fix)
            return
        t, R, P = self._predicted(stamp_ns)
        innovation = np.concatenate((fix.t_a_b_m - t, rotation_log(R_fix @ R.T)))
        S = P[:6, :6] + fix.covariance
        solved = np.linalg.solve(S, np.concatenate((P[:6], innovation[:, None]), axis=1))
        gain = solved[:, :12].T
        if innovation @ solved[:, 12] > GATE_CHI2:
            self._start(stamp_ns, fix, R_fix)
            return
        step = gain @ innovation
        P = P - gain @ P[:6]
        self._stamp_ns = stamp_ns
        self._t, self._R = t + step[:3], rotation_exp(step[3:6]) @ R
        self._rates = self._rates + step[6:]
        self._P = (P + P.T) / 2

    def _start(self, stamp_ns: int, fix: Fix, R_fix: NDArray[np.float64]) -> None:
        self._stamp_ns = stamp_ns
        self._t, self._R, self._rates = fix.t_a_b_m.copy(), R_fix, np.zeros(6)
        self._P = np.zeros((12, 12))
        self._P[:6, :6] = fix.covariance
        self._P[6:9, 6:9] = SPEED_MPS**2 * np.eye(3)
        self._P[9:, 9:] = TURN_RADPS**2 * np.eye(3)

    def _predicted(self, stamp_ns: int) -> _State:
        """Return t, R and P at stamp_ns; asked for twice a trigger, worked out once."""
        if self._stamp_ns is None:
            raise RuntimeError("nothing is followed")
        asked = (self._stamp_ns, stamp_ns)
        if self._last is None or self._last[0] != asked:
            self._last = asked, self._predict((stamp_ns - self._stamp_ns) / S_NS)
        return self._last[1]

    def _predict(self, dt_s: float) -> _State:
        t = self._t + dt_s * self._rates[:3]
        R = rotation_exp(dt_s * self._rates[3:]) @ self._R
        # F P F^T with F = [[1, dt], [0, 1]] in blocks, and the noise of a white acceleration.
        poses, both, rates = self._P[:6, :6], self._P[:6, 6:], self._P[6:, 6:]
        P = np.empty((12, 12))
        cross = both + dt_s * rates
        P[:6, :6] = poses + dt_s * (cross + both.T) + _DENSITY * (dt_s**3 / 3)
        P[:6, 6:] = cross + _DENSITY * (dt_s**2 / 2)
        P[6:, :6] = P[:6, 6:].T
        P[6:, 6:] = rates + _DENSITY * dt_s
        return t, R, P
