"""Lamps that are dimmed by pulses: noticed by cores whose light changes from frame to frame."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from statistics import median
from typing import Final

from buddyline.node.capture.cores import Core
from buddyline.node.capture.exposure import Exposure

COMPARABLE: Final = 2.0
"""Exposures further apart are not compared: a tone curve that is not quite known would show as a swing."""
NEAR_PX: Final = 60.0
TRIPLES: Final = (20, 60)
"""At least so many comparisons are judged, and at most so many, the last ones."""
SWING: Final = 0.12
"""A lamp that turns in a swell changes its light by less than this from the mean of the frames before and after."""


class FlickerWatch:
    """Compares each core's light per ms of exposure with the mean of the frames before and after.

    Pulses at a whole multiple of the frame rate look the same in all frames: they are not noticed.
    """

    def __init__(self) -> None:
        self._frames: deque[tuple[float, list[Core]]] = deque(maxlen=3)
        self._swings: deque[float] = deque(maxlen=TRIPLES[1])

    @property
    def swing(self) -> float | None:
        """Median difference between a core's light and that of the frames around it, as a share; None at first."""
        return median(self._swings) if len(self._swings) >= TRIPLES[0] else None

    @property
    def problem(self) -> str:
        """What is wrong, with advice; "" where nothing is."""
        swing = self.swing
        if swing is None or swing <= SWING:
            return ""
        return (
            f"the lamps flicker by {swing:.0%} from frame to frame: are they dimmed by pulses? "
            "Set them to full power, or exposure.flicker_hz to the pulses' frequency"
        )

    def update(self, exposure: Exposure, cores: Sequence[Core]) -> None:
        """Take the cores of a frame; those that are clipped tell nothing."""
        usable = [core for core in cores if core.light > 0.0 and not core.clipped]
        if not usable:
            return
        self._frames.append((exposure.amount, usable))
        amounts = [amount for amount, _ in self._frames]
        if len(amounts) < 3 or max(amounts) > COMPARABLE * min(amounts):
            return
        (before_ms, before), (middle_ms, middle), (after_ms, after) = self._frames
        for core in middle:
            earlier, later = _nearest(core, before), _nearest(core, after)
            if earlier is None or later is None:
                continue
            around = math.log(earlier.light / before_ms) + math.log(later.light / after_ms)
            self._swings.append(abs(math.log(core.light / middle_ms) - around / 2))


def _nearest(core: Core, others: Sequence[Core]) -> Core | None:
    distances = [(math.hypot(core.u_px - other.u_px, core.v_px - other.v_px), i) for i, other in enumerate(others)]
    distance_px, i = min(distances)
    return others[i] if distance_px <= NEAR_PX else None
