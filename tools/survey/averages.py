"""Means of readings that are correlated and contain outliers, with realistic standard deviations."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Bools: TypeAlias = NDArray[np.bool_]
Ints: TypeAlias = NDArray[np.int64]

OUTLIER_SIGMAS: Final = 4.0
# Ratio of standard deviation to median absolute deviation of a normal distribution.
MAD_TO_SIGMA: Final = 1.4826
# Readings within this time have the same error at any rate: the diver's hold and the filters change slowly.
CORRELATION_S: Final = 1.0


@dataclass(frozen=True)
class Mean:
    """A value with its standard deviation, in one unit; count: the number of readings.

    noise: the part of sigma that is new in each series of readings; the rest varies slowly.
    """

    value: float
    sigma: float
    count: int
    noise: float


def inliers(values: Floats, least_sigma: float) -> Bools:
    """Return a mask (n,) of the values (n,) or (n, k) that are no outlier in any column.

    least_sigma: the least scatter that is assumed, so that one reading among equal ones is not an outlier.
    """
    table = values.reshape(len(values), -1)
    off = np.abs(table - np.median(table, axis=0))
    sigma = np.maximum(MAD_TO_SIGMA * np.median(off, axis=0), least_sigma)
    return np.asarray((off <= OUTLIER_SIGMAS * sigma).all(axis=1))


def effective_count(stamps_s: Floats, values: Floats) -> float:
    """Return the effective number of independent readings of a correlated series (n,), from 1 to n.

    n / (1 + 2 sum of autocorrelations), summed until the first that is not positive (Geyer 1992's initial
    positive sequence, lag by lag), and never more than one reading in CORRELATION_S.
    """
    n = len(values)
    if n < 2:
        return float(n)
    centred = values - values.mean()
    power = float(centred @ centred)
    inflation = 1.0
    if power > 0:
        for lag in range(1, n // 2 + 1):
            correlation = float(centred[lag:] @ centred[:-lag]) / power
            if correlation <= 0:
                break
            inflation += 2 * correlation
    span_s = float(np.ptp(stamps_s))
    return max(min(n / inflation, span_s / CORRELATION_S + 1, n), 1.0)


def mean_of_white(stamps_s: Floats, values: Floats, stated_sigma: float, floor: float) -> Mean:
    """Return the mean of readings whose stated noise is new in each of them; floor: what averaging does not reduce.

    The larger of scatter and stated noise counts.
    """
    scatter = float(values.std(ddof=1)) if len(values) > 1 else 0.0
    count = effective_count(stamps_s, values)
    sigma = math.hypot(max(scatter, stated_sigma) / math.sqrt(count), floor)
    return Mean(float(values.mean()), sigma, len(values), sigma)


def mean_of_slow(stamps_s: Floats, values: Floats, stated_sigma: float, floor: float) -> Mean:
    """Return the mean of readings whose stated error is partly slow: a compass, a tilt, a gauge.

    Averaging reduces the part that scatters. The rest of the stated variance did not vary during the series, so it
    stays in full.
    """
    variance = float(values.var(ddof=1)) if len(values) > 1 else 0.0
    unseen = max(stated_sigma**2 - variance, 0.0)
    noise = math.sqrt(variance / effective_count(stamps_s, values) + floor**2)
    return Mean(float(values.mean()), math.hypot(math.sqrt(unseen), noise), len(values), noise)


def unwrapped(angles_rad: Floats) -> Floats:
    """Return angles (n,) within pi of their circular mean, so that they can be averaged."""
    centre = math.atan2(float(np.sin(angles_rad).mean()), float(np.cos(angles_rad).mean()))
    turned: Floats = centre + (angles_rad - centre + math.pi) % (2 * math.pi) - math.pi
    return turned


def wrap(angle_rad: float) -> float:
    """Return an angle within -pi..pi."""
    return (angle_rad + math.pi) % (2 * math.pi) - math.pi
