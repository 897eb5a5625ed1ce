"""The JPEG encoder beside a Pi's camera, through picamera2: pictures go into it from the camera's own buffers.

Pis up to 4 and Zero 2 W have one, for pictures of up to 1920 x 1920; a Pi 5 has none. It is a video encoder: its
quality is a number of bits, and it answers some milliseconds later, in a thread of its own, with the time that it got.
"""

from __future__ import annotations

import logging
import threading
from concurrent.futures import Future
from typing import Any, Final

from buddyline.node.drivers.samples import DeviceError

log = logging.getLogger(__name__)

LARGEST_PX: Final = 1920
# Each holds one of the camera's buffers.
MOST_WAITING: Final = 2
# picamera2's names, by the least JPEG quality that each stands for.
QUALITIES: Final = ((90, "VERY_HIGH"), (75, "HIGH"), (60, "MEDIUM"), (40, "LOW"), (0, "VERY_LOW"))
# What picamera2 and the kernel's driver raise.
ENCODER_ERRORS: Final = (RuntimeError, OSError, ValueError, TypeError, LookupError, AssertionError)
# With this picamera2 makes the bits of a second from those of a picture.
NOMINAL_HZ: Final = 30


class EncoderError(Exception):
    """A picture that the encoder did not give back."""


class CameraJpegs:
    """Encodes pictures of one camera, which is configured and not yet started."""

    def __init__(self, camera: Any, quality: int) -> None:
        """Start the encoder; raise DeviceError if there is none, or the pictures are too large for it."""
        main = camera.camera_configuration()["main"]
        width, height = main["size"]
        if max(width, height) > LARGEST_PX:
            raise DeviceError(
                f"record.encoder = 'camera': {width}x{height}, it takes {LARGEST_PX} pixels at most: use 'software'"
            )
        self._waiting: dict[int, Future[bytes]] = {}
        self._first_us: int | None = None
        self._lock = threading.Lock()
        try:
            from picamera2.encoders import Quality
            from picamera2.encoders.mjpeg_encoder import MJPEGEncoder
            from picamera2.outputs import Output

            encoder = MJPEGEncoder()
            encoder.width, encoder.height = width, height
            encoder.framerate = NOMINAL_HZ
            encoder.format, encoder.stride, encoder.name = main["format"], main["stride"], "main"
            encoder.output = _output(Output, self._take)
            encoder.start(quality=getattr(Quality, next(name for least, name in QUALITIES if quality >= least)))
        except (ImportError, *ENCODER_ERRORS) as error:
            raise DeviceError(
                f"record.encoder = 'camera': {error}: a Pi 5 has no such encoder: use 'software'"
            ) from error
        self._encoder = encoder

    def encode(self, request: Any, sensor_ns: int) -> Future[bytes]:
        """Begin to encode a request's picture; the future fails where the encoder does. sensor_ns: SensorTimestamp."""
        future: Future[bytes] = Future()
        time_us = sensor_ns // 1000
        with self._lock:
            if len(self._waiting) >= MOST_WAITING:
                future.set_exception(EncoderError(f"{MOST_WAITING} pictures wait already"))
                return future
            if self._first_us is None:
                self._first_us = time_us
            number = time_us - self._first_us
            self._waiting[number] = future
        try:
            self._encoder.encode("main", request)
        except ENCODER_ERRORS as error:
            with self._lock:
                self._waiting.pop(number, None)
            future.set_exception(EncoderError(f"{type(error).__name__}: {error}"))
        return future

    def _take(self, data: bytes, timestamp_us: int | None) -> None:
        """Take a picture from the encoder; earlier ones that it has left out fail."""
        # The encoder counts from its first picture's time, and may have rounded it otherwise.
        done = (timestamp_us or 0) + 1
        with self._lock:
            due = sorted(number for number in self._waiting if number <= done)
            futures = [self._waiting.pop(number) for number in due]
        for future in futures[:-1]:
            future.set_exception(EncoderError("left out by the encoder"))
        if futures:
            futures[-1].set_result(data)

    def close(self) -> None:
        """Stop the encoder; what has not been encoded fails."""
        try:
            self._encoder.stop()
        except ENCODER_ERRORS as error:
            log.warning("camera: its JPEG encoder: %s: %s", type(error).__name__, error)
        with self._lock:
            futures, self._waiting = list(self._waiting.values()), {}
        for future in futures:
            future.set_exception(EncoderError("the camera is closed"))


def _output(base: Any, take: Any) -> Any:
    """Return an output of picamera2's that passes each picture on. base: its class Output."""

    class Passed(base):  # type: ignore[misc]
        def outputframe(self, frame: Any, keyframe: bool = True, timestamp: int | None = None, *_: Any) -> None:
            take(bytes(frame), timestamp)

    return Passed()
