"""Attitude messages as measurements of the turning, for a node or a time without an inertial unit."""

from __future__ import annotations

import bisect
from collections.abc import Sequence
from operator import itemgetter
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track.inputs import AttitudeSeen

# An attitude at a time is a straight line's value, fitted over so long on either side.
HALF_WINDOW_S: Final = 0.05
FLOOR_RAD: Final = 1e-3
time_of: Final = itemgetter(0)
"""Of a message with its time before it."""


class Turning:
    """What one node's attitudes at their times (s), in order, tell of its turning; messages are added to the list."""

    def __init__(self, attitudes: Sequence[tuple[float, AttitudeSeen]], R_body_camera: Floats) -> None:
        self._attitudes = attitudes
        self._R_body_camera = R_body_camera
        self._white_s = -np.inf
        self._white = np.full(3, 0.008)

    def stated(self, t_s: float) -> tuple[float, float] | None:
        """Give the last stated sigmas of tilt and heading at or before t_s, rad; None before the first."""
        last = bisect.bisect_right(self._attitudes, t_s, key=time_of)
        if last == 0:
            return None
        roll, pitch, heading = self._attitudes[last - 1][1].sigma_rad.tolist()
        return max(roll, pitch), heading

    def at(self, t_s: float, known_s: float) -> tuple[Floats, Floats] | None:
        """Give R_level_camera at t_s and the variances (3,) of what is new in it, rad^2, camera axes.

        Nothing later than known_s is looked at. None where there are too few messages.
        """
        last = bisect.bisect_right(self._attitudes, known_s, key=time_of)
        near = self._near(t_s, last)
        if near is None:
            return None
        self._learn(t_s, last)
        return near[0], self._white**2 * near[1]

    def _near(self, t_s: float, last: int) -> tuple[Floats, float] | None:
        """Give the fitted attitude at t_s and its variance over that of one message."""
        first = bisect.bisect_left(self._attitudes, t_s - HALF_WINDOW_S, 0, last, key=time_of)
        stop = bisect.bisect_left(self._attitudes, t_s + HALF_WINDOW_S, 0, last, key=time_of)
        if stop - first < 3:
            return None
        t = np.array([at_s for at_s, _ in self._attitudes[first:stop]]) - t_s
        R = self._R_level_camera(first, stop)
        middle = R[len(R) // 2]
        off = small_log(middle.T @ R)
        mean_t = float(t.mean())
        spread = float(((t - mean_t) ** 2).sum())
        if spread <= 0.0 or t[0] > 0.03 or t[-1] < -0.03:
            return None
        weights = 1.0 / len(t) - mean_t * (t - mean_t) / spread
        return middle @ rotation_exp(weights @ off), float(weights @ weights)

    def _learn(self, t_s: float, last: int) -> None:
        """Learn the messages' white noise from third differences over the last two seconds."""
        if t_s - self._white_s < 1.0 or last < 20:
            return
        self._white_s = t_s
        R = self._R_level_camera(max(last - 100, 0), last)
        steps = small_log(R[:-1].swapaxes(1, 2) @ R[1:])
        third = np.diff(steps, 2, axis=0)
        white = np.median(np.abs(third), axis=0) / (0.6745 * np.sqrt(20.0))
        self._white = np.maximum(white, FLOOR_RAD)

    def _R_level_camera(self, first: int, stop: int) -> Floats:
        R: Floats = np.array([seen.R_ned_body for _, seen in self._attitudes[first:stop]]) @ self._R_body_camera
        return R


def small_log(R: Floats) -> Floats:
    """Give the rotation vectors (..., 3) of small turns (..., 3, 3)."""
    vector: Floats = 0.5 * np.stack(
        (R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]), axis=-1
    )
    sine = np.sqrt((vector * vector).sum(-1, keepdims=True))
    return vector * np.where(sine > 1e-6, np.arcsin(np.minimum(sine, 1.0)) / np.maximum(sine, 1e-9), 1.0)
