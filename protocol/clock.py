"""Clocks, which are passed as arguments: no other module reads the wall clock for stamps."""

from __future__ import annotations

import threading
import time
from typing import Protocol

S_NS = 1_000_000_000
MS_NS = 1_000_000
SHORT_NS = 20 * MS_NS
# A message whose stamp is this near to the receive time is of a live dive; any other, of a stored dive that is played.
LIVE_WITHIN_NS = 60 * S_NS


class Clock(Protocol):
    """Wall clock in integer nanoseconds since the Unix epoch, UTC."""

    def now_ns(self) -> int:
        """Return the present time."""
        ...

    def wait_until_ns(self, instant_ns: int, stop: threading.Event) -> bool:
        """Sleep until instant_ns; return True if stop is set before then."""
        ...


def sleep_ns(duration_ns: int, stop: threading.Event) -> bool:
    """Sleep; return True if stop is set at the end, or for a long sleep, before it.

    A short sleep costs half as much as waiting for an event, and a stop can wait for its end.
    """
    if duration_ns > SHORT_NS:
        return stop.wait(duration_ns / S_NS)
    if duration_ns > 0 and not stop.is_set():
        time.sleep(duration_ns / S_NS)
    return stop.is_set()


class SystemClock:
    """The machine's own wall clock."""

    def now_ns(self) -> int:
        """Return the present time."""
        return time.time_ns()

    def wait_until_ns(self, instant_ns: int, stop: threading.Event) -> bool:
        """Sleep until instant_ns; return True if stop is set before then."""
        return sleep_ns(instant_ns - time.time_ns(), stop)


class ManualClock:
    """A clock for tests and offline tools: it is set by the caller, and waiting advances it."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        """Return the time set last."""
        return self._now_ns

    def set_ns(self, now_ns: int) -> None:
        """Set the present time."""
        self._now_ns = now_ns

    def wait_until_ns(self, instant_ns: int, stop: threading.Event) -> bool:
        """Advance to instant_ns at once; return whether stop is set."""
        self._now_ns = max(self._now_ns, instant_ns)
        return stop.is_set()


def trigger_index(stamp_ns: int, trigger_period_ns: int) -> int:
    """Return the number k of the trigger whose instant, k * trigger_period_ns since the epoch, is nearest to stamp_ns.

    Integer arithmetic: a float cannot hold today's epoch nanoseconds exactly.
    """
    return (stamp_ns + trigger_period_ns // 2) // trigger_period_ns
