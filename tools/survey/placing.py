"""First places of stations, from which an adjustment is searched: along the legs, or from distances alone."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from itertools import combinations
from typing import Final

import numpy as np
from buddyline.tools.survey.averages import Floats, wrap
from buddyline.tools.survey.lines import TURNED_RAD, is_steep
from buddyline.tools.survey.project import Leg, Project
from msgspec import UNSET

# Two distances to a station meet at two places; a third one chooses, if they are this far apart for it.
CLEAR_M: Final = 0.3


def place_all(
    project: Project,
    legs: Sequence[Leg],
    ends: Sequence[tuple[str, str]],
    steps: Sequence[Floats | None],
    fixed: dict[str, Floats],
) -> tuple[dict[str, Floats], list[str], tuple[str, str] | None]:
    """Return places of stations (east, north, up, m), why a leg has none ("": it has), and the line that gives north.

    steps: the legs' vectors, see step_m_of. fixed: places to begin with. The last is None where directions were read;
    else north is arbitrary: along that line.
    """
    touching: dict[str, list[tuple[str, Floats]]] = {}
    ranges: dict[str, list[tuple[str, float, float]]] = {}
    for leg, (start, end), step_m in zip(legs, ends, steps, strict=True):
        if step_m is not None:
            touching.setdefault(start, []).append((end, step_m))
            touching.setdefault(end, []).append((start, -step_m))
        elif (rise_m := _rise_m(leg)) is not None and (abs(rise_m) < leg.distance_m or not _has_bearing(leg)):
            run_m = math.sqrt(max(leg.distance_m**2 - rise_m**2, 0.0))
            ranges.setdefault(start, []).append((end, run_m, rise_m))
            ranges.setdefault(end, []).append((start, run_m, -rise_m))
    known = {(one.from_, one.to) for one in project.known if one.azimuth_deg is not UNSET}
    placed = dict(fixed)
    along = None
    _walk(placed, touching, deque(fixed))
    if not touching and ranges and len(fixed) == 1 and not known:
        start = next(iter(fixed))
        # A plumbed line has no direction on the map.
        level = [one for one in ranges.get(start, ()) if one[1] > CLEAR_M]
        if level:
            other, run_m, rise_m = level[0]
            along = start, other
            placed[other] = placed[start] + (0.0, run_m, rise_m)
    mirrored = along is not None
    while (found := _trilaterated(placed, ranges, mirrored=mirrored)) is not None:
        name, placed[name] = found
        mirrored = False
        _walk(placed, touching, deque([name]))
    why = []
    for (start, end), step_m, leg in zip(ends, steps, legs, strict=True):
        lost = start not in placed or end not in placed
        lost_by = "not connected to a fixed point" if step_m is not None else _no_direction(leg)
        why.append(lost_by if lost else "")
    return placed, why, along


def _has_bearing(leg: Leg) -> bool:
    return leg.azimuth_deg is not UNSET or leg.back_azimuth_deg is not UNSET


def _no_direction(leg: Leg) -> str:
    if not _has_bearing(leg):
        return "no bearing, and too few distances to place its station"
    return "no bearing, or no slope that its distance allows"


def _walk(placed: dict[str, Floats], touching: dict[str, list[tuple[str, Floats]]], queue: deque[str]) -> None:
    while queue:
        name = queue.popleft()
        for other, step_m in touching.get(name, ()):
            if other not in placed:
                placed[other] = placed[name] + step_m
                queue.append(other)


def _rise_m(leg: Leg) -> float | None:
    if leg.depth_from_m is not UNSET and leg.depth_to_m is not UNSET:
        return leg.depth_from_m - leg.depth_to_m
    return None


def step_m_of(leg: Leg, turn_rad: float) -> Floats | None:
    """Return a leg's vector as read; None without a bearing, or without a rise that its distance allows."""
    fore, back = leg.azimuth_deg, leg.back_azimuth_deg
    if fore is UNSET and back is UNSET:
        return None
    if fore is UNSET:
        angle = math.radians(float(back)) + math.pi  # type: ignore[arg-type]
    else:
        angle = math.radians(fore)
        if back is not UNSET and leg.from_node in leg.disturbed and leg.to_node not in leg.disturbed:
            angle = math.radians(back) + math.pi
        elif back is not UNSET and leg.to_node not in leg.disturbed:
            gap = wrap(math.radians(back) + math.pi - angle)
            angle += 0.5 * gap if abs(gap) < TURNED_RAD else 0.0
    rise_m = _rise_m(leg)
    slopes = [
        sign * math.radians(one)
        for one, sign in ((leg.inclination_deg, 1.0), (leg.back_inclination_deg, -1.0))
        if one is not UNSET
    ]
    if slopes and is_steep(leg):
        slope = sum(slopes) / len(slopes)
        run_m, rise_m = leg.distance_m * math.cos(slope), leg.distance_m * math.sin(slope)
    elif rise_m is not None and abs(rise_m) < leg.distance_m:
        run_m = math.sqrt(leg.distance_m**2 - rise_m**2)
    else:
        return None
    azimuth = angle + turn_rad
    return np.array([run_m * math.sin(azimuth), run_m * math.cos(azimuth), rise_m])


def _trilaterated(
    placed: dict[str, Floats], ranges: dict[str, list[tuple[str, float, float]]], *, mirrored: bool
) -> tuple[str, Floats] | None:
    """Return the next station that distances place; mirrored: of the first, either side will do."""
    for name, seen in ranges.items():
        known = [(placed[other], run_m, rise_m) for other, run_m, rise_m in seen if other in placed]
        if name in placed or len(known) < (2 if mirrored else 3):
            continue
        best = None
        for one, other in combinations(known, 2):
            for place_m in _meeting(one, other):
                off_m = sum(abs(math.dist(place_m[:2], there[:2]) - run_m) for there, run_m, _ in known)
                if best is None or off_m < best[0]:
                    best = off_m, place_m
        if best is not None:
            return name, best[1]
    return None


def _meeting(one: tuple[Floats, float, float], other: tuple[Floats, float, float]) -> list[Floats]:
    """Return the two places at these distances on the map from two known places."""
    (there, run_m, rise_m), (over, other_m, _) = one, other
    away = over[:2] - there[:2]
    apart_m = float(np.hypot(*away))
    if apart_m < CLEAR_M:
        return []
    along_m = (apart_m**2 + run_m**2 - other_m**2) / (2 * apart_m)
    aside_m = math.sqrt(max(run_m**2 - along_m**2, 0.0))
    unit = away / apart_m
    left = np.array([-unit[1], unit[0]])
    up_m = there[2] - rise_m
    return [np.array([*(there[:2] + along_m * unit + side * aside_m * left), up_m]) for side in (1.0, -1.0)]
