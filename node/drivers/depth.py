"""Depth from pressure: water density, the surface's pressure, and the standard deviation of the result."""

from __future__ import annotations

import json
import math
from collections import deque
from pathlib import Path
from statistics import median
from typing import Final

from buddyline.node.drivers.samples import STANDARD_GRAVITY_MPS2, DepthSample
from buddyline.protocol.clock import S_NS

FRESH_KGPM3: Final = 997.0
STANDARD_AIR_PA: Final = 101_325.0

# Air at the surface: from lakes at 5500 m to the strongest winter highs. 105 kPa is also 0.37 m under water
# on an average day, so that a start deeper than that is noticed at once.
AIR_PA: Final = (50_000.0, 105_000.0)
ZERO_SAMPLES: Final = 40
ZERO_SPREAD_PA: Final = 500.0
SAME_DAY_PA: Final = 1_500.0
REMEMBER_NS: Final = 12 * 3600 * S_NS

NOISE_SIGMA_M: Final = 0.01
ZERO_SIGMA_M: Final = 0.03
UNZEROED_SIGMA_M: Final = 0.3  # weather moves air pressure by 3 kPa
SCALE_SIGMA: Final = 0.003  # density within 3 kg/m3, and the chip's own scale


def depth_m(pressure_pa: float, surface_pa: float, density_kgpm3: float) -> float:
    """Return the depth below the surface, positive down, of an absolute pressure."""
    return (pressure_pa - surface_pa) / (density_kgpm3 * STANDARD_GRAVITY_MPS2)


class SurfaceZero:
    """Air pressure at the start of the dive: the median of two seconds of samples, where that can be air.

    remembered_pa: the same day's zero, for a node that restarts under water. surface_pa: the best estimate. complete:
    the first search is over. measured: a zero was found. A pressure that stays below the zero proves that the zero was
    taken under water: the lower one replaces it, and `problem` says so for the rest of the dive.
    """

    def __init__(self, remembered_pa: float | None = None) -> None:
        self.surface_pa = STANDARD_AIR_PA if remembered_pa is None else remembered_pa
        self.complete = False
        self.measured = False
        self.problem = ""
        self._remembered_pa = remembered_pa
        self._pressures_pa: deque[float] = deque(maxlen=ZERO_SAMPLES)

    def update(self, sample: DepthSample) -> bool:
        """Take a sample; return whether the first search is over."""
        self._pressures_pa.append(sample.pressure_pa)
        if len(self._pressures_pa) < ZERO_SAMPLES:
            return self.complete
        if not self.complete:
            self.complete = True
            if self._is_air():
                self.surface_pa = median(self._pressures_pa)
                self.measured = True
            elif self._remembered_pa is None:
                self.problem = f"not started in calm air: surface taken at {self.surface_pa:.0f} Pa"
        elif max(self._pressures_pa) < self.surface_pa - SAME_DAY_PA:
            self._correct()
        return True

    def _is_air(self) -> bool:
        """Return whether the window can be air: calm, of a possible pressure, and not far above the same day's zero."""
        middle_pa = median(self._pressures_pa)
        if not AIR_PA[0] < middle_pa < AIR_PA[1] or not self._is_calm():
            return False
        return self._remembered_pa is None or middle_pa < self._remembered_pa + SAME_DAY_PA

    def _is_calm(self) -> bool:
        return max(self._pressures_pa) - min(self._pressures_pa) <= ZERO_SPREAD_PA

    def _correct(self) -> None:
        middle_pa = median(self._pressures_pa)
        if middle_pa <= AIR_PA[0] or not self._is_calm():
            return
        under_m = depth_m(self.surface_pa, middle_pa, FRESH_KGPM3)
        self.problem = f"the surface zero was {under_m:.2f} m too deep; corrected, earlier depths are too small"
        self.surface_pa = middle_pa
        self.measured = True

    def sigma_m(self, depth_m: float) -> float:
        """Return the standard deviation of a depth."""
        zeroed = self.measured or self._remembered_pa is not None
        return math.hypot(NOISE_SIGMA_M, ZERO_SIGMA_M if zeroed else UNZEROED_SIGMA_M, SCALE_SIGMA * depth_m)


def save_zero(path: Path, stamp_ns: int, surface_pa: float) -> None:
    """Store a zero for the rest of the day; raise OSError if it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps({"stamp_ns": stamp_ns, "surface_pa": surface_pa}))
    fresh.replace(path)


def load_zero(path: Path, now_ns: int) -> float | None:
    """Return the zero that was stored less than half a day ago, or None."""
    try:
        kept = json.loads(path.read_text())
        stamp_ns, surface_pa = int(kept["stamp_ns"]), float(kept["surface_pa"])
    except (OSError, ValueError, TypeError, KeyError):
        return None
    fresh = 0 <= now_ns - stamp_ns <= REMEMBER_NS
    return surface_pa if fresh and AIR_PA[0] < surface_pa < AIR_PA[1] else None
