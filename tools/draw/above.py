"""Divers from above, as text: where they are, and where each looks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

# Looking forward (up on the page), and on clockwise by 45 degrees.
ARROWS: Final = "↑↗→↘↓↙←↖"
ASCII_ARROWS: Final = "^/>\\v/<\\"
# A character is about twice as high as it is wide.
COLUMNS_A_ROW: Final = 2.0
STEPS_M: Final = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)


def from_above(
    width: int,
    height: int,
    right_m: float,
    forward_m: float,
    turned_rad: float,
    *,
    arrows: str = ARROWS,
    names: tuple[str, str] = ("A", "B"),
) -> list[str]:
    """Draw A at the bottom, looking up, and B before it; return height lines of width characters at most.

    right_m, forward_m: B's place as A sees it, level. turned_rad: B's look direction, clockwise from A's. The last line
    says how much a row is. Anything that would lie outside is drawn at the edge. names: of one character each, which a
    terminal's codes for colours may surround.
    """
    rows = max(height - 1, 2)
    middle = width // 2
    row_m = _row_m(rows, middle, abs(right_m), abs(forward_m))
    a_row = rows - 1 if forward_m >= 0.0 else 0
    b_row = min(max(a_row - round(forward_m / row_m), 0), rows - 1)
    b_column = min(max(middle + round(right_m / row_m * COLUMNS_A_ROW), 1), width - 2)
    page = [[" "] * width for _ in range(rows)]
    steps = max(abs(b_row - a_row), abs(b_column - middle))
    for i in range(1, steps):
        page[round(a_row + (b_row - a_row) * i / steps)][round(middle + (b_column - middle) * i / steps)] = "."
    for row, column, name, look_rad in ((a_row, middle, names[0], 0.0), (b_row, b_column, names[1], turned_rad)):
        page[row][column] = name
        page[row][column + 1] = arrows[round(look_rad / (math.pi / 4)) % 8]
    scale = f"from above; a row is {row_m:g} m"
    said = f"{scale}; up is where A looks"
    return ["".join(line).rstrip() for line in page] + [said if len(said) <= width else scale]


def nodes_from_above(
    width: int, height: int, nodes: Sequence[tuple[str, float, float, float]], *, arrows: str = ARROWS
) -> list[str]:
    """Draw nodes with north up; return height lines of width characters at most, the last with the scale.

    nodes: each one's name, of one character, north and east in m, and the azimuth in rad in which it looks.
    """
    rows = max(height - 1, 2)
    norths_m, easts_m = [node[1] for node in nodes], [node[2] for node in nodes]
    least_north_m, most_north_m, least_east_m, most_east_m = min(norths_m), max(norths_m), min(easts_m), max(easts_m)
    row_m = _row_m(rows, width // 2, (most_east_m - least_east_m) / 2, most_north_m - least_north_m)
    page = [[" "] * width for _ in range(rows)]
    for name, north_m, east_m, look_rad in nodes:
        above = (north_m - (least_north_m + most_north_m) / 2) / row_m
        right = (east_m - (least_east_m + most_east_m) / 2) / row_m * COLUMNS_A_ROW
        row = min(max(round((rows - 1) / 2 - above), 0), rows - 1)
        column = min(max(round(width / 2 - 1 + right), 0), width - 2)
        page[row][column : column + 2] = [name, arrows[round(look_rad / (math.pi / 4)) % 8]]
    return ["".join(line).rstrip() for line in page] + [f"from above, north up; a row is {row_m:g} m"]


def _row_m(rows: int, middle: int, right_m: float, forward_m: float) -> float:
    """Return the least round length of a row with which both ends are on the page."""
    needed_m = max(forward_m / max(rows - 1, 1), right_m * COLUMNS_A_ROW / max(middle - 2, 1))
    return next((step_m for step_m in STEPS_M if step_m >= needed_m), STEPS_M[-1])
