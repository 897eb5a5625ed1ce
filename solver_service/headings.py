"""By how much the two nodes' headings disagree, learned from the poses: magnetometers are biased, and slowly so.

A Kalman filter on one angle that drifts; how much the headings scatter about it is learned along with it.
"""

from __future__ import annotations

import math
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.observation import Heading

# Without a pose for so long, another bias is as likely as this one.
LIFETIME_NS: Final = 60 * S_NS
# How fast a bias drifts as a diver turns and passes by steel, rad^2/s.
DRIFT: Final = math.radians(1.0) ** 2
# At first: what a bias may be, and how the headings scatter; and between which the latter is believed to be.
START_VARIANCE: Final = math.radians(15.0) ** 2
START_NOISE: Final = math.radians(4.0) ** 2
LEAST_NOISE, MOST_NOISE = math.radians(1.0) ** 2, math.radians(10.0) ** 2
# So many poses tell the bias better than the sensors' own word.
ENOUGH: Final = 5
# Of what the last pose tells of the scatter.
MEMORY: Final = 0.95
# A heading this many times its variance off is a jump, or a wrong pose: so much more is then thought possible.
GATE_CHI2: Final = 25.0
JUMP_VARIANCE: Final = math.radians(10.0) ** 2


class HeadingOffset:
    """Follows what is to be added to B's heading so that both agree with the poses."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget it."""
        self._stamp_ns: int | None = None
        self._offset_rad = 0.0
        self._variance = START_VARIANCE
        self._noise = START_NOISE
        self._count = 0

    def predict(self, stamp_ns: int) -> Heading | None:
        """Return it for stamp_ns, None where too few poses, too old or later ones, have told it."""
        if self._count < ENOUGH or not self._follows(stamp_ns):
            return None
        return Heading(self._offset_rad, self._predicted(stamp_ns) + self._noise)

    def update(self, stamp_ns: int, offset_rad: float, variance: float) -> None:
        """Take what one pose tells, with the variance (rad^2) that the pose itself has."""
        if not self._follows(stamp_ns):
            self.reset()
        predicted = self._predicted(stamp_ns)
        self._stamp_ns = stamp_ns
        total = predicted + self._noise + variance
        off_rad = math.remainder(offset_rad - self._offset_rad, 2.0 * math.pi)
        if off_rad * off_rad > GATE_CHI2 * total:
            self._variance = predicted + JUMP_VARIANCE
            return
        gain = predicted / total
        self._offset_rad = math.remainder(self._offset_rad + gain * off_rad, 2.0 * math.pi)
        self._variance = (1.0 - gain) * predicted
        noise = self._noise + (1.0 - MEMORY) * (off_rad * off_rad - total)
        self._noise = min(max(noise, LEAST_NOISE), MOST_NOISE)
        self._count += 1

    def _follows(self, stamp_ns: int) -> bool:
        return self._stamp_ns is not None and 0 <= stamp_ns - self._stamp_ns <= LIFETIME_NS

    def _predicted(self, stamp_ns: int) -> float:
        return self._variance + DRIFT * ((stamp_ns - self._stamp_ns) / S_NS if self._stamp_ns is not None else 0.0)
