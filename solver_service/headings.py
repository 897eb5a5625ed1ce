"""Estimate the difference of two nodes' heading biases from the poses. Magnetometer biases change slowly.

A Kalman filter on one angle that drifts. The scatter of the headings about it, its measurement noise, is estimated too.

Why the track does not replace it: a fix must not depend on the track (see prior.py), and compasses.py needs to know how
far two compasses usually are apart, to tell a third party's lights. Without it, the dives of prior.py give 9,277 poses
in place of 9,364.
"""

from __future__ import annotations

import math
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.compasses import MOST_APART_RAD
from buddyline.solver_service.geometry.fix import Fix, NoFix
from buddyline.solver_service.geometry.observation import Heading
from buddyline.solver_service.witness import Witnesses

# After this time without a pose the estimate is dropped: the bias may have changed.
LIFETIME_NS: Final = 60 * S_NS
# Drift of the bias as a diver turns and passes by steel, rad^2/s.
DRIFT: Final = math.radians(1.0) ** 2
# Initial variance of the bias, and initial variance of the headings' scatter, rad^2; then the bounds of the latter.
START_VARIANCE: Final = math.radians(15.0) ** 2
START_NOISE: Final = math.radians(4.0) ** 2
LEAST_NOISE, MOST_NOISE = math.radians(1.0) ** 2, math.radians(10.0) ** 2
# After this many poses the estimate is better than the sensors' stated sigmas.
ENOUGH: Final = 5
# Weight of the old estimate of the scatter at each pose.
MEMORY: Final = 0.95
# A squared innovation above GATE_CHI2 times its variance is a jump of the bias, or a wrong pose. It is not used, and
# the variance of the bias grows by JUMP_VARIANCE, rad^2.
GATE_CHI2: Final = 25.0
JUMP_VARIANCE: Final = math.radians(10.0) ** 2


class HeadingOffset:
    """Tracks the angle to add to B's heading so that both headings agree with the poses."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the estimate."""
        self._stamp_ns: int | None = None
        self._offset_rad = 0.0
        self._variance = START_VARIANCE
        self._noise = START_NOISE
        self._count = 0
        self._witnesses = Witnesses()

    def predict(self, stamp_ns: int) -> Heading | None:
        """Return the estimate at stamp_ns; None after too few poses, or if the last pose is later or too old."""
        if self._count < ENOUGH or not self._follows(stamp_ns):
            return None
        return Heading(self._offset_rad, self._predicted(stamp_ns) + self._noise)

    def take(self, stamp_ns: int, found: Fix | NoFix) -> None:
        """Take what became of a trigger."""
        if isinstance(found, Fix):
            if found.heading is not None and found.method != "three_lights":
                if found.heading.agrees:
                    self._witnesses.reset()
                self.update(stamp_ns, found.heading.gap_rad, found.heading.variance)
        elif not found.silent:
            witnessed = self._witnesses.take(stamp_ns, found.contradiction)
            if witnessed is not None:
                self._witnesses.reset()
                self._stamp_ns, self._count = stamp_ns, ENOUGH
                self._offset_rad, self._variance = witnessed.offset_rad, DRIFT
                self._noise = min(max(witnessed.scatter, LEAST_NOISE), MOST_NOISE)

    def update(self, stamp_ns: int, offset_rad: float, variance: float) -> None:
        """Take the offset that one pose gives, rad, and its variance from the pose alone, rad^2."""
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
        # Compasses point aside, not backwards: poses that say so must not be learned from.
        offset_rad = math.remainder(self._offset_rad + gain * off_rad, 2.0 * math.pi)
        self._offset_rad = min(max(offset_rad, -MOST_APART_RAD), MOST_APART_RAD)
        self._variance = (1.0 - gain) * predicted
        noise = self._noise + (1.0 - MEMORY) * (off_rad * off_rad - total)
        self._noise = min(max(noise, LEAST_NOISE), MOST_NOISE)
        self._count += 1

    def _follows(self, stamp_ns: int) -> bool:
        return self._stamp_ns is not None and 0 <= stamp_ns - self._stamp_ns <= LIFETIME_NS

    def _predicted(self, stamp_ns: int) -> float:
        return self._variance + DRIFT * ((stamp_ns - self._stamp_ns) / S_NS if self._stamp_ns is not None else 0.0)
