"""One node, running: camera and sensors in threads of their own, a log that is always written, the bus."""

from __future__ import annotations

import logging
import shutil
import threading
import time
import uuid
from collections import Counter, deque
from pathlib import Path
from typing import TYPE_CHECKING, Final

import cv2
import msgspec
import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from node import __version__
from node.config import NodeConfig
from node.detect import make_detector
from node.devices import Camera, Frame, Source, open_camera, open_sensors
from node.outlet import Outlet
from node.pipeline import Pipeline
from protocol.clock import S_NS, Clock, SystemClock
from protocol.config import ConfigError, config_sha256
from protocol.messages import CompressedImage, FoxgloveTime, NodeInfo, NodeStatus
from protocol.recorder import Recorder
from protocol.security import RefusedError, SecurityError, check_identity, node_name
from protocol.service import Service
from protocol.topics import TOPICS

if TYPE_CHECKING:
    from protocol.bus import Bus

log = logging.getLogger(__name__)

FRAME_QUEUE: Final = 2
STALE_S: Final = 2.0
REFUSED_RETRY_S: Final = 5.0


class NodeService(Service):
    """Captures, detects, publishes and records until it is stopped."""

    def __init__(self, config: NodeConfig, clock: Clock | None = None) -> None:
        super().__init__(f"node {config.node}")
        self.config = config
        self.clock = clock or SystemClock()
        self.boot = uuid.uuid4().hex[:12]
        self.drops: Counter[str] = Counter()
        self._sha256 = config_sha256(config)
        self._software = f"buddyline {__version__}"
        self._started_s = time.monotonic()
        self._last_s: dict[str, float] = {}
        self._detect_s: deque[float] = deque(maxlen=100)
        self._frames: deque[Frame] = deque()
        self._frame_ready = threading.Condition()
        self._capturing = True
        self._problems: dict[str, str] = {}
        self._sent_before: Counter[str] = Counter()
        self._status_s = self._started_s
        self._next_image_ns = 0
        self._next_preview_ns = 0

    def open(self) -> None:
        """Open devices and log; raise BuddylineError where one cannot be had."""
        self.camera: Camera = open_camera(self.config, self.clock)
        self.sources: list[Source] = open_sensors(self.config, self.clock)
        info = self._info()
        self.pipeline = Pipeline(
            self.config.node,
            self.boot,
            info.trigger_period_ns,
            make_detector(
                self.config.detector.method, self.config.detector.environment, self.config.detector.overrides
            ),
        )
        self.recorder = Recorder(self._log_path(), metadata=self._log_metadata())
        self.outlet = Outlet(self.config.node, self.recorder, self.clock)
        self.outlet.send(info)

    def _info(self) -> NodeInfo:
        own = self.camera.info()
        if own is None or self.config.calibration is not None:
            return self.config.node_info(self.clock.now_ns(), self._software, self._sha256, self.camera.row_time_ns)
        if own.node != self.config.node:
            raise ConfigError(f"node {self.config.node}: the camera's pictures are those of node {own.node}")
        return own

    def _log_metadata(self) -> dict[str, str]:
        """Return what a log is to be understood by later: the configuration in force goes with it, in full."""
        return {
            "node": self.config.node,
            "software": self._software,
            "boot": self.boot,
            "config": msgspec.json.encode(self.config, order="sorted").decode(),
            "config_sha256": self._sha256,
        }

    def _log_path(self) -> Path:
        directory = Path(self.config.record.directory)
        try:
            directory.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"record.directory = {directory}: cannot be made: {error.strerror}") from error
        begun = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(self.clock.now_ns() / S_NS))
        return directory / f"{self.config.node}-{begun}-{self.boot}.mcap"

    def start(self) -> None:
        """Start all threads."""
        self.spawn("detect", self._detect_frames)
        self.spawn("camera", self._capture)
        for source in self.sources:
            self.spawn(source.name, lambda source=source: self._read(source))  # type: ignore[misc]
        self.spawn("status", self._report)
        self.spawn("bus", self._connect)

    def close(self) -> int:
        """Stop all threads, write the log's end; return the exit status."""
        status = self.join()
        self.camera.close()
        for source in self.sources:
            source.close()
        self.recorder.close()
        log.info("%s: log %s", self.name, self.recorder.path)
        return status

    def _capture(self) -> None:
        # Stored pictures may be far apart.
        watched = self.config.camera.name != "stored" and self.config.rate_hz >= 1.0
        try:
            while not self.stop.is_set():
                frame = self.camera.next_frame(self.stop)
                if frame is None:
                    break
                self._last_s["camera"] = time.monotonic()
                if watched:
                    self.going_on()
                with self._frame_ready:
                    self._frames.append(frame)
                    while len(self._frames) > FRAME_QUEUE:
                        self._frames.popleft()
                        self.drops["frame"] += 1
                    self._frame_ready.notify()
        finally:
            with self._frame_ready:
                self._capturing = False
                self._frame_ready.notify()
        if not self.stop.is_set():
            log.info("%s: the camera has no more pictures", self.name)

    def _detect_frames(self) -> None:
        cv2.setNumThreads(1)
        while True:
            self.going_on()
            with self._frame_ready:
                while not self._frames and self._capturing and not self.stop.is_set():
                    self._frame_ready.wait(0.5)
                    self.going_on()
                if not self._frames:
                    return
                frame = self._frames.popleft()
            began_s = time.perf_counter()
            candidates = self.pipeline.candidates(frame)
            self._detect_s.append(time.perf_counter() - began_s)
            if candidates is None:
                continue
            self.outlet.send(candidates)
            self._send_images(frame)

    def _send_images(self, frame: Frame) -> None:
        record, preview = self.config.record, self.config.preview
        if record.images_hz > 0 and frame.stamp_ns >= self._next_image_ns:
            self._next_image_ns = frame.stamp_ns + round(0.99e9 / record.images_hz)
            self.outlet.send(self._image(frame.image, frame.stamp_ns, record.image_quality), publish=False)
        if preview.rate_hz > 0 and frame.stamp_ns >= self._next_preview_ns:
            self._next_preview_ns = frame.stamp_ns + round(0.99e9 / preview.rate_hz)
            height, width = frame.image.shape[:2]
            scale = min(preview.width_px / width, 1.0)
            small = cv2.resize(
                frame.image, (round(width * scale), max(round(height * scale), 1)), interpolation=cv2.INTER_AREA
            )
            self.outlet.send(self._image(np.asarray(small, np.uint8), frame.stamp_ns, preview.quality), record=False)

    def _image(self, image: NDArray[np.uint8], stamp_ns: int, quality: int) -> CompressedImage:
        sound, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
        if not sound:
            raise RuntimeError("the picture could not be encoded")
        return CompressedImage(
            timestamp=FoxgloveTime(sec=stamp_ns // S_NS, nsec=stamp_ns % S_NS),
            frame_id=f"{self.config.node}_camera",
            data=data.tobytes(),
            format="jpeg",
        )

    def _read(self, source: Source) -> None:
        while not self.stop.is_set():
            messages = source.next_messages(self.stop)
            if messages is None:
                return
            self._last_s[source.name] = time.monotonic()
            for message in messages:
                self.outlet.send(message)

    def _connect(self) -> None:
        bus = self._open_bus()
        if bus is None:
            return
        with bus:
            bus.on_failure(lambda error: self.fail("bus", error))
            if bus.is_alive(f"node/{self.config.node}"):
                raise ConfigError(
                    f"another node with the id {self.config.node!r} is on the bus at {self.config.connect}; "
                    "give each its own `node`"
                )
            bus.declare_alive(f"node/{self.config.node}")
            self.outlet.connect(bus)
            log.info("%s: connected to %s", self.name, self.config.connect)
            self.stop.wait()
            self.outlet.disconnect()

    def _open_bus(self) -> Bus | None:
        """Connect, again and again where the hub and this node do not accept each other: the log goes on anyway."""
        from protocol.zenoh_bus import connect

        while not self.stop.is_set():
            try:
                if self.config.tls is not None:
                    check_identity(self.config.tls, node_name(self.config.node))
                bus = connect(
                    self.config.connect,
                    namespace=self.config.namespace or None,
                    stop=self.stop,
                    on_wait=lambda text: log.info("%s: %s; recording meanwhile", self.name, text),
                    tls=self.config.tls,
                )
            except (SecurityError, RefusedError) as error:
                if self._problems.get("bus") != str(error):
                    log.error("%s: not on the bus: %s; recording meanwhile", self.name, error)
                self._problems["bus"] = str(error)
                self.stop.wait(REFUSED_RETRY_S)
            else:
                self._problems.pop("bus", None)
                return bus
        return None

    def _report(self) -> None:
        while not self.stop.wait(1.0):
            self.outlet.send(self.status())
            self.going_on()

    def status(self) -> NodeStatus:
        """Return the node's health; rates are over the time since the last call."""
        now_s = time.monotonic()
        passed_s = max(now_s - self._status_s, 1e-3)
        sent = self.outlet.sent.copy()
        rates_hz = {
            topic.name: (sent[topic.name] - self._sent_before[topic.name]) / passed_s
            for topic in TOPICS
            if sent[topic.name]
        }
        self._sent_before, self._status_s = sent, now_s
        ages_s = {name: now_s - last_s for name, last_s in self._last_s.items()}
        problems = [f"{name}: nothing for {age_s:.1f} s" for name, age_s in ages_s.items() if age_s > STALE_S]
        problems += [f"{name}: {text}" for name, text in list(self._problems.items())]
        devices = [("camera", self.camera.problem), *((source.name, source.problem) for source in self.sources)]
        problems += [f"{name}: {text}" for name, text in devices if text]
        if self.recorder.error is not None:
            problems.append(f"log: {self.recorder.error}; not recording")
        if self.recorder.dropped:
            problems.append(f"log: {self.recorder.dropped} messages dropped, the disk is too slow")
        free_bytes = shutil.disk_usage(self.recorder.path.parent).free
        if free_bytes < self.config.record.min_free_mb * 1e6:
            problems.append(f"disk: {free_bytes / 1e6:.0f} MB free")
        residual_s = self.pipeline.residual_s
        return NodeStatus(
            node=self.config.node,
            stamp_ns=self.clock.now_ns(),
            boot=self.boot,
            software=self._software,
            uptime_s=now_s - self._started_s,
            rates_hz=rates_hz,
            drops={**self.drops, "log": self.recorder.dropped, "repeated_trigger": self.pipeline.repeated},
            ages_s=ages_s,
            trigger_residual_s=UNSET if residual_s is None else residual_s,
            detect_s=float(np.median(self._detect_s)) if self._detect_s else UNSET,
            disk_free_bytes=free_bytes,
            log=self.recorder.path.name,
            problem="; ".join(problems),
        )
