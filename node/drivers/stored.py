"""Stored pictures as a camera: a folder of pictures, or a dive log with its sensors' samples.

A dive log keeps its own times, and is played at the pace of its recording. Pictures of a folder come one
a trigger.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from buddyline.node.config import NodeConfig
from buddyline.node.devices import Frame
from buddyline.node.drivers.picture_header import stated_size
from buddyline.protocol.clock import Clock
from buddyline.protocol.config import ConfigError
from buddyline.protocol.divelog import DiveLogReader, read_logs
from buddyline.protocol.envelope import Refusals
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Attitude, CompressedImage, Depth, Imu, Message, NodeInfo
from buddyline.protocol.pictures import with_pictures
from buddyline.protocol.topics import ATTITUDE, DEPTH, IMAGE, IMU, INFO
from numpy.typing import NDArray

log = logging.getLogger(__name__)

PICTURE_SUFFIXES: Final = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})

MOST_PIXELS: Final = 100_000_000
"""A picture of more pixels is refused by its header: decoded, it would take more than 300 MB of memory."""


class PictureError(BuddylineError):
    """A picture that cannot be used."""


def decode_picture(data: bytes, name: str) -> NDArray[np.uint8]:
    """Return a stored picture, BGR (H, W, 3) or grey (H, W); name: what an error calls it."""
    size = stated_size(data)
    if size is not None and size[0] * size[1] > MOST_PIXELS:
        raise PictureError(
            f"{name}: its header says {size[0]}x{size[1]} px; at most {MOST_PIXELS // 10**6} megapixels are read"
        )
    raw = np.frombuffer(data, np.uint8)
    try:
        picture = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED) if raw.size else None
    except cv2.error as error:
        raise PictureError(f"{name}: cannot be decoded: {error.err or error}") from error
    if picture is None:
        raise PictureError(f"{name}: is not a picture, or is cut off")
    if data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[-64:]:
        raise PictureError(f"{name}: is cut off (a JPEG without its end)")
    if picture.dtype == np.uint16:
        raise PictureError(f"{name}: has 16 bits a channel; convert it to 8 first")
    if picture.dtype != np.uint8:
        raise PictureError(f"{name}: has values of type {picture.dtype}, not 8 bits")
    if picture.ndim == 3 and picture.shape[2] == 4:
        picture = picture[:, :, :3]
    if picture.ndim == 3 and picture.shape[2] == 1:
        picture = picture[:, :, 0]
    return np.ascontiguousarray(picture, np.uint8)


def read_picture(path: Path) -> NDArray[np.uint8]:
    """Return the picture of a file, as decode_picture does; raise PictureError naming the file."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise PictureError(f"{path}: cannot be read: {error.strerror}") from error
    return decode_picture(data, str(path))


def picture_files(path: Path) -> list[Path]:
    """Return the pictures of a folder, or a single one, by name; raise PictureError where there is neither."""
    try:
        if path.is_dir():
            return sorted(p for p in path.iterdir() if p.suffix.lower() in PICTURE_SUFFIXES)
        if path.exists():
            return [path]
    except OSError as error:
        raise PictureError(f"{path}: cannot be read: {error.strerror}") from error
    raise PictureError(f"{path}: no such picture, folder or dive log")


