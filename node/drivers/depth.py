"""Depth out of pressure: water density, the surface's pressure, and how far to trust the result."""

from __future__ import annotations

import json
import math
from pathlib import Path
from statistics import median
from typing import Final

from buddyline.node.drivers.samples import STANDARD_GRAVITY_MPS2, DepthSample
from buddyline.protocol.clock import S_NS

FRESH_KGPM3: Final = 997.0
STANDARD_AIR_PA: Final = 101_325.0

# Air on Earth lies between these, from lakes at 5500 m to the highest pressure ever measured. Above, the
# node was started under water.
AIR_PA: Final = (50_000.0, 108_500.0)
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
    """Air pressure at the dive's start: the median of the first two seconds' samples, where that can be air.

    remembered_pa: the same day's zero, for a node that starts again under water. surface_pa: the best there
    is; complete: whether looking for it is over; measured: whether it was found.
    """

    def __init__(self, remembered_pa: float | None = None) -> None:
        self.surface_pa = STANDARD_AIR_PA if remembered_pa is None else remembered_pa
        self.complete = False
        self.measured = False
        self._remembered_pa = remembered_pa
        self._pressures_pa: list[float] = []

    def update(self, sample: DepthSample) -> bool:
        """Take a sample; return whether looking is over."""
        if not self.complete:
            self._pressures_pa.append(sample.pressure_pa)
            self.complete = len(self._pressures_pa) >= ZERO_SAMPLES
            if self.complete and self._is_air():
                self.surface_pa = median(self._pressures_pa)
                self.measured = True
        return self.complete

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


def save_zero(path: Path, stamp_ns: int, surface_pa: float) -> None:
    """Keep a zero for the rest of the day; raise OSError where it cannot be written."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps({"stamp_ns": stamp_ns, "surface_pa": surface_pa}))
    fresh.replace(path)


def load_zero(path: Path, now_ns: int) -> float | None:
    """Return the zero that was kept less than half a day ago, or None."""
    try:
        kept = json.loads(path.read_text())
        stamp_ns, surface_pa = int(kept["stamp_ns"]), float(kept["surface_pa"])
    except (OSError, ValueError, TypeError, KeyError):
        return None
    fresh = 0 <= now_ns - stamp_ns <= REMEMBER_NS
    return surface_pa if fresh and AIR_PA[0] < surface_pa < AIR_PA[1] else None
