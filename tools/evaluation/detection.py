"""The quality of the candidates in each picture with known lights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.tools.evaluation.lights import Blobs, TrueLights
from buddyline.tools.evaluation.rotation import Floats
from buddyline.tools.evaluation.statistics import share
from numpy.typing import NDArray

CLOSE_PX: Final = 2.0
FIRST: Final = (3, 5, 8)
# Median of |x| of a standard normal: the median of normalized errors if the sigmas are true.
_NORMAL_MEDIAN: Final = 0.6745


@dataclass(frozen=True)
class DetectionFigures:
    """Figures over the pictures of both nodes that have LightTruth.

    "Near" is within the tolerance of `lights.tolerance_px` (1 % of the width, at least 3 px).
    lost_pictures: number without Candidates; their lights count as missed. recall_*: share of the visible lights found.
    both_first: share of the pictures with both lights visible that have a candidate near each light among the first n
    candidates (0: among all). false_per_picture: candidates near neither light, visible or hidden. error_*_px: of the
    nearest candidate, where it is near. normalized_rms: RMS of its error over its sigma_px, per axis; 1 if sigma_px is
    true. normalized_robust: the same from the median, insensitive to outliers.
    """

    pictures: int
    lost_pictures: int
    visible_lights: int
    recall_close: float | None
    recall_near: float | None
    both_visible: int
    both_first: dict[int, float | None]
    candidates_per_picture: float | None
    false_per_picture: float | None
    error_median_px: float | None
    error_p90_px: float | None
    normalized_rms: float | None
    normalized_robust: float | None


def _both_among(near: NDArray[np.bool_]) -> bool:
    """Return whether two different candidates are near the left and the right light; near: (n, 2)."""
    left, right = near[:, 0], near[:, 1]
    return bool(left.any() and right.any() and (left | right).sum() >= 2)


def detection_figures(
    lights: Mapping[tuple[str, int], TrueLights], blobs: Mapping[tuple[str, int], Blobs]
) -> DetectionFigures | None:
    """Compare candidates with the lights of LightTruth; None if there is nothing to compare."""
    marked = {key: true for key, true in lights.items() if true.marked}
    if not any(key in blobs for key in marked):
        return None
    close = near_count = visible = both_visible = lost = false = total = 0
    both = dict.fromkeys((*FIRST, 0), 0)
    errors: list[Floats] = []
    normalized: list[Floats] = []
    for key, true in marked.items():
        visible += int(true.visible.sum())
        both_visible += int(true.visible.all())
        seen = blobs.get(key)
        if seen is None:
            lost += 1
            continue
        total += len(seen.pixels)
        away = seen.distances_px(true)
        near = away <= seen.tolerance_px
        false += int((~near.any(axis=1)).sum())
        if true.visible.all():
            for n in both:
                both[n] += _both_among(near[:n] if n else near)
        for side in np.flatnonzero(true.visible & near.any(axis=0)):
            nearest = int(away[:, side].argmin())
            near_count += 1
            close += int(away[nearest, side] <= CLOSE_PX)
            errors.append(away[nearest, side])
            normalized.append((seen.pixels[nearest] - true.pixels[side]) / seen.sigma_px[nearest])
    error_px, axes = np.array(errors), np.abs(np.array(normalized).ravel())
    measured = len(marked) - lost
    return DetectionFigures(
        pictures=len(marked),
        lost_pictures=lost,
        visible_lights=visible,
        recall_close=share(close, visible),
        recall_near=share(near_count, visible),
        both_visible=both_visible,
        both_first={n: share(count, both_visible) for n, count in both.items()},
        candidates_per_picture=share(total, measured),
        false_per_picture=share(false, measured),
        error_median_px=float(np.median(error_px)) if errors else None,
        error_p90_px=float(np.percentile(error_px, 90)) if errors else None,
        normalized_rms=float(np.sqrt(np.mean(axes**2))) if errors else None,
        normalized_robust=float(np.median(axes)) / _NORMAL_MEDIAN if errors else None,
    )
