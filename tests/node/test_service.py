"""A whole node: ready, watched, stopped, with a disk that fills up, with a clock that is set."""

import contextlib
import json
import logging
import queue
import shutil
import signal
import socket
import subprocess
import threading
import time
from collections import Counter
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from buddyline.node.config import (
    CameraConfig,
    NodeConfig,
    PreviewConfig,
    RecordConfig,
    SensorsConfig,
    load_node_config,
)
from buddyline.node.devices import Frame
from buddyline.node.drivers.samples import AbsentError
from buddyline.node.images import Images
from buddyline.node.picking import RateLimiter
from buddyline.node.service import NodeService
from buddyline.node.time_base import NodeClock
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.codec import decode
from buddyline.protocol.config import ConfigError
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.messages import Depth, Imu, NodeStatus
from buddyline.tools.dives import Dive
from msgspec.structs import replace

from tests.disks import small_disk
from tests.processes import PATIENCE_S, REPOSITORY, Process, free_endpoint, until
from tests.tagged import CAMERA, frame

CONFIG = """
node = "a"
connect = "{endpoint}"
rate_hz = 5.0
status_file = "{status}"
[camera]
name = "stalling"
width_px = 160
height_px = 120
[sensors]
name = "stalling"
[preview]
rate_hz = 0.0
[record]
directory = "{directory}"
images_hz = {images_hz}
min_free_mb = 0
"""


class Manager:
    """The end of the socket at which systemd listens; it listens all the time."""

    def __init__(self, path):
        self.path = path
        self._said = queue.SimpleQueue()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self):
        while said := self._socket.recv(4096):
            self._said.put(said.decode())

    def hear(self):
        return self._said.get(timeout=PATIENCE_S)

    def hear_until(self, wanted):
        """Listen until a datagram is as wanted; return it."""
        ends_s = time.monotonic() + PATIENCE_S
        while not wanted(said := self.hear()):
            assert time.monotonic() < ends_s, said
        return said

    def close(self):
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as last:
            last.sendto(b"", str(self.path))
        self._thread.join(PATIENCE_S)
        self._socket.close()


def fed(said):
    return "WATCHDOG=1" in said.split("\n")


@contextlib.contextmanager
def node(tmp_path, directory, images_hz=0.0):
    """A real node process, its manager, and where its status file is."""
    status = tmp_path / "status.json"
    config = tmp_path / "a.toml"
    config.write_text(CONFIG.format(endpoint=free_endpoint(), status=status, directory=directory, images_hz=images_hz))
    manager = Manager(tmp_path / "notify")
    prefix = ("env", f"NOTIFY_SOCKET={manager.path}", f"STALL_IN={tmp_path}")
    process = Process("node", "--config", config, prefix=prefix, module="tests.node.stalling_node")
    try:
        yield process, manager, status
    finally:
        process.end()
        manager.close()


def problems(status):
    """What the status file says is wrong; None before there is a status."""
    content = json.loads(status.read_bytes()) if status.exists() else {"status": None}
    return None if content["status"] is None else "; ".join(content["problems"])


def end_in_time(process):
    # A thread that does not end in time would make the status 1.
    assert process.end(signal.SIGTERM) == 0


def test_the_watchdog_is_fed_only_while_frames_and_sensors_go_on(tmp_path):
    with node(tmp_path, tmp_path / "dives") as (process, manager, status):
        assert manager.hear() == "READY=1"
        assert fed(manager.hear())
        for name in ("camera", "imu"):
            manager.hear_until(fed)
            stall = tmp_path / name
            stall.touch()
            manager.hear_until(lambda said, name=name: not fed(said) and f"{name}: nothing for" in said)
            assert not any(fed(manager.hear()) for _ in range(3))
            assert f"{name}: nothing for" in problems(status)
            stall.unlink()
            manager.hear_until(fed)
        end_in_time(process)
        assert manager.hear_until(lambda said: not fed(said)) == "STOPPING=1"
        assert not status.exists()
    (log,) = (tmp_path / "dives").glob("a-*.mcap")
    with DiveLogReader(log) as reader:
        assert reader.damage == []
        said = [decode(r.payload, NodeStatus).problem for r in reader.records(lambda key: key.endswith("/status"))]
    assert any("camera: nothing for" in problem for problem in said)
    assert any("imu: nothing for" in problem for problem in said)


