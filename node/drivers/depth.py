"""Depth out of pressure: water density, the surface's pressure, and how far to trust the result."""

from __future__ import annotations

import math
from statistics import median
from typing import Final

from node.drivers.samples import STANDARD_GRAVITY_MPS2, DepthSample

FRESH_KGPM3: Final = 997.0
STANDARD_AIR_PA: Final = 101_325.0

# Air on Earth lies between these, from lakes at 5500 m to the highest pressure ever measured. Above, the
# node was started under water.
AIR_PA: Final = (50_000.0, 108_500.0)
ZERO_SAMPLES: Final = 40
ZERO_SPREAD_PA: Final = 500.0
SAME_DAY_PA: Final = 1_500.0

NOISE_SIGMA_M: Final = 0.01
ZERO_SIGMA_M: Final = 0.03
UNZEROED_SIGMA_M: Final = 0.3  # weather moves air pressure by 3 kPa
SCALE_SIGMA: Final = 0.003  # density within 3 kg/m3, and the chip's own scale


def depth_m(pressure_pa: float, surface_pa: float, density_kgpm3: float) -> float:
    """Return the depth below the surface, positive down, of an absolute pressure."""
    return (pressure_pa - surface_pa) / (density_kgpm3 * STANDARD_GRAVITY_MPS2)


class SurfaceZero:
    """Air pressure at the dive's start: the median of the first two seconds' samples, where that can be air.

    remembered_pa: the same day's zero, for a node that starts again under water. surface_pa: the best there
    is; measured: whether it is of this start.
    """

    def __init__(self, remembered_pa: float | None = None) -> None:
        self.surface_pa = STANDARD_AIR_PA if remembered_pa is None else remembered_pa
        self.measured = False
        self._remembered_pa = remembered_pa
        self._pressures_pa: list[float] = []

    def update(self, sample: DepthSample) -> bool:
        """Take a sample; return True at the one that sets the zero."""
        if len(self._pressures_pa) >= ZERO_SAMPLES:
            return False
        self._pressures_pa.append(sample.pressure_pa)
        if len(self._pressures_pa) < ZERO_SAMPLES or not self._is_air():
            return False
        self.surface_pa = median(self._pressures_pa)
        self.measured = True
        return True

    def _is_air(self) -> bool:
        pressures_pa = self._pressures_pa
        middle_pa = median(pressures_pa)
        if not AIR_PA[0] < middle_pa < AIR_PA[1] or max(pressures_pa) - min(pressures_pa) > ZERO_SPREAD_PA:
            return False
        return self._remembered_pa is None or middle_pa < self._remembered_pa + SAME_DAY_PA

    def sigma_m(self, depth_m: float) -> float:
        """Return the standard deviation of a depth."""
        zeroed = self.measured or self._remembered_pa is not None
        return math.hypot(NOISE_SIGMA_M, ZERO_SIGMA_M if zeroed else UNZEROED_SIGMA_M, SCALE_SIGMA * depth_m)
