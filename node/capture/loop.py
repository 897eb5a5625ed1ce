"""From a frame and its candidates to the camera's next exposures: the loop without camera, threads or clock."""

from __future__ import annotations

from collections.abc import Sequence

from buddyline.node.capture.cores import ExpectedLamp, choose_lamps, measure_cores, measure_scene
from buddyline.node.capture.exposure import ExposurePlan, ExposureRange
from buddyline.node.capture.flicker import FlickerWatch
from buddyline.node.capture.lock import ExposureLock, Metering
from buddyline.node.config import ExposureConfig
from buddyline.node.devices import Frame
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Blob


class ExposureLoop:
    """One camera's loop. plan: what the camera is to do from now on."""

    def __init__(self, config: ExposureConfig, exposures: ExposureRange) -> None:
        self._range = exposures.within(config.longest_us * 1000, config.gain_max)
        self._flicker_ns = S_NS / config.flicker_hz if config.flicker_hz > 0 else 0.0
        self._lock = ExposureLock(self._range, config.context_every, self._flicker_ns, config.target)
        self._flicker = FlickerWatch()

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

    def update(self, frame: Frame, blobs: Sequence[Blob], expected: Sequence[ExpectedLamp] = ()) -> ExposurePlan:
        """Take a frame and its candidates, the likeliest first; return the plan from now on.

        expected: where the solver expects the other node's lamps. A frame that does not say its exposure is ignored.
        """
        if frame.exposure is None:
            return self.plan
        cores = measure_cores(frame.image, choose_lamps(blobs, expected), self._range.linear)
        self._flicker.update(frame.exposure, cores)
        return self._lock.update(Metering(frame.exposure, cores, measure_scene(frame.image, self._range.linear)))
