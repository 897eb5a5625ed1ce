"""Lamps that are dimmed by pulses: noticed by light that changes from frame to frame, or from row to row."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from statistics import median, quantiles
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
BANDED: Final = 0.18
"""The banding of steady lamps, unclipped, is below this in three of four: see Core. They have 0.04 to 0.11 in rendered
waters; lamps that pulses of 50 % displace by more than 0.1 px have 0.19 to 0.45."""
ADVICE: Final = "are they dimmed by pulses? Set them to full power, or exposure.flicker_hz to the pulses' frequency"


class FlickerWatch:
    """Compares each core's light per ms of exposure with the frames before and after, and its rows with its columns.

    Pulses at a whole multiple of the frame rate look the same in all frames. With a rolling shutter they still make
    bands. A lamp that no band's edge crosses is as good as steady.
    """

    def __init__(self) -> None:
        self._frames: deque[tuple[float, list[Core]]] = deque(maxlen=3)
        self._swings: deque[float] = deque(maxlen=TRIPLES[1])
        self._bandings: deque[float] = deque(maxlen=TRIPLES[1])

    @property
    def swing(self) -> float | None:
        """Median difference between a core's light and that of the frames around it, as a share; None at first."""
        return median(self._swings) if len(self._swings) >= TRIPLES[0] else None

    @property
    def banding(self) -> float | None:
        """Upper quartile of the cores' banding: the bands' edges may miss one lamp of two; None at first."""
        return quantiles(self._bandings, n=4)[2] if len(self._bandings) >= TRIPLES[0] else None

    @property
    def problem(self) -> str:
        """What is wrong, with advice; "" where nothing is."""
        if self.swing is not None and self.swing > SWING:
            return f"the lamps flicker by {self.swing:.0%} from frame to frame: {ADVICE}"
        if self.banding is not None and self.banding > BANDED:
            return f"the lamps flicker by {self.banding:.0%} from row to row: {ADVICE}"
        return ""

    def update(self, exposure: Exposure, cores: Sequence[Core]) -> None:
        """Take the cores of a frame; those that are clipped tell nothing."""
        usable = [core for core in cores if core.light > 0.0 and not core.clipped]
        if not usable:
            return
        self._bandings.extend(core.banding for core in usable if core.banding is not None)
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
