"""Detects that the wall clock was set while the node runs, by comparing it with CLOCK_BOOTTIME, which is never set."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final

from buddyline.node.drivers.readout import boottime_ns, wall_offset_ns
from buddyline.protocol.clock import MS_NS, S_NS

log = logging.getLogger(__name__)

# chronyd slews by 83 ms a second at most (maxslewrate); what is faster was a step.
STEP_NS: Final = 10 * MS_NS
SLEW: Final = 0.1
REMEMBER_NS: Final = 60 * S_NS


class ClockWatch:
    """Compares the wall clock with CLOCK_BOOTTIME a few times a second. steps: how often the wall clock was set."""

    def __init__(self, wall: Callable[[], int], boottime: Callable[[], int] = boottime_ns) -> None:
        self.steps = 0
        self._wall = wall
        self._boottime = boottime
        self._looked_ns = boottime()
        self._offset_ns = wall_offset_ns(boottime, wall)
        self._last_step_ns: int | None = None
        self._said = ""

    def look(self) -> None:
        """Compare the two clocks; a step is logged."""
        now_ns, offset_ns = self._boottime(), wall_offset_ns(self._boottime, self._wall)
        moved_ns = offset_ns - self._offset_ns
        if abs(moved_ns) > STEP_NS + SLEW * (now_ns - self._looked_ns):
            self.steps += 1
            self._last_step_ns = now_ns
            at = time.strftime("%H:%M:%S", time.gmtime(self._wall() / S_NS))
            self._said = f"clock: was set by {moved_ns / S_NS:+.3f} s at {at} UTC in mid-dive"
            log.warning("%s: poses across that instant are not to be trusted", self._said)
        self._looked_ns, self._offset_ns = now_ns, offset_ns

    @property
    def problem(self) -> str:
        """What was wrong within the last minute; "" if nothing."""
        if self._last_step_ns is None or self._boottime() - self._last_step_ns > REMEMBER_NS:
            return ""
        return self._said
