"""Trigger instants and a free-running camera: choice of the nearest frame, lock of the phase.

The instants t_k = k * period since the epoch are the same for every node whose clock is right; no message triggers a
frame. Each node moves its own frames onto them, by giving a single frame another duration.
"""

from __future__ import annotations

from collections import deque
from statistics import median
from typing import Final

from buddyline.protocol.clock import MS_NS, S_NS, trigger_index

PHASES: Final = 5
SETTLING_FRAMES: Final = 6
LATENCY_FRAMES: Final = 10  # of a picamera2 control, with six buffers
MAX_DRIFT: Final = 1e-3
LOCKED_NS: Final = 300_000
LONGEST_FRAME_NS: Final = 100 * MS_NS
# libcamera's server sends its time every 30 frames by default.
FOLLOWED_WITHIN_NS: Final = 15 * S_NS
FOLLOWED_FRAMES: Final = 9


def frames_per_trigger(trigger_period_ns: int) -> int:
    """Return the frames per trigger: enough for a lock within two seconds."""
    return -(-trigger_period_ns // LONGEST_FRAME_NS)


class FrameChooser:
    """Picks the frame nearest to each instant."""

    def __init__(self, trigger_period_ns: int, frame_period_ns: int) -> None:
        self._trigger_period_ns = trigger_period_ns
        self._frame_period_ns = frame_period_ns
        self._last: int | None = None

    def is_nearest(self, stamp_ns: int) -> bool:
        """Return whether this frame is the one for its instant.

        Frames are a frame period apart, so the nearest one is at most half of that away.
        """
        trigger = trigger_index(stamp_ns, self._trigger_period_ns)
        off_ns = stamp_ns - trigger * self._trigger_period_ns
        if trigger == self._last or not -self._frame_period_ns <= 2 * off_ns < self._frame_period_ns:
            return False
        self._last = trigger
        return True


class FollowerWatch:
    """Checks that the frames of a camera whose phase something else locks are on the instants.

    problem: what is wrong; "" if nothing, and during the first FOLLOWED_WITHIN_NS.
    """

    def __init__(self, trigger_period_ns: int) -> None:
        self.problem = ""
        self._trigger_period_ns = trigger_period_ns
        self._began_ns: int | None = None
        self._residuals_ns: deque[int] = deque(maxlen=FOLLOWED_FRAMES)

    def update(self, stamp_ns: int) -> None:
        """Take the stamp of a frame that is nearest to its instant."""
        if self._began_ns is None or stamp_ns < self._began_ns:
            self._began_ns = stamp_ns
        trigger = trigger_index(stamp_ns, self._trigger_period_ns)
        self._residuals_ns.append(abs(stamp_ns - trigger * self._trigger_period_ns))
        if stamp_ns - self._began_ns < FOLLOWED_WITHIN_NS or len(self._residuals_ns) < FOLLOWED_FRAMES:
            return
        off_ns = median(self._residuals_ns)
        self.problem = (
            "" if off_ns <= LOCKED_NS else f"frames are {off_ns / MS_NS:.1f} ms away from the trigger instants"
        )


class PhaseLock:
    """Brings the frames' middles of exposure onto the grid of the instants, and keeps them there.

    Measures phase and drift over a few frames, requests one frame of another duration, and waits until that frame
    must have come. A frame lasts a whole number of lines, and clocks differ: each correction includes half of the drift
    expected until the next one, so that the phase is zero midway between two corrections.
    frames: per trigger period. min_frame_ns: the camera's shortest. line_ns: time of a line. residual_ns: the phase
    measured last, None before that.
    """

    def __init__(
        self,
        trigger_period_ns: int,
        frames: int,
        min_frame_ns: int,
        line_ns: float,
        latency_frames: int = LATENCY_FRAMES,
    ) -> None:
        self.residual_ns: int | None = None
        self._trigger_period_ns = trigger_period_ns
        self._period_ns = trigger_period_ns / frames
        self._min_ns = min_frame_ns
        self._line_ns = line_ns
        self._lines = round(self._period_ns / line_ns)
        self._latency_frames = latency_frames
        self._waiting_frames = 0
        self._enough_frames = PHASES
        self._stretched = False
        self._stamps_ns: list[int] = []

    @property
    def duration_ns(self) -> int:
        """Duration to request while no correction is needed."""
        return self._request_ns(self._lines)

    @property
    def locked(self) -> bool:
        """Whether the phase last measured was within the bounds."""
        return self.residual_ns is not None and abs(self.residual_ns) <= LOCKED_NS

    def update(self, stamp_ns: int) -> int | None:
        """Take a frame's stamp; return the duration, ns, to set from the next request on; None: no change."""
        if self._stretched:
            self._stretched = False
            return self.duration_ns
        if self._waiting_frames:
            self._waiting_frames -= 1
            return None
        self._stamps_ns.append(stamp_ns)
        if len(self._stamps_ns) < self._enough_frames:
            return None
        stamps_ns, self._stamps_ns = self._stamps_ns, []
        first = self._enough_frames == PHASES
        drift_ns = self._lines * self._line_ns - self._period_ns if first else self._drift_ns(stamps_ns)
        self._enough_frames = SETTLING_FRAMES + PHASES
        phases_ns = [self._carried_ns(stamp_ns, stamps_ns[-1], drift_ns) for stamp_ns in stamps_ns[-PHASES:]]
        self.residual_ns = self._phase_ns(stamps_ns[-1] + round(median(phases_ns)))
        return self._correct(self.residual_ns, drift_ns)

    def _phase_ns(self, time_ns: int) -> int:
        """Return how far after the nearest point of the grid a time is: from -period/2 to +period/2.

        The grid begins at each instant: otherwise the rounding of the period to whole ns would add up since 1970.
        """
        since_ns = time_ns % self._trigger_period_ns
        return since_ns - round(round(since_ns / self._period_ns) * self._period_ns)

    def _frames(self, span_ns: int) -> int:
        return round(span_ns / self._period_ns)

    def _drift_ns(self, stamps_ns: list[int]) -> float:
        """Return how much longer than the period a frame takes: the median of all pairs' slopes."""
        slopes = []
        for i, earlier_ns in enumerate(stamps_ns):
            for later_ns in stamps_ns[i + 1 :]:
                frames = self._frames(later_ns - earlier_ns)
                if frames > 0:
                    slopes.append((later_ns - earlier_ns - frames * self._period_ns) / frames)
        return median(slopes) if slopes else 0.0

    def _carried_ns(self, stamp_ns: int, newest_ns: int, drift_ns: float) -> float:
        """Return when the newest frame would have come by this frame's time and the drift, minus when it came, ns."""
        return stamp_ns + self._frames(newest_ns - stamp_ns) * (self._period_ns + drift_ns) - newest_ns

    def _correct(self, phase_ns: int, drift_ns: float) -> int | None:
        """Return the duration of the one frame that corrects phase and drift."""
        # Half a line too long and half a line too short are equally good: do not alternate between them.
        more = round(-drift_ns / self._line_ns) if abs(drift_ns) > 0.65 * self._line_ns else 0
        if abs((self._lines + more) * self._line_ns - self._period_ns) > self._period_ns * MAX_DRIFT:
            more = 0
        left_ns = drift_ns + more * self._line_ns
        cycle_frames = self._latency_frames + SETTLING_FRAMES + PHASES
        ahead_ns = phase_ns + round(drift_ns * self._latency_frames + left_ns * cycle_frames / 2)
        lines = round(self._phase_ns(ahead_ns) / self._line_ns)
        if lines == 0 and more == 0:
            return None
        self._lines += more
        self._stretched = True
        self._waiting_frames = self._latency_frames
        whole = self._lines - lines
        if whole * self._line_ns < self._min_ns:
            whole += round(self._period_ns / self._line_ns)
        return self._request_ns(whole)

    def _request_ns(self, lines: int) -> int:
        """Return a duration that gives this many lines, whether the camera truncates or rounds."""
        return round((lines + 0.25) * self._line_ns)
