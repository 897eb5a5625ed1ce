"""Old surveys in a project: their shots as legs of the one adjustment, their fixed points in the project's grid."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.config import ConfigError
from buddyline.tools.survey.geodesy import utm_epsg
from buddyline.tools.survey.old.model import LEAST_M, OldShot, OldSurvey, StationName, merged
from buddyline.tools.survey.old.readers import read_old
from buddyline.tools.survey.old.systems import crs_of, map_system, moved
from buddyline.tools.survey.project import STATION_NAME, FixedPoint, Leg, Place, Project, Station
from msgspec import UNSET, structs

# 1 sd of an angle that nothing tells, degrees.
ANY_DEG: Final = 180.0
# Two fixed points of one station are the same within this, m, and so many sds.
SAME_M: Final = 0.02
SAME_SIGMAS: Final = 3.0


def read_project_files(project: Project, folder: Path) -> list[OldSurvey]:
    """Read a project's old surveys, each with its name before its stations; raise BuddylineError."""
    found: list[OldSurvey] = []
    names: set[str] = set()
    for one in project.old:
        name = one.name or name_of(Path(one.file))
        if not STATION_NAME.match(name):
            raise ConfigError(f"old.name {name!r} of {one.file}: is not 1 to 12 of A-Z a-z 0-9 _ -")
        if name in names:
            raise ConfigError(f"old.name {name!r}: two old surveys have it; name one of them otherwise")
        names.add(name)
        found.append(named(read_old(folder / one.file), name))
    return found


def name_of(path: Path) -> str:
    """Return a survey's name by its file's."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in path.stem)[:12]


def named(survey: OldSurvey, name: str) -> OldSurvey:
    """Return a survey with all stations below one survey of this name; as it is where they are already."""
    stations = [end for shot in survey.shots for end in (shot.start, shot.end) if end]
    if all(one.startswith(f"{name}.") for one in [*stations, *(fix.station for fix in survey.fixes)]):
        return survey

    def below(station: StationName) -> StationName:
        return f"{name}.{station}" if station else ""

    return OldSurvey(
        [replace(s, start=below(s.start), end=below(s.end), survey=(name, *s.survey)) for s in survey.shots],
        [
            replace(
                one,
                survey=(name, *one.survey),
                sections=tuple(replace(section, station=below(section.station)) for section in one.sections),
            )
            for one in survey.passages
        ],
        [tuple(map(below, same)) for same in survey.equates],
        [replace(fix, station=below(fix.station)) for fix in survey.fixes],
        [below(one) for one in survey.entrances],
        {(name, *path): notes for path, notes in survey.surveys.items()},
        {below(station): note for station, note in survey.station_notes.items()},
        survey.system,
        survey.left_out,
    )


def joined(project: Project, olds: Sequence[OldSurvey]) -> Project:
    """Return a project with its old surveys' legs and fixed points; raise ConfigError naming what does not fit."""
    if not olds:
        return project
    same_as = same_place(project, olds)
    stations = {name for leg in project.leg for name in (leg.from_, leg.to)}
    stations |= {name for old in olds for name in old.stations}
    for one in project.equate:
        for name in one.stations:
            if name not in stations:
                raise ConfigError(f"equate of {name!r}: no leg and no old survey has this station")
    legs = [
        structs.replace(leg, from_=same_as(leg.from_), to=same_as(leg.to))
        for leg in [*project.leg, *(leg for old in olds for leg in legs_of(old))]
    ]
    place, system = _place_in_system(project.place, olds)
    fixes = _fixed_points(project, olds, same_as, stations, system)
    names = {leg.name for leg in legs}
    for edit in project.edit:
        if edit.leg not in names:
            raise ConfigError(f"edit of leg {edit.leg!r}: no such leg, nor in the old surveys")
    lines = [structs.replace(one, from_=same_as(one.from_), to=same_as(one.to)) for one in project.known]
    points = [structs.replace(leg, from_=same_as(leg.from_)) for leg in project.point]
    stated = {station.name for station in project.station}
    depths = [
        structs.replace(one, name=same_as(one.name))
        for old in olds
        for one in depths_of(old)
        if same_as(one.name) not in stated
    ]
    return structs.replace(
        project, leg=legs, point=points, fix=fixes, known=lines, place=place, station=project.station + depths
    )


def _place_in_system(place: Place, olds: Sequence[OldSurvey]) -> tuple[Place, str]:
    """Return a project's place and its coordinate system: its own, or else that of its old surveys; "" for none."""
    system = next((name for old in olds if (name := map_system(old))), "")
    if system and place.epsg is UNSET and place.utm_zone is UNSET:
        code = crs_of(system).to_epsg()
        if code is not None:
            place = structs.replace(place, epsg=code)
    if place.utm_zone is not UNSET:
        return place, f"EPSG:{utm_epsg(place.utm_zone)}"
    return place, system if place.epsg is UNSET else f"EPSG:{place.epsg}"


