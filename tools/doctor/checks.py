"""The doctor's judgements, over facts that others have gathered."""

from __future__ import annotations

from typing import Final

import numpy as np
from buddyline.node.chrony import Tracking
from buddyline.node.config import CalibrationConfig
from buddyline.node.detect import Detection
from buddyline.node.drivers.samples import STANDARD_GRAVITY_MPS2
from buddyline.protocol.messages import Attitude, CameraModel, Depth, Imu, Message, NodeInfo
from buddyline.tools.doctor.finding import Finding, Level
from msgspec import UNSET
from numpy.typing import NDArray

CLOCK_LIMIT_S: Final = 2e-3
HOT_DEGC: Final = 70.0
TOO_HOT_DEGC: Final = 80.0  # a Pi slows down from here on
DIVE_H: Final = 4.0
LIKELY: Final = 0.5
# Of JPEGs of quality 90 of dark water with lamps, and of all else that a node records.
BYTES_A_PIXEL: Final = 0.25
BYTES_A_SECOND: Final = 50_000

# vcgencmd get_throttled: now, and since the start.
UNDERVOLTAGE: Final = 1 << 0
THROTTLED: Final = 1 << 2
UNDERVOLTAGE_WAS: Final = 1 << 16
THROTTLED_WAS: Final = 1 << 18


def clock(tracking: Tracking | None, error: str, timesyncd: bool, *, stamps: bool = True) -> Finding:
    """Judge whether this machine's clock is that of the others.

    timesyncd: systemd says it is synchronised. stamps: frames are stamped by it; else nothing is worse than a warning.
    """
    worst: Level = "problem" if stamps else "warning"
    if error:
        return Finding("clock", worst, error, "see node/README.md: chrony on two Pis")
    if tracking is None:
        if timesyncd:
            return Finding("clock", "warning", "set by systemd-timesyncd, to milliseconds", "apt install chrony")
        return Finding(
            "clock", "warning", "chrony is not installed: nothing keeps it with the others'", "apt install chrony"
        )
    if not tracking.synchronised:
        return Finding(
            "clock", worst, "not synchronised: chrony has no source", "connect the tether, then: chronyc sources"
        )
    if tracking.local:
        return Finding("clock", "ok", f"served to others as it stands (stratum {tracking.stratum})")
    text = f"{1e3 * tracking.offset_s:+.3f} ms from {tracking.source}, RMS {1e3 * tracking.rms_s:.3f} ms"
    if max(abs(tracking.offset_s), tracking.rms_s) > CLOCK_LIMIT_S:
        return Finding("clock", worst, text, f"wait until it is within {1e3 * CLOCK_LIMIT_S:g} ms: chronyc waitsync")
    return Finding("clock", "ok", text)


def temperature(degc: float | None) -> Finding:
    """Judge the processor's temperature."""
    if degc is None:
        return Finding("temperature", "skipped", "this machine does not tell")
    level: Level = "problem" if degc >= TOO_HOT_DEGC else "warning" if degc >= HOT_DEGC else "ok"
    advice = "" if level == "ok" else "get it into the shade or the water; a Pi slows down at 80 degrees"
    return Finding("temperature", level, f"{degc:.0f} degrees C", advice)


def power(throttled: int | None) -> Finding:
    """Judge the supply by the firmware's bits (vcgencmd get_throttled)."""
    if throttled is None:
        return Finding("power", "skipped", "this machine does not tell of undervoltage")
    if throttled & UNDERVOLTAGE:
        return Finding("power", "problem", "undervoltage now", "charge or change the battery; thicker, shorter cables")
    if throttled & THROTTLED:
        return Finding("power", "problem", "the processor is slowed down now", "cool it, and check the supply")
    if throttled & UNDERVOLTAGE_WAS:
        return Finding("power", "warning", "undervoltage since the start", "charge the battery, check cables, reboot")
    if throttled & THROTTLED_WAS:
        return Finding("power", "warning", "was slowed down since the start", "cool it, and check the supply")
    return Finding("power", "ok", "no undervoltage since the start")


