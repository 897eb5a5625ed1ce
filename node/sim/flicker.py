"""Lamps dimmed by pulses, as the rows of a rolling shutter see them."""

from __future__ import annotations

from typing import Any

import numpy as np
from buddyline.node.capture.exposure import Exposure
from buddyline.node.sim.scenario import Scenario
from numpy.typing import NDArray

PHASES = (0.0, 0.37)


class Flicker:
    """The other node's two lights: each swings between 1 + depth and 1 - depth, in a square wave of its own phase."""

    def __init__(self, scenario: Scenario) -> None:
        self._hz, self._depth = scenario.pwm_hz, scenario.pwm_depth
        rows = np.arange(scenario.height_px)
        self._delay_s = (rows - (scenario.height_px - 1) / 2) * scenario.row_time_ns * 1e-9

    def rows(self, side: int, t_s: float, exposure: Exposure) -> NDArray[np.float32]:
        """Return the share of a light that each row gets, (H,), mean 1: the wave's mean over the row's exposure."""
        half_s = exposure.time_ns * 0.5e-9
        periods = [(t_s + self._delay_s + end_s) * self._hz + PHASES[side] for end_s in (-half_s, half_s)]
        begin, end = (_integral(at) for at in periods)
        return np.asarray(1.0 + self._depth * (end - begin) / (2 * half_s * self._hz), np.float32)


def _integral(periods: NDArray[np.floating[Any]]) -> NDArray[np.floating[Any]]:
    """Return the integral, in periods, of a square wave of +1 and -1, from 0: a triangle."""
    phase = periods % 1.0
    return np.asarray(np.minimum(phase, 1.0 - phase))
