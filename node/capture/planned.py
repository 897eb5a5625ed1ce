"""Exposures asked for ahead of time: a camera's controls act some frames later, and only metadata tell when."""

from __future__ import annotations

from collections import Counter, deque
from statistics import median
from typing import Final

from buddyline.node.capture.exposure import Exposure, ExposurePlan, ExposureRange
from buddyline.protocol.clock import trigger_index

FIRST_DELAY: Final = 9
"""Frames of delay, before it is learnt."""
DELAYS: Final = range(1, 25)
REMEMBERED: Final = 32
"""What was asked for is kept for so many frames."""
VOTES: Final = 12
"""The delay is the most frequent one of the last so many changes of exposure."""
SAME: Final = 1.05
"""A frame had what was asked for if both exposures are within this ratio."""
CHANGED: Final = 1.5
"""Only a change by more than this ratio from one frame to the next tells the delay."""
TYPICAL_OF: Final = 15
"""The usual exposure time is the median over so many frames."""


class PlannedExposures:
    """The exposure control of a free-running camera: says what to ask for with each frame that is given back.

    range: what the camera can be asked for. synced: whether libcamera keeps the frames in phase with another camera's.
    delay_frames: from asking for an exposure to the frame that has it, learnt from frames that had what was asked for.
    It decides only which frame is the scene's.
    """

    def __init__(
        self, exposures: ExposureRange, trigger_period_ns: int, frame_period_ns: int, synced: bool = False
    ) -> None:
        self.range = exposures
        self._synced = synced
        self.delay_frames = FIRST_DELAY
        self._trigger_period_ns = trigger_period_ns
        self._frame_period_ns = frame_period_ns
        self._plan = exposures.first_plan()
        self.restart()

    def restart(self) -> None:
        """Begin anew with a camera that was started with `first`."""
        self._asked: dict[int, Exposure] = {}
        self._had: tuple[int, Exposure] | None = None
        self._newest = self.first
        self._votes: deque[int] = deque(maxlen=VOTES)
        self._times_ns: deque[int] = deque(maxlen=TYPICAL_OF)
        self._last: tuple[int, int] | None = None

    @property
    def first(self) -> Exposure:
        """The exposure to start the camera with."""
        return self._plan.lamps

    @property
    def plan(self) -> ExposurePlan:
        """The plan that is followed."""
        return self._plan

    def follow(self, plan: ExposurePlan) -> None:
        """Expose by this plan from now on; for any thread."""
        self._plan = plan

    def steady_ns(self, stamp_ns: int, exposure: Exposure) -> int:
        """Return the stamp that a frame would have with the usual exposure time: the phase is locked by it.

        Where another camera keeps the phase, nothing is known of its exposures. Then it is the row's readout.
        """
        if self._synced:
            return stamp_ns + exposure.time_ns // 2
        self._times_ns.append(exposure.time_ns)
        return stamp_ns + (exposure.time_ns - round(median(self._times_ns))) // 2

    def next(self, steady_ns: int, exposure: Exposure) -> Exposure | None:
        """Take a frame's steady stamp and exposure; return what to ask for as it is given back, None: as before."""
        number = self._number(steady_ns)
        self._learn(number, exposure)
        ahead_ns = steady_ns + self.delay_frames * self._frame_period_ns
        trigger = trigger_index(ahead_ns, self._trigger_period_ns)
        off_ns = ahead_ns - trigger * self._trigger_period_ns
        plan = self._plan
        due = -self._frame_period_ns <= 2 * off_ns < self._frame_period_ns
        wanted = plan.at(trigger) if due else plan.lamps
        self._asked[number] = wanted
        for old in [key for key in self._asked if key < number - REMEMBERED]:
            del self._asked[old]
        if wanted == self._newest:
            return None
        self._newest = wanted
        return wanted

    def _number(self, stamp_ns: int) -> int:
        """Return the number of a frame, lost ones counted."""
        number = 0
        if self._last is not None:
            number = self._last[0] + max(round((stamp_ns - self._last[1]) / self._frame_period_ns), 1)
        self._last = number, stamp_ns
        return number

    def _learn(self, number: int, exposure: Exposure) -> None:
        """Learn the delay where the exposure has changed from one frame to the next."""
        before, self._had = self._had, (number, exposure)
        if before is None or before[0] != number - 1 or _alike(before[1], exposure, CHANGED):
            return
        fitting = [
            delay
            for delay in DELAYS
            if (now := self._asked.get(number - delay)) is not None
            and (then := self._asked.get(number - delay - 1)) is not None
            and _alike(now, exposure, SAME)
            and _alike(then, before[1], SAME)
        ]
        if len(fitting) == 1:
            self._votes.append(fitting[0])
            self.delay_frames = Counter(self._votes).most_common(1)[0][0]


def _alike(one: Exposure, two: Exposure, ratio: float) -> bool:
    return 1 / ratio <= one.amount / two.amount <= ratio