class FolderCamera:
    """Gives one picture of a folder at each trigger; damaged ones are counted and skipped."""

    row_time_ns = 0
    problem = ""
    exposure_control = None

    def __init__(self, files: list[Path], trigger_period_ns: int, clock: Clock) -> None:
        self.skipped: Counter[str] = Counter()
        self._files = iter(files)
        self._period_ns = trigger_period_ns
        self._clock = clock
        self._next_ns = 0

    def info(self) -> NodeInfo | None:
        """Return None: a folder of pictures has no calibration."""
        return None

    def next_frame(self, stop: threading.Event) -> Frame | None:
        """Wait for the next trigger instant and return the next undamaged picture."""
        for file in self._files:
            try:
                picture = read_picture(file)
            except PictureError as error:
                self.skipped["unreadable"] += 1
                log.warning("skipped: %s", error)
                continue
            due_ns = (self._clock.now_ns() // self._period_ns + 1) * self._period_ns
            self._next_ns = max(due_ns, self._next_ns + self._period_ns)
            if self._clock.wait_until_ns(self._next_ns, stop):
                return None
            return Frame(picture, self._next_ns)
        return None

    def close(self) -> None:
        """Nothing to free."""


class _Paced:
    """Gives some messages of a log, each at its time."""

    def __init__(self, path: Path, kinds: frozenset[str], clock: Clock) -> None:
        self._logs = ExitStack()
        self._readers = [self._logs.enter_context(DiveLogReader(file)) for file in with_pictures([path])]
        self._refusals = Refusals(str(path))
        self._messages = self._decoded(kinds)
        self._clock = clock
        self._began_ns: int | None = None

    def _decoded(self, kinds: frozenset[str]) -> Iterator[Message]:
        for record in read_logs(self._readers, lambda key: key in kinds):
            envelope = self._refusals.open(record)
            if envelope is not None:
                yield envelope.message

    def next_message(self, stop: threading.Event) -> Message | None:
        message = next(self._messages, None)
        if message is None:
            return None
        if self._began_ns is None:
            self._began_ns = self._clock.now_ns()
        stamp_ns: int = message.stamp_ns  # type: ignore[attr-defined]
        due_ns = self._began_ns + stamp_ns - (self._readers[0].start_ns or stamp_ns)
        return None if self._clock.wait_until_ns(due_ns, stop) else message

    def close(self) -> None:
        self._logs.close()


class DiveCamera:
    """The pictures of one node in a dive log, with the log's own calibration and times."""

    row_time_ns = 0  # the log's NodeInfo has it
    exposure_control = None
    problem = ""

    def __init__(self, path: Path, node: str, clock: Clock) -> None:
        with ExitStack() as stack:
            readers = [stack.enter_context(DiveLogReader(file)) for file in with_pictures([path])]
            key = INFO.key(node)
            found = next(iter(readers[0].records(lambda topic: topic == key)), None)
            message = found.open().message if found else None
            if not any(IMAGE.key(node) in reader.keys for reader in readers):
                raise ConfigError(f"{path}: holds no pictures of node {node}; topics: {', '.join(readers[0].keys)}")
        self._info = message if isinstance(message, NodeInfo) else None
        self._paced = _Paced(path, frozenset({IMAGE.key(node)}), clock)
        self.skipped: Counter[str] = Counter()

    def info(self) -> NodeInfo | None:
        """Return the log's calibration of this node."""
        return self._info

    def next_frame(self, stop: threading.Event) -> Frame | None:
        """Wait for the next picture's time and return it."""
        while (message := self._paced.next_message(stop)) is not None:
            if not isinstance(message, CompressedImage):
                continue
            try:
                picture = decode_picture(message.data, f"picture at {message.stamp_ns}")
            except PictureError as error:
                self.skipped["unreadable"] += 1
                log.warning("skipped: %s", error)
                continue
            return Frame(picture, message.stamp_ns, self._info.row_time_ns if self._info else 0)
        return None

    def close(self) -> None:
        """Close the log."""
        self._paced.close()


class DiveSensors:
    """Attitude, depth and inertial samples of one node in a dive log."""

    name = "stored sensors"
    read_by = ""
    problem = ""
    retries = 0

    def __init__(self, path: Path, node: str, clock: Clock) -> None:
        kinds = frozenset({ATTITUDE.key(node), DEPTH.key(node), IMU.key(node)})
        self._paced = _Paced(path, kinds, clock)

    def next_messages(self, stop: threading.Event) -> list[Message] | None:
        """Wait for the next sample's time and return it."""
        message = self._paced.next_message(stop)
        return [message] if isinstance(message, Attitude | Depth | Imu) else None

    def close(self) -> None:
        """Close the log."""
        self._paced.close()


def open_camera(config: NodeConfig, clock: Clock) -> FolderCamera | DiveCamera:
    """Open `camera.path`: a folder, a picture, or a dive log."""
    path = Path(config.camera.path)
    if not config.camera.path or not path.exists():
        raise ConfigError(f"camera.path = {config.camera.path!r}: no such folder, picture or dive log")
    if path.suffix == ".mcap":
        return DiveCamera(path, config.node, clock)
    files = picture_files(path)
    if not files:
        raise ConfigError(f"camera.path = {config.camera.path!r}: holds no pictures")
    return FolderCamera(files, config.trigger_period_ns, clock)


def open_sensors(config: NodeConfig, clock: Clock) -> list[DiveSensors]:
    """Open the sensors of the dive log in `camera.path`."""
    path = Path(config.camera.path)
    if path.suffix != ".mcap" or not path.exists():
        raise ConfigError(f"sensors.name = 'stored' needs a dive log in camera.path, not {config.camera.path!r}")
    return [DiveSensors(path, config.node, clock)]
