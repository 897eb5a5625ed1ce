"""One node's inertial samples: in order, sound, interpolated to any time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.strapdown import Bools, Noise
from numpy.typing import NDArray

# Further apart, and what lies between two samples is not told.
GAP_S: Final = 0.06
# A sample further than this from both its neighbours, in any axis of force (m/s^2) or rate (rad/s), is false: a torn or
# a wrong reading. Divers, shaken housings and noise stay below a tenth of it from one sample to the next at 100 Hz.
# Where a unit vibrates, the limit is so many times the median distance of the last true samples, if that is more.
FALSE: Final[Floats] = np.repeat((5.0, 0.5), 3)
FALSE_TIMES: Final = 8.0
_LAST_ONES: Final = 33
# Over so long shaking has no mean to speak of, and motion changes little.
SLOW_S: Final = 0.4
_NOISE_SPAN_S: Final = 2.0
# Below these densities what the model leaves out rules: scale, cross-axis, interpolation, shake.
GYRO_FLOOR: Final = 1e-4
ACCEL_FLOOR: Final = 1e-3


@dataclass(frozen=True, eq=False)
class SampleSteps:
    """One node's samples in steps (M): times_s (M, P), values (M, P, 13) and slow_radps (M, 2, 3) as in SampleGrid.

    The last point of a step is repeated where others have more. told (M,): whether samples tell all of the step.
    """

    times_s: Floats
    values: Floats
    slow_radps: Floats
    told: Bools


def sound_ones(values: Floats) -> Bools:
    """Tell which samples (N, 6) are numbers that a unit can give."""
    return np.asarray(np.isfinite(values).all(1) & (np.abs(values) < 1e4).all(1))


def false_ones(times_s: Floats, values: Floats, known: int = 1) -> Bools:
    """Tell which samples (N,), (N, 6), sound and in order of time, are false: jumps that later ones do not follow.

    Nothing later is looked at than the sample itself. One that is near both false ones just before it, or comes more
    than GAP_S after the last true one, is true. So are the first `known` ones.
    """
    out, k = np.zeros(len(times_s), dtype=bool), known - 1
    jumps = _apart(values[1:], values[:-1], FALSE) | (np.diff(times_s) <= 0.0)
    for true in np.flatnonzero(jumps).tolist():
        # Those before k have been judged already.
        if true < k:
            continue
        first = max(true + 1 - 4 * _LAST_ONES, 0)
        last_ones = values[first : true + 1][~out[first : true + 1]][-_LAST_ONES:]
        limits = FALSE
        if len(last_ones) > _LAST_ONES // 2:
            typical = np.median(np.abs(np.diff(last_ones, axis=0)), axis=0).reshape(2, 3).max(axis=1)
            limits = np.maximum(FALSE, np.repeat(FALSE_TIMES * typical, 3))
        k = true + 1
        while k < len(out) and times_s[k] - times_s[true] < GAP_S and _apart(values[k], values[true], limits):
            last = slice(k - 2, k + 1)
            lasts = k > true + 2 and (np.diff(times_s[last]) > 0.0).all()
            if lasts and not _apart(values[last][1:], values[last][:-1], limits).any():
                break
            out[k] = True
            k += 1
    return out


def _apart(one: Floats, other: Floats, limits: Floats) -> Bools:
    """Whether samples (..., 6) are further from each other than limits (6,) in any axis."""
    return np.asarray((np.abs(one - other) > limits).any(axis=-1))


class Samples:
    """Inertial samples in camera axes, by stamp in s since an epoch.

    `rejected` counts samples that were not finite, false, or came twice. `trusted`: whether they are to be used.
    `parted`: whether the fast part of any is known. `shares` (2,): how much of the fast part of force and rate is the
    unit's alone, and is taken off (vibration.py).
    """

    def __init__(self) -> None:
        self._t = np.empty(1024)
        # Force, rate, the fast part of both, and the camera's sudden turn.
        self._values = np.zeros((1024, 13))
        self.parted = False
        self.shares = np.zeros(2)
        self._count = 0
        # The false ones since the last that is not.
        self._false = np.zeros(0), np.zeros((0, 6))
        self._noise_s = -np.inf
        self._noise = Noise(GYRO_FLOOR, ACCEL_FLOOR)
        self.rejected = 0
        self.trusted = True

    def __len__(self) -> int:
        return self._count

    @property
    def times_s(self) -> Floats:
        """The stamps (N,)."""
        return self._t[: self._count]

    @property
    def values(self) -> Floats:
        """Force and rate (N, 6)."""
        return self._values[: self._count, :6]

    def add(self, times_s: Floats, values: Floats, fast: Floats | None = None) -> None:
        """Take samples (N,), (N, 6), in any order; a stamp that is there already is refused.

        fast (N, 7): their fast part and the camera's sudden turn, where they are known.
        """
        sound = np.isfinite(times_s) & sound_ones(values)
        self.rejected += int(len(sound) - sound.sum())
        self.parted |= fast is not None
        values = np.hstack((values, np.zeros((len(values), 7)) if fast is None else fast))
        times_s, values = times_s[sound], values[sound]
        if not len(times_s):
            return
        in_order = bool((np.diff(times_s) > 0.0).all()) and (self._count == 0 or times_s[0] > self._t[self._count - 1])
        if not in_order:
            merged = np.concatenate((self.times_s, times_s))
            every, first = np.unique(merged, return_index=True)
            self.rejected += len(merged) - len(every)
            values = np.concatenate((self._values[: self._count], values))[first]
            # Those that were there have been judged.
            false = false_ones(every, values[:, :6]) & (first >= self._count)
            times_s, self._count, self._false = every, 0, (np.zeros(0), np.zeros((0, 6)))
        else:
            false = self._judged(times_s, values[:, :6])
        self.rejected += int(false.sum())
        times_s, values = times_s[~false], values[~false]
        need = self._count + len(times_s)
        if need > len(self._t):
            room = max(2 * len(self._t), need)
            self._t = np.concatenate((self.times_s, np.empty(room - self._count)))
            self._values = np.concatenate((self._values[: self._count], np.empty((room - self._count, 13))))
        self._t[self._count : need] = times_s
        self._values[self._count : need] = values
        self._count = need

    def _judged(self, times_s: Floats, values: Floats) -> Bools:
        """Tell which of these samples (N,), (N, 6), which come after all others, are false."""
        one = slice(max(self._count - _LAST_ONES, 0), self._count)
        times_s = np.concatenate((self._t[one], self._false[0], times_s))
        values = np.concatenate((self._values[one, :6], self._false[1], values))
        known = max(one.stop - one.start, 1)
        false, count = false_ones(times_s, values, known), one.stop - one.start + len(self._false[0])
        last = 1 + int(np.flatnonzero(~false)[-1])
        self._false = times_s[last:], values[last:]
        return false[count:]

    def forget_before(self, time_s: float) -> None:
        """Drop samples older than time_s, but for the last one."""
        first = min(int(np.searchsorted(self.times_s, time_s)), self._count - 1)
        if first > self._count // 2:
            kept = self._count - first
            self._t[:kept], self._values[:kept] = self._t[first : self._count], self._values[first : self._count]
            self._count = kept

    def put_back(self, by_s: float) -> None:
        """Take all samples for so much earlier: their clock is ahead."""
        self._t[: self._count] -= by_s
        self._false = self._false[0] - by_s, self._false[1]

    def between(self, start_s: float, end_s: float, known_s: float) -> tuple[Floats, Floats, Bools]:
        """Give the grid (M,) from start_s to end_s, the values (M, 13) there, and which intervals are told (M - 1,).

        The values: force and rate without `shares` of their fast part, that part, and the camera's sudden turn; 0 where
        they are not known. known_s: nothing later than this is looked at, so that more samples do not change the
        answer.
        """
        last = int(self.times_s.searchsorted(known_s, side="right"))
        if last == 0 or not self.trusted:
            return np.array((start_s, end_s)), np.zeros((2, 13)), np.zeros(1, dtype=bool)
        t = self._t[:last]
        first, stop = int(t.searchsorted(start_s, side="right")), int(t.searchsorted(end_s, side="left"))
        # Where both times are that of one sample, the first after it is past the last before it.
        points = max(stop - first, 0) + 2
        grid: Floats = np.empty(points)
        at: Floats = np.empty((points, 13))
        grid[0], grid[1:-1], grid[-1] = start_s, t[first:stop], end_s
        at[0], at[-1] = self._interpolated(start_s, first, last), self._interpolated(end_s, stop, last)
        at[1:-1] = self._values[first:stop]
        # An interval is told where the samples on its two sides are near each other.
        sides = t.take(np.arange(first - 1, first + points - 1), mode="clip")
        told: Bools = sides[1:] - sides[:-1] < GAP_S
        if start_s < t[0] or end_s > t[-1]:
            late = np.maximum(grid[1:] - t[-1], 0.0) + np.maximum(t[0] - grid[:-1], 0.0)
            told &= late < 0.5 * GAP_S
        if self.shares.any():
            at[:, :6] -= np.repeat(self.shares, 3) * at[:, 6:12]
        return grid, at, told

    def steps(self, edges_s: Floats, hold_s: float) -> SampleSteps:
        """Give the steps between edges (M + 1,) as `between` and `slow_rate` would, where samples tell all of them.

        hold_s: nothing later than this after a step's end is looked at.
        """
        t, starts, ends = self.times_s, edges_s[:-1], edges_s[1:]
        if len(t) < 2 or not self.trusted:
            steps = len(starts)
            return SampleSteps(
                np.zeros((steps, 2)), np.zeros((steps, 2, 13)), np.zeros((steps, 2, 3)), np.zeros(steps, bool)
            )
        first, stop = t.searchsorted(starts, side="right"), t.searchsorted(ends, side="left")
        known = np.minimum(stop, len(t) - 1)
        told = (first > 0) & (stop > first) & (stop < len(t)) & (t[known] <= ends + hold_s)
        sides = np.maximum(first - 1, 0)
        near = t[sides[0] : known[-1] + 1]
        broken = np.concatenate(((0,), np.cumsum(near[1:] - near[:-1] >= GAP_S)))
        told &= broken[known - sides[0]] == broken[sides - sides[0]]
        inside = first[:, None] + np.arange(max(int((stop - first).max()), 0) + 2) - 1
        past = inside >= stop[:, None]
        at = np.clip(inside, 0, known[:, None])
        times_s, values = t[at], self._values[at]
        times_s[:, 0], values[:, 0] = starts, self._interpolated_at(starts, first)
        times_s[past], values[past] = (
            np.repeat(ends, past.sum(axis=1)),
            np.repeat(self._interpolated_at(ends, stop), past.sum(axis=1), axis=0),
        )
        if self.shares.any():
            values[..., :6] -= np.repeat(self.shares, 3) * values[..., 6:12]
        begin, until = t.searchsorted(edges_s - SLOW_S), t.searchsorted(edges_s + min(0.1 * SLOW_S, hold_s))
        oldest = int(begin[0])
        summed = np.concatenate((np.zeros((1, 3)), np.cumsum(self._values[oldest : until[-1], 3:6], axis=0)))
        slow = (summed[until - oldest] - summed[begin - oldest]) / np.maximum(until - begin, 1)[:, None]
        return SampleSteps(times_s, values, np.stack((slow[:-1], slow[1:]), axis=1), told)

    def _interpolated_at(self, times_s: Floats, after: NDArray[np.intp]) -> Floats:
        """Give the values (N, 13) at times before the samples `after` (N,); beyond the samples, the nearest."""
        after = np.clip(after, 1, self._count - 1)
        before_s, after_s = self._t[after - 1], self._t[after]
        share = np.clip((times_s - before_s) / (after_s - before_s), 0.0, 1.0)[:, None]
        values: Floats = (1.0 - share) * self._values[after - 1] + share * self._values[after]
        return values

    def _interpolated(self, time_s: float, after: int, last: int) -> Floats:
        """Give the values (13,) at a time before the sample `after`, of the first `last`; beyond them, the nearest."""
        if last == 1:
            only: Floats = self._values[0]
            return only
        after = min(max(after, 1), last - 1)
        before_s, after_s = self._t[after - 1 : after + 1].tolist()
        share = min(max((time_s - before_s) / (after_s - before_s), 0.0), 1.0)
        value: Floats = (1.0 - share) * self._values[after - 1] + share * self._values[after]
        return value

    def slow_rate(self, time_s: float, known_s: float) -> Floats | None:
        """Give the mean turn rate (3,) of SLOW_S until known_s or shortly after time_s, None where there is none.

        Shaking is gone from it, motion is SLOW_S / 2 late in it.
        """
        ends_s = time_s - SLOW_S, min(time_s + 0.1 * SLOW_S, known_s)
        first, stop = self.times_s.searchsorted(ends_s).tolist()
        if stop <= first:
            return None
        return np.asarray(np.add.reduce(self._values[first:stop, 3:6]) / (stop - first))

    def near(self, time_s: float, known_s: float) -> bool:
        """Whether there is a sample within a second before time_s, nothing later than known_s looked at."""
        last = int(np.searchsorted(self.times_s, known_s, side="right"))
        return self.trusted and last > 0 and bool(self._t[last - 1] > time_s - 1.0)

    def last(self, time_s: float, span_s: float) -> tuple[Floats, Floats]:
        """Give the times (N,) and the values (N, 6) of the last span_s up to time_s."""
        first, stop = np.searchsorted(self.times_s, (time_s - span_s, time_s))
        return self.times_s[first:stop], self._values[first:stop, :6]

    def noise(self, time_s: float) -> Noise:
        """Give the samples' noise as densities, from their third differences over the last seconds.

        Slow motion has none to speak of; white noise of variance s^2 has 20 s^2.
        """
        if time_s - self._noise_s >= 1.0:
            last = int(np.searchsorted(self.times_s, time_s, side="right"))
            first = int(np.searchsorted(self.times_s, time_s - _NOISE_SPAN_S))
            if last - first > 20:
                self._noise_s = time_s
                t, values = self._t[first:last], self._values[first:last, :6]
                step_s = float(np.median(np.diff(t)))
                # The median of squares, not the mean: a jolt is no noise.
                white = np.median(np.abs(np.diff(values, 3, axis=0)), axis=0) / (0.6745 * np.sqrt(20.0))
                force, rate = np.sqrt(np.mean(white[:3] ** 2)), np.sqrt(np.mean(white[3:] ** 2))
                root = np.sqrt(step_s)
                self._noise = Noise(
                    gyro_rad=float(np.hypot(rate * root, GYRO_FLOOR)),
                    accel_mps=float(np.hypot(force * root, ACCEL_FLOOR)),
                )
        return self._noise
