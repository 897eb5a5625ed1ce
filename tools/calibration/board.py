"""The calibration board: a chessboard with markers in its white squares, and a page to print it from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.newfile import write_new
from numpy.typing import NDArray

# A marker of five bits with its border has seven modules. A square of ten modules leaves a white rim around it, and
# makes the whole board a grid of modules.
SQUARE_MODULES: Final = 10
MARKER_MODULES: Final = 7
DICTIONARY: Final = cv2.aruco.DICT_5X5_100
MOST_MARKERS: Final = 100

MARGIN_MM: Final = 12.0
POINTS_PER_MM: Final = 72 / 25.4


@dataclass(frozen=True)
class Board:
    """A ChArUco board: columns x rows squares of square_m, markers of DICT_5X5_100 in the white ones."""

    columns: int = 9
    rows: int = 6
    square_m: float = 0.030

    def __post_init__(self) -> None:
        """Raise BuddylineError for a board that cannot be made."""
        if not (self.columns >= 3 and self.rows >= 3 and self.columns * self.rows // 2 <= MOST_MARKERS):
            raise BuddylineError(f"board of {self.columns} x {self.rows} squares: from 3 x 3 to {2 * MOST_MARKERS}")
        if not 0.005 <= self.square_m <= 0.5:
            raise BuddylineError(f"board with squares of {self.square_m * 1e3:g} mm: from 5 to 500 mm")

    def charuco(self) -> Any:
        """Return OpenCV's board, in metres."""
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows),
            self.square_m,
            self.square_m * MARKER_MODULES / SQUARE_MODULES,
            cv2.aruco.getPredefinedDictionary(DICTIONARY),
        )

    def modules(self) -> NDArray[np.bool_]:
        """Return which modules are black, (rows * 10, columns * 10)."""
        size = (self.columns * SQUARE_MODULES, self.rows * SQUARE_MODULES)
        black: NDArray[np.bool_] = np.asarray(self.charuco().generateImage(size)) < 128
        return black

    @property
    def caption(self) -> str:
        """The text under the board."""
        return (
            f"Buddyline: {self.columns} x {self.rows} squares of {self.square_m * 1e3:g} mm. "
            "Print at 100 %, glue it flat, measure a square."
        )

    def write_pdf(self, path: Path) -> None:
        """Write one page of the board's true size."""
        write_new(path, self._pdf())

    def _pdf(self) -> bytes:
        black = self.modules()
        module = self.square_m * 1e3 / SQUARE_MODULES * POINTS_PER_MM
        margin = MARGIN_MM * POINTS_PER_MM
        height, width = (n * module for n in black.shape)
        drawing = [f"BT /F 9 Tf {margin:.3f} {margin / 2:.3f} Td ({self.caption}) Tj ET"]
        for row, line in enumerate(black):
            edges = np.flatnonzero(np.diff(np.concatenate(([False], line, [False])).astype(np.int8)))
            for begin, end in edges.reshape(-1, 2):
                x, y = margin + begin * module, margin + height - (row + 1) * module
                # Slightly taller than the module, so that viewers draw no seams between two rows.
                drawing.append(f"{x:.4f} {y:.4f} {(end - begin) * module:.4f} {module + 0.01:.4f} re")
        page = (width + 2 * margin, height + 2 * margin)
        return _pdf_of("\n".join([*drawing, "f"]), page)


def _pdf_of(drawing: str, page_points: tuple[float, float]) -> bytes:
    """Return a PDF of one page with one drawing and Helvetica as /F."""
    objects = [
        "<< /Type /Catalog /Pages 2 0 R >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {page_points[0]:.3f} {page_points[1]:.3f}] "
        "/Contents 4 0 R /Resources << /Font << /F 5 0 R >> >> >>",
        f"<< /Length {len(drawing)} >>\nstream\n{drawing}\nendstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    out, starts = b"%PDF-1.4\n", []
    for number, text in enumerate(objects, 1):
        starts.append(len(out))
        out += f"{number} 0 obj\n{text}\nendobj\n".encode("ascii")
    table = "".join(f"{start:010d} 00000 n \n" for start in starts)
    count = len(objects) + 1
    end = f"xref\n0 {count}\n0000000000 65535 f \n{table}trailer\n<< /Size {count} /Root 1 0 R >>\n"
    return out + f"{end}startxref\n{len(out)}\n%%EOF\n".encode("ascii")
