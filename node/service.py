"""One running node: camera and sensors in threads of their own, a log that is always written, the bus."""

from __future__ import annotations

import logging
import shutil
import statistics
import threading
import time
import uuid
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

import cv2
import msgspec
from buddyline.node import __version__
from buddyline.node.awaited import AwaitedCamera
from buddyline.node.blinker import Blinker
from buddyline.node.capture.loop import ExposureLoop
from buddyline.node.clock_sync import ClockSync
from buddyline.node.config import NodeConfig
from buddyline.node.detect import make_detector
from buddyline.node.detect.detection import is_likely
from buddyline.node.devices import CameraDevice, Frame, Source, open_camera, open_sensors
from buddyline.node.drivers.samples import AbsentError
from buddyline.node.guide import Guide
from buddyline.node.hub_connection import HubConnection
from buddyline.node.images import Images
from buddyline.node.outlet import Outlet
from buddyline.node.pipeline import Pipeline
from buddyline.node.power.watch import PowerWatch
from buddyline.node.station_tags import StationTags
from buddyline.node.time_base import NodeClock, wait_for_time
from buddyline.node.underwater.panel import Panel
from buddyline.protocol.clock import S_NS, Clock
from buddyline.protocol.config import ConfigError, config_sha256
from buddyline.protocol.health import stale_after_s
from buddyline.protocol.messages import Candidates, NodeInfo, NodeStatus
from buddyline.protocol.pictures import PictureLog
from buddyline.protocol.recorder import Recorder, RecordError
from buddyline.protocol.security import SecurityError
from buddyline.protocol.service import Service
from buddyline.protocol.statusfile import StatusFile
from buddyline.protocol.topics import CANDIDATES, IMU, TOPICS, topic_of
from msgspec import UNSET

if TYPE_CHECKING:
    from buddyline.protocol.signing import Signer

log = logging.getLogger(__name__)

FRAME_QUEUE: Final = 2
# A device that gives nothing for this long without naming a problem hangs. The first sample may take longer.
HANGS_S: Final = 5.0
FIRST_S: Final = 15.0
LOOK_S: Final = 0.2
REPORT_S: Final = 1.0


