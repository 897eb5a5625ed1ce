"""What stays still in the pictures of a dive, and is no light: proposals for masks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, TypeAlias

import cv2
import numpy as np
from buddyline.node.detect import make_detector
from numpy.typing import NDArray

Points: TypeAlias = NDArray[np.float64]
Rectangle: TypeAlias = tuple[tuple[float, float], tuple[float, float]]

# The picture is divided into so many columns, and as many rows of square cells as that makes.
COLUMNS: Final = 40
# What is in a cell, or beside it, in this share of the pictures stays there; fewer pictures do not tell.
STAYS: Final = 0.6
LEAST_PICTURES: Final = 8
# A light that is in the same place in this share of the pictures would be masked with what stays: nothing is proposed.
LIGHTS_THERE: Final = 0.2
# A mask reaches so many cells beyond the cells that it is proposed for.
BEYOND: Final = 0.5


def still_parts(pictures: Sequence[NDArray[np.uint8]], lights_px: Sequence[Points] | None) -> list[Rectangle]:
    """Return rectangles, as shares of width and height, where nearly every picture has a candidate.

    lights_px: the true lights (L, 2) in each picture; None where they are not known. Then two nodes that stand still
    look like something in their pictures that does: look at what is proposed.
    """
    if len(pictures) < LEAST_PICTURES or len({picture.shape[:2] for picture in pictures}) > 1:
        return []
    height, width = pictures[0].shape[:2]
    cell_px = width / COLUMNS
    shape = int(np.ceil(height / cell_px)), COLUMNS
    detector = make_detector()
    seen, lit = np.zeros(shape), np.zeros(shape)
    for i, picture in enumerate(pictures):
        at_px = np.array([(d.blob.u_px, d.blob.v_px) for d in detector.detect(picture)]).reshape(-1, 2)
        seen += _near(at_px, cell_px, shape)
        if lights_px is not None:
            lit += _near(lights_px[i], cell_px, shape)
    share = 1.0 / len(pictures)
    still = (seen * share >= STAYS) & (lit * share < LIGHTS_THERE)
    count, _, boxes, _ = cv2.connectedComponentsWithStats(still.astype(np.uint8), connectivity=8)
    found = []
    for left, top, columns, rows, _ in boxes[1:count].tolist():
        u0, v0 = (left - BEYOND) * cell_px / width, (top - BEYOND) * cell_px / height
        u1, v1 = (left + columns + BEYOND) * cell_px / width, (top + rows + BEYOND) * cell_px / height
        corners = [
            (round(float(np.clip(u, 0, 1)), 3), round(float(np.clip(v, 0, 1)), 3)) for u, v in ((u0, v0), (u1, v1))
        ]
        found.append((corners[0], corners[1]))
    return found


def _near(at_px: Points, cell_px: float, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return which cells have one of some points (N, 2) in or beside them."""
    cells = np.zeros(shape, np.uint8)
    column, row = np.clip((at_px + 0.5) / cell_px, 0, np.array(shape[::-1]) - 1).astype(int).T
    cells[row, column] = 1
    return np.asarray(cv2.dilate(cells, np.ones((3, 3), np.uint8)), np.uint8)
