"""Two compasses that are far apart, or a third party's bar: let the triggers that follow tell.

A pose that both headings contradict is no pose, unless it is shown that the compasses are off. A small contradiction
that stays is steel's: strangers' lamps that happen to fit do so for a moment, and for a contradiction as small, a third
whose bar both see would have to stand almost between them. A large one the motion must show. Of two nodes that
look at each other, both lines of sight turn together, so that the contradiction stays the same wherever they go. Of two
that look at a third's bar, a line of sight turns with one of them alone. And where the third itself comes nearer to
both by a share p of the range, the lines of sight, theta apart, turn against each other by 2 p tan(theta / 2): by p and
more, where they are a quarter turn apart. Nodes that rest tell nothing of it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.compasses import Contradiction

# Witnesses are remembered for this time. Two seconds of them are believed: at most MOST, and no fewer than FEWEST.
MEMORY_NS: Final = 30 * S_NS
BELIEVED_NS: Final = 2 * S_NS
MOST: Final = 15
FEWEST: Final = 5
# Two lights from equal range are a chance that passes with the motion: so large a share of the triggers must show it.
LEAST_SHARE: Final = 0.3
# Scatter of the contradiction, at most, as a share of the change that a third's bar would have caused.
MOST_SCATTER: Final = 0.35
# Steel and iron put compasses 10 to 25 degrees off, at stations by a wreck or in a mine. What is off by up to this, and
# scatters by no more than compasses' noise (1 sd), is taken for steel's.
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
        """Return how many witnesses two seconds of triggers are."""
        apart_ns = (self._seen[-1][0] - self._seen[0][0]) / max(len(self._seen) - 1, 1)
        return min(max(BELIEVED_NS / max(apart_ns, 1.0), FEWEST), MOST)


def _about_mean(angles_rad: list[float]) -> tuple[float, float]:
    """Return the mean of angles, and their variance about it."""
    mean = math.atan2(sum(map(math.sin, angles_rad)), sum(map(math.cos, angles_rad)))
    off = [math.remainder(angle - mean, 2.0 * math.pi) for angle in angles_rad]
    return mean, sum(one * one for one in off) / len(off)