class NodeService(Service):
    """Captures, detects, publishes and records until it is stopped. camera, sensors: functions that open them."""

    def __init__(
        self,
        config: NodeConfig,
        clock: NodeClock | None = None,
        camera: Callable[[NodeConfig, Clock], CameraDevice] = open_camera,
        sensors: Callable[[NodeConfig, Clock], list[Source]] = open_sensors,
    ) -> None:
        super().__init__(f"node {config.node}", StatusFile.of(f"node-{config.node}", config.status_file))
        self.config = config
        self.clock = clock or NodeClock()
        self._open_camera, self._open_sensors = camera, sensors
        self.boot = uuid.uuid4().hex[:12]
        self.drops: Counter[str] = Counter()
        self._sha256 = config_sha256(config)
        self._signer = _signer(config)
        self._software = f"buddyline {__version__}"
        self._started_s = time.monotonic()
        self._last_s: dict[str, float] = {}
        self._seen_s = self._started_s + FIRST_S
        self._ended: set[str] = set()
        self._awaited: AwaitedCamera | None = None
        self._exposure: ExposureLoop | None = None
        # Stored pictures may be far apart.
        self._watched = config.camera.name != "stored" and config.rate_hz >= 1.0
        self._detect_s: deque[float] = deque(maxlen=100)
        self._lights_seen: deque[int] = deque(maxlen=10)
        self._frames: deque[tuple[Frame, int]] = deque()
        self._frame_ready = threading.Condition()
        self._capturing = True
        self._sent_before: Counter[str] = Counter()
        self._status_s = self._started_s
        self._clock_sync = ClockSync(config.node, self.boot, self.clock)
        self._guide = Guide(config.node) if config.detector.guided else None

    def open(self) -> None:
        """Open devices and log; raise BuddylineError for what waiting cannot mend. An absent camera is awaited."""
        if self.config.camera.name not in ("simulated", "stored"):
            wait_for_time(self.stop)
            self.clock.start()
        self.camera: CameraDevice = self._open_or_await_camera()
        self.sources: list[Source] = self._open_sensors(self.config, self.clock)
        info = self._info()
        self.pipeline = Pipeline(
            self.config.node,
            self.boot,
            info.trigger_period_ns,
            make_detector(
                self.config.detector.method,
                self.config.detector.environment,
                self.config.detector.overrides,
                info.camera.fx_px,
                self.config.detector.masks,
            ),
            self._guide,
        )
        path, metadata = self._log_path(), self._log_metadata()
        min_free_bytes = self.config.record.min_free_mb * 1_000_000
        self.pictures = PictureLog(path, f"{self.config.node}-*", min_free_bytes, metadata=metadata)
        self.recorder = Recorder(path, metadata=metadata, pictures=self.pictures)
        self.outlet = Outlet(self.config.node, self.recorder, self.clock, self.boot, self._signer)
        self._power = PowerWatch(self.config)
        self._panel = panel = Panel(self.config, self.clock, self.outlet.send)
        blink, slot_ns = self.config.blink, self.config.trigger_period_ns
        self._blinker = None if blink is None else Blinker(blink, slot_ns, self.clock, lambda: panel.shines)
        self._images = Images(self.config, self.outlet)
        self._station_tags = StationTags(self.config.node, self.config.station_tags, info.camera.fx_px)
        self._hub = HubConnection(self.config, self.outlet, self.clock, self._clock_sync, self._guide, self._panel.hear)
        self.outlet.send(info)

    def _open_or_await_camera(self) -> CameraDevice:
        try:
            return self._open_camera(self.config, self.clock)
        except AbsentError as error:
            self._awaited = AwaitedCamera(
                lambda: self._open_camera(self.config, self.clock),
                str(error),
                self.clock,
                lambda: self.outlet.send(self._info()),
            )
            return self._awaited

    def _info(self) -> NodeInfo:
        own = self.camera.info()
        if own is None or self.config.calibration is not None:
            row_time_ns = self.camera.row_time_ns
            own = self.config.node_info(self.clock.now_ns(), self._software, self._sha256, row_time_ns)
        if own.node != self.config.node:
            raise ConfigError(f"node {self.config.node}: the camera's pictures are those of node {own.node}")
        certificate = UNSET if self._signer is None else self._signer.certificate
        return msgspec.structs.replace(self.config.in_net(own), certificate=certificate)

    def _log_metadata(self) -> dict[str, str]:
        """Return what is needed to understand a log later, with the whole configuration."""
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
        except (OSError, ValueError) as error:
            why = error.strerror if isinstance(error, OSError) else error
            raise ConfigError(f"record.directory = {str(directory)!r}: cannot be made: {why}; name another") from error
        begun = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime(self.clock.now_ns() / S_NS))
        return directory / f"{self.config.node}-{begun}-{self.boot}.mcap"

    def start(self) -> None:
        """Start all threads."""
        self.spawn("detect", self._detect_frames)
        self.spawn("camera", self._capture)
        for source in self.sources:
            if not source.read_by:
                self.spawn(source.name, lambda source=source: self._read(source))  # type: ignore[misc]
        self.spawn("status", self._report)
        self.spawn("chrony", lambda: self._clock_sync.follow_chrony(self.stop))
        self.spawn("clock", lambda: self._clock_sync.send_beacons(self.outlet, self.stop))
        self.spawn("bus", lambda: self._hub.run(self.stop, lambda error: self.fail("bus", error)))
        self.spawn("power", lambda: self._power.run(self.stop))
        self.spawn("panel", lambda: self._panel.run(self.stop))
        display = self._panel.display
        if display is not None:
            self.spawn("display", lambda: display.run(self.stop))
        if self._blinker is not None:
            blinker = self._blinker
            self.spawn("blink", lambda: blinker.run(self.stop))

    def close(self) -> int:
        """Stop all threads, write the log's end; return the exit status."""
        status = self.join()
        self.outlet.send_digest(last=True)
        # Before the devices, whose end may take its time.
        try:
            self.recorder.close()
        except RecordError as error:
            if self.failure is None or self.failure[1] is not error:
                log.error("%s: %s", self.name, error)
            status = status or 2
        else:
            log.info("%s: log %s", self.name, self.recorder.path)
        self.camera.close()
        self._panel.close()
        if self._blinker is not None:
            self._blinker.close()
        self._power.close()
        for source in self.sources:
            source.close()
        return status

    def progressing(self) -> bool:
        """Return whether frames and sensors go on.

        A sensor that names its problem is tried again by its driver, and so is a camera that was never open: a restart
        of the node would interrupt the rest.
        """
        now_s = time.monotonic()
        if self._awaited is not None and not self._awaited.is_open:
            self._seen_s = now_s + FIRST_S
        if self._watched and self._capturing and now_s - self._seen_s > HANGS_S:
            return False
        return all(
            source.problem
            or source.name in self._ended
            or now_s - self._last_s.get(source.name, self._started_s + FIRST_S) <= HANGS_S
            for source in self.sources
        )

    def _capture(self) -> None:
        try:
            while not self.stop.is_set():
                frame = self.camera.next_frame(self.stop)
                if frame is None:
                    break
                self._last_s["camera"] = time.monotonic()
                if self._watched:
                    self.heartbeat()
                with self._frame_ready:
                    self._frames.append((frame, self.clock.steps))
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
            self.heartbeat()
            with self._frame_ready:
                while not self._frames and self._capturing and not self.stop.is_set():
                    self._frame_ready.wait(0.5)
                    self.heartbeat()
                if not self._frames:
                    return
                frame, steps = self._frames.popleft()
            if steps != self.clock.steps:
                # Its stamp is of the clock before it was set.
                self.drops["clock_set"] += 1
                continue
            if self._power.skips(frame.stamp_ns):
                self._seen_s = time.monotonic()
                continue
            began_s = time.perf_counter()
            candidates = self.pipeline.candidates(frame)
            self._detect_s.append(time.perf_counter() - began_s)
            self._seen_s = time.monotonic()
            if candidates is None:
                continue
            self.outlet.send(candidates)
            self._expose(frame, candidates)
            self._lights_seen.append(sum(map(is_likely, candidates.blobs)))
            if self._panel.takes_pictures and self._power.takes_pictures:
                self._images.send(frame)
                if (mark := self._station_tags.read(frame)) is not None:
                    self.outlet.send(mark)

    def _expose(self, frame: Frame, candidates: Candidates) -> None:
        """Lock the camera's exposure to the other node's lamps, where it can be changed."""
        control = self.camera.exposure_control
        if control is None:
            return
        if self._exposure is None:
            self._exposure = ExposureLoop(self.config.exposure, control.range)
        control.follow(self._exposure.update(frame, candidates, self.pipeline.expected))

    def _read(self, source: Source) -> None:
        beside = [other.name for other in self.sources if other.read_by == source.name]
        while not self.stop.is_set():
            steps = self.clock.steps
            messages = source.next_messages(self.stop)
            if messages is None:
                self._ended.add(source.name)
                return
            heard = {topic_of(message).name for message in messages} if beside else {source.name}
            self._last_s.update(dict.fromkeys(heard.intersection([source.name, *beside]), time.monotonic()))
            if steps != self.clock.steps:
                # Some of their stamps are of the clock before it was set.
                self.drops["clock_set"] += len(messages)
                continue
            for message in messages:
                self.outlet.send(message)

    def _report(self) -> None:
        report_s = time.monotonic() + REPORT_S
        while not self.stop.wait(LOOK_S):
            self.heartbeat()
            if self.recorder.ended and self.recorder.error is not None:
                # systemd starts the node again, with a new log.
                self.fail("recorder", self.recorder.error)
            if time.monotonic() >= report_s:
                report_s += REPORT_S
                self.status_message = status = self.status()
                self.outlet.send(status)
                self.outlet.send_digest()
                self._panel.show(status, self.problems)

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
        free_bytes = self._free_bytes()
        self.problems = self._find_problems(ages_s, free_bytes)
        residual_s = self.pipeline.residual_s
        retries = [source.retries for source in self.sources]
        leak = self._panel.leak
        return NodeStatus(
            node=self.config.node,
            stamp_ns=self.clock.now_ns(),
            boot=self.boot,
            software=self._software,
            uptime_s=now_s - self._started_s,
            rates_hz=rates_hz,
            drops=self._all_drops(),
            ages_s=ages_s,
            trigger_residual_s=UNSET if residual_s is None else residual_s,
            detect_s=statistics.median(list(self._detect_s)) if self._detect_s else UNSET,
            disk_free_bytes=UNSET if free_bytes is None else free_bytes,
            bus_retries=max(retries) if retries else UNSET,
            lights_seen=statistics.median_low(list(self._lights_seen)) if self._lights_seen else UNSET,
            leak=UNSET if leak is None else leak,
            **self._power.status_fields(),
            **self._clock_sync.status_fields(),
            log=self.recorder.path.name,
            problem="; ".join(self.problems),
        )

    def _all_drops(self) -> dict[str, int]:
        # Frames between two instants were never due.
        skipped = {f"camera_{why}": count for why, count in self.camera.skipped.items() if why != "not_nearest"}
        return {
            **self.drops,
            **skipped,
            "log": self.recorder.dropped,
            "picture": self.pictures.dropped,
            "picture_file": self.pictures.deleted,
            "repeated_trigger": self.pipeline.repeated,
            **{f"link_{topic}": count for topic, count in self._hub.shed.items()},
        }

    def _free_bytes(self) -> int | None:
        try:
            return shutil.disk_usage(self.recorder.path.parent).free
        except OSError:
            return None

    def _stale_after_s(self, device: str) -> float:
        """Return how long a device may give nothing: as long as what it sends may stay away."""
        if device == "camera":
            return stale_after_s(CANDIDATES, self.config.trigger_period_ns / S_NS)
        # A chip with several readings goes by its inertial unit's.
        return stale_after_s(next((topic for topic in TOPICS if topic.name == device), IMU))

    def _find_problems(self, ages_s: dict[str, float], free_bytes: int | None) -> list[str]:
        problems = [
            f"{name}: nothing for {age_s:.1f} s" for name, age_s in ages_s.items() if age_s > self._stale_after_s(name)
        ]
        if self._hub.problem:
            problems.append(f"bus: {self._hub.problem}")
        devices = [("camera", self.camera.problem), *((source.name, source.problem) for source in self.sources)]
        problems += [f"{name}: {text}" for name, text in devices if text]
        if self._exposure is not None and self._exposure.problem:
            problems.append(f"exposure: {self._exposure.problem}")
        # A simulated world is on this machine's own clock, whoever keeps that.
        if self._clock_sync.problem and self.config.camera.name != "simulated":
            problems.append(f"clock: {self._clock_sync.problem}")
        problems += self._panel.problems + self._power.problems
        if self._blinker is not None and self._blinker.problem:
            problems.append(f"blink: {self._blinker.problem}")
        if self.clock.problem:
            problems.append(self.clock.problem)
        if self.recorder.error is not None:
            problems.append(f"log: {self.recorder.error}; kept in memory, tried again")
        if self.recorder.dropped:
            problems.append(f"log: {self.recorder.dropped} messages dropped, the disk is too slow")
        if self.pictures.problem:
            problems.append(f"disk: {self.pictures.problem}")
        if free_bytes is None:
            problems.append(f"disk: {self.recorder.path.parent} cannot be reached")
        elif free_bytes < self.config.record.min_free_mb * 1e6:
            problems.append(f"disk: {free_bytes / 1e6:.0f} MB free")
        return problems


def _signer(config: NodeConfig) -> Signer | None:
    """Return what signs with the key of the node's certificate; None, with a warning, where that cannot be."""
    if config.tls is None:
        return None
    try:
        from buddyline.protocol.signing import Signer

        return Signer.of(config.tls)
    except ImportError:
        why = "the package cryptography is missing (`make install EXTRAS=keys`)"
    except SecurityError as error:
        why = str(error)
    log.warning("node %s: what it records is not signed: %s", config.node, why)
    return None
