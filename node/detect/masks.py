"""Parts of the picture that are never searched: a burned-in clock, the node's own bar, its regulator's bubbles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypeAlias

import cv2
import numpy as np
from buddyline.node.detect.detection import Detection, Detector
from buddyline.protocol.errors import BuddylineError
from numpy.typing import NDArray

Corners: TypeAlias = Sequence[tuple[float, float]]

# Masks are drawn no larger than this: their edges are good to a pixel or two.
_WIDEST_PX: Final = 1024


class Masks:
    """Polygons. Corners (u, v) are shares of the picture's width and height; two corners give a rectangle."""

    def __init__(self, polygons: Sequence[Corners]) -> None:
        """Raise BuddylineError for a polygon of one corner, or with a corner outside of the picture."""
        for i, polygon in enumerate(polygons):
            if len(polygon) < 2:
                raise BuddylineError(f"masks[{i}]: {len(polygon)} corners; give two of a rectangle, or more")
            for u, v in polygon:
                if not (0.0 <= u <= 1.0 and 0.0 <= v <= 1.0):
                    raise BuddylineError(f"masks[{i}]: corner {u:g}, {v:g} is not within 0 to 1 of the picture")
        self._polygons = [np.array(_corners(polygon), np.float64) for polygon in polygons]
        self._size = 0, 0
        self._drawn = np.zeros((1, 1), np.uint8)

    def hide(self, at_px: NDArray[np.floating], width_px: int, height_px: int) -> NDArray[np.bool_]:
        """Return which places (N, 2), px, of a picture of this size lie within a mask, (N,)."""
        if self._size != (width_px, height_px):
            self._size = width_px, height_px
            self._draw(width_px, height_px)
        rows, columns = self._drawn.shape
        u = np.clip((at_px[:, 0] + 0.5) * (columns / width_px), 0, columns - 1).astype(np.intp)
        v = np.clip((at_px[:, 1] + 0.5) * (rows / height_px), 0, rows - 1).astype(np.intp)
        hidden: NDArray[np.bool_] = self._drawn[v, u] != 0
        return hidden

    def _draw(self, width_px: int, height_px: int) -> None:
        scale = min(_WIDEST_PX / width_px, 1.0)
        columns, rows = max(round(width_px * scale), 1), max(round(height_px * scale), 1)
        self._drawn = np.zeros((rows, columns), np.uint8)
        for polygon in self._polygons:
            corners = np.round(polygon * (columns, rows) - 0.5).astype(np.int32)
            cv2.fillPoly(self._drawn, [corners.reshape(-1, 1, 2)], 1)


def _corners(polygon: Corners) -> Corners:
    if len(polygon) > 2:
        return polygon
    (u0, v0), (u1, v1) = polygon
    return [(u0, v0), (u1, v0), (u1, v1), (u0, v1)]


def unmasked(found: list[Detection], masks: Masks | None, shape: tuple[int, ...]) -> list[Detection]:
    """Return the candidates of a picture of this shape that no mask hides."""
    if masks is None or not found:
        return found
    hidden = masks.hide(np.array([(d.blob.u_px, d.blob.v_px) for d in found]), shape[1], shape[0])
    return [d for d, is_hidden in zip(found, hidden.tolist(), strict=True) if not is_hidden]


class MaskedDetector:
    """Another detector without masks of its own; candidates that a mask hides are left out."""

    def __init__(self, detector: Detector, masks: Masks) -> None:
        self._detector = detector
        self._masks = masks

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """Find the candidates of one picture, the likeliest lights first."""
        return unmasked(self._detector.detect(image), self._masks, image.shape)
