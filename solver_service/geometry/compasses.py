"""Heading as a check of its own: can two compasses, and how far they may disagree, explain a pose?

Two nodes that look at a third party's two lights from equal range get a pose that passes range, twist, tilt and depth.
In that pose they face each other. By their compasses their lines of sight are theta apart, so the headings are 180
degrees minus theta off the pose, whatever the fields of view. A compass beside steel gives a gap, too, and one trigger
cannot tell which of the two it is. A small gap, of up to some 30 degrees, is taken for steel's. For such a gap a third
would have to stand almost between the two nodes, and they would then see each other as well. A gap that noise, steel
and what has been learned of the compasses do not explain contradicts the pose, until the motion has shown that the
compasses are off (`witness.py`). A pose that follows from earlier ones needs no such witness: a diver passes by steel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from buddyline.solver_service.geometry.observation import Heading

# Two compasses disagree by no more than this: one near steel points aside, not backwards. The rest of a quarter turn is
# for the noise of a reading.
MOST_APART_RAD: Final = math.radians(100.0)
# What steel and iron add to the gap, 1 sd. The compasses do not state it, and what was learned at one place does not
# hold at the next: stations by a wreck or in a mine are 10 to 25 degrees off.
STEEL_RAD: Final = math.radians(10.0)
# Squared sigmas of a gap that noise and steel explain. If one pose of four lights in a hundred is of a third's bar, and
# their gaps are spread evenly, then one in fourteen with this gap is (noise of 7 degrees, and steel).
EXPLAINED_CHI2: Final = 9.0


@dataclass(frozen=True, slots=True)
class HeadingGap:
    """How a pose compares with both headings.

    gap_rad: what to add to B's heading so that both agree with the pose. variance: the pose's part in the gap's
    variance, rad^2. azimuth_rad: of the line of sight, by A's heading. agrees: whether noise and steel explain the gap,
    or where a bias was learned, its difference from that. contradicts: whether it speaks against the pose.
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
    off_rad, expected = gap_rad, sensors_variance + variance + STEEL_RAD**2
    if learned is not None:
        off_rad = math.remainder(gap_rad - learned.offset_rad, 2.0 * math.pi)
        expected = learned.variance + variance + STEEL_RAD**2
    agrees = off_rad * off_rad < EXPLAINED_CHI2 * expected
    contradicts = not agrees and not (follows and abs(gap_rad) <= MOST_APART_RAD)
    return HeadingGap(gap_rad, variance, azimuth_rad, agrees, contradicts)
