"""The offset between two nodes' clocks, out of the dive itself.

A pair that moves is seen by A and by B at two instants if their clocks disagree: the range gap and the twist gap
then follow the motion. Each fix gives two linear equations for the offset, by the motion of the fixes around it; a
constant bias of either gap, from calibration, is estimated beside it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from protocol.clock import S_NS
from solver_service.geometry.closed_form import closed_form
from solver_service.geometry.rotation import matrix_of, rotation_exp, rotation_log
from solver_service.geometry.trigger import Fix, Rig

Floats = NDArray[np.float64]

STEP_S: Final = 1e-3
MIN_FIXES: Final = 20
# The motion at a fix is that of the fixes this far before and after it.
HALF_WINDOW_S: Final = 1.0
MIN_NEIGHBOURS: Final = 2
# Beyond this many standard deviations a gap says something else than the time.
HUBER: Final = 2.0
ROUNDS: Final = 8
MAX_EQUATIONS: Final = 20_000


@dataclass(frozen=True)
class ClockOffset:
    """offset_s: B's clock minus A's (positive: B is ahead); sigma_s: 1 sd; fixes: how many it is from."""

    offset_s: float
    sigma_s: float
    fixes: int


@dataclass(frozen=True)
class _Sighting:
    """A fix with what its equations need; see ClockAlignment.add."""

    time_s: float
    fix: Fix
    R_a_b: Floats
    rigs: tuple[Rig, Rig]
    known_s: float
    sigma_rad: tuple[float, float]


class ClockAlignment:
    """Collects the equations of a dive; bounded, the oldest are forgotten."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, float, float, float]] = []  # gap kind, slope, value, sd
        self._window: deque[_Sighting] = deque()
        self._next = 0  # the first of the window whose equations are still to be made

    def add(
        self, stamp_ns: int, fix: Fix, rigs: tuple[Rig, Rig], known_s: float, sigma_rad: tuple[float, float]
    ) -> None:
        """Take one fix, in order of time.

        known_s: stamp of B's frame minus A's. sigma_rad: bearing noise of A's and B's view.
        """
        if min(fix.pair_a + fix.pair_b) < 0:
            return
        time_s = stamp_ns / S_NS
        if self._window and not 0 < time_s - self._window[-1].time_s <= HALF_WINDOW_S:
            self._window.clear()
            self._next = 0
        self._window.append(_Sighting(time_s, fix, matrix_of(fix.q_a_b_xyzw), rigs, known_s, sigma_rad))
        while self._window[self._next].time_s <= time_s - HALF_WINDOW_S:
            self._add_equations(self._window[self._next])
            self._next += 1
            while self._window[0].time_s < self._window[self._next].time_s - HALF_WINDOW_S:
                self._window.popleft()
                self._next -= 1

    def _rates(self, centre: _Sighting) -> Floats | None:
        """Velocity (m/s) and turn rate (rad/s) of T_a_b at a fix, (6,): the slope through its neighbours."""
        near = [s for s in self._window if abs(s.time_s - centre.time_s) <= HALF_WINDOW_S]
        times_s = np.array([s.time_s - centre.time_s for s in near])
        if (times_s < 0).sum() < MIN_NEIGHBOURS or (times_s > 0).sum() < MIN_NEIGHBOURS:
            return None
        moved = np.array([np.concatenate((s.fix.t_a_b_m, rotation_log(s.R_a_b @ centre.R_a_b.T))) for s in near])
        times_s -= times_s.mean()
        return np.asarray(times_s @ (moved - moved.mean(0)) / (times_s @ times_s))

    def _add_equations(self, sighting: _Sighting) -> None:
        rates = self._rates(sighting)
        if rates is None:
            return
        expected, slopes, apart_rad = gap_slopes(sighting.fix, rates, sighting.rigs)
        sigma_a, sigma_b = sighting.sigma_rad
        sd = math.sqrt(2.0) * math.hypot(sigma_a / apart_rad[0], sigma_b / apart_rad[1])
        seen = math.log(sighting.fix.range_a_m / sighting.fix.range_b_m), sighting.fix.twist_gap_rad
        for kind in range(2):
            value = math.remainder(seen[kind] - expected[kind], 2 * math.pi)
            self._rows.append((float(kind), slopes[kind], value - slopes[kind] * sighting.known_s, sd))
        if len(self._rows) > MAX_EQUATIONS:
            del self._rows[: MAX_EQUATIONS // 10]

    def estimate(self) -> ClockOffset | None:
        """Return the offset, None where the fixes are too few or the pair did not move."""
        if len(self._rows) < 2 * MIN_FIXES:
            return None
        kind, slope, value, sd = np.array(self._rows).T
        design = np.stack((-slope, kind == 0, kind == 1), axis=1) / sd[:, None]
        target = value / sd
        weight = np.ones_like(target)
        for _ in range(ROUNDS):
            normal = design.T @ (weight[:, None] * design)
            if np.linalg.cond(normal) > 1e12:
                return None
            solution = np.linalg.solve(normal, design.T @ (weight * target))
            off = np.abs(target - design @ solution)
            # The candidates' own noise may be stated wrongly: the residuals tell its scale.
            scale = max(1.4826 * float(np.median(off)), 0.1)
            weight = np.minimum(1.0, HUBER * scale / np.maximum(off, 1e-12))
        sigma_s = scale * math.sqrt(float(np.linalg.inv(normal)[0, 0]))
        return ClockOffset(float(solution[0]), sigma_s, len(self._rows) // 2)


def gap_slopes(
    fix: Fix, rates: Floats, rigs: tuple[Rig, Rig]
) -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Return both gaps of noise-free views, their slopes by the time B's view is later (1/s), and both alphas (rad).

    The gaps: log of the ratio of both ranges, and the twist gap.
    """
    R = matrix_of(fix.q_a_b_xyzw)
    shifts_s = np.array([0.0, -STEP_S, STEP_S])
    seen_by_a = _bearings(rigs[1].lights_m @ R.T + fix.t_a_b_m)
    in_a = np.repeat(seen_by_a[:, :, None], 3, axis=2)
    in_b = np.empty((2, 3, 3))
    for i, shift_s in enumerate(shifts_s):
        t_later = fix.t_a_b_m + shift_s * rates[:3]
        R_later = rotation_exp(shift_s * rates[3:]) @ R
        in_b[:, :, i] = _bearings((rigs[0].lights_m - t_later) @ R_later)
    left, right = np.stack((in_a[0], in_b[0])), np.stack((in_a[1], in_b[1]))
    solved = closed_form(left, right, *rigs)
    log_ratio = np.log(solved.range_m[0] / solved.range_m[1])
    twist = solved.twist_gap_rad
    slopes = (
        (log_ratio[2] - log_ratio[1]) / (2 * STEP_S),
        math.remainder(twist[2] - twist[1], 2 * math.pi) / (2 * STEP_S),
    )
    apart = tuple(math.acos(min(max(float(v[0] @ v[1]), -1.0), 1.0)) for v in (seen_by_a, in_b[:, :, 0]))
    return (float(log_ratio[0]), float(twist[0])), (float(slopes[0]), float(slopes[1])), (apart[0], apart[1])


def _bearings(points: Floats) -> Floats:
    return np.asarray(points / np.linalg.norm(points, axis=1, keepdims=True))
