"""Places: latitude and longitude, the grid of a UTM zone, its convergence, the declination there and then."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.project import FixedPoint, Project
from msgspec import UNSET

# WGS 84.
SEMI_MAJOR_M: Final = 6378137.0
FLATTENING: Final = 1 / 298.257223563
UTM_SCALE: Final = 0.9996
FALSE_EAST_M: Final = 500_000.0
FALSE_NORTH_SOUTHERN_M: Final = 10_000_000.0

_N: Final = FLATTENING / (2 - FLATTENING)
_SCALE_M: Final = UTM_SCALE * SEMI_MAJOR_M / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
# Krueger's series to the third power of n: below a millimetre within a zone (Karney 2011, Eq. 35).
_ALPHA: Final = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16,
    13 * _N**2 / 48 - 3 * _N**3 / 5,
    61 * _N**3 / 240,
)
_E2: Final = FLATTENING * (2 - FLATTENING)
_E: Final = math.sqrt(_E2)
# Each step of the inverse is right to the grid's convergence, a tenth at the very worst.
_INVERSE_STEPS: Final = 20


def zone_meridian_rad(zone: str) -> float:
    """Return the central meridian of a UTM zone such as "32N"."""
    return math.radians(6 * int(zone[:-1]) - 183)


def to_utm(latitude_deg: float, longitude_deg: float, zone: str) -> tuple[float, float]:
    """Return east and north, metres."""
    tangent = math.tan(math.radians(latitude_deg))
    sigma = math.sinh(_E * math.atanh(_E * tangent / math.hypot(1, tangent)))
    conformal = tangent * math.hypot(1, sigma) - sigma * math.hypot(1, tangent)
    away = math.radians(longitude_deg) - zone_meridian_rad(zone)
    eta = math.asinh(math.sin(away) / math.hypot(conformal, math.cos(away)))
    z = complex(math.atan2(conformal, math.cos(away)), eta)
    z += sum(alpha * cmath.sin(2 * k * z) for k, alpha in enumerate(_ALPHA, 1))
    false_north_m = FALSE_NORTH_SOUTHERN_M if zone.endswith("S") else 0.0
    return FALSE_EAST_M + _SCALE_M * z.imag, false_north_m + _SCALE_M * z.real


def from_utm(east_m: float, north_m: float, zone: str) -> tuple[float, float]:
    """Return latitude and longitude, degrees, by going towards the point until the projection meets it."""
    latitude_deg, longitude_deg = 0.0, math.degrees(zone_meridian_rad(zone))
    for _ in range(_INVERSE_STEPS):
        east_now_m, north_now_m = to_utm(latitude_deg, longitude_deg, zone)
        per_longitude_m, per_latitude_m = radii_m(latitude_deg)
        latitude_deg += math.degrees((north_m - north_now_m) / (UTM_SCALE * per_latitude_m))
        longitude_deg += math.degrees((east_m - east_now_m) / (UTM_SCALE * per_longitude_m))
    return latitude_deg, longitude_deg


def convergence_rad(latitude_deg: float, longitude_deg: float, zone: str) -> float:
    """Return the azimuth of grid north, east of true north positive, by a step of the projection itself."""
    step_deg = 1e-5
    low = to_utm(latitude_deg - step_deg, longitude_deg, zone)
    high = to_utm(latitude_deg + step_deg, longitude_deg, zone)
    return math.atan2(-(high[0] - low[0]), high[1] - low[1])


def radii_m(latitude_deg: float) -> tuple[float, float]:
    """Return metres per radian of longitude and of latitude, at the ellipsoid."""
    sine = math.sin(math.radians(latitude_deg))
    prime_m = SEMI_MAJOR_M / math.sqrt(1 - _E2 * sine**2)
    return prime_m * math.cos(math.radians(latitude_deg)), prime_m * (1 - _E2) / (1 - _E2 * sine**2)


@dataclass(frozen=True)
class Declination:
    """Of magnetic north, east of true north positive; source: where it comes from, for the exports."""

    rad: float
    source: str


def survey_date(project: Project) -> date | None:
    """Return the stated date, or the first leg's (UTC)."""
    if project.survey.date is not UNSET:
        return project.survey.date
    moments = [leg.moment for leg in project.leg + project.point]
    return min(moments).date() if moments else None


