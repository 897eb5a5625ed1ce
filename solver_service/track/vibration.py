"""What in a node's inertial samples is faster than a diver moves, and how much of it is the unit's alone.

Fins and housings shake a unit in its mount, faster than its camera moves. The fast part of its samples is known where
later samples are: on a dive that is over. Which share of it the camera does not do is told by the lights. With shares s
a sample is x - s x_fast, and every residual of a light that is not corrected so is y = H U s + noise, where U is how a
share of 1 would have moved the state, carried along by the same transition and the same gains (Friedland 1969). Least
squares over a pass give s.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.inputs import Stamps

# The fast part begins here, and is made by a window of so long on either side, longer for what is slower.
FAST_HZ: Final = 1.5
HALF_WINDOW_S: Final = 1.5
# A fast part of less than so many times the variance of the samples' white noise is taken to be that noise: taken off,
# it would leave less noise than is counted.
LEAST_SHAKING: Final = 4.0
# Samples further apart than this many periods are of two runs; a run of less than a window has no fast part.
BROKEN: Final = 1.5
# Of a camera's sudden turn: over so long its variance is averaged, and which share of an octave's is above the octave.
SUDDEN_S: Final = 0.4
ABOVE: Final = 1.0 / 7.0
# The shares of both units' forces and turn rates: A's force, A's rate, B's.
SHARES: Final = 4


def fast_part(stamps_ns: Stamps, values: Floats) -> Floats:
    """Give what is faster than FAST_HZ in a sensor's samples (N, C) in order of time.

    0 where samples are too few to tell, and throughout where it is hardly more than white noise (LEAST_SHAKING).
    """
    fast = _faster_than(FAST_HZ, stamps_ns, values)
    if fast.any() and (fast * fast).mean() < LEAST_SHAKING * _white_variance(values):
        fast[:] = 0.0
    return fast


def sudden_turn(stamps_ns: Stamps, rates_radps: Floats) -> Floats:
    """Give how far (N,) the camera itself may turn faster than FAST_HZ, 1 sd of each axis, rad.

    A diver who looks away turns faster than he swims. Shaking of the unit alone has little in the octave below FAST_HZ,
    such a turn has most there: its rate, whose changes begin and end at once, has a spectrum that falls by 12 dB an
    octave, and so 1 / 7 of that octave's variance above it.
    """
    octave = _faster_than(0.5 * FAST_HZ, stamps_ns, rates_radps) - _faster_than(FAST_HZ, stamps_ns, rates_radps)
    if len(octave) < 2:
        return np.zeros(len(octave))
    period_s = float(np.median(np.diff(stamps_ns))) * 1e-9
    near = np.ones(max(round(SUDDEN_S / max(period_s, 1e-9)), 1) if len(octave) * period_s > SUDDEN_S else 1)
    variance = np.convolve((octave * octave).mean(axis=1), near / len(near), "same")
    turn: Floats = np.sqrt(ABOVE * variance) / (2.0 * np.pi * FAST_HZ)
    return turn


def _faster_than(hz: float, stamps_ns: Stamps, values: Floats) -> Floats:
    """Give what is faster than hz in samples (N, C); 0 where they are too few to tell."""
    fast = np.zeros_like(values)
    if len(stamps_ns) < 3:
        return fast
    steps_s = np.diff(stamps_ns) * 1e-9
    period_s = float(np.median(steps_s))
    half = round(HALF_WINDOW_S * FAST_HZ / hz / period_s) if period_s > 0.0 else 0
    if half < 2:
        return fast
    t_s = np.arange(-half, half + 1) * period_s
    window = np.sinc(2.0 * hz * t_s) * np.hanning(2 * half + 3)[1:-1]
    breaks = np.flatnonzero(np.abs(steps_s / period_s - 1.0) > BROKEN - 1.0) + 1
    for first, stop in zip((0, *breaks.tolist()), (*breaks.tolist(), len(values)), strict=True):
        run = values[first:stop]
        if stop - first < 2 * half + 1 or not np.isfinite(run).all():
            continue
        # Near the ends of a run the window is cut.
        weight = np.convolve(np.ones(stop - first), window, "same")
        for column in range(values.shape[1]):
            middle = run[:, column].mean()
            slow = np.convolve(run[:, column] - middle, window, "same") / weight
            fast[first:stop, column] = run[:, column] - middle - slow
    return fast


def _white_variance(values: Floats) -> float:
    """Give the white noise of samples (N, C) as a variance, mean over the columns, by their third differences."""
    third = np.abs(np.diff(values, 3, axis=0)) / np.sqrt(20.0)
    return float(((np.median(third, axis=0) / 0.6745) ** 2).mean()) if len(third) else 0.0


@dataclass(frozen=True, eq=False)
class Shares:
    """What the lights tell of the shares, as normal equations: information (4, 4) and told (4,)."""

    information: Floats = field(default_factory=lambda: np.zeros((SHARES, SHARES)))
    told: Floats = field(default_factory=lambda: np.zeros(SHARES))

    def taught(self, y: Floats, S_inverse: Floats, moved: Floats) -> Shares:
        """Go on by one picture's residuals y (m,), of which moved (m, 4) is how much a share of 1 makes."""
        weighed = moved.T @ S_inverse
        return Shares(self.information + weighed @ moved, self.told + weighed @ y)

    def plus(self, other: Shares) -> Shares:
        """Join what two tracks tell."""
        return Shares(self.information + other.information, self.told + other.told)

    def best(self) -> Floats:
        """Give the shares (2 nodes, 2: force, rate), each between 0, which is believed without light, and 1."""
        found = np.linalg.solve(self.information + np.eye(SHARES), self.told)
        shares: Floats = np.minimum(np.maximum(found, 0.0), 1.0).reshape(2, 2)
        return shares
