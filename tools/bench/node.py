"""The cost of a whole node: time from a picture in memory to its candidates on the bus, processor, memory, log.

The node runs in this process as on a Pi: a picture at each trigger, the drivers of a MinIMU-9 v6 at 100 Hz with its
attitude filter and of a Bar30 at 20 Hz over an I2C bus in memory, detector, log, recorded pictures and previews, and a
real hub on loopback. Another process has rendered the pictures before; each is copied from memory, as the camera's
driver does. The measured time begins with that copy, and ends when the Zenoh bus has taken the candidates. Exposure,
readout and the camera's own pipeline are not in it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import tempfile
import threading
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, Final

import numpy as np
from buddyline.node.attitude import VqfAttitude
from buddyline.node.config import (
    CalibrationConfig,
    CameraConfig,
    NodeConfig,
    RecordConfig,
    SensorsConfig,
    SimulationConfig,
)
from buddyline.node.devices import Frame, Source
from buddyline.node.drivers.devices import DepthSource, ImuSource
from buddyline.node.drivers.registry import open_depth, open_imu
from buddyline.node.geomagnetism import MagnetometerCalibration
from buddyline.node.service import NodeService
from buddyline.protocol.clock import S_NS, Clock
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Candidates, Message, NodeInfo
from buddyline.protocol.options import finite
from buddyline.tools.bench.prepared_bus import PreparedBus
from buddyline.tools.measure.children import Child, free_endpoint
from buddyline.tools.measure.load import load_of, thread_times_s
from numpy.typing import NDArray

PICTURES: Final = 24
WARM_UP_S: Final = 5.0
# A thread with less of a core is not named.
SHOWN: Final = 2e-4
CONNECT_S: Final = 20.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument("--environment", default="cavern")
    parser.add_argument("--seconds", type=finite, default=60.0, metavar="S", help="default: 60, after 5 to warm up")
    parser.add_argument("--rate", type=finite, default=10.0, metavar="HZ", help="default: 10")
    parser.add_argument("--width", type=int, default=1640, metavar="PX", help="default: 1640, by 1232")
    parser.add_argument("--images", type=finite, default=2.0, metavar="HZ", help="recorded pictures; default: 2")


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Run one node for --seconds; return its figures."""
    if args.seconds < 2 or args.rate <= 0 or args.width < 64:
        raise BuddylineError("--seconds: at least 2; --rate: above 0; --width: at least 64")
    config = NodeConfig(
        node="a",
        connect=free_endpoint(),
        rate_hz=args.rate,
        camera=CameraConfig(name="bench", width_px=args.width, height_px=round(args.width * 1232 / 1640)),
        sensors=SensorsConfig(name="bench"),
        simulation=SimulationConfig(environment=args.environment),
    )
    with tempfile.TemporaryDirectory() as folder, Child("hub", "--listen", config.connect):
        pictures, info = _prepared(config, Path(folder) / "pictures.npy")
        config = _on_this_disk(config, info, Path(folder) / "dives", args.images)
        service = MeasuredNode(config, PreparedCamera(pictures, config.trigger_period_ns))
        try:
            service.open()
            service.start()
            figures = _watch(service, args.seconds)
        finally:
            status = service.close()
        if status:
            raise BuddylineError(f"the node ended with status {status}")
        figures["log_kb_per_s"] = service.recorder.path.stat().st_size / 1e3 / (args.seconds + WARM_UP_S)
    asked = {"width_px": args.width, "rate_hz": args.rate, "images_hz": args.images}
    return figures | {"environment": args.environment, **asked}


def table(figures: dict[str, Any]) -> str:
    """Return the figures for a person."""
    rss = ", ".join(f"{mib:.1f} MiB after {minutes:g} min" for minutes, mib in figures["rss_mib"])
    rates = ", ".join(f"{name} {rate:.1f}" for name, rate in sorted(figures["rates_hz"].items()))
    threads = sorted(figures["cpu_by_thread"].items(), key=lambda one: -one[1])
    shares = ", ".join(f"{name} {share:.2%}" for name, share in threads if share >= SHOWN)
    return (
        "{environment}, {width_px} px wide, {rate_hz:g} Hz, {images_hz:g} pictures a second recorded; {frames} frames\n"
        "capture to candidates published   median {median_ms:.1f} ms, p99 {p99_ms:.1f} ms, most {most_ms:.1f} ms\n"
        "processor, of one core            {cpu:.1%}\n"
        f"of it by thread                   {shares}\n"
        f"memory (RSS)                      {rss}\n"
        "log without pictures              {log_kb_per_s:.1f} kB/s\n"
        f"rates, Hz                         {rates}\n"
        "dropped                           {dropped}"
    ).format(**figures)


