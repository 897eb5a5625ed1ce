"""The clock of a node's stamps: CLOCK_BOOTTIME, moved onto UTC, so that every step happens at one known instant.

CLOCK_BOOTTIME is also the clock of libcamera's frames. It is never set, but chrony slews it. CLOCK_MONOTONIC_RAW is
neither set nor slewed: a node's beacons carry it, so that the slews can be taken out of the stamps later.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from buddyline.node.chrony import ChronyError, Tracking, read_tracking
from buddyline.node.drivers.readout import boottime_ns, clock_offset_ns
from buddyline.protocol.clock import MS_NS, S_NS, sleep_ns

log = logging.getLogger(__name__)

# Slewing moves both clocks alike, so what is left are steps, and the error of comparing two clocks.
STEP_NS: Final = MS_NS // 2
REMEMBER_NS: Final = 60 * S_NS
# A Pi without a clock chip waits this long after it was switched on, and only then: a node that is restarted in
# mid-dive must record at once. systemd gives a service 60 s to start.
TIME_WITHIN_NS: Final = 45 * S_NS
ASK_NS: Final = S_NS
RTC: Final = Path("/sys/class/rtc/rtc0")
# A chip without a battery, such as a Pi 5's own, begins at 1970 with each start.
NO_EARLIER_S: Final = 1_735_689_600


def raw_ns() -> int:
    """Return the clock that nothing sets or slews; it counts by the machine's quartz alone."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


class NodeClock:
    """A clock that follows the steps of the system clock only when `follow` is called.

    steps: how many it has followed. problem: the last one, for a minute.
    """

    def __init__(
        self,
        wall: Callable[[], int] = time.time_ns,
        boottime: Callable[[], int] = boottime_ns,
        raw: Callable[[], int] = raw_ns,
    ) -> None:
        self.steps = 0
        self._wall = wall
        self._boottime = boottime
        self._raw = raw
        self._last_step_ns: int | None = None
        self._said = ""
        self.start()

    def start(self) -> None:
        """Take the system clock's time, before anything has been stamped."""
        self._offset_ns = clock_offset_ns(self._boottime, self._wall)

    def now_ns(self) -> int:
        """Return the present time."""
        return self._boottime() + self._offset_ns

    def wait_until_ns(self, instant_ns: int, stop: threading.Event) -> bool:
        """Sleep until instant_ns; return True if stop is set before then."""
        return sleep_ns(instant_ns - self.now_ns(), stop)

    def reading(self) -> tuple[int, int]:
        """Return the present time, and CLOCK_MONOTONIC_RAW at the same instant."""
        raw_from_boottime_ns = clock_offset_ns(self._boottime, self._raw)
        now_ns = self._boottime()
        return now_ns + self._offset_ns, now_ns + raw_from_boottime_ns

    def follow(self) -> int:
        """Follow a step of the system clock; return by how much this clock was set, 0 if it was not."""
        moved_ns = clock_offset_ns(self._boottime, self._wall) - self._offset_ns
        if abs(moved_ns) <= STEP_NS:
            return 0
        # Again: a thread can be interrupted in each of the tries.
        moved_ns = clock_offset_ns(self._boottime, self._wall) - self._offset_ns
        if abs(moved_ns) <= STEP_NS:
            return 0
        self._offset_ns += moved_ns
        self.steps += 1
        self._last_step_ns = self._boottime()
        at = time.strftime("%H:%M:%S", time.gmtime(self.now_ns() / S_NS))
        self._said = f"clock: was set by {moved_ns / S_NS:+.3f} s at {at} UTC in mid-dive"
        log.warning("%s: live poses across that instant are not to be trusted; stored ones can be", self._said)
        return moved_ns

    @property
    def problem(self) -> str:
        """What was wrong within the last minute; "" if nothing."""
        if self._last_step_ns is None or self._boottime() - self._last_step_ns > REMEMBER_NS:
            return ""
        return self._said


def wait_for_time(
    stop: threading.Event,
    read: Callable[[], Tracking | None] = read_tracking,
    boottime: Callable[[], int] = boottime_ns,
    rtc: Path = RTC,
) -> bool:
    """Wait until chrony has a source, at most until TIME_WITHIN_NS after the machine was switched on.

    Returns whether the time is known, as far as can be told: a clock chip or a missing chrony is not waited for.
    """
    said = False
    while not stop.is_set():
        try:
            tracking = read()
            why = "" if tracking is None or tracking.synchronised else "chrony has no source"
        except ChronyError as error:
            why = str(error)
        if not why or is_kept(rtc):
            return True
        if boottime() > TIME_WITHIN_NS:
            log.warning("clock: %s and there is no clock chip: stamps count from the last time this machine knew", why)
            return False
        if not said:
            log.info("clock: %s; waiting for it until %.0f s after the start", why, TIME_WITHIN_NS / S_NS)
            said = True
        stop.wait(ASK_NS / S_NS)
    return False


def is_kept(rtc: Path = RTC) -> bool:
    """Return whether the kernel has set the clock from this chip, and the chip has kept the time."""
    try:
        hctosys, since_epoch = ((rtc / name).read_text().strip() for name in ("hctosys", "since_epoch"))
        return hctosys == "1" and int(since_epoch) > NO_EARLIER_S
    except (OSError, ValueError):
        return False
