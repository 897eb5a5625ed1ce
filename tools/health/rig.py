"""Judge a node's rig: calibration, camera, lights, sensors. Input: their data; output: findings."""

from __future__ import annotations

import numpy as np
from buddyline.node.capture.exposure import Exposure
from buddyline.node.config import CalibrationConfig
from buddyline.node.detect.detection import Detection, is_likely
from buddyline.node.drivers.samples import STANDARD_GRAVITY_MPS2
from buddyline.protocol.clock import MS_NS
from buddyline.protocol.messages import Attitude, CameraModel, Depth, Imu, Message, NodeInfo
from buddyline.tools.health.finding import Finding
from msgspec import UNSET
from numpy.typing import NDArray


def calibration(entered: CalibrationConfig | None, info: NodeInfo | None, shape: tuple[int, ...] | None) -> Finding:
    """Judge whether there is a calibration, and whether it is of this camera.

    entered: the configuration's own; info: what the node sends; shape: of a frame, (H, W, ...).
    """
    if info is None:
        return Finding(
            "calibration", "problem", "there is none", "buddyline calibrate camera and lights, into [calibration]"
        )
    size = info.width_px, info.height_px
    if shape is not None and (shape[1], shape[0]) != size:
        return Finding(
            "calibration",
            "problem",
            f"is of {size[0]}x{size[1]} pixels, the camera gives {shape[1]}x{shape[0]}",
            "calibrate in the mode that dives, or set camera.width_px and height_px",
        )
    odd = _odd(info.camera, size)
    if odd:
        return Finding("calibration", "problem", odd, "is it of this camera, in this mode? buddyline calibrate camera")
    bar_m = float(np.linalg.norm(np.subtract(info.light_left_m, info.light_right_m)))
    text = f"of node {info.node}, {size[0]}x{size[1]}, focal length {info.camera.fx_px:.0f} px, bar {bar_m:.3f} m"
    if info.light_left_m[0] > info.light_right_m[0]:
        return Finding("calibration", "problem", f"{text}: left and right light are swapped", "exchange them")
    if entered is not None and not any(entered.camera.distortion):
        return Finding(
            "calibration", "warning", f"{text}; without distortion, as an example has it", "buddyline calibrate camera"
        )
    return Finding("calibration", "ok", text)


def _odd(camera: CameraModel, size: tuple[int, int]) -> str:
    """Return what is implausible for a camera with pictures of this size; "" if nothing."""
    if abs(camera.cx_px / size[0] - 0.5) > 0.2 or abs(camera.cy_px / size[1] - 0.5) > 0.2:
        return f"has its centre at {camera.cx_px:.0f}, {camera.cy_px:.0f} in pictures of {size[0]}x{size[1]} pixels"
    if not 0.2 < camera.fx_px / size[0] < 5 or abs(camera.fx_px / camera.fy_px - 1) > 0.1:
        return f"has a focal length of {camera.fx_px:.0f}, {camera.fy_px:.0f} px in pictures {size[0]} px wide"
    return ""


def picture(image: NDArray[np.uint8], *, fixed: bool = True) -> Finding:
    """Judge the exposure of a test frame; lamps in it do not count. fixed: whether the configuration fixes it."""
    height, width = image.shape[:2]
    brightest, clipped = int(image.max()), float((image >= 250).mean())
    text = f"gives {width}x{height} pixels, median {np.median(image):.0f} of 255"
    if brightest < 10:
        advice = "take the cap off; raise exposure_us or gain" if fixed else "take the cap off"
        return Finding("camera", "warning", f"{text}: all black", advice)
    if clipped > 0.2 and fixed:
        return Finding("camera", "warning", f"{text}: {clipped:.0%} overexposed", "lower exposure_us or gain, or dive")
    return Finding("camera", "ok", text)


def exposure(state: str | None, had: Exposure | None) -> Finding:
    """Judge the exposure of the last test frame. state: of the loop that locks it to the lamps; None if it is fixed."""
    text = "not told by the camera" if had is None else f"{had.time_ns / MS_NS:.3g} ms, gain {had.gain:.3g}"
    if state is None:
        advice = "leave camera.exposure_us out: lamps near the camera are overexposed at any fixed exposure"
        return Finding("exposure", "ok" if had is None else "warning", f"fixed: {text}", "" if had is None else advice)
    if state == "locked":
        return Finding("exposure", "ok", f"locked to the lamps: {text}")
    return Finding("exposure", "skipped", f"follows lamps, and no lamp was seen for long enough: {text}")


