"""Try a node's camera and sensors for a few seconds, with the node's own drivers."""

from __future__ import annotations

import shutil
import tempfile
import threading
import time
from typing import Final

from buddyline.node.capture.loop import ExposureLoop
from buddyline.node.config import NodeConfig
from buddyline.node.detect import Detection, make_detector
from buddyline.node.devices import CameraDevice, Frame, Source, open_camera, open_sensors
from buddyline.node.pipeline import Pipeline
from buddyline.node.power.watch import BatteryGauge
from buddyline.node.underwater.display import Display
from buddyline.node.underwater.pins import PanelPins
from buddyline.protocol.clock import SystemClock
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Imu, Message, NodeInfo
from buddyline.tools.health import machine as judge_machine
from buddyline.tools.health import rig as judge
from buddyline.tools.health.finding import Finding
from msgspec import UNSET
from msgspec.structs import replace

FRAMES: Final = 3
# An exposure that follows the lamps: enough frames for a camera whose controls show nine frames later.
FRAMES_TO_LOCK: Final = 40
FRAMES_WITHIN_S: Final = 5.0
LISTEN_S: Final = 3.0
# Longer than the search for the chips plus the two seconds of samples that the surface pressure needs.
SENSE_S: Final = 4.0
# Of a battery gauge's first conversion.
GAUGE_S: Final = 0.3


def check_camera(config: NodeConfig) -> list[Finding]:
    """Open the camera, take a few frames, and look for lights in them."""
    try:
        camera = open_camera(config, SystemClock())
    except BuddylineError as error:
        unseen = Finding("lights", "skipped", "no test frame without a camera")
        problem = Finding(
            "camera", "problem", str(error), "does a node run already? check the cable, then node/README.md"
        )
        return [problem, _calibration(config, None, None), unseen]
    try:
        info = camera.info()
        frames, found, loop = _take_frames(camera, config, info)
    finally:
        problem_text = camera.problem
        camera.close()
    if not frames:
        text = problem_text or f"gave no frame within {FRAMES_WITHIN_S:g} s"
        return [
            Finding("camera", "problem", text, "check its cable: rpicam-hello --list-cameras"),
            _calibration(config, info, None),
            Finding("lights", "skipped", "no test frame"),
        ]
    # The scene is judged, where there is a picture of it.
    seen = next((frame for frame in reversed(frames) if frame.context is not False), frames[-1])
    return [
        judge.picture(seen.image, fixed=loop is None),
        judge.exposure(loop.state if loop else None, frames[-1].exposure),
        _calibration(config, info, frames[-1].image.shape),
        judge.lights(found),
    ]


def _take_frames(
    camera: CameraDevice, config: NodeConfig, info: NodeInfo | None
) -> tuple[list[Frame], list[list[Detection]], ExposureLoop | None]:
    """Take a few frames, and find lights in each; where the exposure follows the lamps, until it is locked to them."""
    control = camera.exposure_control
    loop = None if control is None else ExposureLoop(config.exposure, control.range)
    stated = config.calibration or info
    detector = make_detector(
        config.detector.method,
        config.detector.environment,
        config.detector.overrides,
        stated.camera.fx_px if stated else None,
        config.detector.masks,
    )
    pipeline = Pipeline(config.node, "doctor", config.trigger_period_ns, detector)
    stop = threading.Event()
    timer = threading.Timer(FRAMES_WITHIN_S, stop.set)
    timer.start()
    frames: list[Frame] = []
    found: list[list[Detection]] = []
    locked = 0
    try:
        while len(frames) < (FRAMES_TO_LOCK if loop else FRAMES) and locked < FRAMES:
            frame = camera.next_frame(stop)
            if frame is None:
                break
            frames.append(frame)
            candidates = pipeline.candidates(frame)
            found.append(pipeline.detections)
            if control is not None and loop is not None and candidates is not None:
                control.follow(loop.update(frame, candidates))
                locked = locked + 1 if loop.state == "locked" else 0
    finally:
        timer.cancel()
    return frames, found, loop


def _calibration(config: NodeConfig, own: NodeInfo | None, shape: tuple[int, ...] | None) -> Finding:
    info = own
    if config.calibration is not None:
        info = config.node_info(0, "", "", 0)
    elif own is not None and own.node != config.node:
        text = f"the pictures' is of node {own.node}, this is node {config.node}"
        return Finding("calibration", "problem", text, "take that node's pictures, or its name")
    elif own is None and config.camera.name == "simulated":
        return Finding("calibration", "skipped", "comes with the simulated camera")
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
        calibrated=not sensors.magnetometer_calibration.is_none,
        chips=chips,
        heard=any(message.mag_t is not UNSET for message in given),
    )
    return [*findings, compass, judge.imu_place(config.calibration, chips)]


def check_panel(config: NodeConfig) -> list[Finding]:
    """Open each pin of the panel and read the inputs; lamp, buzzer and lights stay off."""
    has_display = config.panel.display != "none"
    if not config.panel.pins and not has_display:
        return []
    pins = PanelPins(config.panel)
    display = Display(config.panel, config.sensors.i2c_bus)
    try:
        pressed = None if pins.button is None else pins.button.read()
        leak = None if pins.leak is None else pins.leak.read()
        for output in (pins.lamp, pins.buzzer, pins.lights):
            if output is not None:
                output.write(False)
        problems = [f"{pin.name}: {pin.problem}" for pin in pins.all if pin.problem]
        if has_display:
            display.show([f"doctor of node {config.node}"])
            display.turn(0.0)
            problems += [f"display: {display.problem}"] if display.problem else []
    finally:
        pins.close()
        display.close()
    command = config.panel.shutdown_command
    absent = command[0] if command and shutil.which(command[0]) is None else ""
    return [judge.panel(config.panel.pins, problems, pressed=bool(pressed), leak=bool(leak), absent=absent)]


def check_battery(config: NodeConfig) -> list[Finding]:
    """Read the battery gauge once."""
    gauge = BatteryGauge(config)
    if gauge.absent:
        return []
    try:
        gauge.look(time.monotonic())
        if not gauge.problem:
            time.sleep(GAUGE_S)
            gauge.look(time.monotonic())
    finally:
        gauge.close()
    return [judge_machine.battery(gauge.sample, config.power.cells, gauge.problem)]


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
