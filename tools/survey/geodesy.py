"""Places: latitude and longitude, the projection of a map grid, its convergence, the declination of place and date."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from datetime import UTC, date, datetime
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.project import FixedPoint, Leg, Project
from msgspec import UNSET

if TYPE_CHECKING:
    from pyproj import Transformer

# WGS 84.
SEMI_MAJOR_M: Final = 6378137.0
FLATTENING: Final = 1 / 298.257223563
_E2: Final = FLATTENING * (2 - FLATTENING)
# Places are rounded to this for the World Magnetic Model: to a kilometre, in which it changes by 0.01 degrees.
MODEL_DIGITS: Final = 2
# No survey reaches so far from its place.
FAR_M: Final = 200e3
# Half the way by which a grid's north and scale are found.
STEP_M: Final = 10.0


@dataclass(frozen=True)
class Projection:
    """A projected coordinate system of the EPSG registry, in metres east and north. Needs pyproj."""

    epsg: int

    @cached_property
    def _transformer(self) -> Transformer:
        try:
            from pyproj import CRS, Transformer
            from pyproj.exceptions import CRSError
        except ModuleNotFoundError as error:
            raise BuddylineError("a map grid needs pyproj: make install EXTRAS=survey") from error
        try:
            crs = CRS.from_epsg(self.epsg)
        except CRSError as error:
            raise ConfigError(f"place.epsg {self.epsg}: the EPSG registry has no such coordinate system") from error
        units = {axis.unit_name for axis in crs.axis_info}
        if not crs.is_projected or units != {"metre"}:
            raise ConfigError(f"place.epsg {self.epsg}: {crs.name} is no map grid in metres")
        # Around a pole both axes point the same way.
        if "west" in (directions := [axis.direction for axis in crs.axis_info]):
            where = " and ".join(directions)
            raise ConfigError(f"place.epsg {self.epsg}: {crs.name} has axes to {where}: name a grid to east and north")
        return Transformer.from_crs("EPSG:4326", crs, always_xy=True)

    def metres(self, latitude_deg: float, longitude_deg: float) -> tuple[float, float]:
        """Return east and north, metres, of a place of WGS 84; raise BuddylineError outside of the grid."""
        east_m, north_m = self._transformer.transform(longitude_deg, latitude_deg)
        if not math.isfinite(east_m + north_m):
            raise BuddylineError(f"latitude {latitude_deg}, longitude {longitude_deg}: outside of EPSG:{self.epsg}")
        return east_m, north_m

    def degrees(self, east_m: float, north_m: float) -> tuple[float, float]:
        """Return latitude and longitude, WGS 84; raise BuddylineError outside of the grid."""
        back = partial(self._transformer.transform, direction="INVERSE")
        # PROJ may take another operation on the way back: what it errs by is taken off.
        there_m = self._transformer.transform(*back(east_m, north_m))
        longitude_deg, latitude_deg = back(2 * east_m - there_m[0], 2 * north_m - there_m[1])
        if not math.isfinite(longitude_deg + latitude_deg):
            raise BuddylineError(f"east {east_m} m, north {north_m} m: outside of EPSG:{self.epsg}")
        return latitude_deg, longitude_deg

    def convergence_rad(self, latitude_deg: float, longitude_deg: float) -> float:
        """Return the azimuth of grid north, east of true north positive."""
        return convergence_rad(self._transformer, latitude_deg, longitude_deg)

    def stretch(self, latitude_deg: float, longitude_deg: float) -> Floats:
        """Return how the grid deforms what is turned to its north, (2, 2): a scale alone, where it keeps angles."""
        angle = self.convergence_rad(latitude_deg, longitude_deg)
        turn = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
        return np.column_stack([_on_map(self._transformer, latitude_deg, longitude_deg, *axis) for axis in turn.T])


def convergence_rad(to_map: Transformer, latitude_deg: float, longitude_deg: float) -> float:
    """Return the azimuth of grid north, east of true north positive, by the grid's own coordinates.

    PROJ's factors err where the meridians of a grid are not counted from Greenwich.
    """
    east, north = _on_map(to_map, latitude_deg, longitude_deg, 0.0, 1.0)
    return -math.atan2(east, north)


def _on_map(to_map: Transformer, latitude_deg: float, longitude_deg: float, east: float, north: float) -> Floats:
    """Return the way on the map (2,) of a metre on the ellipsoid, by the place before and behind."""
    per_longitude_m, per_latitude_m = radii_m(latitude_deg)
    longer_deg, further_deg = (math.degrees(STEP_M * part) for part in (east / per_longitude_m, north / per_latitude_m))
    ahead, behind = (
        to_map.transform(longitude_deg + sign * longer_deg, latitude_deg + sign * further_deg) for sign in (1, -1)
    )
    return np.subtract(ahead, behind) / (2 * STEP_M)


def utm_epsg(zone: str) -> int:
    """Return the EPSG code of a UTM zone such as "32N", on WGS 84."""
    number = int(zone[:-1])
    if not 1 <= number <= 60:
        raise ConfigError(f"place.utm_zone {zone!r}: zones are 1 to 60")
    return (32600 if zone.endswith("N") else 32700) + number


def radii_m(latitude_deg: float) -> tuple[float, float]:
    """Return metres per radian of longitude and of latitude, at the ellipsoid."""
    sine = math.sin(math.radians(latitude_deg))
    prime_m = SEMI_MAJOR_M / math.sqrt(1 - _E2 * sine**2)
    return prime_m * math.cos(math.radians(latitude_deg)), prime_m * (1 - _E2) / (1 - _E2 * sine**2)


def survey_date(project: Project) -> date | None:
    """Return the stated date, or the first leg's (UTC)."""
    if project.survey.date is not UNSET:
        return project.survey.date
    moments = [leg.moment for leg in project.leg + project.point if leg.start_ns]
    return min(moments).date() if moments else None


