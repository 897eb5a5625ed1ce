"""One shot: all fixes while both nodes rest, as distance, sights both ways and depths, with honest sigmas."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from buddyline.tools.survey.averages import Bools, Floats, Mean, inliers, mean_of_slow, mean_of_white, unwrapped
from buddyline.tools.survey.magnetism import Field, field_of
from buddyline.tools.survey.readings import Node, Readings
from buddyline.tools.survey.settings import SurveySettings
from buddyline.tools.survey.sights import Sights
from numpy.typing import NDArray


@dataclass(frozen=True)
class Sight:
    """What one node's own attitude says of the line to the other: radians; azimuth magnetic, inclination up."""

    azimuth: Mean
    inclination: Mean


@dataclass(frozen=True, eq=False)
class Shot:
    """Line between A's station and B's, each way as that node read it. None: not measured.

    used, unused: triggers. range_spread: chi of the fixes' ranges against what they state. heading_gap_rad: B's
    compass minus A's, as they see each other.
    """

    start_ns: int
    end_ns: int
    distance: Mean
    sight_a: Sight | None
    sight_b: Sight | None
    depth_a: Mean | None
    depth_b: Mean | None
    field_a: Field | None
    field_b: Field | None
    range_spread: float
    heading_gap_rad: float | None
    used: NDArray[np.int64]
    unused: dict[str, list[int]] = field(default_factory=dict)


def shoot(
    readings: Readings,
    seen: Sights,
    chosen: Bools,
    settings: SurveySettings,
    unused: dict[str, list[int]] | None = None,
) -> Shot:
    """Average the chosen fixes, (n,) of the dive's, of which there is at least one.

    unused: triggers left out before, by reason. Fixes off the others in range or direction are left out here.
    """
    unused = dict(unused or {})
    index = np.flatnonzero(chosen)
    spread = np.column_stack([seen.range_m[index], _known(seen.line_m[index])])
    least = float(np.median(seen.across_sigma_m[index])) + settings.centering_m
    kept = inliers(spread, least)
    if not kept.all():
        unused["outlier"] = sorted({*unused.get("outlier", []), *seen.triggers[index[~kept]].tolist()})
    index = index[kept]
    stamps_s = (seen.stamps_ns[index] - seen.stamps_ns[index[0]]) / 1e9
    range_m = seen.range_m[index]
    start_ns, end_ns = int(seen.stamps_ns[index[0]]), int(seen.stamps_ns[index[-1]])
    # Both ends are held only so well; a fraction of the range is the calibration's.
    held_m = math.sqrt(2) * settings.centering_m
    along_m = float(np.median(seen.along_sigma_m[index]))
    floor_m = math.hypot(held_m, settings.range_share * float(range_m.mean()))
    gaps = seen.heading_gap_rad[index]
    gaps = gaps[~np.isnan(gaps)]
    return Shot(
        start_ns=start_ns,
        end_ns=end_ns,
        distance=mean_of_white(stamps_s, range_m, along_m, floor_m),
        sight_a=_sight(seen, index, seen.line_a_m, seen.sigma_a_rad, 1.0, settings),
        sight_b=_sight(seen, index, seen.line_b_m, seen.sigma_b_rad, -1.0, settings),
        depth_a=_depth(readings.a, seen.port_a_m[index], start_ns, end_ns, settings),
        depth_b=_depth(readings.b, seen.port_b_m[index], start_ns, end_ns, settings),
        field_a=field_of(readings.a, start_ns, end_ns),
        field_b=field_of(readings.b, start_ns, end_ns),
        range_spread=float(range_m.std(ddof=1)) / max(along_m, 1e-4) if len(index) > 2 else 0.0,
        heading_gap_rad=float(unwrapped(gaps).mean()) if len(gaps) else None,
        used=seen.triggers[index],
        unused=unused,
    )


def _known(line_m: Floats) -> Floats:
    """Give lines without any attitude as zeros: then their range alone tells outliers."""
    return np.nan_to_num(line_m)


def _sight(
    seen: Sights, index: NDArray[np.intp], lines_m: Floats, sigmas_rad: Floats, sign: float, settings: SurveySettings
) -> Sight | None:
    known = index[~np.isnan(lines_m[index]).any(axis=1)]
    if not len(known):
        return None
    line_m = sign * lines_m[known]
    flat_m = np.hypot(line_m[:, 0], line_m[:, 1])
    stamps_s = (seen.stamps_ns[known] - seen.stamps_ns[known[0]]) / 1e9
    azimuth = unwrapped(np.arctan2(line_m[:, 1], line_m[:, 0]))
    inclination = np.arctan2(-line_m[:, 2], flat_m)
    range_m = float(seen.range_m[known].mean())
    run_m = max(float(flat_m.mean()), 1e-3)
    across_m = float(np.median(seen.across_sigma_m[known]))
    tilt_rad = float(np.median(sigmas_rad[known][:, :2]))
    yaw_rad = float(np.median(sigmas_rad[known][:, 2]))
    held_m = math.sqrt(2) * settings.centering_m
    azimuth_mean = mean_of_slow(
        stamps_s,
        azimuth,
        math.hypot(yaw_rad, across_m / run_m),
        math.hypot(math.radians(settings.compass_floor_deg), held_m / run_m),
    )
    inclination_mean = mean_of_slow(
        stamps_s,
        inclination,
        math.hypot(tilt_rad, across_m / range_m),
        math.hypot(math.radians(settings.tilt_floor_deg), held_m / range_m),
    )
    return Sight(replace(azimuth_mean, value=azimuth_mean.value % (2 * math.pi)), inclination_mean)


def _depth(node: Node, below_port_m: Floats, start_ns: int, end_ns: int, settings: SurveySettings) -> Mean | None:
    part = node.between(node.depth_ns, start_ns, end_ns)
    depth_m = node.depth_m[part]
    known = below_port_m[~np.isnan(below_port_m)]
    if not len(depth_m) or (not len(known) and any(node.info.depth_port_m)):
        return None
    kept = inliers(depth_m, settings.depth_floor_m)
    below_m = float(known.mean()) if len(known) else 0.0
    mean = mean_of_slow(
        (node.depth_ns[part][kept] - start_ns) / 1e9,
        depth_m[kept],
        float(np.median(node.depth_sigma_m[part])),
        math.hypot(settings.depth_floor_m, settings.centering_m),
    )
    return replace(mean, value=mean.value + below_m)
