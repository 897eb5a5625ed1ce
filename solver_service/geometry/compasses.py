"""Heading as a check of its own: can two compasses, and how far they may disagree, explain a pose?

Two nodes that look at a third party's two lights from equal range get a pose that passes range, twist, tilt and depth.
In that pose they face each other. By their compasses their lines of sight are theta apart, so the headings are 180
degrees minus theta off the pose, whatever the fields of view. A compass that is biased gives a gap too. Which of the
two it is follows from how large a bias may be, and from what earlier poses have told of it. Without earlier poses a
third party's bar that is seen from more than 80 degrees apart cannot be told from a compass beside steel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from buddyline.solver_service.geometry.evidence import AGREES
from buddyline.solver_service.geometry.observation import Heading

# Two compasses disagree by no more than this: one near steel points aside, not backwards. The rest of a quarter turn is
# for the noise of a reading. Lines of sight within 80 degrees of each other are then never taken for opposite ones.
MOST_APART_RAD: Final = math.radians(100.0)
# What has been learned of both compasses changes by less than this until the next pose, unless the motion shows that
# the pose is right.
MOST_CHANGED_RAD: Final = math.radians(60.0)


@dataclass(frozen=True, slots=True)
class HeadingGap:
    """How a pose compares with both headings.

    gap_rad: what to add to B's heading so that both agree with the pose. variance: the pose's part in the gap's
    variance, rad^2. agrees: whether noise explains the gap, alone or about the bias that was learned. contradicts:
    whether no likely bias explains it either.
    """

    gap_rad: float
    variance: float
    agrees: bool
    contradicts: bool


def compare_headings(
    gap_rad: float, variance: float, sensors_variance: float, learned: Heading | None, *, follows: bool
) -> HeadingGap:
    """Judge a gap; sensors_variance: of both headings' difference, rad^2; follows: earlier poses predict this one."""
    agrees = gap_rad * gap_rad < AGREES * (sensors_variance + variance)
    changed = False
    if learned is not None:
        off_rad = abs(math.remainder(gap_rad - learned.offset_rad, 2.0 * math.pi))
        agrees = agrees or off_rad * off_rad < AGREES * (learned.variance + variance)
        changed = off_rad > MOST_CHANGED_RAD and not follows
    return HeadingGap(gap_rad, variance, agrees, not agrees and (abs(gap_rad) > MOST_APART_RAD or changed))
