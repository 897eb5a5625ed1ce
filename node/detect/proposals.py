"""Where a light may be: small things brighter than their surround, over scales, and alone in being so."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

_OCTAVES = 5
_BASE_WIDTH_PX = 512
_SMALLEST_PX = 5
_CLUTTER_CELL = 4
_WORD = 8
_WITHIN_WORD = np.arange(_WORD)
_CLUTTER_CELLS = 7
_NOISE = 4.0
CLEAR: Final = 5.0
"""How outstanding a place is that clearly stands out of its neighbourhood."""
_ALWAYS, _AT_MOST = 16, 64
_MEAN_OF_LOWER_HALF = 0.46
_NEIGHBOURS = np.ones((5, 5), np.uint8)


@dataclass(slots=True, eq=False)
class Proposals:
    """Places to look at, the most outstanding first; arrays of length N.

    centre_px: (N, 2) in the whole picture. step_px: pixels of the picture per pixel of the octave it was found in.
    outstanding: centre minus surround over what noise and the neighbourhood (its mean contrast) explain.
    """

    centre_px: NDArray[np.float32]
    step_px: NDArray[np.float32]
    outstanding: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class _Octave:
    """Working memory of one octave. All but level are parts of arrays that hold all octaves, end to end."""

    level: NDArray[np.uint8]
    contrast: NDArray[np.uint8]
    highest: NDArray[np.uint8]
    clutter: NDArray[np.uint8]

    def measure(self, below: NDArray[np.uint8] | None) -> None:
        """Measure centre minus surround, its highest value around each place, and the neighbourhoods' mean.

        below: the level of the next octave, of which the surround is made.
        """
        surround = self.highest
        if below is None:
            cv2.blur(self.level, (9, 9), dst=surround)
        else:
            cv2.pyrUp(cv2.blur(below, (5, 5)), dst=surround, dstsize=self.level.shape[::-1])
        cv2.GaussianBlur(self.level, (3, 3), 0, dst=self.contrast)
        cv2.subtract(self.contrast, surround, dst=self.contrast)
        rows, columns = self.clutter.shape
        whole = self.contrast[: _CLUTTER_CELL * rows, : _CLUTTER_CELL * columns]
        cells = halve(halve(whole))
        cv2.blur(cells, (_CLUTTER_CELLS, _CLUTTER_CELLS), dst=self.clutter)
        cv2.dilate(self.contrast, _NEIGHBOURS, dst=self.highest)


class ProposalFinder:
    """Local maxima of centre minus surround in a pyramid of the grey picture.

    A lamp stands alone, while caustics, glitter and texture come in fields: what the neighbourhood's mean contrast
    explains does not count.
    """

    def __init__(self) -> None:
        self._shape: tuple[int, ...] = ()
        self._octaves: list[_Octave] = []
        self._halves: list[NDArray[np.uint8]] = []
        self._grey_level = np.zeros((0, 0), np.uint8)
        self._marks = np.zeros(0, np.uint8)
        self._contrast = np.zeros(0, np.uint8)
        self._highest = np.zeros(0, np.uint8)
        self._clutter = np.zeros(0, np.uint8)
        self._cell_of = np.zeros(0, np.int32)
        self._starts = self._widths = np.zeros(0, np.int64)
        self._steps_px = np.zeros(0, np.float32)
        self._base_step_px = 1.0

    def load(self, image: NDArray[np.uint8]) -> None:
        """Make the pyramid of a (H, W, 3) BGR or (H, W) grey picture."""
        if image.shape != self._shape:
            self._allocate(image.shape)
        for i, octave in enumerate(self._octaves):
            if i == 0:
                self._fill_base(image, octave.level)
            else:
                halve(self._octaves[i - 1].level, octave.level)

    def noise(self) -> float:
        """Estimate the noise at the pyramid's base, 1 sd in grey levels, from neighbouring pixels of some rows."""
        if not self._octaves:
            return 0.0
        some = self._octaves[0].level[::48]
        steps = np.sort(cv2.absdiff(some[:, 1:], some[:, :-1]), axis=None, kind="stable")
        # What is not noise (edges, texture) stands in the upper half; below it, noise is as good as normal.
        lower = steps[: len(steps) // 2 + 1]
        return float(cv2.mean(lower)[0]) / _MEAN_OF_LOWER_HALF

    def find(self, contrast_min: float, clutter_gain: float) -> Proposals:
        """Find places in the picture that was loaded: the most outstanding 16, and up to 64 that clearly stand out.

        A place counts from a contrast of contrast_min grey levels, plus clutter_gain times the mean contrast of its
        neighbourhood.
        """
        below: NDArray[np.uint8] | None = None
        for octave in reversed(self._octaves):
            octave.measure(below)
            below = octave.level
        if self._octaves:
            # As one row of a picture, which OpenCV compares many times faster than numpy.
            contrast_row, highest, marks = self._contrast[None], self._highest[None], self._marks[None]
            cv2.compare(contrast_row, highest, cv2.CMP_EQ, dst=marks)
            # The highest values have served: in their place, whether the contrast is enough.
            cv2.threshold(contrast_row, max(math.ceil(contrast_min), 1) - 1, 255, cv2.THRESH_BINARY, dst=highest)
            cv2.bitwise_and(marks, highest, dst=marks)

        # Empty places are passed over a machine word at a time.
        places = (np.flatnonzero(self._marks.view(np.uint64) != 0)[:, None] * _WORD + _WITHIN_WORD).ravel()
        places = places[self._marks[places] != 0]
        contrast = self._contrast[places].astype(np.float32)
        clutter = self._clutter[self._cell_of[places]].astype(np.float32)
        outstanding = contrast / (_NOISE + clutter)
        outstanding[contrast < contrast_min + clutter_gain * clutter] = 0.0
        clear = int(np.count_nonzero(outstanding >= CLEAR))
        order = np.argsort(-outstanding, kind="stable")[: min(max(clear, _ALWAYS), _AT_MOST)]
        order = order[outstanding[order] > 0.0]
        places = places[order]
        which = np.searchsorted(self._starts, places, side="right") - 1
        step = self._steps_px[which]
        centre_px = np.empty((len(order), 2), np.float32)
        centre_px[:, 1], centre_px[:, 0] = np.divmod(places - self._starts[which], self._widths[which])
        return Proposals((centre_px + 0.5) * step[:, None] - 0.5, step, outstanding[order])

    @property
    def base(self) -> tuple[NDArray[np.uint8], float]:
        """The last picture's grey at the pyramid's base, and its step in px; only where proposals were found."""
        return self._octaves[0].level, self._base_step_px

    def _allocate(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._halves = []
        height, width = shape[:2]
        self._grey_level = np.empty((height, width) if len(shape) == 3 else (0, 0), np.uint8)
        self._base_step_px = 1.0
        while width > _BASE_WIDTH_PX and height >= 2 * _SMALLEST_PX:
            height, width = height // 2, width // 2
            self._base_step_px *= 2.0
            self._halves.append(np.empty((height, width), np.uint8))
        sizes: list[tuple[int, int]] = []
        while min(height, width) >= _SMALLEST_PX and len(sizes) < _OCTAVES:
            sizes.append((height, width))
            height, width = height // 2, width // 2
        cells = [(max(h // _CLUTTER_CELL, 1), max(w // _CLUTTER_CELL, 1)) for h, w in sizes]
        starts = np.cumsum([0, *(h * w for h, w in sizes)])
        cell_starts = np.cumsum([0, *(h * w for h, w in cells)])
        whole_words = -(-int(starts[-1]) // _WORD) * _WORD
        self._marks = np.zeros(whole_words, np.uint8)
        self._contrast = np.zeros(whole_words, np.uint8)
        self._highest = np.zeros(whole_words, np.uint8)
        self._clutter = np.zeros(int(cell_starts[-1]), np.uint8)
        self._cell_of = np.zeros(whole_words, np.int32)
        for start, (h, w), cell_start, (rows, columns) in zip(starts, sizes, cell_starts, cells, strict=False):
            row = np.minimum(np.arange(h) // _CLUTTER_CELL, rows - 1) * columns + cell_start
            column = np.minimum(np.arange(w) // _CLUTTER_CELL, columns - 1)
            self._cell_of[start : start + h * w] = (row[:, None] + column).ravel()
        self._starts = starts[:-1]
        self._widths = np.array([w for _, w in sizes], np.int64)
        self._steps_px = np.float32(self._base_step_px) * np.exp2(np.arange(len(sizes)), dtype=np.float32)
        self._octaves = [
            _Octave(
                # The last of the halves is the pyramid's base.
                self._halves[-1] if self._halves and start == 0 else np.empty(size, np.uint8),
                self._contrast[start : start + size[0] * size[1]].reshape(size),
                self._highest[start : start + size[0] * size[1]].reshape(size),
                self._clutter[cell_start : cell_start + cell[0] * cell[1]].reshape(cell),
            )
            for start, size, cell_start, cell in zip(starts, sizes, cell_starts, cells, strict=False)
        ]

    def _fill_base(self, image: NDArray[np.uint8], base: NDArray[np.uint8]) -> None:
        """Halve down to the pyramid's base.

        Where the picture is to be quartered or less, every other row will do: the blur of a lens that resolves so
        many pixels is wider than two of them.
        """
        level = image
        halves = self._halves
        if len(halves) > 1:
            height, width = halves[1].shape
            level = halve(self._grey(level[: 4 * height : 2, : 4 * width]))
            level = np.asarray(cv2.resize(level, (width, height), dst=halves[1]), np.uint8)
            halves = halves[2:]
        level = self._grey(level)
        for half in halves:
            level = halve(level, half)
        if not self._halves:
            base[...] = level

    def _grey(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Give a picture's luminance; a grey one is it."""
        if image.ndim == 2:
            return image
        height, width = image.shape[:2]
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY, dst=self._grey_level[:height, :width]), np.uint8)


def halve(image: NDArray[np.uint8], into: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
    """Average 2x2 pixels; an odd last row or column is left out, which keeps to OpenCV's fast path."""
    height, width = max(image.shape[0] // 2, 1), max(image.shape[1] // 2, 1)
    even = image[: 2 * height, : 2 * width]
    return np.asarray(cv2.resize(even, (width, height), dst=into, interpolation=cv2.INTER_AREA), np.uint8)