def test_a_disk_that_runs_full_in_mid_dive_costs_no_candidates(tmp_path):
    with (
        small_disk(tmp_path / "disk", 2048) as disk,
        node(tmp_path, disk, images_hz=5.0) as (process, manager, status),
    ):
        until(lambda: any(disk.glob("*.pictures/*")))
        ballast = disk / "ballast"
        # Again and again: pictures are deleted to make room for the log.
        with open(ballast, "wb", buffering=0) as file:

            def named():
                with contextlib.suppress(OSError):
                    file.write(bytes(65536))
                return "No space left" in (problems(status) or "")

            until(named)
        # Said once the log has been refused: the first to make room are the pictures.
        until(lambda: "pictures" in (problems(status) or ""))
        assert fed(manager.hear_until(fed))
        ballast.unlink()
        until(lambda: "No space left" not in (problems(status) or ""))
        assert process.end(signal.SIGTERM) == 0
        (log,) = disk.glob("a-*.mcap")
        with DiveLogReader(log) as reader:
            assert reader.damage == []
            frames = [r.open().message.seq for r in reader.records(lambda key: key.endswith("/candidates"))]
            said = [r.open().message.problem for r in reader.records(lambda key: key.endswith("/status"))]
    assert frames == list(range(len(frames)))
    assert any("No space left" in problem for problem in said)
    assert process.wait_for("written again")


def test_a_log_that_is_removed_ends_the_node_so_that_systemd_begins_another(tmp_path):
    with node(tmp_path, tmp_path / "dives") as (process, manager, _status):
        manager.hear_until(fed)
        shutil.rmtree(tmp_path / "dives")
        assert process.wait() == 2
        (said,) = [line for line in process.lines if "was removed while it was written" in line]
        assert "start again" in said
        assert not [line for line in process.lines if "Traceback" in line]


def test_a_read_only_disk_is_refused_at_the_start_in_one_line(tmp_path):
    with (
        small_disk(tmp_path / "disk", 64, "ro") as disk,
        node(tmp_path, disk) as (process, _manager, _status),
    ):
        assert process.wait() == 2
        assert [line for line in process.lines if "Read-only file system" in line]
        assert not [line for line in process.lines if "Traceback" in line]


@pytest.mark.parametrize("directory", ["/dev/null", "a\0b"])
def test_a_folder_that_cannot_be_made_is_refused_with_its_name(directory):
    config = NodeConfig(
        node="a", sensors=SensorsConfig(name="simulated"), record=RecordConfig(directory=directory, images_hz=0.0)
    )
    service = NodeService(config)
    with pytest.raises(ConfigError) as refused:
        service.open()
    assert str(refused.value).startswith(f"record.directory = {directory!r}: cannot be made: ")


class Settable:
    """The machine's clock, as if it had been set."""

    shift_ns = 0

    def now_ns(self):
        return time.time_ns() + self.shift_ns


@pytest.mark.parametrize("step_s", [1, -30])
def test_a_clock_that_is_set_in_mid_dive_is_named_and_all_goes_on(tmp_path, caplog, step_s):
    config = NodeConfig(
        node="a",
        connect=free_endpoint(),
        camera=CameraConfig(width_px=160, height_px=120),
        sensors=SensorsConfig(name="simulated"),
        preview=PreviewConfig(rate_hz=0.0),
        record=RecordConfig(directory=str(tmp_path), images_hz=5.0),
    )
    clock = Settable()
    service = NodeService(config, NodeClock(clock.now_ns))
    service.open()
    with caplog.at_level(logging.WARNING):
        try:
            service.start()
            until(lambda: service.outlet.sent["candidates"] > 2 and service.outlet.sent["node_status"] > 0)
            clock.shift_ns = step_s * S_NS
            until(lambda: service.status_message and "in mid-dive" in service.status_message.problem)
            pictures, frames = service.outlet.sent["image"], service.outlet.sent["candidates"]
            until(lambda: service.outlet.sent["image"] > pictures and service.outlet.sent["candidates"] > frames)
        finally:
            assert service.close() == 0
    assert f"clock: was set by {step_s:+d}.0" in caplog.text or f"clock: was set by {step_s - 1:+d}.9" in caplog.text
    assert service.recorder.error is None
    with DiveLogReader(service.recorder.path) as reader:
        (said,) = [record.open().message for record in reader.records(lambda key: key.endswith("/clock_set"))]
    assert said.moved_ns == pytest.approx(step_s * S_NS, abs=MS_NS)
    # As the commands read it, the node's clock and its uptime go on together.
    with Dive([service.recorder.path]) as dive:
        statuses = [one.message for one in dive.messages("node_status")]
    begun_s = [status.stamp_ns / S_NS - status.uptime_s for status in statuses]
    assert len(begun_s) > 1
    assert max(begun_s) - min(begun_s) < 0.3