def disk(place: str, free_bytes: int, min_free_bytes: int, picture_px_a_second: float, error: str) -> Finding:
    """Judge whether a dive fits. error: why nothing can be written there, "" where it can."""
    if error:
        return Finding("disk", "problem", f"{place}: {error}", "set record.directory to a place this user can write")
    hours = max(free_bytes - min_free_bytes, 0) / (picture_px_a_second * BYTES_A_PIXEL + BYTES_A_SECOND) / 3600
    text = (
        f"{place}: {free_bytes / 1e9:.1f} GB free, for about {hours:.0f} hours"
        if hours < 1000
        else (f"{place}: {free_bytes / 1e9:.0f} GB free")
    )
    advice = "copy old dives away and delete them, or lower record.images_hz"
    if free_bytes <= min_free_bytes:
        return Finding("disk", "problem", text, advice)
    return Finding("disk", "warning" if hours < DIVE_H else "ok", text, advice if hours < DIVE_H else "")


def calibration(entered: CalibrationConfig | None, info: NodeInfo | None, shape: tuple[int, ...] | None) -> Finding:
    """Judge whether there is a calibration, and of this camera.

    entered: what stands in the configuration; info: what the node sends; shape: of a frame, (H, W, ...).
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
    """Say what no camera with pictures of this size has, "" where nothing."""
    if abs(camera.cx_px / size[0] - 0.5) > 0.2 or abs(camera.cy_px / size[1] - 0.5) > 0.2:
        return f"has its centre at {camera.cx_px:.0f}, {camera.cy_px:.0f} in pictures of {size[0]}x{size[1]} pixels"
    if not 0.2 < camera.fx_px / size[0] < 5 or abs(camera.fx_px / camera.fy_px - 1) > 0.1:
        return f"has a focal length of {camera.fx_px:.0f}, {camera.fy_px:.0f} px in pictures {size[0]} px wide"
    return ""


def picture(image: NDArray[np.uint8]) -> Finding:
    """Judge a test frame's light, without the lamps in it."""
    height, width = image.shape[:2]
    brightest, clipped = int(image.max()), float((image >= 250).mean())
    text = f"gives {width}x{height} pixels, median {np.median(image):.0f} of 255"
    if brightest < 10:
        return Finding("camera", "warning", f"{text}: all black", "take the cap off; raise exposure_us or gain")
    if clipped > 0.2:
        return Finding("camera", "warning", f"{text}: {clipped:.0%} overexposed", "lower exposure_us or gain, or dive")
    return Finding("camera", "ok", text)


def lights(frames: list[list[Detection]]) -> Finding:
    """Judge whether lights are seen in the test frames: of each, what was detected."""
    counts = [sum(1 for d in found if d.blob.score is UNSET or d.blob.score >= LIKELY) for found in frames]
    best = max(counts, default=0)
    text = f"{best} likely in a test frame" if best else "none likely in a test frame"
    if best >= 2:
        return Finding("lights", "ok", text)
    return Finding("lights", "warning", text, "point it at the other node's two lights, switched on, 2 m away")


def sensor(name: str, messages: list[Message], problem: str) -> Finding:
    """Judge one sensor by what it gave within a few seconds."""
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
    """Return a reading in words, and what is odd about it."""
    if isinstance(message, Imu):
        pull_mps2 = float(np.linalg.norm(message.accel_mps2))
        text = f"{pull_mps2:.2f} m/s2"
        wrong = abs(pull_mps2 - STANDARD_GRAVITY_MPS2) > 2.0
        if message.mag_t is not UNSET:
            field_ut = 1e6 * float(np.linalg.norm(message.mag_t))
            text += f", {field_ut:.0f} uT"
            # The Earth's is 22 to 67 uT; hard iron that calibration takes off may be as much again.
            wrong = wrong or not 5 < field_ut < 200
        return text, f"{text}: not the Earth's" if wrong else ""
    if isinstance(message, Depth):
        text = f"depth {message.depth_m:+.2f} m"
        return text, "" if -1.0 < message.depth_m < 300.0 else f"{text}: not where a diver is"
    sigma_deg = np.degrees(max(message.sigma_rad))
    return f"attitude within {sigma_deg:.0f} degrees", ""


def magnetometer(calibrated: bool, chips: bool) -> Finding:
    """Judge whether headings can be trusted; chips: real ones, not simulated."""
    if calibrated or not chips:
        return Finding("compass", "ok" if chips else "skipped", "calibrated" if chips else "not a real one")
    return Finding(
        "compass", "warning", "not calibrated: headings are off by the rig's iron", "buddyline calibrate magnetometer"
    )