class PreparedCamera:
    """Returns prepared pictures at the trigger instants, each a copy. taken_s: start time of each copy, by stamp."""

    row_time_ns = 0
    exposure_control = None
    problem = ""

    def __init__(self, pictures: NDArray[np.uint8], period_ns: int) -> None:
        self.skipped: Counter[str] = Counter()
        self.taken_s: dict[int, float] = {}
        self._pictures = pictures
        self._period_ns = period_ns
        self._number = 0

    def info(self) -> None:
        """Return nothing: the calibration is in the configuration."""

    def next_frame(self, stop: threading.Event) -> Frame | None:
        """Wait for the next instant."""
        now_ns = time.time_ns()
        instant_ns = (now_ns // self._period_ns + 1) * self._period_ns
        if stop.wait((instant_ns - now_ns) / S_NS):
            return None
        self.taken_s[instant_ns] = time.perf_counter()
        self._number += 1
        return Frame(np.array(self._pictures[self._number % len(self._pictures)]), instant_ns)

    def close(self) -> None:
        """Nothing to free."""


class MeasuredNode(NodeService):
    """A node that measures each frame. times_s: from the start of the copy until the bus has taken the candidates."""

    def __init__(self, config: NodeConfig, camera: PreparedCamera) -> None:
        super().__init__(config, camera=lambda _config, _clock: camera, sensors=_sensors)
        self.times_s: list[float] = []
        self._prepared = camera

    def open(self) -> None:
        """Open as a node does, and measure when candidates are sent."""
        super().open()
        plain = self.outlet.send

        def send(message: Message, *, record: bool = True, publish: bool = True) -> None:
            plain(message, record=record, publish=publish)
            if isinstance(message, Candidates):
                self.times_s.append(time.perf_counter() - self._prepared.taken_s.pop(message.stamp_ns))

        self.outlet.send = send  # type: ignore[method-assign]


def _sensors(config: NodeConfig, clock: Clock) -> list[Source]:
    bus = PreparedBus()
    zero_path = Path(config.record.directory) / "surface.json"
    attitude = VqfAttitude(MagnetometerCalibration(np.full(3, 1e-12), np.eye(3)))
    density_kgpm3 = config.sensors.water_density_kgpm3
    depth = DepthSource(config.node, bus, lambda: open_depth(bus, clock=clock), density_kgpm3, zero_path, clock)
    return [ImuSource(config.node, bus, lambda: open_imu(bus, clock=clock), attitude, clock, depth), depth]


def _watch(service: MeasuredNode, seconds: float) -> dict[str, Any]:
    """Wait for the hub, warm up, and measure."""
    ends_s = time.monotonic() + CONNECT_S
    while not service.outlet.connected:
        if service.stop.wait(0.05) or time.monotonic() > ends_s:
            raise BuddylineError("the node did not connect to its hub")
    service.stop.wait(WARM_UP_S)
    first, sent = len(service.times_s), service.outlet.sent.copy()
    began_s, began, threads = time.monotonic(), load_of(), thread_times_s()
    rss_mib: list[tuple[float, float]] = []
    while (passed_s := time.monotonic() - began_s) < seconds:
        if passed_s >= 60.0 and not rss_mib:
            rss_mib.append((1.0, load_of().rss_mib))
        if service.stop.wait(min(1.0, seconds - passed_s)):
            raise BuddylineError("the node ended")
    ended, spent = load_of(), thread_times_s()
    cpu = (ended.cpu_s - began.cpu_s) / passed_s
    rss_mib.append((round(passed_s / 60.0, 1), ended.rss_mib))
    times_ms = 1e3 * np.array(service.times_s[first:])
    if not len(times_ms):
        raise BuddylineError("no frame was published")
    return {
        "frames": len(times_ms),
        "median_ms": float(np.median(times_ms)),
        "p99_ms": float(np.percentile(times_ms, 99)),
        "most_ms": float(times_ms.max()),
        "cpu": cpu,
        "cpu_by_thread": {name: (spent_s - threads.get(name, 0.0)) / passed_s for name, spent_s in spent.items()},
        "rss_mib": rss_mib,
        "rates_hz": {name: (count - sent[name]) / passed_s for name, count in service.outlet.sent.copy().items()},
        "dropped": service.drops["frame"] + service.recorder.dropped,
    }


def _prepared(config: NodeConfig, path: Path) -> tuple[NDArray[np.uint8], NodeInfo]:
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as other:
        info = other.submit(_render, config, str(path)).result()
    return np.load(path), info


def _render(config: NodeConfig, path: str) -> NodeInfo:
    """Render the pictures as the camera's driver returns them, in luminance, and save them; return the NodeInfo."""
    import cv2
    from buddyline.node.sim.devices import scenario_of
    from buddyline.node.sim.world import World

    cv2.setNumThreads(1)
    world = World(scenario_of(config))
    start_ns = config.simulation.start_ns
    stamps_ns = [start_ns + round((1.0 + 1.7 * i) * S_NS) for i in range(PICTURES)]
    pictures = [cv2.cvtColor(world.render(config.node, stamp_ns), cv2.COLOR_BGR2GRAY) for stamp_ns in stamps_ns]
    np.save(path, np.stack(pictures))
    return world.info(config.node, start_ns, config.trigger_period_ns)


def _on_this_disk(config: NodeConfig, info: NodeInfo, directory: Path, images_hz: float) -> NodeConfig:
    from msgspec.structs import replace

    calibration = CalibrationConfig(
        camera=info.camera, light_left_m=info.light_left_m, light_right_m=info.light_right_m, sigma_px=info.sigma_px
    )
    record = RecordConfig(directory=str(directory), images_hz=images_hz)
    return replace(config, calibration=calibration, record=record)