def leg_date(project: Project, leg: Leg) -> date:
    """Return the date that the leg's dive states, or the leg's own (UTC)."""
    dive = project.dive[leg.dive - 1] if 1 <= leg.dive <= len(project.dive) else None
    return dive.date if dive is not None and dive.date is not UNSET else leg.moment.date()


@lru_cache(maxsize=4096)
def _model_declination_rad(latitude_deg: float, longitude_deg: float, when: date) -> float:
    from buddyline.node.geomagnetism import earth_field

    noon_ns = int(datetime(when.year, when.month, when.day, 12, tzinfo=UTC).timestamp()) * S_NS
    return earth_field(latitude_deg, longitude_deg, noon_ns).declination_rad


@dataclass(frozen=True)
class Declination:
    """The declination of magnetic north, east of true north positive. source: its origin, for the exports.

    stated_rad: the same everywhere, by the project. None: the World Magnetic Model's, for each leg's date and place.
    """

    source: str
    stated_rad: float | None

    def rad(self, place: tuple[float, float] | None, when: date) -> float:
        """Return it at a latitude and longitude, degrees."""
        if self.stated_rad is not None:
            return self.stated_rad
        if place is None:
            raise ValueError("the magnetic model needs a place")
        return _model_declination_rad(round(place[0], MODEL_DIGITS), round(place[1], MODEL_DIGITS), when)


def declination(project: Project) -> Declination | None:
    """Return the declination: stated, or the World Magnetic Model's for each leg's place and date. None: not known."""
    place = project.place
    if place.declination_deg is not UNSET:
        source = place.declination_source or "stated in the project"
        return Declination(source, math.radians(place.declination_deg))
    magnetic = [leg for leg in project.leg + project.point if leg.turn_deg is leg.declination_deg is UNSET]
    if not magnetic:
        read = any(leg.azimuth_deg is not UNSET or leg.back_azimuth_deg is not UNSET for leg in project.leg)
        return Declination("stated with the old surveys" if read else "no bearing was read", 0.0)
    where = _somewhere(project)
    if where is None:
        return None
    dates = sorted({leg_date(project, leg) for leg in magnetic})
    if not dates:
        return None
    when = f"{dates[0]}" if len(dates) == 1 else f"{dates[0]} to {dates[-1]}"
    from buddyline.node.geomagnetism import FIRST_MODEL, NEWEST_MODEL

    last = NEWEST_MODEL + 4
    outside = dates[0].year < FIRST_MODEL or dates[-1].year > last
    beyond = f", extrapolated: the models are of {FIRST_MODEL} to {last}" if outside else ""
    return Declination(f"World Magnetic Model, {where[0]:.4f} {where[1]:.4f}, {when}{beyond}", None)


def _projection(project: Project) -> Projection | None:
    place = project.place
    if place.utm_zone is not UNSET and place.epsg is not UNSET:
        raise ConfigError("place: give utm_zone or epsg, not both")
    if place.utm_zone is not UNSET:
        return Projection(utm_epsg(place.utm_zone))
    return None if place.epsg is UNSET else Projection(place.epsg)


def _somewhere(project: Project) -> tuple[float, float] | None:
    """Return the latitude and longitude of the place, or of the first fixed point that has one."""
    if project.place.degrees is not None:
        return project.place.degrees
    projection = _projection(project)
    for fix in project.fix:
        if fix.degrees is not None:
            return fix.degrees
        if projection is not None and fix.metres is not None:
            return projection.degrees(*fix.metres)
    return None


def _metres_from(origin: tuple[float, float], place: tuple[float, float]) -> tuple[float, float]:
    """Return how far east and north a place is of an origin near it, both latitude and longitude in degrees."""
    per_longitude_m, per_latitude_m = radii_m(origin[0])
    return (
        # Longitudes differ by less than half a turn, also where +180 and -180 degrees meet.
        math.radians(math.remainder(place[1] - origin[1], 360)) * per_longitude_m,
        math.radians(place[0] - origin[0]) * per_latitude_m,
    )


