"""From a frame and its candidates to the camera's next exposures: the loop without camera, threads or clock."""

from __future__ import annotations

import math
from typing import Final

from buddyline.node.capture.cores import choose_lamps, measure_cores, measure_scene
from buddyline.node.capture.exposure import ExposurePlan, ExposureRange
from buddyline.node.capture.flicker import FlickerWatch
from buddyline.node.capture.lock import ExposureLock, Metering
from buddyline.node.config import ExposureConfig
from buddyline.node.detect.detection import is_likely
from buddyline.node.devices import Frame
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates
from msgspec import UNSET

APART: Final = 0.05
"""A lamp of one frame is within this share of the picture's width in the next."""


class ExposureLoop:
    """One camera's loop. plan: what the camera is to do from now on."""

    def __init__(self, config: ExposureConfig, exposures: ExposureRange) -> None:
        self._range = exposures.within(config.longest_us * 1000, config.gain_max)
        self._flicker_ns = S_NS / config.flicker_hz if config.flicker_hz > 0 else 0.0
        self._lock = ExposureLock(self._range, config.context_every, self._flicker_ns, config.target)
        self._flicker = FlickerWatch()
        self._seen_px: list[tuple[float, float]] = []

    @property
    def plan(self) -> ExposurePlan:
        """The exposures of the triggers to come."""
        return self._lock.plan

    @property
    def state(self) -> str:
        """What it does: "search", "descend" or "locked"."""
        return self._lock.state

    @property
    def problem(self) -> str:
        """What is wrong with the lamps, "" where nothing is."""
        return self._flicker.problem

    def update(self, frame: Frame, candidates: Candidates, expected: int = 0) -> ExposurePlan:
        """Take a frame and its candidates; return the plan from now on.

        expected: how many of the first candidates are where the solver expects the other node's lamps. A frame that
        does not say its exposure is ignored.
        """
        if frame.exposure is None:
            return self.plan
        cores = measure_cores(frame.image, choose_lamps(candidates.blobs, expected), self._range.linear)
        self._flicker.update(frame.exposure, cores)
        scene, hidden = None, False
        if self.plan.is_context(frame.exposure):
            scene = measure_scene(frame.image, self._range.linear)
            hidden = expected == 0 and self._hides(frame, candidates)
        elif candidates.elsewhere is UNSET:
            self._seen_px = [(blob.u_px, blob.v_px) for blob in candidates.blobs]
        return self._lock.update(Metering(frame.exposure, cores, scene, hidden))

    def _hides(self, frame: Frame, candidates: Candidates) -> bool:
        """Return whether a context frame has a lamp, clipped as lamps are in it, that the lamps' frames do not show."""
        likely = [blob for blob in candidates.blobs if is_likely(blob)]
        reach_px = APART * frame.image.shape[1]
        return any(
            core.clipped and all(math.hypot(core.u_px - u, core.v_px - v) > reach_px for u, v in self._seen_px)
            for core in measure_cores(frame.image, likely, self._range.linear)
        )