def lights(frames: list[list[Detection]]) -> Finding:
    """Judge whether lights are seen. frames: the detections of each test frame."""
    counts = [sum(is_likely(d.blob) for d in found) for found in frames]
    best = max(counts, default=0)
    text = f"{best} likely in a test frame" if best else "none likely in a test frame"
    if best >= 2:
        return Finding("lights", "ok", text)
    return Finding("lights", "warning", text, "point it at the other node's two lights, switched on, 2 m away")


def sensor(name: str, messages: list[Message], problem: str) -> Finding:
    """Judge one sensor by its messages of a few seconds."""
    if problem:
        return Finding(name, "problem", problem, "check its wiring; see node/README.md")
    if not messages:
        return Finding(name, "problem", "gives nothing", "check its wiring: i2cdetect -y 1")
    texts, odd = [], []
    for kind in (Imu, Attitude, Depth):
        newest = next((message for message in reversed(messages) if isinstance(message, kind)), None)
        if newest is not None:
            text, wrong = _plausible(newest)
            texts.append(text)
            odd += [wrong] if wrong else []
    if odd:
        return Finding(name, "problem", "; ".join(odd), "is it at rest, and the right chip? check wiring and mounting")
    return Finding(name, "ok", ", ".join(texts))


def _plausible(message: Imu | Attitude | Depth) -> tuple[str, str]:
    """Return a reading in words, and what is implausible about it."""
    if isinstance(message, Imu):
        pull_mps2 = float(np.linalg.norm(message.accel_mps2))
        text = f"{pull_mps2:.2f} m/s2"
        wrong = abs(pull_mps2 - STANDARD_GRAVITY_MPS2) > 2.0
        if message.mag_t is not UNSET:
            field_ut = 1e6 * float(np.linalg.norm(message.mag_t))
            text += f", {field_ut:.0f} uT"
            # The Earth's field is 22 to 67 uT; hard iron, which calibration removes, may add as much again.
            wrong = wrong or not 5 < field_ut < 200
        return text, f"{text}: not the Earth's" if wrong else ""
    if isinstance(message, Depth):
        text = f"depth {message.depth_m:+.2f} m"
        return text, "" if -1.0 < message.depth_m < 300.0 else f"{text}: not where a diver is"
    sigma_deg = np.degrees(max(message.sigma_rad))
    return f"attitude within {sigma_deg:.0f} degrees", ""


def panel(pins: dict[str, int], problems: list[str], *, pressed: bool, leak: bool, absent: str) -> Finding:
    """Judge the panel's pins, by field. absent: the shutdown command's program, if it cannot be found."""
    if leak:
        return Finding("panel", "problem", "the leak probe is wet", "open the housing, dry it, and find the leak")
    if problems:
        advice = "is the pin in use elsewhere? see node/README.md, The panel"
        return Finding("panel", "problem", "; ".join(problems), advice)
    if pressed:
        advice = "take the magnet away, or look for a short: the button goes to ground"
        return Finding("panel", "warning", "the button is held", advice)
    if absent:
        return Finding("panel", "problem", f"shutdown_command: {absent} is not found", "name a program that is there")
    found = ", ".join(f"{name.removesuffix('_pin')} GPIO {pin}" for name, pin in pins.items())
    return Finding("panel", "ok", found or "a display")


def imu_place(entered: CalibrationConfig | None, chips: bool) -> Finding:
    """Judge whether the inertial unit's place is known; chips: real ones, not simulated."""
    if not chips:
        return Finding("imu place", "skipped", "not a real one")
    if entered is None or entered.imu_m is None:
        advice = "measure it by ruler, calibration.imu_m: node/README.md, Calibrate"
        return Finding("imu place", "warning", "not known: the track needs it, and has to estimate it", advice)
    x_m, y_m, z_m = entered.imu_m
    return Finding("imu place", "ok", f"{x_m:.3f}, {y_m:.3f}, {z_m:.3f} m in the camera's frame")


def magnetometer(calibrated: bool, chips: bool, heard: bool) -> Finding:
    """Judge whether headings can be trusted. chips: real ones, not simulated. heard: the magnetometer gave a field."""
    if not chips:
        return Finding("compass", "skipped", "not a real one")
    if calibrated and not heard:
        advice = "check the magnetometer's wiring: i2cdetect -y 1 shows 1d (v3) or 1e (v5, v6)"
        return Finding("compass", "problem", "is calibrated, and no magnetometer answers: no heading", advice)
    if calibrated:
        return Finding("compass", "ok", "calibrated")
    return Finding(
        "compass", "warning", "not calibrated: headings are off by the rig's iron", "buddyline calibrate magnetometer"
    )