def _check_near(project: Project, projection: Projection) -> None:
    """Raise ConfigError for a fixed point in metres far from the stated place: exchanged, or of another grid."""
    place = project.place.degrees
    if place is None:
        return
    for fix in project.fix:
        if fix.metres is None:
            continue
        latitude_deg, longitude_deg = projection.degrees(*fix.metres)
        away_m = math.hypot(*_metres_from(place, (latitude_deg, longitude_deg)))
        if away_m > FAR_M:
            east_m, north_m = fix.metres
            raise ConfigError(
                f"fix of {fix.station!r}: east_m = {east_m:g}, north_m = {north_m:g} is at {latitude_deg:.3f}, "
                f"{longitude_deg:.3f} in EPSG:{projection.epsg}, {away_m / 1e3:.0f} km from [place]"
            )


@dataclass(frozen=True)
class Grid:
    """The survey's coordinates: those of a projection, or metres east and north (true, or magnetic) of an origin.

    Legs are as long on the map as on the ground: around `anchor`, the first fixed point, a projection's own scale
    counts for latitude and longitude alone, as cave programs have it. where: a latitude and longitude of the survey.
    north: the kind of the grid's north, in words. origin: latitude and longitude of east 0, north 0
    of a local grid; None if no place is known.
    """

    north: str
    declination: Declination | None = None
    where: tuple[float, float] | None = None
    projection: Projection | None = None
    origin: tuple[float, float] | None = None
    anchor_m: tuple[float, float] = field(default=(0.0, 0.0))

    def declination_rad(self, when: date, position_m: Floats | None = None) -> float:
        """Return the declination at a position (east, north, ...), or where the survey is; 0 if it is not known."""
        return 0.0 if self.declination is None else self.declination.rad(self._place(position_m), when)

    def convergence_rad(self, position_m: Floats | None = None) -> float:
        """Return the azimuth of grid north at a position (east, north, ...), or where the survey is."""
        place = self._place(position_m)
        return 0.0 if self.projection is None or place is None else self.projection.convergence_rad(*place)

    def turn_rad(self, when: date, position_m: Floats | None = None) -> float:
        """Return grid azimuth minus magnetic azimuth."""
        return self.declination_rad(when, position_m) - self.convergence_rad(position_m)

    def leg_turn_rad(self, leg: Leg, when: date, position_m: Floats | None = None) -> float:
        """Return grid azimuth minus the azimuth that a leg's readings have: stated with them, or magnetic."""
        if leg.turn_deg is not UNSET:
            return math.radians(leg.turn_deg)
        if leg.declination_deg is not UNSET:
            return math.radians(leg.declination_deg) - self.convergence_rad(position_m)
        return self.turn_rad(when, position_m)

    def _place(self, position_m: Floats | None) -> tuple[float, float] | None:
        return self.where if position_m is None else self.degrees(position_m) or self.where

    def degrees(self, position_m: Floats) -> tuple[float, float] | None:
        """Return latitude and longitude of a position (east, north, ...); None if no place is known."""
        east_m, north_m = float(position_m[0]), float(position_m[1])
        if self.projection is not None:
            at_m = self._stretch @ np.subtract((east_m, north_m), self.anchor_m) + self.anchor_m
            return self.projection.degrees(*at_m.tolist())
        if self.origin is None:
            return None
        per_longitude_m, per_latitude_m = radii_m(self.origin[0])
        return (
            self.origin[0] + math.degrees(north_m / per_latitude_m),
            math.remainder(self.origin[1] + math.degrees(east_m / per_longitude_m), 360),
        )

    @cached_property
    def _stretch(self) -> Floats:
        assert self.projection is not None
        return self.projection.stretch(*self.projection.degrees(*self.anchor_m))

    def position_m(self, fix: FixedPoint) -> tuple[float, float]:
        """Return east and north of a fixed point."""
        if fix.metres is not None:
            return fix.metres
        if fix.degrees is None:
            raise BuddylineError(f"fix of {fix.station!r}: no coordinates")
        if self.projection is not None:
            return self.projection.metres(*fix.degrees)
        if self.origin is None:
            return 0.0, 0.0
        return _metres_from(self.origin, fix.degrees)


def grid_of(project: Project) -> Grid:
    """Return the grid that a project's coordinates are in."""
    known = declination(project)
    projection = _projection(project)
    where = _somewhere(project)
    if projection is not None:
        if known is None or where is None:
            raise BuddylineError("place: a map grid needs a position and a declination as well, to turn to grid north")
        _check_near(project, projection)
        grid = Grid("grid", known, where, projection)
        anchor_m = grid.position_m(project.fix[0]) if project.fix else projection.metres(*where)
        return replace(grid, anchor_m=anchor_m)
    degrees = [fix.degrees for fix in project.fix if fix.degrees is not None]
    if degrees and len(degrees) < len(project.fix):
        raise BuddylineError("fix: some in metres, some in degrees; name place.utm_zone or epsg, or use one of them")
    if known is None:
        # Without a declination the map would be rotated by an unknown angle.
        return Grid("magnetic")
    return Grid("true", known, where, origin=degrees[0] if degrees else None if project.fix else where)
