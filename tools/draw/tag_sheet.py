"""Pages of station tags to print: black squares of the true size, each with its name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from buddyline.node.station_tags import DICTIONARY, name_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

A4_MM: Final = (210.0, 297.0)
EDGE_MM: Final = 10.0
# Cells along the square's side; a white margin of one cell all round belongs to the tag.
CELLS: Final = 8
# Below each tag, for its name.
NAME_MM: Final = 9.0
INCH_MM: Final = 25.4


def tags_on_a_page(side_mm: float) -> tuple[int, int]:
    """Return how many tags stand beside and below each other on a page."""
    pitch_mm = side_mm * (CELLS + 2) / CELLS
    columns, rows = (A4_MM[0] - 2 * EDGE_MM) / pitch_mm, (A4_MM[1] - 2 * EDGE_MM) / (pitch_mm + NAME_MM)
    return int(columns), int(rows)


def tag_sheet(numbers: Sequence[int], side_mm: float) -> list[Figure]:
    """Return pages of A4 with these tags of 36h11; side_mm: of the black square, of which one fits a page at least."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    dictionary = cv2.aruco.getPredefinedDictionary(DICTIONARY)
    columns, rows = tags_on_a_page(side_mm)
    cell_mm = side_mm / CELLS
    pages = []
    for first in range(0, len(numbers), columns * rows):
        page = Figure(figsize=(A4_MM[0] / INCH_MM, A4_MM[1] / INCH_MM))
        page.set_layout_engine("none")
        axes = page.add_axes((0, 0, 1, 1), xlim=(0, A4_MM[0]), ylim=(A4_MM[1], 0))
        axes.set_axis_off()
        for place, number in enumerate(numbers[first : first + columns * rows]):
            row, column = divmod(place, columns)
            x_mm = EDGE_MM + column * (CELLS + 2) * cell_mm
            y_mm = EDGE_MM + row * ((CELLS + 2) * cell_mm + NAME_MM)
            frame_mm = (CELLS + 2) * cell_mm
            # The line to cut along.
            axes.add_patch(Rectangle((x_mm, y_mm), frame_mm, frame_mm + NAME_MM, fill=False, lw=0.3, ec="0.7"))
            black = np.asarray(cv2.aruco.generateImageMarker(dictionary, number, CELLS)) < 128
            for v, u in np.argwhere(black).tolist():
                corner_mm = x_mm + (u + 1) * cell_mm, y_mm + (v + 1) * cell_mm
                # A little larger than the cell, so that no seam shows.
                axes.add_patch(Rectangle(corner_mm, cell_mm * 1.01, cell_mm * 1.01, fc="black", lw=0))
            axes.text(x_mm + frame_mm / 2, y_mm + frame_mm + NAME_MM / 3, name_of(number), ha="center", size=14)
        pages.append(page)
    return pages
