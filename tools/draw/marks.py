"""Pictures with marks: what was found in them and why, and which lights were chosen."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np
from buddyline.node.detect.detection import Detection, check_image
from buddyline.protocol.messages import Blob, Candidates, CompressedImage
from numpy.typing import NDArray

LEFT_COLOUR: Final = "#ff4040"
RIGHT_COLOUR: Final = "#8affc1"
OTHER_COLOUR: Final = "#ffd34d"
_MIME: Final = {"jpeg": "image/jpeg", "jpg": "image/jpeg", "png": "image/png"}
_RING_PX: Final = 22
# Blue, green, red, as OpenCV has them.
_LIKELY = (80, 255, 80)
_UNLIKELY = (60, 60, 255)
_TRUTH = (255, 80, 255)


def mark_candidates(
    image: NDArray[np.uint8],
    detections: Sequence[Detection],
    truth: Sequence[tuple[float, float]] | None = None,
    letters: float = 1.0,
) -> NDArray[np.uint8]:
    """Mark every candidate: outline of its region, axis with the chosen end, centre, 3 sigma circle, rank and score.

    letters: their size, relative to what can be read on a screen. truth: (u, v) px of the true lights, marked with a
    cross. Likely candidates are green, unlikely ones red. Returns a new (H, W, 3) BGR picture.
    """
    check_image(image)
    marked = np.array(image if image.ndim == 3 else cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
    size = letters * max(0.4, image.shape[1] / 1800)
    for rank, detection in reversed(list(enumerate(detections, start=1))):
        # Large letters leave no room for the reasons of several.
        _mark(marked, rank, detection, size, say_why=rank <= 3 and letters <= 1.0)
    for u_px, v_px in truth or ():
        cv2.drawMarker(marked, (round(u_px), round(v_px)), _TRUTH, cv2.MARKER_TILTED_CROSS, round(24 * size), 1)
    return marked


def _mark(marked: NDArray[np.uint8], rank: int, detection: Detection, size: float, *, say_why: bool) -> None:
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
    text = f"{rank}: {score:.2f}, 1 sd {blob.sigma_px:.2f} px"
    corner = detection.outline_px.max(axis=0) + 3
    _write(marked, text, (float(corner[0]), float(corner[1])), size, colour)
    if say_why:
        below = float(corner[0]), float(corner[1]) + 26 * size
        _write(marked, detection.why, below, max(0.35, 0.7 * size), colour)


def _write(marked: NDArray[np.uint8], text: str, at: tuple[float, float], size: float, colour: tuple[int, ...]) -> None:
    """Write a line, moved into the picture where it would leave it."""
    (width_px, height_px), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    u = max(min(round(at[0]), marked.shape[1] - width_px - 2), 0)
    v = max(min(round(at[1]), marked.shape[0] - 3), height_px)
    cv2.putText(marked, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)


def mark_lights(image: NDArray[np.uint8], blobs: Sequence[Blob], chosen: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a BGR picture with the chosen left light circled in red, the right one in green; -1: none chosen."""
    marked = image.copy()
    for index, colour in zip(chosen, (_UNLIKELY, _LIKELY), strict=True):
        if index >= 0:
            at_px = round(blobs[index].u_px), round(blobs[index].v_px)
            cv2.circle(marked, at_px, _RING_PX, colour, 2, cv2.LINE_AA)
    return marked


def marked_svg(image: CompressedImage | None, frame: Candidates | None, chosen: tuple[int, int] = (-1, -1)) -> str:
    """Return a picture as <svg> with a ring around each candidate; L and R: the chosen left and right light.

    chosen: indices into the frame's blobs, -1 for none. The picture's own pixels are passed on as they are.
    """
    width, height = (frame.width_px, frame.height_px) if frame is not None else (4, 3)
    parts = []
    mime = _MIME.get(image.format.lower()) if image is not None else None
    if image is not None and mime is not None:
        data = base64.b64encode(image.data).decode("ascii")
        fitted = "none" if frame is not None else "xMidYMid meet"
        parts.append(
            f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" preserveAspectRatio="{fitted}" '
            f'href="data:{mime};base64,{data}"/>'
        )
    for index, blob in enumerate(frame.blobs if frame is not None else ()):
        parts.append(_ring(blob, width / 100, chosen.index(index) if index in chosen else None))
    return f'<svg viewBox="-0.5 -0.5 {width} {height}">{"".join(parts)}</svg>'


def _ring(blob: Blob, unit_px: float, side: int | None) -> str:
    """Return a candidate's ring; unit_px: a hundredth of the width; side: 0 left, 1 right light, None not chosen."""
    radius, thick, colour = (1.3, 0.3, OTHER_COLOUR) if side is None else (2.2, 0.6, (LEFT_COLOUR, RIGHT_COLOUR)[side])
    ring = (
        f'<circle cx="{blob.u_px:.1f}" cy="{blob.v_px:.1f}" r="{unit_px * radius:.1f}" fill="none" stroke="{colour}" '
        f'stroke-width="{unit_px * thick:.1f}"/>'
    )
    if side is None:
        return ring
    x_px, anchor, name = ((blob.u_px - unit_px * 3, "end", "L"), (blob.u_px + unit_px * 3, "start", "R"))[side]
    return ring + (
        f'<text x="{x_px:.1f}" y="{blob.v_px - unit_px * 2:.1f}" fill="{colour}" font-size="{unit_px * 4:.1f}" '
        f'font-weight="700" text-anchor="{anchor}">{name}</text>'
    )
