"""Which frames are recorded or shown: at most so many a second, and all that show the scene."""

from __future__ import annotations


class RateLimiter:
    """Allows frames at rate_hz or less, also where the clock jumps; allows none where rate_hz is 0."""

    def __init__(self, rate_hz: float) -> None:
        # From one frame in thirty years to every frame.
        self._period_ns = max(round(0.99e9 / max(rate_hz, 1e-9)), 1) if rate_hz > 0 else 0
        self._next_ns = 0

    def allow(self, stamp_ns: int) -> bool:
        """Return whether the frame with this stamp is allowed."""
        # After the clock is set back, the next frame is allowed at once.
        if self._period_ns == 0 or 0 < self._next_ns - stamp_ns <= self._period_ns:
            return False
        self._next_ns = stamp_ns + self._period_ns
        return True

    def force(self, stamp_ns: int) -> bool:
        """Allow this frame whatever came before, unless none is ever allowed."""
        self._next_ns = 0
        return self.allow(stamp_ns)


class RecordedFrames:
    """Picks the frames to record: all of the scene's, where they take turns with those for the lamps, and others."""

    def __init__(self, rate_hz: float) -> None:
        self._limit = RateLimiter(rate_hz)

    def pick(self, stamp_ns: int, context: bool | None) -> bool:
        """Return whether to record this frame. context: as in Frame."""
        return self._limit.force(stamp_ns) if context else self._limit.allow(stamp_ns)
