"""NMEA 0183: sentences for chart plotters, and a boat's place out of its receiver's sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.tools.bridge.place import GeoPoint, OnEarth
from buddyline.tools.bridge.placed import Placed

# NMEA has no value for "not a satellite": plotters refuse a position of fewer than four.
SATELLITES: Final = 10
# Error in metres of a receiver with HDOP 1, by the usual rule.
M_PER_HDOP: Final = 2.5
# Receivers state 99.99 where they do not know; beyond there is no receiver.
MOST_HDOP: Final = 100.0
TARGET: Final = 1


def checksum(body: str) -> str:
    """Return the checksum of what stands between $ and *: the exclusive or of its bytes, in hexadecimal."""
    value = 0
    for byte in body.encode("ascii", "replace"):
        value ^= byte
    return f"{value:02X}"


def sentence(*fields: object) -> str:
    """Return a sentence with its checksum and line end."""
    body = ",".join(str(field) for field in fields)
    return f"${body}*{checksum(body)}\r\n"


def sentences(placed: Placed, earth: OnEarth | None) -> Iterator[str]:
    """Yield what a plotter takes of one estimate.

    With a place on Earth: GGA (position), GST (its sigmas) and TLL (the vehicle as a radar target). Always: TTM (range
    over ground and bearing from the reference: true where north is, else relative to the reference's heading), and the
    vehicle's heading as HDT (true) or HDM (magnetic).
    """
    time = clock_words(placed.stamp_ns)
    name = placed.vehicle
    if earth is not None:
        latitude, longitude = angle(earth.latitude_deg, "NS"), angle(earth.longitude_deg, "EW")
        hdop = max(earth.horizontal_m / M_PER_HDOP, 0.1)
        height = f"{earth.altitude_m:.2f}"
        yield sentence(
            "GPGGA", time, latitude, longitude, 1, SATELLITES, f"{hdop:.1f}", height, "M", "0.0", "M", "", ""
        )
        sigmas = (f"{x:.3f}" for x in (earth.sigma_north_m, earth.sigma_east_m, earth.sigma_down_m))
        yield sentence("GPGST", time, f"{earth.horizontal_m:.3f}", "", "", "", *sigmas)
        yield sentence("RATLL", f"{TARGET:02d}", latitude, longitude, name, time, "T", "")
    north_m, east_m, _ = placed.p_ned_m.tolist()
    bearing_rad, of = math.atan2(east_m, north_m), "T"
    if not placed.is_north_true and placed.reference_yaw_rad is not None:
        bearing_rad, of = bearing_rad - placed.reference_yaw_rad, "R"
    if placed.is_north_true or placed.reference_yaw_rad is not None:
        distance_km = math.hypot(north_m, east_m) / 1e3
        speed_kmh = course = ""
        if placed.v_ned_mps is not None and placed.is_north_true:
            north_mps, east_mps, _ = placed.v_ned_mps.tolist()
            speed_kmh = f"{math.hypot(north_mps, east_mps) * 3.6:.2f}"
            course = degrees(math.atan2(east_mps, north_mps))
        moving = (speed_kmh, course, "T" if course else "", "", "")
        bearing = degrees(bearing_rad)
        yield sentence(
            "RATTM", f"{TARGET:02d}", f"{distance_km:.5f}", bearing, of, *moving, "K", name, "T", "", time, "A"
        )
    if placed.is_north_true:
        yield sentence("HEHDT", degrees(placed.yaw_rad), "T")
    else:
        yield sentence("HCHDM", degrees(placed.yaw_rad), "M")


def clock_words(stamp_ns: int) -> str:
    """Return the time of day, UTC, as hhmmss.ss."""
    return datetime.fromtimestamp(stamp_ns // S_NS, UTC).strftime("%H%M%S") + f".{stamp_ns % S_NS // 10_000_000:02d}"


def angle(angle_deg: float, sides: str) -> str:
    """Return a latitude or longitude as two fields, `ddmm.mmmmmm,N` or `dddmm.mmmmmm,E`; sides: "NS" or "EW"."""
    micro_minutes = round(abs(angle_deg) * 60e6)
    whole, rest = divmod(micro_minutes, 60_000_000)
    digits = 2 if sides == "NS" else 3
    return f"{whole:0{digits}d}{rest / 1e6:09.6f},{sides[angle_deg < 0]}"


def degrees(angle_rad: float) -> str:
    """Return an angle of 0 to 360 degrees, to a tenth."""
    return f"{round(math.degrees(angle_rad) % 360.0, 1) % 360.0:.1f}"


def place_of(line: str) -> GeoPoint | None:
    """Return the place in a boat's GGA or RMC sentence; None for another, invalid or damaged one."""
    body, star, check = line.strip().partition("*")
    if not body.startswith("$") or not star or checksum(body[1:]) != check.upper():
        return None
    fields = body[1:].split(",")
    kind = fields[0][2:]
    try:
        if kind == "GGA" and fields[6] not in ("", "0"):
            hdop = float(fields[8] or "nan")
            if not (math.isnan(hdop) or 0.0 <= hdop <= MOST_HDOP):
                return None
            sigma_m = M_PER_HDOP * hdop / math.sqrt(2.0) if math.isfinite(hdop) else 0.0
            return GeoPoint(_degrees_of(fields[2], fields[3]), _degrees_of(fields[4], fields[5]), sigma_m)
        if kind == "RMC" and fields[2] == "A":
            return GeoPoint(_degrees_of(fields[3], fields[4]), _degrees_of(fields[5], fields[6]))
    except (ValueError, IndexError):
        pass
    return None


def _degrees_of(text: str, side: str) -> float:
    if side not in ("N", "S", "E", "W"):
        raise ValueError(f"side {side!r}")
    point = text.index(".") if "." in text else len(text)
    angle_deg = int(text[: point - 2]) + float(text[point - 2 :]) / 60.0
    limit = 90.0 if side in "NS" else 180.0
    if not 0.0 <= angle_deg <= limit:
        raise ValueError(f"{text} is out of range")
    return -angle_deg if side in "SW" else angle_deg
