"""The place of the reference on Earth, and a vehicle's place by it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

from buddyline.protocol.errors import BuddylineError
from buddyline.tools.bridge.placed import Placed
from buddyline.tools.survey.geodesy import radii_m

# A boat's place that is older than this is not used.
BOAT_STALE_NS: Final = 5_000_000_000


@dataclass(frozen=True)
class GeoPoint:
    """Latitude and longitude, WGS 84, degrees. sigma_m: its own uncertainty, per axis."""

    latitude_deg: float
    longitude_deg: float
    sigma_m: float = 0.0

    def moved(self, north_m: float, east_m: float) -> tuple[float, float]:
        """Return latitude and longitude, degrees, so far from here (plane, to a few kilometres)."""
        of_longitude_m, of_latitude_m = radii_m(self.latitude_deg)
        latitude_deg = self.latitude_deg + math.degrees(north_m / of_latitude_m)
        longitude_deg = self.longitude_deg + math.degrees(east_m / of_longitude_m)
        return latitude_deg, (longitude_deg + 180.0) % 360.0 - 180.0


@dataclass(frozen=True)
class OnEarth:
    """A vehicle on Earth. altitude_m: above the surface, so under water negative; sigmas with the reference's own."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    sigma_north_m: float
    sigma_east_m: float
    sigma_down_m: float

    @property
    def horizontal_m(self) -> float:
        """Horizontal uncertainty, 1 sd, of both axes together."""
        return math.hypot(self.sigma_north_m, self.sigma_east_m)


def on_earth(placed: Placed, place: GeoPoint) -> OnEarth:
    """Return where on Earth a vehicle is. Its altitude is minus its depth, by its gauge if it has one."""
    north_m, east_m, down_m = placed.p_ned_m.tolist()
    latitude_deg, longitude_deg = place.moved(north_m, east_m)
    variances = [max(float(placed.covariance[i, i]), 0.0) for i in range(3)]
    return OnEarth(
        latitude_deg=latitude_deg,
        longitude_deg=longitude_deg,
        altitude_m=-(down_m if placed.depth_m is None else placed.depth_m),
        sigma_north_m=math.sqrt(variances[0] + place.sigma_m**2),
        sigma_east_m=math.sqrt(variances[1] + place.sigma_m**2),
        sigma_down_m=math.sqrt(variances[2]),
    )


def parse_place(text: str) -> GeoPoint:
    """Return the place of `LAT,LON` in degrees; raise BuddylineError otherwise."""
    try:
        latitude_deg, longitude_deg = (float(part) for part in text.split(","))
    except ValueError:
        latitude_deg = longitude_deg = math.nan
    if not (-90.0 < latitude_deg < 90.0 and -180.0 <= longitude_deg <= 180.0):
        raise BuddylineError(f"--place {text}: give LAT,LON in degrees, such as 47.123456,9.654321")
    return GeoPoint(latitude_deg, longitude_deg)
