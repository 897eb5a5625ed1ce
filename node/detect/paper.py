"""The paper's detector: a fixed HSV threshold, closing, contours, the brighter end of each region.

Damron, Quattrini Li, Rekleitis, "Underwater Surveying via Bearing only Cooperative Localization", IROS 2018. It is
the baseline for the project's own detector.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import cv2
import numpy as np
from buddyline.node.detect.detection import FOCAL_PX, Detection, check_image, focal_of
from buddyline.protocol.messages import MAX_BLOBS, Blob
from numpy.typing import NDArray

PRESETS: Final[Mapping[str, Mapping[str, float]]] = MappingProxyType(
    {
        "cavern": {"value_min": 250, "saturation_max": 90, "close_px": 5, "area_min_px": 6},
        "night_reef": {"value_min": 235, "saturation_max": 150, "close_px": 5, "area_min_px": 6},
        "lake": {"value_min": 245, "saturation_max": 120, "close_px": 5, "area_min_px": 4},
        "basin": {"value_min": 254, "saturation_max": 90, "close_px": 1, "area_min_px": 6},
        "day_reef": {"value_min": 160, "saturation_max": 150, "close_px": 9, "area_min_px": 1},
    }
)
"""One set of thresholds for each site, as in the paper. Sizes in px at the focal length FOCAL_PX.

Found by `tune --method paper` on 80 pictures of each water: 40 of this project's simulator (seed 77), 40 rendered by
another program. What is reported is measured on other pictures.
"""

_DARK_MEDIAN: Final = 40.0
_TURBID_MEDIAN_SHARE: Final = 0.8


class PaperDetector:
    """Detects with the thresholds of one site. `auto` chooses the site for each picture by its background."""

    def __init__(self, environment: str, overrides: Mapping[str, float], focal_px: float | None = None) -> None:
        """focal_px: of the pictures; None to take each picture's from its width."""
        self._environment = environment
        self._focal_px = focal_px
        self._overrides = dict(overrides)
        self._hsv: NDArray[np.uint8] | None = None

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """Find the brighter ends of all regions that pass the thresholds, the brightest and largest first."""
        check_image(image)
        bgr = image if image.ndim == 3 else np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        if self._hsv is None or self._hsv.shape != bgr.shape:
            self._hsv = np.empty_like(bgr)
        hsv = cv2.cvtColor(bgr, cv2.COLOR_BGR2HSV, dst=self._hsv)
        value = np.asarray(hsv[:, :, 2], np.uint8)
        site = self._environment if self._environment != "auto" else _choose_site(value)
        preset = {**PRESETS[site], **self._overrides}
        scale = (self._focal_px or focal_of(image.shape[1])) / FOCAL_PX

        mask = cv2.inRange(hsv, (0, 0, preset["value_min"]), (180, preset["saturation_max"], 255))
        side = 2 * int(preset["close_px"] * scale / 2) + 1
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8))
        passed = np.asarray(mask, np.uint8)
        contours, _ = cv2.findContours(passed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        found = [
            _brighter_end(np.asarray(contour, np.int32).reshape(-1, 2), value, passed, scale) for contour in contours
        ]
        found = [d for d in found if d.blob.area_px >= preset["area_min_px"] * scale * scale]
        found.sort(key=lambda d: (-d.blob.score, -d.blob.area_px))  # type: ignore[operator]
        return found[:MAX_BLOBS]


def _choose_site(value: NDArray[np.uint8]) -> str:
    """Return the site whose background matches: dark, turbid (evenly bright) or sunlit. value: (H, W), HSV's V."""
    coarse = value[::8, ::8]
    median = float(np.median(coarse))
    if median < _DARK_MEDIAN:
        return "night_reef"
    spread = float(np.percentile(coarse, 10)) / median
    return "lake" if spread > _TURBID_MEDIAN_SHARE else "basin"


def _brighter_end(
    contour: NDArray[np.int32], value: NDArray[np.uint8], mask: NDArray[np.uint8], scale: float
) -> Detection:
    """Put the light at the brighter end of the region's rotated rectangle: the centroid of its brightest pixels.

    contour: (N, 2) px. value: (H, W), HSV's V. mask: (H, W), 255 where a pixel passed the thresholds. scale: focal
    length over FOCAL_PX.
    """
    u0, v0 = contour.min(axis=0)
    u1, v1 = contour.max(axis=0) + 1
    inside = np.zeros((v1 - v0, u1 - u0), np.uint8)
    cv2.drawContours(inside, [(contour - (u0, v0)).reshape(-1, 1, 2)], 0, 255, cv2.FILLED)
    rows, columns = np.nonzero(inside & mask[v0:v1, u0:u1])
    levels = value[v0 + rows, u0 + columns].astype(np.float64)

    (centre_u, centre_v), (side_a, side_b), angle_deg = cv2.minAreaRect(contour)
    corners = cv2.boxPoints(((centre_u, centre_v), (side_a, side_b), angle_deg))
    angle_rad = np.deg2rad(angle_deg if side_a >= side_b else angle_deg + 90.0)
    axis = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    long_px, short_px = max(side_a, side_b), min(side_a, side_b)
    along = (columns + u0 - centre_u) * axis[0] + (rows + v0 - centre_v) * axis[1]

    ends = []
    for sign in (1.0, -1.0):
        near = sign * along >= long_px / 2 - max(short_px, 1.0) - 0.5
        if not near.any():
            continue
        peak = levels[near].max()
        brightest = near & (levels >= 0.98 * peak)
        weight = levels[brightest]
        centre = np.array(
            [np.average(columns[brightest] + u0, weights=weight), np.average(rows[brightest] + v0, weights=weight)]
        )
        ends.append((float(levels[near].mean()), sign, float(peak), centre))
    mean, sign, peak, centre = max(ends, key=lambda end: end[0])
    end_px = np.array([centre_u, centre_v]) + sign * axis * long_px / 2
    other_px = np.array([centre_u, centre_v]) - sign * axis * long_px / 2
    area = float(len(levels))
    radius = np.sqrt(area / np.pi)
    elongation = float((long_px + 1.0) / (short_px + 1.0))
    # A region that covers a quarter of the picture is water or sun, not a lamp.
    filled = 4.0 * area / value.size
    score = peak / 255.0 * min(1.0, radius / (3.0 * scale)) / elongation * max(0.0, 1.0 - filled)
    return Detection(
        blob=Blob(
            u_px=float(centre[0]),
            v_px=float(centre[1]),
            sigma_px=0.3 + 0.15 * float(radius),
            area_px=area,
            peak=peak,
            elongation=elongation,
            score=float(min(1.0, max(0.0, score))),
        ),
        outline_px=np.asarray(corners, np.float64),
        axis_px=np.array([end_px, other_px]),
        why=f"V {mean:.0f} at this end, {area:.0f} px, elongation {elongation:.1f}",
    )
