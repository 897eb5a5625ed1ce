"""Clocks as arguments: nothing else in the project asks what time it is."""

from __future__ import annotations

import threading
import time
from typing import Protocol

S_NS = 1_000_000_000
MS_NS = 1_000_000


class Clock(Protocol):
    """Wall clock in integer nanoseconds since the Unix epoch, UTC."""

    def now_ns(self) -> int:
        """Return the present time."""
        ...

    def wait_until_ns(self, instant_ns: int, stop: threading.Event) -> bool:
        """Sleep until instant_ns; return True where stop was set before."""
        ...


class SystemClock:
    """The machine's own wall clock."""

    def now_ns(self) -> int:
        """Return the present time."""
        return time.time_ns()

    def wait_until_ns(self, instant_ns: int, stop: threading.Event) -> bool:
        """Sleep until instant_ns; return True where stop was set before."""
        remaining_ns = instant_ns - time.time_ns()
        return stop.wait(max(remaining_ns, 0) / S_NS) if remaining_ns > 0 else stop.is_set()


class ManualClock:
    """A clock that a test or an offline tool sets: waiting moves it on."""

    def __init__(self, now_ns: int = 0) -> None:
        self._now_ns = now_ns

    def now_ns(self) -> int:
        """Return the time that was set last."""
        return self._now_ns

    def set_ns(self, now_ns: int) -> None:
        """Set the present time."""
        self._now_ns = now_ns

    def wait_until_ns(self, instant_ns: int, stop: threading.Event) -> bool:
        """Move on to instant_ns at once."""
        self._now_ns = max(self._now_ns, instant_ns)
        return stop.is_set()


def trigger_index(stamp_ns: int, trigger_period_ns: int) -> int:
    """Return the index k of the trigger instant k * period since the epoch nearest to stamp_ns.

    Integer arithmetic: a float would lose the last digits of today's epoch nanoseconds.
    """
    return (stamp_ns + trigger_period_ns // 2) // trigger_period_ns
