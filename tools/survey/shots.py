"""One shot: all fixes of a rest, averaged to distance, sights both ways and depths, with realistic sigmas."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.tools.survey.averages import (
    Bools,
    Floats,
    Ints,
    Mean,
    inliers,
    mean_of_slow,
    mean_of_white,
    unwrapped,
)
from buddyline.tools.survey.magnetism import Field, field_of
from buddyline.tools.survey.readings import NodeReadings, PairReadings
from buddyline.tools.survey.settings import SurveySettings
from buddyline.tools.survey.sights import Sights
from numpy.typing import NDArray

# Sensors are averaged over this time on either side of a single fix.
BESIDE_NS: Final = 500_000_000


@dataclass(frozen=True)
class End:
    """One node's own measurements of a shot; None: not measured.

    azimuth (magnetic) and inclination (up): of the line to the other node, radians; both are known, or neither.
    """

    node: str
    azimuth: Mean | None
    inclination: Mean | None
    depth: Mean | None
    field: Field | None


@dataclass(frozen=True, eq=False)
class Shot:
    """The line between a's station and b's. ends: a's and b's.

    used, unused: triggers. range_spread: chi of the fixes' ranges against their stated sigma. heading_gap_rad: b's
    compass minus a's, as they see each other.
    """

    start_ns: int
    end_ns: int
    distance: Mean
    ends: tuple[End, End]
    range_spread: float
    heading_gap_rad: float | None
    used: Ints
    unused: dict[str, list[int]]


def shoot(
    readings: PairReadings,
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
    # Lines without any attitude are zeros, so that only their range shows outliers.
    spread = np.column_stack([seen.range_m[index], np.nan_to_num(seen.line_m[index])])
    kept = inliers(spread, float(np.median(seen.across_sigma_m[index])) + settings.centering_m)
    if not kept.all():
        unused["outlier"] = sorted({*unused.get("outlier", []), *seen.triggers[index[~kept]].tolist()})
    index = index[kept]
    range_m = seen.range_m[index]
    start_ns, end_ns = int(seen.stamps_ns[index[0]]), int(seen.stamps_ns[index[-1]])
    # Each end is held with the sigma centering_m; the calibration adds a share of the range.
    floor_m = math.hypot(math.sqrt(2) * settings.centering_m, settings.range_share * float(range_m.mean()))
    along_m = float(np.median(seen.along_sigma_m[index]))
    gaps = seen.heading_gap_rad[index]
    gaps = gaps[~np.isnan(gaps)]

    beside_ns = BESIDE_NS if len(index) == 1 else 0
    span_ns = start_ns - beside_ns, end_ns + beside_ns

    def end(i: int, node: NodeReadings) -> End:
        azimuth, inclination = _sight(seen, i, index, settings)
        depth = _depth(node, seen.below_port_m[i, index], *span_ns, settings)
        return End(node.info.node, azimuth, inclination, depth, field_of(node, *span_ns))

    # The track's rows are smoothed: what their sigma says is nearly the same error in all of them. What they scatter by
    # is how the nodes are held.
    mean_of, scatter_m = mean_of_white, max(along_m, 1e-4)
    if readings.speed_mps is not None:
        mean_of, scatter_m = mean_of_slow, math.hypot(scatter_m, math.sqrt(2) * settings.centering_m)
    return Shot(
        start_ns=start_ns,
        end_ns=end_ns,
        distance=mean_of((seen.stamps_ns[index] - start_ns) / 1e9, range_m, along_m, floor_m),
        ends=(end(0, readings.pair[0]), end(1, readings.pair[1])),
        range_spread=float(range_m.std(ddof=1)) / scatter_m if len(index) > 2 else 0.0,
        heading_gap_rad=float(unwrapped(gaps).mean()) if len(gaps) else None,
        used=seen.triggers[index],
        unused=unused,
    )


def _sight(
    seen: Sights, i: int, index: NDArray[np.intp], settings: SurveySettings
) -> tuple[Mean, Mean] | tuple[None, None]:
    """Return azimuth and inclination of the line from node i to the other, by its own attitude."""
    known = index[~np.isnan(seen.line_by_m[i, index]).any(axis=1)]
    if not len(known):
        return None, None
    line_m = (1.0 if i == 0 else -1.0) * seen.line_by_m[i, known]
    flat_m = np.hypot(line_m[:, 0], line_m[:, 1])
    stamps_s = (seen.stamps_ns[known] - seen.stamps_ns[known[0]]) / 1e9
    across_m = float(np.median(seen.across_sigma_m[known]))
    held_m = math.sqrt(2) * settings.centering_m

    def mean(angles_rad: Floats, stated_rad: Floats, floor_deg: float, away_m: Floats) -> Mean:
        """Average angles; an offset across the line turns them by the offset over the distance away_m."""
        far_m = max(float(away_m.mean()), 1e-3)
        stated = math.hypot(float(np.median(stated_rad)), across_m / far_m)
        return mean_of_slow(stamps_s, angles_rad, stated, math.hypot(math.radians(floor_deg), held_m / far_m))

    sigma_rad = seen.sigma_rad[i, known]
    azimuths = unwrapped(np.arctan2(line_m[:, 1], line_m[:, 0]))
    azimuth = mean(azimuths, sigma_rad[:, 2], settings.compass_floor_deg, flat_m)
    inclinations = np.arctan2(-line_m[:, 2], flat_m)
    inclination = mean(inclinations, sigma_rad[:, :2], settings.tilt_floor_deg, seen.range_m[known])
    return replace(azimuth, value=azimuth.value % (2 * math.pi)), inclination


def _depth(
    node: NodeReadings, below_port_m: Floats, start_ns: int, end_ns: int, settings: SurveySettings
) -> Mean | None:
    part = node.depth.between(start_ns, end_ns)
    depth_m = node.depth["depth_m"][part]
    known = below_port_m[~np.isnan(below_port_m)]
    if not len(depth_m) or (not len(known) and any(node.info.depth_port_m)):
        return None
    kept = inliers(depth_m, settings.depth_floor_m)
    mean = mean_of_slow(
        (node.depth.stamps_ns[part][kept] - start_ns) / 1e9,
        depth_m[kept],
        float(np.median(node.depth["sigma_m"][part])),
        math.hypot(settings.depth_floor_m, settings.centering_m),
    )
    return replace(mean, value=mean.value + (float(known.mean()) if len(known) else 0.0))
