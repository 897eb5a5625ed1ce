"""Send a node's pictures: some frames are recorded at full size, some are published as small previews."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from buddyline.node.config import NodeConfig
from buddyline.node.devices import Frame
from buddyline.node.outlet import Outlet
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import CompressedImage, FoxgloveTime
from numpy.typing import NDArray

SCENE_AWAITED_NS: Final = 5 * S_NS // 2


class RateLimiter:
    """Allows frames at rate_hz or less, also where the clock jumps; allows none where rate_hz is 0."""

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = round(0.99e9 / rate_hz) if rate_hz > 0 else 0
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


class Images:
    """Records and publishes a node's pictures as JPEG, each at its configured rate.

    Where frames for the lamps and for the scene take turns, all of the scene's are recorded, for a person to find them
    in the log, and previews are of the scene. A frame for the lamps is shown only after SCENE_AWAITED_NS without one.
    """

    def __init__(self, config: NodeConfig, outlet: Outlet) -> None:
        self._frame_id = f"{config.node}_camera"
        self._record = config.record
        self._preview = config.preview
        self._outlet = outlet
        self._record_limit = RateLimiter(config.record.images_hz)
        self._preview_limit = RateLimiter(config.preview.rate_hz)
        self._scene_ns = 0

    def send(self, frame: Frame) -> None:
        """Record or publish a frame's picture if its rate limit allows it."""
        limit = self._record_limit
        if limit.force(frame.stamp_ns) if frame.context else limit.allow(frame.stamp_ns):
            image = self._encoded(frame.image, frame.stamp_ns, self._record.image_quality)
            self._outlet.send(image, publish=False)
        if frame.context is not False:
            self._scene_ns = frame.stamp_ns
        waited_ns = abs(frame.stamp_ns - self._scene_ns)
        if not 0 < waited_ns <= SCENE_AWAITED_NS and self._preview_limit.allow(frame.stamp_ns):
            height, width = frame.image.shape[:2]
            scale = min(self._preview.width_px / width, 1.0)
            size = (round(width * scale), max(round(height * scale), 1))
            small = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8)
            self._outlet.send(self._encoded(small, frame.stamp_ns, self._preview.quality), record=False)

    def _encoded(self, image: NDArray[np.uint8], stamp_ns: int, quality: int) -> CompressedImage:
        sound, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if not sound:
            raise RuntimeError("the picture could not be encoded")
        return CompressedImage(
            timestamp=FoxgloveTime(sec=stamp_ns // S_NS, nsec=stamp_ns % S_NS),
            frame_id=self._frame_id,
            data=data.tobytes(),
            format="jpeg",
        )