@pytest.mark.parametrize("step_ns", [-3600 * S_NS, -S_NS, 0, S_NS])
def test_pictures_keep_their_rate_when_the_clock_is_set(step_ns):
    turn = RateLimiter(2.0)
    taken = [i for i in range(40) if turn.allow(i * 100 * MS_NS + 7200 * S_NS + (step_ns if i >= 20 else 0))]
    assert all(4 <= later - earlier <= 6 or earlier < 20 <= later for earlier, later in pairwise(taken))
    assert len(taken) in (8, 9)


@pytest.mark.parametrize(("rate_hz", "count"), [(0.0, 0), (1e-300, 1), (1e12, 40)])
def test_a_rate_of_pictures_may_be_any_number(rate_hz, count):
    turn = RateLimiter(rate_hz)
    assert sum(turn.allow(7200 * S_NS + i * 100 * MS_NS) for i in range(40)) == count


class PictureOutlet:
    """Takes what would be recorded and what would be shown."""

    def __init__(self):
        self.recorded, self.shown = [], []

    def send(self, image, publish=True, record=True):
        (self.recorded if record else self.shown).append(round(image.stamp_ns / S_NS, 1))


@pytest.mark.parametrize(
    ("every", "recorded", "shown"),
    [(20, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [0.0, 2.0, 4.0]), (None, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [0, 1, 2, 3, 4, 5]),
     (1000, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0], [0.0, 2.6, 3.6, 4.6, 5.6])],
)  # fmt: skip
def test_pictures_of_the_scene_are_recorded_and_shown_before_those_of_the_lamps(every, recorded, shown):
    outlet = PictureOutlet()
    images = Images(NodeConfig(node="a"), outlet)
    for i in range(60):
        context = None if every is None else i % every == 0
        images.send(Frame(np.zeros((9, 12, 3), np.uint8), i * 100 * MS_NS, context=context))
    assert outlet.recorded == recorded
    assert outlet.shown == shown


class SilentSensor:
    """A sensor that gives nothing."""

    name = "depth"
    read_by = ""
    retries = 7

    def __init__(self, problem):
        self.problem = problem


@pytest.mark.parametrize(("problem", "progresses"), [("", False), ("no answer: check the chip's wiring", True)])
def test_a_sensor_that_says_what_is_wrong_does_not_restart_the_node(tmp_path, monkeypatch, problem, progresses):
    monkeypatch.setattr("buddyline.node.service.FIRST_S", -10.0)
    config = NodeConfig(node="a", camera=CameraConfig(name="stored"), record=RecordConfig(directory=str(tmp_path)))
    service = NodeService(config)
    service.sources = [SilentSensor(problem)]
    assert service.progressing() is progresses


class Giving:
    """A sensor that gives these blocks of messages."""

    problem, retries, read_by = "", 0, ""

    def __init__(self, name, read_by="", blocks=()):
        self.name, self.read_by, self._blocks = name, read_by, list(blocks)

    def next_messages(self, stop):
        return self._blocks.pop(0) if self._blocks else None

    def close(self):
        pass


