"""The project's own detector: find the sources of light, not just what is bright."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from node.detect.detection import Detection, check_image
from protocol.messages import Blob

PRESETS: Final[Mapping[str, Mapping[str, float]]] = MappingProxyType(
    {
        "cavern": {"contrast_min": 10},
        "night_reef": {"contrast_min": 10},
        "lake": {"contrast_min": 8},
        "basin": {"contrast_min": 16},
    }
)
_AUTO: Final = {"contrast_min": 10.0}
_OCTAVES: Final = 5
_MAX_PROPOSALS: Final = 24
_MAX_FOUND: Final = 12


class SourceDetector:
    """Scale-space proposals, then iso-intensity centres extrapolated to radius 0."""

    def __init__(self, environment: str, overrides: Mapping[str, float]) -> None:
        self._values = {**PRESETS.get(environment, _AUTO), **overrides}

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """Find the candidates of one picture, the likeliest first."""
        check_image(image)
        weak = image if image.ndim == 2 else None
        grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        found = []
        for u, v, radius, contrast in _propose(grey, self._values["contrast_min"]):
            d = _refine(image, weak, u, v, radius, contrast)
            if d is not None:
                found.append(d)
        found.sort(key=lambda d: -float(d.blob.score))  # type: ignore[arg-type]
        kept: list[Detection] = []
        for d in found:
            near = any(
                np.hypot(d.blob.u_px - k.blob.u_px, d.blob.v_px - k.blob.v_px)
                < max(3.0, 0.7 * np.sqrt(max(k.blob.area_px, d.blob.area_px) / np.pi))
                for k in kept
            )
            if not near:
                kept.append(d)
        return kept[:_MAX_FOUND]


def _propose(grey: NDArray[np.uint8], contrast_min: float) -> list[tuple[float, float, float, float]]:
    """Give local maxima of centre minus surround over octaves: (u, v, radius, contrast), px of the whole picture."""
    level: NDArray[np.uint8] = grey
    found: list[tuple[float, float, float, float]] = []
    step = 1.0
    for _ in range(_OCTAVES):
        if min(level.shape) < 4:
            break
        level = np.asarray(cv2.resize(level, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.uint8)
        step *= 2.0
        centre = cv2.GaussianBlur(level, (3, 3), 0)
        surround = cv2.boxFilter(level, -1, (9, 9))
        contrast = cv2.subtract(centre, surround)
        top = cv2.dilate(contrast, np.ones((5, 5), np.uint8))
        rows, columns = np.nonzero((contrast == top) & (contrast >= contrast_min))
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
            u, v = (column + 0.5) * step - 0.5, (row + 0.5) * step - 0.5
            found.append((u, v, 1.5 * step, float(contrast[row, column])))
    found.sort(key=lambda f: -f[3])
    return found[:_MAX_PROPOSALS]


def _refine(
    image: NDArray[np.uint8], weak: NDArray[np.uint8] | None, u: float, v: float, radius: float, contrast: float
) -> Detection | None:
    """Extrapolate the centres of iso-intensity regions to radius 0: centre = source + k radius^2."""
    reach = int(4 * radius) + 4
    u0, v0 = max(0, int(u) - reach), max(0, int(v) - reach)
    part = image[v0 : int(v) + reach + 1, u0 : int(u) + reach + 1]
    patch = part.min(axis=2) if weak is None else part
    near = int(radius) + 1
    cu, cv_ = round(u) - u0, round(v) - v0
    inner = patch[max(0, cv_ - near) : cv_ + near + 1, max(0, cu - near) : cu + near + 1]
    if inner.size == 0:
        return None
    peak = int(inner.max())
    at = np.unravel_index(int(inner.argmax()), inner.shape)
    seed = (int(at[1]) + max(0, cu - near), int(at[0]) + max(0, cv_ - near))
    ground = float(np.percentile(patch, 25))
    if peak - ground < 6:
        return None
    centres: list[tuple[float, float, float]] = []
    outline = None
    for share in (0.9, 0.8, 0.7, 0.6, 0.5, 0.4):
        mask = (patch >= ground + share * (peak - ground)).astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        for contour in contours:
            x, y, w, h = cv2.boundingRect(contour)
            if not (x <= seed[0] < x + w and y <= seed[1] < y + h):
                continue
            if cv2.pointPolygonTest(contour, seed, False) < 0:
                continue
            inside = np.zeros(mask.shape, np.uint8)
            cv2.drawContours(inside, [contour], 0, 1, cv2.FILLED)
            m = cv2.moments(inside, True)
            touches = x == 0 or y == 0 or x + w == patch.shape[1] or y + h == patch.shape[0]
            if not touches or not centres:
                centres.append((m["m10"] / m["m00"], m["m01"] / m["m00"], m["m00"]))
                if share >= 0.5 or outline is None:
                    outline = contour.reshape(-1, 2)
            break
    if outline is None:
        return None
    data = np.array(centres)
    area = float(data[-1, 2])
    r2 = data[:, 2] / np.pi
    source = data[0, :2]
    if len(data) >= 3 and r2[-1] > 1.3 * r2[0]:
        design = np.stack([np.ones_like(r2), r2], axis=1)
        fit = np.linalg.lstsq(design, data[:, :2], rcond=None)[0]
        if np.hypot(*(fit[0] - source)) < 0.5 * np.sqrt(r2[0]) + 1:
            source = fit[0]
    uu, vv = float(source[0]) + u0, float(source[1]) + v0
    height, width = image.shape[:2]
    if not (-0.5 <= uu <= width - 0.5 and -0.5 <= vv <= height - 0.5):
        return None
    (_, (side_a, side_b), _) = rect = cv2.minAreaRect(outline.astype(np.float32))
    elongation = (max(side_a, side_b) + 1) / (min(side_a, side_b) + 1)
    score = 1 / (1 + np.exp(-((peak - ground - 60) / 40 - 1.5 * (elongation - 1.5))))
    corners = cv2.boxPoints(rect) + np.array([u0, v0])
    return Detection(
        blob=Blob(
            u_px=uu,
            v_px=vv,
            sigma_px=0.2 + 0.1 * float(np.sqrt(r2[0])),
            area_px=area,
            peak=float(peak),
            elongation=float(elongation),
            score=float(score),
        ),
        outline_px=np.asarray(outline + np.array([u0, v0]), np.float64),
        axis_px=np.array([[uu, vv], corners.mean(axis=0)]),
        why=f"contrast {contrast:.0f}, weak channel {ground:.0f} to {peak}, elongation {elongation:.1f}",
    )
