"""When a row of a picture was exposed, on the wall clock, out of what libcamera says about a frame."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

log = logging.getLogger(__name__)

# Lines of blanking in a mode's shortest frame, as the kernel's sensor drivers have them.
SHORTEST_BLANKING_LINES: Final = {"imx219": 32, "imx708": 58, "ov5647": 24}
GLOBAL_SHUTTERS: Final = frozenset({"imx296", "ov9281", "ov9282", "imx287", "ar0144"})

BRACKET_NS: Final = 20_000
BRACKET_TRIES: Final = 4

Rectangle = tuple[int, int, int, int]


def boottime_ns() -> int:
    """Return the clock of libcamera's SensorTimestamp."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def wall_offset_ns(boottime: Callable[[], int], wall: Callable[[], int]) -> int:
    """Return what to add to a time of CLOCK_BOOTTIME to have it on the wall clock.

    The wall clock is read between two readings of the other; of a few tries the tightest counts, since a thread
    can be interrupted in between.
    """
    best_ns, offset_ns = None, 0
    for _ in range(BRACKET_TRIES):
        before_ns, wall_ns, after_ns = boottime(), wall(), boottime()
        width_ns = after_ns - before_ns
        if best_ns is None or width_ns < best_ns:
            best_ns, offset_ns = width_ns, wall_ns - (before_ns + after_ns) // 2
        if width_ns <= BRACKET_NS:
            break
    return offset_ns


def line_time_ns(model: str, shortest_frame_us: int, mode_height: int) -> float:
    """Return the time of one sensor line out of the mode's shortest frame.

    For a sensor whose blanking is not known, the frame is taken to be all lines: some percent too long.
    """
    blanking = SHORTEST_BLANKING_LINES.get(model)
    if blanking is None:
        log.warning("camera %s: blanking not known; line time good to a few percent", model)
    return shortest_frame_us * 1000.0 / (mode_height + (blanking or 0))


@dataclass(frozen=True, slots=True)
class Readout:
    """Which sensor lines a picture is made of. line_ns: 0 where all are exposed at once."""

    first_line: float
    lines: float
    line_ns: float

    @classmethod
    def of_crop(cls, crop: Rectangle, mode_crop: Rectangle, mode_height: int, line_ns: float) -> Readout:
        """Return the readout of ScalerCrop within the mode's crop, both (x, y, width, height) in full pixels."""
        lines_per_pixel = mode_height / mode_crop[3]
        return cls((crop[1] - mode_crop[1]) * lines_per_pixel, crop[3] * lines_per_pixel, line_ns)

    def row_time_ns(self, height: int) -> float:
        """Return the time from one of the picture's rows to the next."""
        return self.lines * self.line_ns / height

    def middle_ns(self, sensor_timestamp_ns: int, exposure_us: int) -> int:
        """Return the middle of exposure of the picture's middle row, on the clock of SensorTimestamp.

        SensorTimestamp is the start of the frame's readout, which is the end of line 0's exposure.
        """
        middle_line = self.first_line + (self.lines - 1) / 2
        return sensor_timestamp_ns + round(middle_line * self.line_ns) - exposure_us * 1000 // 2
