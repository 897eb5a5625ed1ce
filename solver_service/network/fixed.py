"""Whether a fixed node still stands where its configuration says: by its own attitude and depth gauge."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Final

from buddyline.solver_service.geometry.rotation import Floats, rotation_log

# Attitude filters err by a degree or two in tilt, and by several in heading, near iron by more; gauges drift, and the
# tide rises by a metre in hours. A node counts as moved after ON_END judgements in a row.
TILTED_RAD: Final = math.radians(8.0)
TURNED_RAD: Final = math.radians(20.0)
SUNK_M: Final = 0.3
SUNK_WITHIN_S: Final = 600.0
ON_END: Final = 3


@dataclass(eq=False)
class FixedWatch:
    """Follows one fixed node. R (3, 3): of its place, camera to net. found: how often in a row each fault was found."""

    name: str
    R: Floats
    first: Floats | None = None
    depths: list[tuple[float, float]] = field(default_factory=list)
    found: dict[str, int] = field(default_factory=dict)

    def judge(self, t_s: float, R_level_camera: Floats | None, depth_m: float | None) -> list[str]:
        """Return what is wrong by now, in words; R_level_camera, depth_m: what its sensors say, None if nothing."""
        wrong = []
        if R_level_camera is not None:
            if self.first is None:
                self.first = R_level_camera
            # The frame's north need not be the compass's: the place tells the tilt, the first attitude the heading.
            heading = float(rotation_log(R_level_camera @ self.first.T)[2])
            if _tilt(R_level_camera, self.R) > TILTED_RAD:
                wrong.append("its tilt is not that of its place")
            if abs(heading) > TURNED_RAD:
                wrong.append("its heading has changed since the start")
        if depth_m is not None:
            self.depths = [(at_s, one) for at_s, one in self.depths if at_s > t_s - SUNK_WITHIN_S]
            self.depths.append((t_s, depth_m))
            if abs(depth_m - self.depths[0][1]) > SUNK_M:
                wrong.append("its depth has changed")
        self.found = {fault: self.found.get(fault, 0) + 1 for fault in wrong}
        return [
            f"fixed node {self.name}: {fault}: has it moved?" for fault, count in self.found.items() if count >= ON_END
        ]


def _tilt(one: Floats, other: Floats) -> float:
    """Return the angle between where two attitudes (camera to level) have down in the camera."""
    return math.acos(max(-1.0, min(1.0, float(one[2] @ other[2]))))
