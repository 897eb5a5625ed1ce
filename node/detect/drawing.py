"""Pictures marked for a person: what was found, and why."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from buddyline.node.detect.detection import Detection, check_image
from numpy.typing import NDArray

_LIKELY = (80, 255, 80)
_UNLIKELY = (60, 60, 255)
_TRUTH = (255, 80, 255)


def draw(
    image: NDArray[np.uint8],
    detections: Sequence[Detection],
    truth: Sequence[tuple[float, float]] | None = None,
) -> NDArray[np.uint8]:
    """Mark every candidate: outline of its region, axis with the chosen end, centre, 3 sigma circle, rank and score.

    truth: (u, v) px of the true lights, marked with a cross. Likely candidates are green, unlikely ones red. Returns
    a new (H, W, 3) BGR picture.
    """
    check_image(image)
    marked = np.array(image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    size = max(0.4, image.shape[1] / 1800)
    for rank, detection in reversed(list(enumerate(detections, start=1))):
        _mark(marked, rank, detection, size)
    for u_px, v_px in truth or ():
        cv2.drawMarker(marked, (round(u_px), round(v_px)), _TRUTH, cv2.MARKER_TILTED_CROSS, round(24 * size), 1)
    return marked


def _mark(marked: NDArray[np.uint8], rank: int, detection: Detection, size: float) -> None:
    blob = detection.blob
    score = blob.score if isinstance(blob.score, float) else 0.0
    colour = tuple(round(score * a + (1 - score) * b) for a, b in zip(_LIKELY, _UNLIKELY, strict=True))
    outline = np.round(detection.outline_px).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(marked, [outline], True, colour, 1, cv2.LINE_AA)
    chosen, other = np.round(detection.axis_px).astype(int).tolist()
    cv2.line(marked, chosen, other, colour, 1, cv2.LINE_AA)
    cv2.circle(marked, chosen, max(2, round(5 * size)), colour, cv2.FILLED, cv2.LINE_AA)

    # Eight times finer than a pixel: the centres are sub-pixel.
    fine = (round(blob.u_px * 8), round(blob.v_px * 8))
    cv2.circle(marked, fine, max(8, round(3 * blob.sigma_px * 8)), colour, 1, cv2.LINE_AA, 3)
    cv2.drawMarker(marked, (round(blob.u_px), round(blob.v_px)), colour, cv2.MARKER_CROSS, round(16 * size), 1)
    text = f"{rank}: {score:.2f} s{blob.sigma_px:.1f}"
    corner = detection.outline_px.max(axis=0) + 3
    _write(marked, text, (float(corner[0]), float(corner[1])), size, colour)
    if rank <= 3:
        below = float(corner[0]), float(corner[1]) + 26 * size
        _write(marked, detection.why, below, max(0.35, 0.7 * size), colour)


def _write(marked: NDArray[np.uint8], text: str, at: tuple[float, float], size: float, colour: tuple[int, ...]) -> None:
    """Write a line, moved into the picture where it would leave it."""
    (width_px, height_px), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    u = max(min(round(at[0]), marked.shape[1] - width_px - 2), 0)
    v = max(min(round(at[1]), marked.shape[0] - 3), height_px)
    cv2.putText(marked, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
