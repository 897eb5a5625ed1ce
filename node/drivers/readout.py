"""When a row of a picture was exposed, on the wall clock, from libcamera's metadata of the frame."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

log = logging.getLogger(__name__)

# Lines of blanking in a mode's shortest frame, by model and the mode's height (0: any other), in the kernel's drivers.
# A first estimate only: another kernel may have others.
SHORTEST_BLANKING_LINES: Final[dict[tuple[str, int], int]] = {
    ("imx219", 0): 32,
    ("imx708", 2592): 58,
    ("imx708", 0): 40,
    ("ov5647", 0): 24,
}
TYPICAL_BLANKING_LINES: Final = 40
FIRST_ERROR: Final = 0.05
MAX_DURATIONS: Final = 50
GLOBAL_SHUTTERS: Final = frozenset({"imx296", "ov9281", "ov9282", "imx287", "ar0144"})

BRACKET_NS: Final = 20_000
BRACKET_TRIES: Final = 4

Rectangle = tuple[int, int, int, int]


def boottime_ns() -> int:
    """Return the clock of libcamera's SensorTimestamp."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


def clock_offset_ns(boottime: Callable[[], int], other: Callable[[], int]) -> int:
    """Return another clock minus CLOCK_BOOTTIME.

    The other clock is read between two readings of CLOCK_BOOTTIME; of a few tries the quickest counts, because a thread
    can be interrupted in between.
    """
    best_ns, offset_ns = None, 0
    for _ in range(BRACKET_TRIES):
        before_ns, other_ns, after_ns = boottime(), other(), boottime()
        width_ns = after_ns - before_ns
        if best_ns is None or width_ns < best_ns:
            best_ns, offset_ns = width_ns, other_ns - (before_ns + after_ns) // 2
        if width_ns <= BRACKET_NS:
            break
    return offset_ns


def first_line_ns(model: str, shortest_frame_us: int, mode_height: int) -> float:
    """Return the first estimate of the time of one sensor line, from the mode's shortest frame.

    Right to 0.01 % for the sensors and kernels of SHORTEST_BLANKING_LINES, else to about 3 %.
    """
    blanking = SHORTEST_BLANKING_LINES.get((model, mode_height), SHORTEST_BLANKING_LINES.get((model, 0)))
    if blanking is None:
        log.warning("camera %s: blanking not known; its line time is measured within the first seconds", model)
        blanking = TYPICAL_BLANKING_LINES
    return shortest_frame_us * 1000.0 / (mode_height + blanking)


class LineTimer:
    """Measures the time of one sensor line, from durations that are a whole number of lines.

    libcamera reports ExposureTime, FrameDuration and the shortest frame in whole microseconds. A line time is possible
    if it divides all reported durations. Within FIRST_ERROR of the first estimate, two or three durations leave one.
    line_ns: of the possible line times, the one nearest to the first estimate. measured: only one is possible.
    """

    def __init__(self, first_ns: float) -> None:
        self.line_ns = first_ns
        self._first_ns = first_ns
        self._ranges_ns = [(first_ns * (1 - FIRST_ERROR), first_ns * (1 + FIRST_ERROR))]
        self._seen_us: set[int] = set()

    @property
    def measured(self) -> bool:
        """Whether only one line time is possible."""
        return len(self._ranges_ns) == 1 and bool(self._seen_us)

    def update(self, duration_us: int) -> None:
        """Take a duration; it is ignored if no possible line time divides it."""
        if self.measured or duration_us in self._seen_us or len(self._seen_us) >= MAX_DURATIONS:
            return
        self._seen_us.add(duration_us)
        # Some releases truncate to microseconds, others round.
        low_ns, high_ns = duration_us * 1000.0 - 500.0, duration_us * 1000.0 + 1000.0
        left = []
        for bottom_ns, top_ns in self._ranges_ns:
            for lines in range(max(1, math.ceil(low_ns / top_ns)), math.floor(high_ns / bottom_ns) + 1):
                bottom, top = max(bottom_ns, low_ns / lines), min(top_ns, high_ns / lines)
                if bottom < top:
                    left.append((bottom, top))
        if left:
            self._ranges_ns = left
            bottom, top = min(left, key=lambda ends: abs(sum(ends) / 2 - self._first_ns))
            self.line_ns = (bottom + top) / 2


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
