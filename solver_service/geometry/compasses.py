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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from buddyline.solver_service.geometry.observation import Heading

# Two compasses disagree by no more than this: one near steel points aside, not backwards. The rest of a quarter turn is
# for the noise of a reading.
MOST_APART_RAD: Final = math.radians(100.0)
# Squared sigmas of a gap that noise explains: one right pose in a hundred has a larger one. If one pose of four lights
# in a hundred is of strangers' lamps, and their gaps are spread evenly, then of the poses with this gap one in eighty
# is (for a sigma of 6 degrees).
EXPLAINED_CHI2: Final = 6.63


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


def north_doubt(off_rad: Sequence[float], variances: Sequence[float], variance: float) -> float:
    """Give what the variance of north gains where two compasses are further apart than they state, rad^2; else 0.

    off_rad (2,): each compass minus the north that is told. variances (2,): as they state, rad^2. variance: of their
    difference, by what tells how the nodes are turned to each other. One compass is right, and which of the two is as
    open as their variances say. Where the north that is told is their weighted mean, this is Birge's ratio (Phys. Rev.
    40, 207, 1932), by which the Particle Data Group widens what two measurements tell that do not agree.
    """
    stated, apart = sum(variances), off_rad[1] - off_rad[0]
    if apart * apart <= stated + variance:
        return 0.0
    right = variances[0] * off_rad[1] ** 2 + variances[1] * off_rad[0] ** 2
    return (1.0 - (stated + variance) / (apart * apart)) * right / stated
