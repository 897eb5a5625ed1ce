"""Exposures: what a frame was exposed with, what a camera can be asked for, and which exposure each trigger gets."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from buddyline.protocol.clock import MS_NS
from numpy.typing import NDArray

GREY_LEVELS: Final = 256
FIRST_LAMPS: Final = 0.5
FIRST_SCENE: Final = 8.0
"""Amounts, ms, of the first frames, before any has been seen: for lamps a few metres away, and for a lit scene."""
_SRGB_KNEE: Final = 0.04045


@dataclass(frozen=True, slots=True)
class Exposure:
    """What a frame is exposed with: the time of each row, and the gain behind it (1: none)."""

    time_ns: int
    gain: float = 1.0

    @property
    def amount(self) -> float:
        """Time times gain, ms: grey levels before the tone curve are proportional to it."""
        return self.time_ns * self.gain / MS_NS


def srgb_to_linear() -> NDArray[np.float64]:
    """Return the light of each grey level, (256,), 0 to 1, where nothing better is known: IEC 61966-2-1's curve."""
    level = np.arange(GREY_LEVELS) / (GREY_LEVELS - 1)
    return np.asarray(np.where(level <= _SRGB_KNEE, level / 12.92, ((level + 0.055) / 1.055) ** 2.4))


def inverse_tone_curve(knots: Sequence[float]) -> NDArray[np.float64]:
    """Return the light of each grey level, (256,), 0 to 1, of a tone curve x0, y0, x1, y1, ... (any scale).

    Raises ValueError where the curve is no rising one from 0.
    """
    points = np.asarray(knots, np.float64).reshape(-1, 2)
    if (
        len(points) < 2
        or not np.isfinite(points).all()
        or (points[0] != 0).any()
        or (np.diff(points, axis=0) <= 0).any()
    ):
        raise ValueError("a tone curve rises from 0, 0")
    light, grey = (points / points[-1]).T
    return np.asarray(np.interp(np.arange(GREY_LEVELS) / (GREY_LEVELS - 1), grey, light))


@dataclass(frozen=True)
class ExposureRange:
    """Which exposures a camera can be asked for, and the light of its grey levels.

    line_ns: exposure times are multiples of it (0: any time). linear: (256,), the light of each grey level, as a share
    of what clips. It must rise. Where it is not exact, the loop settles at another exposure, but it settles.
    """

    shortest_ns: int
    longest_ns: int
    gain_max: float = 1.0
    line_ns: float = 0.0
    gain_min: float = 1.0
    linear: NDArray[np.float64] = field(default_factory=srgb_to_linear)

    @property
    def least(self) -> float:
        """Smallest amount."""
        return Exposure(self.shortest_ns, self.gain_min).amount

    @property
    def most(self) -> float:
        """Largest amount."""
        return Exposure(self.longest_ns, self.gain_max).amount

    def first_plan(self) -> ExposurePlan:
        """Return the plan before any frame has been seen."""
        return ExposurePlan(self.exposure(FIRST_LAMPS), self.exposure(FIRST_SCENE))

    def within(self, longest_ns: int, gain_max: float) -> ExposureRange:
        """Return this range, limited to these bounds."""
        longest_ns = max(min(self.longest_ns, longest_ns), self.shortest_ns)
        return replace(self, longest_ns=longest_ns, gain_max=max(min(self.gain_max, gain_max), self.gain_min))

    def exposure(self, amount: float, flicker_ns: float = 0.0) -> Exposure:
        """Return the exposure of this amount, ms, or the nearest there is: gain only where the time is at its longest.

        flicker_ns: the time is made a whole multiple of this, at least one; 0 for any time.
        """
        time_ns = min(max(amount * MS_NS / self.gain_min, self.shortest_ns), self.longest_ns)
        if 0 < flicker_ns <= self.longest_ns:
            periods = max(round(time_ns / flicker_ns), math.ceil(self.shortest_ns / flicker_ns), 1)
            time_ns = min(periods, math.floor(self.longest_ns / flicker_ns)) * flicker_ns
        if self.line_ns > 0:
            # The nearest line, but within the bounds.
            lines = min(
                max(round(time_ns / self.line_ns), math.ceil(self.shortest_ns / self.line_ns)),
                math.floor(self.longest_ns / self.line_ns),
            )
            time_ns = max(lines, 1) * self.line_ns
        gain = min(max(amount * MS_NS / time_ns, self.gain_min), self.gain_max)
        # A little less or more than the longest time is no reason for gain.
        return Exposure(round(time_ns), gain if time_ns >= 0.9 * self.longest_ns else self.gain_min)


@dataclass(frozen=True, slots=True)
class ExposurePlan:
    """The exposures of the triggers to come: most for the lamps, every context_every-th for the scene (0: none).

    Both nodes of a pair have their context frames at the same triggers: then one trigger is worse than others, not two.
    """

    lamps: Exposure
    scene: Exposure
    context_every: int = 0

    def at(self, trigger: int) -> Exposure:
        """Return the exposure of a trigger's frame."""
        return self.scene if self.context_every > 0 and trigger % self.context_every == 0 else self.lamps

    def is_context(self, exposure: Exposure) -> bool:
        """Return whether a frame with this exposure shows the scene."""
        return exposure.amount >= self.scene.amount / math.sqrt(2.0)
