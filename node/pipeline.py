"""Turn a frame into its Candidates message: the part of a node without devices, bus or clock."""

from __future__ import annotations

import statistics
from collections import deque

from buddyline.node.detect import Detection, Detector, GuidedDetector
from buddyline.node.detect.detection import CLIPPED, LASTING_S
from buddyline.node.devices import Frame
from buddyline.node.guide import Guide, expected_first
from buddyline.protocol.clock import trigger_index
from buddyline.protocol.messages import MAX_BLOBS, Blob, Candidates
from msgspec import UNSET, UnsetType

__all__ = ["Pipeline", "blobs_of"]


def blobs_of(detections: list[Detection], frame: Frame) -> tuple[list[Blob], int]:
    """Return the first MAX_BLOBS blobs inside the picture, with dt_ns of their rows, and how many were left out."""
    height, width = frame.image.shape[:2]
    middle_row = (height - 1) / 2
    blobs = [
        _rounded(d.blob, dt_ns=round((d.blob.v_px - middle_row) * frame.row_time_ns))
        for d in detections
        if -0.5 <= d.blob.u_px <= width - 0.5 and -0.5 <= d.blob.v_px <= height - 0.5 and d.blob.sigma_px > 0
    ]
    return blobs[:MAX_BLOBS], max(len(blobs) - MAX_BLOBS, 0)


def _rounded(blob: Blob, dt_ns: int) -> Blob:
    """Return a blob as it is sent, without digits far below its errors, which would be half of the message."""
    return Blob(
        u_px=round(blob.u_px, 4),
        v_px=round(blob.v_px, 4),
        sigma_px=float(f"{blob.sigma_px:.4g}"),
        area_px=float(f"{blob.area_px:.4g}"),
        peak=round(blob.peak, 1),
        elongation=round(blob.elongation, 3),
        dt_ns=dt_ns,
        score=UNSET if blob.score is UNSET else round(blob.score, 4),
        lasting_s=LASTING_S if blob.lasting_s is UNSET and blob.peak >= CLIPPED else blob.lasting_s,
    )


class Pipeline:
    """Detects the candidates of one camera's frames, and numbers the messages.

    guide: plans where to look in each frame; None to search all of each. expected: number of the last frame's
    candidates that are where the solver expects the other node's lights; they come first.
    """

    def __init__(
        self, node: str, boot: str, trigger_period_ns: int, detector: Detector, guide: Guide | None = None
    ) -> None:
        self.node = node
        self.boot = boot
        self.trigger_period_ns = trigger_period_ns
        self.residuals_s: deque[float] = deque(maxlen=100)
        self.repeated = 0
        self.detections: list[Detection] = []  # of the last frame, for drawings
        self.expected = 0
        self._detector = detector
        self._guide = guide
        self._seq = 0
        self._last_trigger = -1

    def candidates(self, frame: Frame) -> Candidates | None:
        """Return the frame's candidates; None if the previous frame had the same trigger."""
        trigger = trigger_index(frame.stamp_ns, self.trigger_period_ns)
        if trigger == self._last_trigger:
            self.repeated += 1
            return None
        self._last_trigger = trigger
        self.residuals_s.append((frame.stamp_ns - trigger * self.trigger_period_ns) / 1e9)
        self.detections, elsewhere = self._search(frame)
        blobs, truncated = blobs_of(self.detections, frame)
        height, width = frame.image.shape[:2]
        message = Candidates(
            node=self.node,
            stamp_ns=frame.stamp_ns,
            trigger=trigger,
            seq=self._seq,
            boot=self.boot,
            width_px=width,
            height_px=height,
            blobs=blobs,
            truncated=truncated,
            exposure_ns=UNSET if frame.exposure is None else frame.exposure.time_ns,
            gain=UNSET if frame.exposure is None else frame.exposure.gain,
            context=UNSET if frame.context is None else frame.context,
            elsewhere=elsewhere,
        )
        self._seq += 1
        return message

    def _search(self, frame: Frame) -> tuple[list[Detection], int | UnsetType]:
        """Return a frame's detections, and how many were elsewhere where only parts of it were searched."""
        guide, image, stamp_ns = self._guide, frame.image, frame.stamp_ns
        if guide is None or not isinstance(self._detector, GuidedDetector):
            return self._detector.detect(image), UNSET
        height, width = image.shape[:2]
        # A frame exposed for the scene shows what the others do not, and the lamps in another size.
        lamps = not frame.context
        plan = guide.plan(stamp_ns, width, height, whole=not lamps)
        found = None
        if plan.regions:
            found = self._detector.detect_near(image, plan.regions)
            if found is not None and plan.is_lost(found):
                found = None
        whole = found is None
        if found is None:
            found = self._detector.detect(image)
        guide.learn(stamp_ns, found, width, whole=whole, sized=lamps, dark=plan.dark)
        elsewhere = UNSET if whole else guide.elsewhere(len(found))
        found, self.expected = expected_first(found, plan.foretold)
        return found, elsewhere

    @property
    def residual_s(self) -> float | None:
        """Median of exposure time minus trigger instant, s, over the last 100 frames."""
        return statistics.median(self.residuals_s) if self.residuals_s else None
