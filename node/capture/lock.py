"""The loop that locks a node's exposure to the other node's lamps: a state machine without a camera or a clock.

A core that is not clipped tells its light per ms of exposure, whichever exposure its frame had. So one frame tells
the exposure that is wanted, and the delay of a camera's controls cannot make the loop hunt. A clipped core tells only
that less is wanted. So the exposure goes down in rungs, frame by frame, without waiting for an answer. It jumps to the
right one at the first frame that is not clipped.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

from buddyline.node.capture.cores import Core, SceneLight
from buddyline.node.capture.exposure import FIRST_LAMPS, FIRST_SCENE, Exposure, ExposurePlan, ExposureRange

State: TypeAlias = Literal["search", "descend", "locked"]

TARGET: Final = 0.6
"""Light of the brighter lamp's core, as a share of what clips: a lamp that turns brighter by 0.7 EV is not clipped."""
RUNG: Final = 4.0
"""Ratio of one amount to the next where lamps are searched for, or clipped."""
RUNGS_AHEAD: Final = 3
"""A descent asks for so many rungs less than the last clipped frame at most: the answers are still to come."""
STILL_BRIGHT: Final = 2
"""So many clipped frames one after the other begin a descent: one alone may be a diver's strobe."""
REMEMBERED: Final = 8
"""The exposure follows what the last so many frames wanted."""
DEAD_BAND: Final = 1.3
"""A locked exposure changes only where the wanted one differs by more than this ratio."""
RISE: Final = 1.25
"""A locked exposure rises by at most this ratio from frame to frame; it falls at once."""
NEAR: Final = 1.5
"""Two exposures within this ratio count as the same."""
LOST: Final = 5
"""After so many frames without a lamp, at the exposure that was asked for, the search begins."""
SCENE_MEAN: Final = 0.15
"""Mean light of a well exposed context frame, as a share of what clips."""
SCENE_CLIPPED: Final = (0.0015, 0.005)
"""Share of clipped pixels above which the scene's exposure does not rise, and above which it falls."""
SCENE_STEP: Final = 1.4
"""The scene's exposure changes by at most this ratio from one context frame to the next."""
SCENE_DEAD_BAND: Final = 1.3
STILL_HIDDEN: Final = 2
"""So many context frames one after the other must show a lamp that the lamps' frames do not."""
FLOOR_BELOW_SCENE: Final = 8.0
"""The floor, the least exposure that keeps a hidden lamp visible, is at most the scene's divided by this."""
FLOOR_TRIED: Final = 30
"""A floor that hides nothing is given up after so many context frames: what was hidden may be gone."""


@dataclass(frozen=True, slots=True)
class Metering:
    """What one frame showed. exposure: by its own metadata. cores: of what is taken for the other node's lamps.

    scene: of a context frame, else None. hidden: whether a context frame has a lamp that the lamps' frames do not show.
    """

    exposure: Exposure
    cores: Sequence[Core]
    scene: SceneLight | None = None
    hidden: bool = False


