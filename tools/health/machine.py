"""Judge this machine: clock, temperature, power, disk. Input: facts; output: findings."""

from __future__ import annotations

from typing import Final

from buddyline.node.chrony import Tracking
from buddyline.node.drivers.samples import BatterySample
from buddyline.protocol.health import (
    BATTERY_EMPTY_CELL_V,
    BATTERY_LOW_CELL_V,
    CLOCK_OFF_S,
    DIVE_H,
    HOT_DEGC,
    SLOWED_NOW,
    SLOWED_SINCE_START,
    TOO_HOT_DEGC,
    UNDERVOLTAGE_NOW,
    UNDERVOLTAGE_SINCE_START,
)
from buddyline.tools.health.finding import Finding, Level

# Bytes per pixel of JPEGs of quality 90 of dark water with lamps; bytes per second of all else that a node records.
BYTES_A_PIXEL: Final = 0.25
BYTES_A_SECOND: Final = 50_000

CHARGE: Final = "end the dive, or charge it before the next"

# Bits of vcgencmd get_throttled, the worst first: the present ones, then those since the start.
_POWER: Final[tuple[tuple[int, Level, str, str], ...]] = (
    (UNDERVOLTAGE_NOW, "problem", "undervoltage now", "charge or change the battery; thicker, shorter cables"),
    (SLOWED_NOW, "problem", "the processor is slowed down now", "cool it, and check the supply"),
    (UNDERVOLTAGE_SINCE_START, "warning", "undervoltage since the start", "charge the battery, check cables, reboot"),
    (SLOWED_SINCE_START, "warning", "was slowed down since the start", "cool it, and check the supply"),
)


def clock(tracking: Tracking | None, error: str, timesyncd: bool, *, stamps: bool = True) -> Finding:
    """Judge whether this machine's clock agrees with the others.

    timesyncd: systemd says it is synchronised. stamps: this clock stamps frames; if not, warnings are the worst.
    """
    worst: Level = "problem" if stamps else "warning"
    if error:
        return Finding("clock", worst, error, "see node/README.md, Synchronise the clocks")
    if tracking is None:
        if timesyncd:
            return Finding("clock", "warning", "set by systemd-timesyncd, to milliseconds", "apt install chrony")
        return Finding(
            "clock",
            "warning",
            "chrony is not installed: nothing synchronises this clock with the others",
            "apt install chrony",
        )
    if not tracking.synchronised:
        return Finding(
            "clock", worst, "not synchronised: chrony has no source", "connect the tether, then: chronyc sources"
        )
    if tracking.local:
        return Finding("clock", "ok", f"served to others as it stands (stratum {tracking.stratum})")
    text = f"{1e3 * tracking.offset_s:+.3f} ms from {tracking.source}, RMS {1e3 * tracking.rms_s:.3f} ms"
    if max(abs(tracking.offset_s), tracking.rms_s) > CLOCK_OFF_S:
        return Finding("clock", worst, text, f"wait until it is within {1e3 * CLOCK_OFF_S:g} ms: chronyc waitsync")
    return Finding("clock", "ok", text)


def clock_chip(*, kept: bool, stamps: bool) -> Finding:
    """Judge whether the time outlives a night without power. kept: a chip has given it; stamps: as for `clock`."""
    if not stamps:
        return Finding("clock chip", "skipped", "only a node needs one")
    if kept:
        return Finding("clock chip", "ok", "the time of the start is a clock chip's")
    return Finding(
        "clock chip",
        "warning",
        "none: after the start the time is that of the last shutdown, until chrony has a source",
        "start with the tether connected, or add a clock chip: node/README.md, Synchronise the clocks",
    )


def temperature(degc: float | None) -> Finding:
    """Judge the processor's temperature."""
    if degc is None:
        return Finding("temperature", "skipped", "this machine does not report it")
    level: Level = "problem" if degc >= TOO_HOT_DEGC else "warning" if degc >= HOT_DEGC else "ok"
    advice = "" if level == "ok" else "get it into the shade or the water; a Pi slows down at 80 degrees"
    return Finding("temperature", level, f"{degc:.0f} degrees C", advice)


def power(throttled: int | None) -> Finding:
    """Judge the supply by the firmware's bits (vcgencmd get_throttled)."""
    if throttled is None:
        return Finding("power", "skipped", "this machine does not report undervoltage")
    for bit, level, text, advice in _POWER:
        if throttled & bit:
            return Finding("power", level, text, advice)
    return Finding("power", "ok", "no undervoltage since the start")


def battery(sample: BatterySample | None, cells: int | None, problem: str) -> Finding:
    """Judge the battery by its gauge. cells: in series; None: its charge cannot be judged."""
    if sample is None:
        return Finding("battery", "problem", problem or "gives nothing", "check its wiring; see node/README.md")
    text = f"{sample.voltage_v:.1f} V" + ("" if sample.current_a is None else f", {sample.current_a:.2f} A")
    if cells is None:
        return Finding("battery", "ok", text)
    level = charge(sample.voltage_v / cells)
    return Finding("battery", level, text, "" if level == "ok" else CHARGE)


def charge(cell_v: float) -> Level:
    """Judge the charge by the voltage of one cell under load."""
    return "problem" if cell_v <= BATTERY_EMPTY_CELL_V else "warning" if cell_v <= BATTERY_LOW_CELL_V else "ok"


def disk(place: str, free_bytes: int, min_free_bytes: int, picture_px_a_second: float, error: str) -> Finding:
    """Judge whether a dive fits. error: why nothing can be written there, "" if it can."""
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
