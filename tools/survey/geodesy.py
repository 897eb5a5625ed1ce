"""Places: latitude and longitude, the grid of a UTM zone, its convergence, the declination there and then."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Final

import numpy as np
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
_RECTIFYING_M: Final = SEMI_MAJOR_M / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64)
# Krueger's series to the third power of n: below a millimetre within a zone (Karney 2011, Eqs. 35 and 36).
_ALPHA: Final = (
    _N / 2 - 2 * _N**2 / 3 + 5 * _N**3 / 16,
    13 * _N**2 / 48 - 3 * _N**3 / 5,
    61 * _N**3 / 240,
)
_BETA: Final = (
    _N / 2 - 2 * _N**2 / 3 + 37 * _N**3 / 96,
    _N**2 / 48 + _N**3 / 15,
    17 * _N**3 / 480,
)


def zone_meridian_rad(zone: str) -> float:
    """Return the central meridian of a UTM zone such as "32N"."""
    return math.radians(6 * int(zone[:-1]) - 183)


def to_utm(latitude_deg: float, longitude_deg: float, zone: str) -> tuple[float, float]:
    """Return east and north, metres."""
    xi, eta = _gauss_schreiber(latitude_deg, longitude_deg, zone)
    z = complex(xi, eta)
    z += sum(a * np.sin(2 * k * z) for k, a in enumerate(_ALPHA, 1))
    north_m = UTM_SCALE * _RECTIFYING_M * z.real + (FALSE_NORTH_SOUTHERN_M if zone.endswith("S") else 0.0)
    return FALSE_EAST_M + UTM_SCALE * _RECTIFYING_M * z.imag, north_m


def from_utm(east_m: float, north_m: float, zone: str) -> tuple[float, float]:
    """Return latitude and longitude, degrees."""
    north_m -= FALSE_NORTH_SOUTHERN_M if zone.endswith("S") else 0.0
    z = complex(north_m, east_m - FALSE_EAST_M) / (UTM_SCALE * _RECTIFYING_M)
    z -= sum(b * np.sin(2 * k * z) for k, b in enumerate(_BETA, 1))
    conformal = math.sin(z.real) / math.hypot(math.sinh(z.imag), math.cos(z.real))
    longitude = zone_meridian_rad(zone) + math.atan2(math.sinh(z.imag), math.cos(z.real))
    tangent = conformal
    e = _eccentricity()
    for _ in range(6):
        sigma = math.sinh(e * math.atanh(e * tangent / math.hypot(1, tangent)))
        residual = tangent * math.hypot(1, sigma) - sigma * math.hypot(1, tangent) - conformal
        slope = (1 - e * e) * math.hypot(1, tangent) * math.hypot(1, conformal) / (1 + (1 - e * e) * tangent**2)
        tangent -= residual / slope
    return math.degrees(math.atan(tangent)), math.degrees(longitude)


def convergence_rad(latitude_deg: float, longitude_deg: float, zone: str) -> float:
    """Return the azimuth of grid north, east of true north positive, by a step of the projection itself."""
    step_deg = 1e-5
    low = to_utm(latitude_deg - step_deg, longitude_deg, zone)
    high = to_utm(latitude_deg + step_deg, longitude_deg, zone)
    return math.atan2(-(high[0] - low[0]), high[1] - low[1])


def _eccentricity() -> float:
    return math.sqrt(FLATTENING * (2 - FLATTENING))


def _gauss_schreiber(latitude_deg: float, longitude_deg: float, zone: str) -> tuple[float, float]:
    e, tangent = _eccentricity(), math.tan(math.radians(latitude_deg))
    sigma = math.sinh(e * math.atanh(e * tangent / math.hypot(1, tangent)))
    conformal = tangent * math.hypot(1, sigma) - sigma * math.hypot(1, tangent)
    away = math.radians(longitude_deg) - zone_meridian_rad(zone)
    return math.atan2(conformal, math.cos(away)), math.asinh(math.sin(away) / math.hypot(conformal, math.cos(away)))


def radii_m(latitude_deg: float) -> tuple[float, float]:
    """Return metres per radian of longitude and of latitude, at the ellipsoid."""
    e2, sine = FLATTENING * (2 - FLATTENING), math.sin(math.radians(latitude_deg))
    prime_m = SEMI_MAJOR_M / math.sqrt(1 - e2 * sine**2)
    return prime_m * math.cos(math.radians(latitude_deg)), prime_m * (1 - e2) / (1 - e2 * sine**2)


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

    noon_ns = int(datetime(when.year, when.month, when.day, 12, tzinfo=UTC).timestamp()) * 1_000_000_000
    field = earth_field(*where, noon_ns)
    return Declination(field.declination_rad, f"World Magnetic Model, {where[0]:.4f} {where[1]:.4f}, {when}")


def _somewhere(project: Project) -> tuple[float, float] | None:
    place = project.place
    if place.latitude_deg is not UNSET and place.longitude_deg is not UNSET:
        return place.latitude_deg, place.longitude_deg
    for fix in project.fix:
        if fix.latitude_deg is not UNSET and fix.longitude_deg is not UNSET:
            return fix.latitude_deg, fix.longitude_deg
        if place.utm_zone is not UNSET and fix.east_m is not UNSET and fix.north_m is not UNSET:
            return from_utm(fix.east_m, fix.north_m, place.utm_zone)
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
        if self.zone is not None:
            return from_utm(float(position_m[0]), float(position_m[1]), self.zone)
        if self.origin is None:
            return None
        per_longitude_m, per_latitude_m = radii_m(self.origin[0])
        return (
            self.origin[0] + math.degrees(float(position_m[1]) / per_latitude_m),
            self.origin[1] + math.degrees(float(position_m[0]) / per_longitude_m),
        )

    def position_m(self, fix: FixedPoint) -> tuple[float, float]:
        """Return east and north of a fixed point."""
        if fix.east_m is not UNSET and fix.north_m is not UNSET:
            return fix.east_m, fix.north_m
        if fix.latitude_deg is UNSET or fix.longitude_deg is UNSET:
            raise BuddylineError(f"fix of {fix.station!r}: no coordinates")
        if self.zone is not None:
            return to_utm(fix.latitude_deg, fix.longitude_deg, self.zone)
        if self.origin is None:
            return 0.0, 0.0
        per_longitude_m, per_latitude_m = radii_m(self.origin[0])
        return (
            math.radians(fix.longitude_deg - self.origin[1]) * per_longitude_m,
            math.radians(fix.latitude_deg - self.origin[0]) * per_latitude_m,
        )


def grid_of(project: Project) -> Grid:
    """Return the grid that a project's coordinates are in."""
    known = declination(project)
    zone = project.place.utm_zone if project.place.utm_zone is not UNSET else None
    if zone is not None:
        where = _somewhere(project)
        if known is None or where is None:
            raise BuddylineError("place.utm_zone: needs a position and a declination as well, to turn to grid north")
        return Grid(known.rad - convergence_rad(*where, zone), "grid", zone, None)
    degrees = [fix for fix in project.fix if fix.latitude_deg is not UNSET]
    metres = [fix for fix in project.fix if fix.east_m is not UNSET]
    if degrees and metres:
        raise BuddylineError("fix: some in metres, some in degrees; name place.utm_zone, or use one of them")
    first = degrees[0] if degrees else None
    origin = None
    if first is not None and first.latitude_deg is not UNSET and first.longitude_deg is not UNSET:
        origin = first.latitude_deg, first.longitude_deg
    elif not project.fix:
        origin = _somewhere(project)
    if known is None:
        # Without a declination the map would be turned by an unknown angle.
        return Grid(0.0, "magnetic", None, None)
    return Grid(known.rad, "true", None, origin)
