"""Two compasses that are far apart, or a third party's bar: let the triggers that follow tell.

A pose that both headings contradict is no pose, until later triggers have shown that the compasses are off.

A small contradiction that stays for two seconds is steel's, whether the nodes move or rest. Strangers' lamps fit by
chance, for a moment. And a third whose bar both see would have to stand almost between them.

A large contradiction can be judged by the motion only. If two nodes look at each other, both lines of sight turn
together, and the contradiction stays the same wherever they go. If they look at a third's bar, each line of sight turns
by the motion of its own node alone. If the third itself comes nearer to both by a share p of the range, the lines of
sight, theta apart, turn against each other by 2 p tan(theta / 2): by 2 p where they are a quarter turn apart. Nodes
that rest show nothing.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.compasses import Contradiction

# Witnesses are remembered for MEMORY_NS. As many are needed as there are triggers in BELIEVED_NS, but at least FEWEST
# (below 2.5 Hz they take longer) and at most MOST (above 7.5 Hz they take less).
MEMORY_NS: Final = 30 * S_NS
BELIEVED_NS: Final = 2 * S_NS
MOST: Final = 15
FEWEST: Final = 5
# At least this share of the remembered triggers must be witnesses: a third's lights at equal range are a chance that
# passes with the motion.
LEAST_SHARE: Final = 0.3
# Scatter of the contradiction, at most, as a share of the change that a third's bar would have caused.
MOST_SCATTER: Final = 0.35
# A contradiction is taken for steel's if its mean is below MOST_STEEL_RAD, and its scatter (1 sd) below MOST_NOISE_RAD,
# as compasses' noise is. At stations by a wreck or in a mine, compasses are 10 to 25 degrees off.
MOST_STEEL_RAD: Final = math.radians(30.0)
MOST_NOISE_RAD: Final = math.radians(6.0)


@dataclass(frozen=True, slots=True)
class Witnessed:
    """What is to be added to B's heading, and the variance of the contradictions about it, rad^2."""

    offset_rad: float
    scatter: float


class Witnesses:
    """Remembers the contradictions of a pair's last triggers."""

    def __init__(self) -> None:
        self._seen: deque[tuple[int, Contradiction | None]] = deque()

    def reset(self) -> None:
        """Forget all: a pose has agreed with the headings, or time has jumped."""
        self._seen.clear()

    def take(self, stamp_ns: int, found: Contradiction | None) -> Witnessed | None:
        """Take a trigger that shows a contradiction, or may have shown one (None); return what has been witnessed."""
        if self._seen and not 0 <= stamp_ns - self._seen[-1][0] <= MEMORY_NS:
            self.reset()
        if found is None and not self._seen:
            return None
        self._seen.append((stamp_ns, found))
        while stamp_ns - self._seen[0][0] > MEMORY_NS:
            self._seen.popleft()
        return None if found is None else self._judge()

    def _judge(self) -> Witnessed | None:
        shown = [found for _, found in self._seen if found is not None]
        if len(shown) < max(self._believed(), LEAST_SHARE * len(self._seen)):
            return None
        log_range = np.log([one.range_m for one in shown])
        gap_rad, gap_scatter = _about_mean([one.gap.gap_rad for one in shown])
        _, azimuth_scatter = _about_mean([one.gap.azimuth_rad for one in shown])
        by_a_third = float(log_range.var()) + azimuth_scatter
        by_steel = abs(gap_rad) < MOST_STEEL_RAD and gap_scatter < MOST_NOISE_RAD**2
        if not by_steel and gap_scatter > MOST_SCATTER**2 * by_a_third:
            return None
        return Witnessed(gap_rad, gap_scatter)

    def _believed(self) -> float:
        """Return how many witnesses are needed: those of BELIEVED_NS, by the median time between triggers.

        A pause would raise the mean: a few triggers after it would be enough.
        """
        apart_ns = np.median(np.diff([stamp_ns for stamp_ns, _ in self._seen])) if len(self._seen) > 1 else 1.0
        return min(max(BELIEVED_NS / max(float(apart_ns), 1.0), FEWEST), MOST)


def _about_mean(angles_rad: list[float]) -> tuple[float, float]:
    """Return the mean of angles, and their variance about it."""
    mean = math.atan2(sum(map(math.sin, angles_rad)), sum(map(math.cos, angles_rad)))
    off = [math.remainder(angle - mean, 2.0 * math.pi) for angle in angles_rad]
    return mean, sum(one * one for one in off) / len(off)
