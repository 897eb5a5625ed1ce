"""Send a node's pictures: some frames are recorded at full size, some are published as small previews."""

from __future__ import annotations

import logging
from concurrent.futures import Future
from typing import Final

import cv2
import numpy as np
from buddyline.node.config import NodeConfig
from buddyline.node.devices import Frame
from buddyline.node.outlet import Outlet
from buddyline.node.picking import RateLimiter, RecordedFrames
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import CompressedImage, FoxgloveTime
from numpy.typing import NDArray

log = logging.getLogger(__name__)

SCENE_AWAITED_NS: Final = 5 * S_NS // 2


class Images:
    """Records and publishes a node's pictures as JPEG, each at its configured rate.

    Where frames for the lamps and for the scene take turns, all of the scene's are recorded, for a person to find them
    in the log, and previews are of the scene. A frame for the lamps is shown only after SCENE_AWAITED_NS without one.
    Where the camera's own encoder makes the recorded ones, the camera picks them. failed: how many it did not make.
    """

    def __init__(self, config: NodeConfig, outlet: Outlet) -> None:
        self._frame_id = f"{config.node}_camera"
        self._record = config.record
        self._preview = config.preview
        self._outlet = outlet
        self._recorded = RecordedFrames(config.record.images_hz)
        self._preview_limit = RateLimiter(config.preview.rate_hz)
        self._scene_ns = 0
        self.failed = 0

    def send(self, frame: Frame) -> None:
        """Record or publish a frame's picture if its rate limit allows it."""
        if frame.jpeg is not None:
            frame.jpeg.add_done_callback(lambda jpeg: self._record_encoded(frame, jpeg))
        elif self._record.encoder == "software" and self._recorded.pick(frame.stamp_ns, frame.context):
            self._record_image(frame)
        if frame.context is not False:
            self._scene_ns = frame.stamp_ns
        waited_ns = abs(frame.stamp_ns - self._scene_ns)
        if not 0 < waited_ns <= SCENE_AWAITED_NS and self._preview_limit.allow(frame.stamp_ns):
            height, width = frame.image.shape[:2]
            scale = min(self._preview.width_px / width, 1.0)
            size = (round(width * scale), max(round(height * scale), 1))
            small = np.asarray(cv2.resize(frame.image, size, interpolation=cv2.INTER_AREA), np.uint8)
            self._outlet.send(self._encoded(small, frame.stamp_ns, self._preview.quality), record=False)

    def _record_encoded(self, frame: Frame, jpeg: Future[bytes]) -> None:
        """Record what the camera's encoder made of a frame, in its thread; where it failed, encode it here."""
        error = jpeg.exception()
        if error is None:
            self._outlet.send(self._message(jpeg.result(), frame.stamp_ns), publish=False)
            return
        self.failed += 1
        if self.failed.bit_count() == 1:
            log.warning("the camera's JPEG encoder: %s (%d pictures so far)", error, self.failed)
        self._record_image(frame)

    def _record_image(self, frame: Frame) -> None:
        image = self._encoded(frame.image, frame.stamp_ns, self._record.image_quality)
        self._outlet.send(image, publish=False)

    def _encoded(self, image: NDArray[np.uint8], stamp_ns: int, quality: int) -> CompressedImage:
        sound, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if not sound:
            raise RuntimeError("the picture could not be encoded")
        return self._message(data.tobytes(), stamp_ns)

    def _message(self, data: bytes, stamp_ns: int) -> CompressedImage:
        return CompressedImage(
            timestamp=FoxgloveTime(sec=stamp_ns // S_NS, nsec=stamp_ns % S_NS),
            frame_id=self._frame_id,
            data=data,
            format="jpeg",
        )
