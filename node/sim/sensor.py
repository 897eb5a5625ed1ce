"""The simulated image sensor: what an exposure makes of the light of a scene.

All waters are seen by the same sensor: a lamp of unit intensity gives LAMP_GAIN_PER_MS of Water.lamp_gain for each
millisecond at gain 1. So each water's lamp_gain is an exposure, and its noise a gain, of the scene as it is drawn.
"""

from __future__ import annotations

from collections import deque
from typing import Final

import numpy as np
from buddyline.node.capture.exposure import GREY_LEVELS, Exposure, ExposurePlan, ExposureRange
from buddyline.node.sim.scenario import Water
from buddyline.protocol.clock import MS_NS

LAMP_GAIN_PER_MS: Final = 0.05
FULL_WELL_E: Final = 11_300.0
"""Electrons that clip at gain 1. Four binned pixels of a small sensor hold more; the noise is that of the waters."""
GREY_MAX: Final = 255.0
SHORTEST_NS: Final = 14_000  # a line of a fast sensor
LONGEST_NS: Final = 40 * MS_NS
GAIN_MAX: Final = 10.0
DELAY_FRAMES: Final = 4
RANGE: Final = ExposureRange(
    SHORTEST_NS, LONGEST_NS, GAIN_MAX, linear=(np.arange(GREY_LEVELS) / (GREY_LEVELS - 1)) ** 2
)
"""What the simulated camera can be asked for. Its tone curve is a square root."""


def shot_noise(gain: float) -> float:
    """Return the noise of light itself, 1 sd in grey levels.

    A square root as tone curve makes it the same at all brightnesses: sqrt(n) of n electrons are half a sqrt(n).
    """
    return float(GREY_MAX / 2 * np.sqrt(gain / FULL_WELL_E))


def scene_exposure(water: Water) -> Exposure:
    """Return the exposure with which a water is drawn where none is asked for."""
    gain = max((water.noise / shot_noise(1.0)) ** 2, 1.0)
    return Exposure(round(water.lamp_gain / LAMP_GAIN_PER_MS / gain * MS_NS), gain)


class DelayedControls:
    """A camera's exposures: what is asked for is had some frames later, as with real cameras."""

    range = RANGE

    def __init__(self, delay: int = DELAY_FRAMES) -> None:
        self._newest = RANGE.first_plan()
        self._plans = deque([self._newest] * delay)

    def follow(self, plan: ExposurePlan) -> None:
        """Ask for exposures by this plan from now on."""
        self._newest = plan

    def take(self, trigger: int) -> tuple[Exposure, bool]:
        """Return the exposure of this trigger's frame, and whether it is the scene's; to be called once a frame."""
        self._plans.append(self._newest)
        plan = self._plans.popleft()
        exposure = plan.at(trigger)
        return exposure, plan.is_context(exposure)