def declination(project: Project) -> Declination | None:
    """Return the declination: stated, or the World Magnetic Model's for place and date. None: not known."""
    place = project.place
    if place.declination_deg is not UNSET:
        return Declination(math.radians(place.declination_deg), place.declination_source or "stated in the project")
    where, when = _somewhere(project), survey_date(project)
    if where is None or when is None:
        return None
    from buddyline.node.geomagnetism import earth_field

    noon_ns = int(datetime(when.year, when.month, when.day, 12, tzinfo=UTC).timestamp()) * S_NS
    field = earth_field(*where, noon_ns)
    return Declination(field.declination_rad, f"World Magnetic Model, {where[0]:.4f} {where[1]:.4f}, {when}")


def _somewhere(project: Project) -> tuple[float, float] | None:
    """Return the latitude and longitude of the place, or of the first fixed point that has one."""
    if project.place.degrees is not None:
        return project.place.degrees
    zone = project.place.utm_zone
    for fix in project.fix:
        if fix.degrees is not None:
            return fix.degrees
        if zone is not UNSET and fix.metres is not None:
            return from_utm(*fix.metres, zone)
    return None


@dataclass(frozen=True)
class Grid:
    """The survey's coordinates: a UTM zone, or metres east and north (true, or magnetic) of an origin.

    to_grid_rad: grid azimuth minus magnetic. north: what the grid's north is. origin: latitude and longitude of
    east 0, north 0 of a local grid; None where no place is known.
    """

    to_grid_rad: float
    north: str
    zone: str | None
    origin: tuple[float, float] | None

    def degrees(self, position_m: Floats) -> tuple[float, float] | None:
        """Return latitude and longitude of a position (east, north, ...); None where no place is known."""
        east_m, north_m = float(position_m[0]), float(position_m[1])
        if self.zone is not None:
            return from_utm(east_m, north_m, self.zone)
        if self.origin is None:
            return None
        per_longitude_m, per_latitude_m = radii_m(self.origin[0])
        return (
            self.origin[0] + math.degrees(north_m / per_latitude_m),
            self.origin[1] + math.degrees(east_m / per_longitude_m),
        )

    def position_m(self, fix: FixedPoint) -> tuple[float, float]:
        """Return east and north of a fixed point."""
        if fix.metres is not None:
            return fix.metres
        if fix.degrees is None:
            raise BuddylineError(f"fix of {fix.station!r}: no coordinates")
        if self.zone is not None:
            return to_utm(*fix.degrees, self.zone)
        if self.origin is None:
            return 0.0, 0.0
        per_longitude_m, per_latitude_m = radii_m(self.origin[0])
        return (
            math.radians(fix.degrees[1] - self.origin[1]) * per_longitude_m,
            math.radians(fix.degrees[0] - self.origin[0]) * per_latitude_m,
        )


def grid_of(project: Project) -> Grid:
    """Return the grid that a project's coordinates are in."""
    known = declination(project)
    zone = project.place.utm_zone
    where = _somewhere(project)
    if zone is not UNSET:
        if known is None or where is None:
            raise BuddylineError("place.utm_zone: needs a position and a declination as well, to turn to grid north")
        return Grid(known.rad - convergence_rad(*where, zone), "grid", zone, None)
    degrees = [fix.degrees for fix in project.fix if fix.degrees is not None]
    if degrees and len(degrees) < len(project.fix):
        raise BuddylineError("fix: some in metres, some in degrees; name place.utm_zone, or use one of them")
    if known is None:
        # Without a declination the map would be turned by an unknown angle.
        return Grid(0.0, "magnetic", None, None)
    return Grid(known.rad, "true", None, degrees[0] if degrees else None if project.fix else where)
