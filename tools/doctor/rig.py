"""Try a node's camera and sensors for a few seconds, with the node's own drivers."""

from __future__ import annotations

import tempfile
import threading
import time
from typing import Final

from buddyline.node.config import NodeConfig
from buddyline.node.detect import make_detector
from buddyline.node.devices import Frame, Source, open_camera, open_sensors
from buddyline.protocol.clock import SystemClock
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Imu, Message, NodeInfo
from buddyline.tools.health import rig as judge
from buddyline.tools.health.finding import Finding
from msgspec import UNSET
from msgspec.structs import replace

FRAMES: Final = 3
FRAMES_WITHIN_S: Final = 5.0
LISTEN_S: Final = 3.0
# Longer than the search for the chips plus the two seconds of samples that the surface pressure needs.
SENSE_S: Final = 4.0


def check_camera(config: NodeConfig) -> list[Finding]:
    """Open the camera, take a few frames, and look for lights in them."""
    info: NodeInfo | None = None
    try:
        camera = open_camera(config, SystemClock())
    except BuddylineError as error:
        unseen = Finding("lights", "skipped", "no test frame without a camera")
        problem = Finding(
            "camera", "problem", str(error), "does a node run already? check the cable, then node/README.md"
        )
        return [problem, _calibration(config, None, None), unseen]
    stop = threading.Event()
    timer = threading.Timer(FRAMES_WITHIN_S, stop.set)
    timer.start()
    frames: list[Frame] = []
    try:
        info = camera.info()
        while len(frames) < FRAMES and (frame := camera.next_frame(stop)) is not None:
            frames.append(frame)
    finally:
        timer.cancel()
        problem_text = camera.problem
        camera.close()
    if not frames:
        text = problem_text or f"gave no frame within {FRAMES_WITHIN_S:g} s"
        return [
            Finding("camera", "problem", text, "check its cable: rpicam-hello --list-cameras"),
            _calibration(config, info, None),
            Finding("lights", "skipped", "no test frame"),
        ]
    stated = config.calibration or info
    detector = make_detector(
        config.detector.method,
        config.detector.environment,
        config.detector.overrides,
        stated.camera.fx_px if stated else None,
    )
    found = [detector.detect(frame.image) for frame in frames]
    seen = judge.picture(frames[-1].image)
    return [seen, _calibration(config, info, frames[-1].image.shape), judge.lights(found)]


def _calibration(config: NodeConfig, own: NodeInfo | None, shape: tuple[int, ...] | None) -> Finding:
    if config.calibration is not None:
        info = config.node_info(0, "", "", 0)
    elif own is not None and own.node != config.node:
        text = f"the pictures' is of node {own.node}, this is node {config.node}"
        return Finding("calibration", "problem", text, "take that node's pictures, or its name")
    elif own is None and config.camera.name == "simulated":
        return Finding("calibration", "skipped", "comes with the simulated camera")
    else:
        info = own  # type: ignore[assignment]
    return judge.calibration(config.calibration, info, shape)


def check_sensors(config: NodeConfig) -> list[Finding]:
    """Open the sensors and read each for a few seconds; a node's stored surface pressure is not changed."""
    if config.sensors.name == "none":
        return [Finding("sensors", "skipped", "none are configured")]
    with tempfile.TemporaryDirectory(prefix="buddyline-doctor-") as work:
        config = replace(config, record=replace(config.record, directory=work))
        try:
            sources = open_sensors(config, SystemClock())
        except BuddylineError as error:
            return [Finding("sensors", "problem", str(error), "check wiring and config.txt: node/README.md")]
        heard = _listen(sources)
        findings = [judge.sensor(source.name, heard[source.name], source.problem) for source in sources]
        for source in sources:
            source.close()
    sensors = config.sensors
    given = [message for messages in heard.values() for message in messages if isinstance(message, Imu)]
    chips = sensors.name == "i2c" and sensors.imu != "none"
    compass = judge.magnetometer(
        calibrated=any(sensors.magnetometer_offset_t),
        chips=chips,
        heard=any(message.mag_t is not UNSET for message in given),
    )
    return [*findings, compass, judge.imu_place(config.calibration, chips)]


def _listen(sources: list[Source]) -> dict[str, list[Message]]:
    stop = threading.Event()
    heard: dict[str, list[Message]] = {source.name: [] for source in sources}
    done = threading.Event()

    def read(source: Source) -> None:
        began_s = time.monotonic()
        while not stop.is_set() and (messages := source.next_messages(stop)) is not None:
            heard[source.name] += messages
            if time.monotonic() - began_s > LISTEN_S / 3 and all(heard.values()):
                done.set()

    threads = [threading.Thread(target=read, args=(source,), name=source.name, daemon=True) for source in sources]
    for thread in threads:
        thread.start()
    done.wait(SENSE_S)
    stop.set()
    for thread in threads:
        thread.join(1.0)
    return heard
