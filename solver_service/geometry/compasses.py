"""Heading as a check of its own: does a pose agree with two compasses, within what they may be off?

Two nodes that look at a third party's two lights from equal range get a pose that passes range, twist, tilt and depth.
In that pose they face each other. By their compasses their lines of sight are theta apart, so the headings are 180
degrees minus theta off the pose, whatever the fields of view. A compass beside steel gives a gap, too, and one trigger
cannot tell which of the two it is. A gap that noise and what has been learned of the compasses do not explain
contradicts the pose, until later triggers have shown that the compasses are off (`witness.py`). A pose that follows
from earlier ones needs no such witness: a diver passes by steel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.observation import Heading
from buddyline.solver_service.geometry.rotation import Floats

# Two compasses disagree by no more than this: one near steel points aside, not backwards. The rest of a quarter turn is
# for the noise of a reading.
MOST_APART_RAD: Final = math.radians(100.0)
# Squared sigmas of a gap that noise explains: one right pose in a hundred has a larger one. If one pose of four lights
# in a hundred is of strangers' lamps, and their gaps are spread evenly, then of the poses with this gap one in eighty
# is (for a sigma of 6 degrees).
EXPLAINED_CHI2: Final = 6.63
# A compass is named as the wrong one where that is so likely.
NAMED: Final = 0.99


@dataclass(frozen=True, slots=True)
class HeadingGap:
    """How a pose compares with both headings.

    gap_rad: what to add to B's heading so that both agree with the pose. variance: the pose's part in the gap's
    variance, rad^2. azimuth_rad: of the line of sight, by A's heading. agrees: whether noise explains the gap, or
    its difference from a learned bias. contradicts: whether it speaks against the pose.
    """

    gap_rad: float
    variance: float
    azimuth_rad: float
    agrees: bool
    contradicts: bool

    @property
    def explicable(self) -> bool:
        """Whether a compass beside steel could explain the gap."""
        return abs(self.gap_rad) <= MOST_APART_RAD


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A pose of four lights at range_m that both headings contradict, as a compass beside steel could."""

    gap: HeadingGap
    range_m: float


def compare_headings(
    gap_rad: float,
    variance: float,
    azimuth_rad: float,
    sensors_variance: float,
    learned: Heading | None,
    *,
    follows: bool,
) -> HeadingGap:
    """Judge a gap; sensors_variance: of both headings' difference, rad^2; follows: earlier poses predict this one."""
    agrees = gap_rad * gap_rad < EXPLAINED_CHI2 * (sensors_variance + variance)
    if learned is not None and not agrees:
        # What was learned beside steel does not hold at the next station; what the compasses state may.
        off_rad = math.remainder(gap_rad - learned.offset_rad, 2.0 * math.pi)
        agrees = off_rad * off_rad < EXPLAINED_CHI2 * (learned.variance + variance)
    contradicts = not agrees and not (follows and abs(gap_rad) <= MOST_APART_RAD)
    return HeadingGap(gap_rad, variance, azimuth_rad, agrees, contradicts)


@dataclass(frozen=True, slots=True)
class LeaveOneOut:
    """What compasses (n) say without each: how far it is off the others' mean, that mean, their chi^2 about it, and
    how likely that compass is the wrong one. chi2: of all about their mean."""

    gaps_rad: Floats
    norths_rad: Floats
    chi2_left: Floats
    wrong: Floats
    chi2: float

    @classmethod
    def of(cls, off_rad: Floats, variances: Floats, covariance: Floats) -> LeaveOneOut:
        """Leave out each of some compasses; the arguments are those of `north_doubt`."""
        inverse = np.linalg.inv(covariance + np.diag(variances))
        weights = inverse.sum(axis=0) / inverse.sum()
        about_mean = inverse - inverse.sum() * np.outer(weights, weights)
        told = about_mean @ off_rad
        gaps = told / np.maximum(np.diag(about_mean), 1e-12)
        chi2 = float(off_rad @ told)
        left = chi2 - told * gaps
        likely = variances * np.exp(0.5 * (left.min() - left))
        return cls(gaps, weights @ off_rad - weights * gaps, left, likely / likely.sum(), chi2)


def wrong_compass(off_rad: Floats, variances: Floats, covariance: Floats) -> tuple[int, float] | None:
    """Give which compass is wrong, and how far it is off the others, rad; None where they do not agree without it.

    The arguments are those of `north_doubt`. Of two, neither is named.
    """
    without = LeaveOneOut.of(off_rad, variances, covariance)
    one = int(without.wrong.argmax())
    named = without.wrong[one] > NAMED and without.chi2_left[one] < EXPLAINED_CHI2 * (len(off_rad) - 2)
    return (one, float(without.gaps_rad[one])) if named else None


def north_doubt(off_rad: Floats, variances: Floats, covariance: Floats) -> float:
    """Give what the variance of north gains where compasses are further apart than they state, rad^2; else 0.

    off_rad (n,): each compass minus the heading that is told. variances (n,): as they state, rad^2. covariance (n, n):
    of the headings; only how well it is known how the nodes are turned to each other counts. One compass is wrong, and
    north is what the others say. Which one is as open as their variances say, and how well the others agree without
    it. Where they do not, either, their mean is widened by Birge's ratio (Phys. Rev. 40, 207, 1932), as the Particle
    Data Group widens what measurements tell that do not agree. Of two whose weighted mean is told, all of it is that.
    """
    free = len(off_rad) - 1
    without = LeaveOneOut.of(off_rad, variances, covariance)
    if without.chi2 <= free:
        return 0.0
    left = np.maximum(without.chi2_left / max(free - 1, 1) - 1.0, 0.0)
    apart = without.norths_rad**2 + left / ((1.0 / variances).sum() - 1.0 / variances)
    return (1.0 - free / without.chi2) * float(without.wrong @ apart)
