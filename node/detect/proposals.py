"""Where a light may be: small things brighter than their surround, over scales, and alone in being so."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_OCTAVES = 6
_BASE_WIDTH_PX = 512
_SMALLEST_PX = 5
_CLUTTER_CELL = 4
_CLUTTER_CELLS = 7
_NOISE = 4.0


@dataclass(frozen=True, slots=True)
class Proposals:
    """Places to look at, the most outstanding first; arrays of length N.

    u_px, v_px: in the whole picture. step_px: pixels of the picture per pixel of the octave it was found in.
    contrast: centre minus surround, grey levels. clutter: mean contrast of the neighbourhood.
    """

    centre_px: NDArray[np.float32]
    step_px: NDArray[np.float32]
    contrast: NDArray[np.float32]
    clutter: NDArray[np.float32]


class ProposalFinder:
    """Local maxima of centre minus surround in a pyramid of the grey picture.

    A lamp stands alone, while caustics, glitter and texture come in fields: what the neighbourhood's mean contrast
    explains does not count. The working memory is kept from picture to picture.
    """

    def __init__(self) -> None:
        self._shape: tuple[int, ...] = ()
        self._levels: list[dict[str, NDArray[np.uint8]]] = []
        self._halves: list[NDArray[np.uint8]] = []

    def find(self, image: NDArray[np.uint8], contrast_min: float, clutter_gain: float, limit: int) -> Proposals:
        """Find at most `limit` places in a (H, W, 3) BGR or (H, W) grey picture."""
        if image.shape != self._shape:
            self._allocate(image.shape)
        level, step = self._base(image)
        found = []
        for buffers in self._levels:
            if buffers["level"].shape != level.shape:
                size = (buffers["level"].shape[1], buffers["level"].shape[0])
                level = _u8(cv2.resize(level, size, dst=buffers["level"], interpolation=cv2.INTER_AREA))
                step *= 2.0
            found.append(_maxima(level, step, contrast_min, clutter_gain, buffers))
        if not found:
            empty = np.zeros(0, np.float32)
            return Proposals(np.zeros((0, 2), np.float32), empty, empty, empty)
        table = np.concatenate(found)
        table = table[np.argsort(-table[:, 3] / (_NOISE + table[:, 4]), kind="stable")[:limit]]
        return Proposals(table[:, :2], table[:, 2], table[:, 3], table[:, 4])

    def _allocate(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._halves = []
        height, width = shape[:2]
        if min(height, width) >= 2 * _SMALLEST_PX:
            while width > _BASE_WIDTH_PX:
                height, width = height // 2, width // 2
                colours = shape[2:] if not self._halves else ()
                self._halves.append(np.empty((height, width, *colours), np.uint8))
        self._levels = []
        while min(height, width) >= _SMALLEST_PX and len(self._levels) < _OCTAVES:
            names = ("level", "centre", "surround", "contrast", "expected", "top", "mask")
            self._levels.append({name: np.empty((height, width), np.uint8) for name in names})
            height, width = height // 2, width // 2

    def _base(self, image: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], float]:
        """Give the grey picture at the pyramid's base; its step in px. Colours are merged after the first halving."""
        level = image
        step = 1.0
        for half in self._halves:
            level = _u8(cv2.resize(level, half.shape[1::-1], dst=half, interpolation=cv2.INTER_AREA))
            step *= 2.0
            if level.ndim == 3:
                level = _u8(cv2.cvtColor(level, cv2.COLOR_BGR2GRAY))
        if level.ndim == 3:
            level = _u8(cv2.cvtColor(level, cv2.COLOR_BGR2GRAY))
        return level, step


def _u8(array: object) -> NDArray[np.uint8]:
    return np.asarray(array, np.uint8)


def _maxima(
    level: NDArray[np.uint8],
    step: float,
    contrast_min: float,
    clutter_gain: float,
    buffers: dict[str, NDArray[np.uint8]],
) -> NDArray[np.float32]:
    """Give (N, 5): u_px, v_px, step_px, contrast, clutter of one octave's local maxima."""
    height, width = level.shape
    centre = cv2.GaussianBlur(level, (3, 3), 0, dst=buffers["centre"])
    surround = cv2.blur(level, (9, 9), dst=buffers["surround"])
    contrast = _u8(cv2.subtract(centre, surround, dst=buffers["contrast"]))
    cells = (max(1, width // _CLUTTER_CELL), max(1, height // _CLUTTER_CELL))
    coarse = cv2.resize(contrast, cells, interpolation=cv2.INTER_AREA)
    clutter = _u8(cv2.blur(coarse, (_CLUTTER_CELLS, _CLUTTER_CELLS)))
    expected = cv2.resize(
        cv2.convertScaleAbs(clutter, alpha=clutter_gain),
        (width, height),
        dst=buffers["expected"],
        interpolation=cv2.INTER_LINEAR,
    )
    excess = cv2.subtract(contrast, expected, dst=buffers["centre"])
    top = cv2.dilate(excess, np.ones((5, 5), np.uint8), dst=buffers["top"])
    mask = cv2.compare(excess, top, cv2.CMP_EQ, dst=buffers["mask"])
    _, strong = cv2.threshold(excess, contrast_min - 0.5, 255, cv2.THRESH_BINARY, dst=buffers["surround"])
    rows, columns = np.nonzero(cv2.bitwise_and(mask, strong, dst=mask))
    cell_rows = np.minimum(rows // _CLUTTER_CELL, clutter.shape[0] - 1)
    cell_columns = np.minimum(columns // _CLUTTER_CELL, clutter.shape[1] - 1)
    table = np.empty((len(rows), 5), np.float32)
    table[:, 0] = (columns + 0.5) * step - 0.5
    table[:, 1] = (rows + 0.5) * step - 0.5
    table[:, 2] = step
    table[:, 3] = contrast[rows, columns]
    table[:, 4] = clutter[cell_rows, cell_columns]
    return table