class ExposureLock:
    """Says with which exposures to go on, after each frame.

    state: `search` (no lamp is seen: the amount rises by rungs from the last good one to the scene's, again and again),
    `descend` (lamps are clipped: it falls by rungs) or `locked`. plan: the exposures of the triggers to come.
    """

    def __init__(
        self, exposures: ExposureRange, context_every: int, flicker_ns: float = 0.0, target: float = TARGET
    ) -> None:
        self.state: State = "search"
        self._range = exposures
        self._context_every = context_every
        self._flicker_ns = flicker_ns
        self._target = target
        self._scene = self._within(FIRST_SCENE)
        self._amount = self._within(FIRST_LAMPS)
        self._good = self._within(self._scene / RUNG**4)
        self._wanted: deque[float] = deque(maxlen=REMEMBERED)
        self._missed = 0
        self._bright = 0
        self._clipped_at = math.inf
        self._floor = 0.0
        self._contexts = self._hidden = 0
        self.plan = self._plan()

    def update(self, metering: Metering) -> ExposurePlan:
        """Take what a frame showed; return the plan from now on."""
        if metering.scene is not None:
            self._follow_scene(metering.exposure.amount, metering.scene)
            self._keep_visible(metering.hidden)
        if not metering.cores:
            self._miss(metering)
        elif any(core.clipped for core in metering.cores):
            self._take_bound(metering)
        else:
            self._take_light(metering)
        self.plan = self._plan()
        return self.plan

    def _plan(self) -> ExposurePlan:
        lamps, scene = (self._range.exposure(amount, self._flicker_ns) for amount in (self._amount, self._scene))
        return ExposurePlan(lamps, scene, self._context_every)

    def _within(self, amount: float) -> float:
        return min(max(amount, self._range.least), self._range.most)

    def _asked(self, metering: Metering) -> bool:
        """Return whether a frame had about the exposure that is asked for now; others are older, or of the scene."""
        ratio = metering.exposure.amount / self.plan.lamps.amount
        return 1 / NEAR <= ratio <= NEAR

    def _miss(self, metering: Metering) -> None:
        self._bright = 0
        if self.state == "search":
            self._amount = self._next_searched()
        elif self._asked(metering):
            self._missed += 1
            if self._missed >= LOST:
                self.state, self._missed = "search", 0
                self._wanted.clear()
                self._amount = self._good

    def _next_searched(self) -> float:
        """Return the next amount to search at: a rung more, from the scene's to the last good one."""
        if self._amount >= self._scene / math.sqrt(RUNG):
            return min(self._good, self._scene)
        return min(self._amount * RUNG, self._scene)

    def _take_bound(self, metering: Metering) -> None:
        """Take a frame with a clipped core: less is wanted than what it had."""
        amount = metering.exposure.amount
        lowest = max(self._floor, self._range.least)
        if amount <= NEAR * lowest:
            self._settle(lowest)
            return
        if self.state == "locked":
            # Frames with more than what is asked for are older, or the scene's.
            if amount > NEAR * self.plan.lamps.amount:
                return
            self._wanted.append(self._within(self._target * amount))
            self._bright += 1
            if self._bright < STILL_BRIGHT:
                return
        if self.state != "descend":
            self.state, self._clipped_at = "descend", amount
            self._amount = self._within(amount / RUNG)
        elif amount <= NEAR * self._clipped_at:
            self._clipped_at = min(self._clipped_at, amount)
            self._amount = self._within(max(self._amount / RUNG, self._clipped_at / RUNG**RUNGS_AHEAD))
        self._missed = self._bright = 0

    def _take_light(self, metering: Metering) -> None:
        """Take a frame without a clipped core: it says what is wanted."""
        self._bright = 0
        # A lamp is brighter than what it lights: what wants more than the scene does is no lamp.
        wanted = self._target * metering.exposure.amount / max(core.light for core in metering.cores)
        wanted = self._within(min(wanted, self._scene))
        if wanted >= self._floor:
            self._floor = 0.0
        self._settle(max(wanted, self._floor))

    def _settle(self, wanted: float) -> None:
        """Go towards the amount that a frame wants."""
        self._missed = 0
        self._wanted.append(wanted)
        if self.state != "locked":
            self.state = "locked"
            self._amount = min(self._wanted)
        # The second least: less at once, more only when all agree, and a single flash is nothing.
        goal = sorted(self._wanted)[min(1, len(self._wanted) - 1)]
        if goal < self._amount / DEAD_BAND:
            self._amount = goal
        elif goal > self._amount * DEAD_BAND:
            self._amount = min(goal, self._amount * RISE)
        self._good = self._amount

    def _keep_visible(self, hidden: bool) -> None:
        """Expose longer than the brightest lamp wants where that hides another one, which may be the other node's."""
        if not hidden:
            self._hidden = 0
        if self.state != "locked":
            self._floor = 0.0
        elif hidden:
            self._hidden += 1
            if self._hidden < STILL_HIDDEN:
                return
            self._floor = min(RUNG * max(self._amount, self._floor), self._scene / FLOOR_BELOW_SCENE)
            self._contexts = 0
        elif self._floor > 0.0:
            self._contexts += 1
            if self._contexts >= FLOOR_TRIED:
                self._floor = 0.0

    def _follow_scene(self, amount: float, scene: SceneLight) -> None:
        """Bring the scene's exposure towards SCENE_MEAN, as long as hardly anything is clipped."""
        few, many = SCENE_CLIPPED
        goal = amount * SCENE_MEAN / max(scene.mean, 1e-6)
        if scene.clipped > many:
            goal = min(goal, amount / SCENE_STEP)
        elif scene.clipped > few:
            goal = min(goal, amount)
        if not 1 / SCENE_DEAD_BAND <= goal / self._scene <= SCENE_DEAD_BAND:
            self._scene = self._within(min(max(goal, self._scene / SCENE_STEP), self._scene * SCENE_STEP))