def _fixed_points(
    project: Project,
    olds: Sequence[OldSurvey],
    same_as: Callable[[StationName], StationName],
    stations: Collection[StationName],
    system: str,
) -> list[FixedPoint]:
    """Return a project's fixed points, and those of its old surveys in this system; raise ConfigError."""
    fixes: dict[str, FixedPoint] = {
        same_as(fix.station): structs.replace(fix, station=same_as(fix.station)) for fix in project.fix
    }
    stated_here = set(fixes)
    placed: dict[StationName, tuple[tuple[float, float, float], tuple[float, float, float]]] = {}
    if len(fixes) < len(project.fix):
        raise ConfigError("fix: two of the stations are one place by [[equate]]; give one place, or their mean")
    if unknown := set(fixes) - {same_as(name) for name in stations}:
        raise ConfigError(f"fix of {min(unknown)!r}: no leg and no old survey has this station")
    for old in olds:
        for fix in old.fixes:
            station = same_as(fix.station)
            if station in stated_here:
                continue
            east_m, north_m = moved(fix, system) if system else fix.position[:2]
            here_m = east_m, north_m, fix.position[2]
            first_m, first_sigmas_m = placed.setdefault(station, (here_m, fix.sigmas_m))
            if station in fixes:
                apart_m = math.dist(here_m, first_m)
                if apart_m > SAME_M + SAME_SIGMAS * math.hypot(*fix.sigmas_m, *first_sigmas_m):
                    raise ConfigError(
                        f"{fix.place}: {fix.station} is fixed {apart_m:.2f} m from where the same station was fixed "
                        f"before; a [[fix]] of {station!r} in the project would decide"
                    )
                continue
            fixes[station] = FixedPoint(
                station=station,
                east_m=east_m,
                north_m=north_m,
                altitude_m=fix.position[2],
                sigma_m=max(fix.sigmas_m[:2]),
                altitude_sigma_m=fix.sigmas_m[2],
                entrance=fix.station in old.entrances,
            )
    return list(fixes.values())


def same_place(project: Project, olds: Sequence[OldSurvey]) -> Callable[[StationName], StationName]:
    """Return the name that stands for a station, of those that the project and old surveys say are one place."""
    stated = [tuple(one.stations) for one in project.equate]
    return merged([*stated, *(same for old in olds for same in old.equates)])


def legs_of(survey: OldSurvey) -> list[Leg]:
    """Return a survey's shots between stations as legs; splays to nameless ends and unmeasured ones are none."""
    return [leg_of(shot) for shot in survey.shots if shot.start and shot.end and shot.style != "nosurvey"]


def depths_of(survey: OldSurvey) -> list[Station]:
    """Return the stations whose depths are read with distances alone."""
    found: dict[StationName, Station] = {}
    for shot in survey.shots:
        if shot.depths_m is not None:
            for name, depth_m in zip((shot.start, shot.end), shot.depths_m, strict=True):
                found.setdefault(
                    name, Station(name=name, depth_m=depth_m, depth_sigma_m=shot.sigma("depth"), readings=1)
                )
    return list(found.values())


def leg_of(shot: OldShot) -> Leg:
    """Return a shot as a leg of the adjustment."""
    if shot.depths_m is not None:
        sigma_m = shot.sigma("depth")
        return _leg(
            shot,
            shot.tape_m,
            shot.sigma("tape"),
            depth_from_m=shot.depths_m[0],
            depth_from_sigma_m=sigma_m,
            depth_to_m=shot.depths_m[1],
            depth_to_sigma_m=sigma_m,
            turn_deg=0.0,
        )
    distance_m, azimuth_deg, slope_deg = shot.polar
    along_m, aside_m, across_m = shot.polar_sigmas
    distance_m = max(distance_m, LEAST_M)
    # As angles; of a plumbed leg the azimuth's sd is large, and its effect on the map the stated one.
    run_m = distance_m * abs(math.cos(math.radians(slope_deg)))
    north = shot.north
    stated = north.kind != "model" or shot.when is None
    return _leg(
        shot,
        distance_m,
        along_m,
        azimuth_deg=azimuth_deg,
        azimuth_sigma_deg=math.degrees(aside_m / run_m) if run_m else ANY_DEG,
        inclination_deg=slope_deg,
        inclination_sigma_deg=math.degrees(across_m / distance_m),
        **({"turn_deg" if north.kind == "grid" else "declination_deg": north.value_deg} if stated else {}),
    )


def _leg(shot: OldShot, distance_m: float, sigma_m: float, **readings: Any) -> Leg:
    """Return a leg without nodes and fixes, at noon of its day where that is known since 1970."""
    noon = None if shot.when is None else datetime(shot.when.year, shot.when.month, shot.when.day, 12, tzinfo=UTC)
    start_ns = 0 if noon is None else max(int(noon.timestamp()) * S_NS, 0)
    return Leg(
        from_=shot.start,
        to=shot.end,
        from_node="",
        to_node="",
        dive=0,
        start_ns=start_ns,
        end_ns=start_ns,
        distance_m=distance_m,
        distance_sigma_m=sigma_m,
        fixes=0,
        extend=shot.extend,
        note=f"{shot.place} {shot.note}".strip(),
        **readings,
    )