def test_of_two_sensors_on_one_bus_each_is_known_to_have_given_by_its_own_messages(tmp_path):
    config = NodeConfig(node="a", camera=CameraConfig(name="stored"), record=RecordConfig(directory=str(tmp_path)))
    service = NodeService(config)
    sent = []
    service.outlet = SimpleNamespace(send=sent.append)
    depth = Depth(node="a", stamp_ns=1, depth_m=1.0, sigma_m=0.1, pressure_pa=1e5, temperature_degc=5.0)
    inertial = Imu(node="a", stamp_ns=1, accel_mps2=(0.0, 0.0, -9.8), gyro_radps=(0.0, 0.0, 0.0))
    for given, heard in ([depth], {"depth"}), ([inertial], {"imu"}), ([inertial, depth], {"imu", "depth"}):
        service.sources = [imu := Giving("imu", blocks=[given]), Giving("depth", read_by="imu")]
        service._last_s.clear()
        service._read(imu)
        assert service._last_s.keys() == heard
    assert len(sent) == 4


class NewCamera:
    """A camera that gives nothing, as the driver makes it once the cable is in."""

    problem, row_time_ns, exposure_control = "", 37_000, None

    def __init__(self):
        self.skipped = Counter()

    def info(self):
        return None

    def next_frame(self, stop):
        stop.wait()

    def close(self):
        pass


def test_a_node_without_its_camera_at_the_start_runs_says_so_and_takes_it_later(tmp_path, monkeypatch):
    monkeypatch.setattr("buddyline.node.awaited.RETRY_NS", 10 * MS_NS)
    plugged = threading.Event()

    def open_camera(config, clock):
        if not plugged.is_set():
            raise AbsentError("camera: none found: check its cable")
        return NewCamera()

    pi = load_node_config(REPOSITORY / "node/examples/pi.toml")
    config = NodeConfig(
        node="a",
        connect=free_endpoint(),
        camera=pi.camera,
        calibration=pi.calibration,
        record=RecordConfig(directory=str(tmp_path)),
    )
    service = NodeService(config, camera=open_camera)
    service.open()
    try:
        service.start()
        until(lambda: service.outlet.sent["imu"] > 2)
        assert "camera: camera: none found" in service.status().problem
        assert service.progressing()
        plugged.set()
        until(lambda: service.outlet.sent["info"] == 2)
        assert "none found" not in service.status().problem
    finally:
        assert service.close() == 0
    with DiveLogReader(service.recorder.path) as reader:
        infos = [record.open().message for record in reader.records(lambda key: key.endswith("/info"))]
    assert [info.row_time_ns for info in infos] == [0, 37_000]


class TagCamera(NewCamera):
    """A camera before whose scene pictures a diver holds a station's tag."""

    def __init__(self, clock):
        super().__init__()
        self.stamp_ns, self.rng = clock.now_ns(), np.random.default_rng(3)

    def next_frame(self, stop):
        if stop.wait(0.02):
            return None
        self.stamp_ns += S_NS
        return frame(self.rng, self.stamp_ns, {117: 0.6})


def test_a_node_that_is_shown_a_tag_marks_itself(tmp_path):
    pi = load_node_config(REPOSITORY / "node/examples/pi.toml")
    config = NodeConfig(
        node="a",
        connect=free_endpoint(),
        calibration=replace(pi.calibration, camera=CAMERA),
        record=RecordConfig(directory=str(tmp_path)),
    )
    service = NodeService(config, camera=lambda config, clock: TagCamera(clock))
    service.open()
    try:
        service.start()
        until(lambda: service.outlet.sent["mark"] > 0)
    finally:
        assert service.close() == 0
    with DiveLogReader(service.recorder.path) as reader:
        marks = [record.open().message for record in reader.records(lambda key: key.endswith("/mark"))]
    assert {(mark.node, mark.kind, mark.name, mark.tag) for mark in marks} == {("a", "station", "T117", 117)}


@pytest.mark.skipif(shutil.which("chronyd") is None, reason="chrony is not on this machine")
@pytest.mark.parametrize("name", ["a", "b"])
def test_chrony_accepts_the_example_configurations(name):
    """-p reads a configuration and prints it."""
    path = REPOSITORY / "node/examples" / f"chrony-{name}.conf"
    done = subprocess.run([shutil.which("chronyd"), "-p", "-f", str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "driftfile" in done.stdout
