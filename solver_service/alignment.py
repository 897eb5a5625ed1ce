"""Estimate the offset between two nodes' clocks from the dive itself.

If the clocks disagree, A and B take their pictures of one trigger at different instants. While the pair moves, the
range gap and the twist gap then follow the motion. Each fix gives two linear equations for the offset, with the
motion taken from the fixes around it. A constant bias of each gap, from calibration errors, is estimated too.

Why track/clocks.py does not replace it: the track finds the offset more exactly, but only where both nodes have an
inertial unit, and a solver can run without a track. docs/track.md has the figures of both.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.closed_form import closed_form, wrap
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.trigger import Fix, Rig

STEP_S: Final = 1e-3
MIN_FIXES: Final = 20
# The motion at a fix is fitted to the fixes within this time before and after it.
HALF_WINDOW_S: Final = 1.0
MIN_NEIGHBOURS: Final = 2
# A diver sways within the window. A straight line underestimates the velocity by a tenth; a cubic does not, but it
# needs this many fixes.
MIN_FOR_CUBIC: Final = 8
# Huber's threshold, in standard deviations: a residual beyond it has another cause than the clocks, and weighs less.
HUBER: Final = 2.0
ROUNDS: Final = 8
MAX_EQUATIONS: Final = 20_000
# Fixes are turned into equations in batches of this size, because a batch costs little more than one fix.
BATCH: Final = 256


@dataclass(frozen=True)
class ClockOffset:
    """offset_s: B's clock minus A's (positive: B is ahead). sigma_s: its 1 sd. fixes: number of fixes used."""

    offset_s: float
    sigma_s: float
    fixes: int


@dataclass(frozen=True)
class _Sighting:
    """A fix with the values for its equations; see ClockAlignment.add."""

    time_s: float
    fix: Fix
    known_s: float
    sigma_rad: tuple[float, float]


class ClockAlignment:
    """Collects the equations of a dive, and solves them for the offset. Beyond MAX_EQUATIONS the oldest are dropped."""

    def __init__(self) -> None:
        self._rows: deque[Floats] = deque()  # batches (4, N) of gap kind, slope, value, sd
        self._window: deque[_Sighting] = deque()
        self._next = 0  # index of the first fix in the window without a motion yet
        self._moving: list[tuple[_Sighting, list[_Sighting]]] = []  # with those that tell their motion
        self._rigs: tuple[Rig, Rig] | None = None

    def add(
        self, stamp_ns: int, fix: Fix, rigs: tuple[Rig, Rig], known_s: float, sigma_rad: tuple[float, float]
    ) -> None:
        """Take one fix; fixes come in order of time.

        known_s: stamp of B's frame minus A's. sigma_rad: bearing noise, 1 sd, of A's and B's view.
        """
        if min(fix.pair_a + fix.pair_b) < 0:
            return
        if self._rigs is None or self._rigs[0] is not rigs[0] or self._rigs[1] is not rigs[1]:
            self._make_equations()
            self._rigs = rigs
        time_s = stamp_ns / S_NS
        if self._window and not 0 < time_s - self._window[-1].time_s <= HALF_WINDOW_S:
            self._window.clear()
            self._next = 0
        self._window.append(_Sighting(time_s, fix, known_s, sigma_rad))
        while self._window[self._next].time_s <= time_s - HALF_WINDOW_S:
            centre = self._window[self._next]
            near = [one for one in self._window if abs(one.time_s - centre.time_s) <= HALF_WINDOW_S]
            before = sum(one.time_s < centre.time_s for one in near)
            if before >= MIN_NEIGHBOURS and len(near) - 1 - before >= MIN_NEIGHBOURS:
                self._moving.append((centre, near))
            self._next += 1
            while self._window[0].time_s < self._window[self._next].time_s - HALF_WINDOW_S:
                self._window.popleft()
                self._next -= 1
        if len(self._moving) >= BATCH:
            self._make_equations()

    def _make_equations(self) -> None:
        """Turn the fixes with known motion into rows."""
        if not self._moving or self._rigs is None:
            return
        sightings = [sighting for sighting, _ in self._moving]
        T_a_b = _poses(sightings)
        rates = _rates(self._moving)
        self._moving.clear()
        expected, slopes, apart_rad = gap_slopes(T_a_b, rates, self._rigs)
        sigma_rad = np.array([s.sigma_rad for s in sightings]).T
        sd = math.sqrt(2.0) * np.hypot(sigma_rad[0] / apart_rad[0], sigma_rad[1] / apart_rad[1])
        seen = np.array(
            [[math.log(s.fix.range_a_m / s.fix.range_b_m) for s in sightings], [s.fix.twist_gap_rad for s in sightings]]
        )
        known_s = np.array([s.known_s for s in sightings])
        value = wrap(seen - expected) - slopes * known_s
        kind = np.repeat([[0.0], [1.0]], len(sightings), axis=1)
        self._rows.append(np.stack((kind, slopes, value, np.stack((sd, sd)))).reshape(4, -1))
        while sum(batch.shape[1] for batch in self._rows) > MAX_EQUATIONS:
            self._rows.popleft()

    def estimate(self) -> ClockOffset | None:
        """Return the offset; None if there are too few fixes, or the pair did not move."""
        self._make_equations()
        if sum(batch.shape[1] for batch in self._rows) < 2 * MIN_FIXES:
            return None
        kind, slope, value, sd = np.hstack(self._rows)
        design = np.stack((-slope, kind == 0, kind == 1), axis=1) / sd[:, None]
        target = value / sd
        weight = np.ones_like(target)
        for _ in range(ROUNDS):
            normal = design.T @ (weight[:, None] * design)
            if np.linalg.cond(normal) > 1e12:
                return None
            solution = np.linalg.solve(normal, design.T @ (weight * target))
            off = np.abs(target - design @ solution)
            # The stated noise of the candidates may be wrong: its scale is estimated from the residuals.
            scale = max(1.4826 * float(np.median(off)), 0.1)
            weight = np.minimum(1.0, HUBER * scale / np.maximum(off, 1e-12))
        sigma_s = scale * math.sqrt(float(np.linalg.inv(normal)[0, 0]))
        return ClockOffset(float(solution[0]), sigma_s, len(kind) // 2)


def _rates(moving: Sequence[tuple[_Sighting, Sequence[_Sighting]]]) -> Floats:
    """Return velocities (m/s) and turn rates (rad/s) of T_a_b at fixes, (N, 6), from cubics through their neighbours.

    With fewer than MIN_FOR_CUBIC fixes: from a straight line.
    """
    counts = np.array([len(near) for _, near in moving])
    told = np.arange(counts.max()) < counts[:, None]
    times_s, moved = np.zeros(told.shape), np.zeros((*told.shape, 6))
    times_s[told] = [one.time_s - centre.time_s for centre, near in moving for one in near]
    centres = _poses([centre for centre, _ in moving])[np.repeat(np.arange(len(moving)), counts)]
    moved[told] = _poses([one for _, near in moving for one in near]).minus(centres)
    powers = times_s[:, :, None] ** np.arange(4) * told[:, :, None]
    powers[counts < MIN_FOR_CUBIC, :, 2:] = 0.0
    return np.asarray((np.linalg.pinv(powers) @ moved)[:, 1], np.float64)


def gap_slopes(T_a_b: SE3, rates: Floats, rigs: tuple[Rig, Rig]) -> tuple[Floats, Floats, Floats]:
    """Return the gaps of noise-free views, their derivatives by the delay of B's view, and the angles between lights.

    T_a_b: K poses, rates: (K, 6), m/s and rad/s. All three results are (2, K). Gaps: the log of the
    ratio of both ranges, and the twist gap (rad). Derivatives: per s. Angles (alpha): rad, between the bearings of
    B's lights in A's view, and of A's lights in B's view.
    """
    count = len(T_a_b)
    shifts_s = np.repeat([0.0, -STEP_S, STEP_S], count)[:, None]
    in_a = np.tile(_bearings(rigs[1].lights_m @ T_a_b.R.swapaxes(1, 2) + T_a_b.t_m[:, None]), (3, 1, 1))
    later = T_a_b[np.tile(np.arange(count), 3)].retract(shifts_s * np.tile(rates, (3, 1)))
    in_b = _bearings((rigs[0].lights_m - later.t_m[:, None]) @ later.R)
    # (3 K, 2 lights, 3) of each view into the closed form's (2 views, 3, 3 K) of each light.
    views = np.stack((in_a, in_b)).transpose(2, 0, 3, 1)
    solved = closed_form(views[0], views[1], *rigs)
    gaps = np.stack((np.log(solved.range_m[0] / solved.range_m[1]), solved.twist_gap_rad)).reshape(2, 3, count)
    slopes = wrap(gaps[:, 2] - gaps[:, 1]) / (2 * STEP_S)
    apart = [np.arccos(np.clip((v[:count, 0] * v[:count, 1]).sum(1), -1.0, 1.0)) for v in (in_a, in_b)]
    return gaps[:, 0], slopes, np.array(apart)


def _poses(sightings: Sequence[_Sighting]) -> SE3:
    return SE3(np.array([s.fix.T_a_b.R for s in sightings]), np.array([s.fix.t_a_b_m for s in sightings]))


def _bearings(points: Floats) -> Floats:
    return np.asarray(points / np.linalg.norm(points, axis=-1, keepdims=True))
