"""Where a point lies as seen from the origin of north-east-down: azimuth, inclination and their sigmas."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from buddyline.solver_service.geometry.rotation import Floats

# Straight above or below, every azimuth is as likely: the standard deviation of a uniform angle.
ANY_AZIMUTH_RAD: Final = math.pi / math.sqrt(3.0)


@dataclass(frozen=True)
class Direction:
    """azimuth_rad: from north, clockwise, 0 to 2 pi; inclination_rad: up positive; sigmas: 1 sd."""

    azimuth_rad: float
    sigma_azimuth_rad: float
    inclination_rad: float
    sigma_inclination_rad: float


def direction_of(t_ned_m: Floats, covariance: Floats) -> Direction:
    """Return the direction of t_ned_m (3,), whose covariance is (3, 3), m^2; the sigmas are to first order."""
    north, east, down = t_ned_m.tolist()
    (nn, ne, nd), (_, ee, ed), (_, _, dd) = covariance.tolist()
    flat = max(math.hypot(north, east), 1e-9)
    azimuth_rad = math.atan2(east, north)
    cosine, sine = math.cos(azimuth_rad), math.sin(azimuth_rad)
    across = (sine * sine * nn - 2.0 * sine * cosine * ne + cosine * cosine * ee) / flat**2
    x, y, z = cosine * down, sine * down, -flat
    up = (x * x * nn + y * y * ee + z * z * dd + 2.0 * (x * y * ne + x * z * nd + y * z * ed)) / (
        flat**2 + down**2
    ) ** 2
    return Direction(
        azimuth_rad=azimuth_rad % (2.0 * math.pi),
        sigma_azimuth_rad=min(math.sqrt(max(across, 0.0)), ANY_AZIMUTH_RAD),
        inclination_rad=-math.atan2(down, flat),
        sigma_inclination_rad=math.sqrt(max(up, 0.0)),
    )
