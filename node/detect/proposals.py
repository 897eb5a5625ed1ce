"""Propose where a light may be: spots of any size that are brighter than their surround and stand alone."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, TypeAlias

import cv2
import numpy as np
from buddyline.node.detect.detection import CLIPPED, focal_of
from numpy.typing import NDArray

_OCTAVES = 5
"""The coarsest one proposes lights of a fifth of the picture's width."""
_BASE_FOCAL_PX = 564.0
"""Pictures are halved until the focal length is this or less: scales go with angles, not with a picture's width."""
_CLUTTER_CELL, _CLUTTER_CELLS = 4, 7
"""Side of a cell, in px of its octave (two halvings). Clutter is the mean contrast of so many cells on a side."""
_WORD = 8
_WITHIN_WORD = np.arange(_WORD)
_NOISE = 4.0
"""Contrast in grey levels that stands out as little as the same amount of clutter: noise makes maxima, too."""
CLEAR: Final = 5.0
"""From this value of `outstanding` upward, a place clearly stands out of its neighbourhood."""
_ALWAYS, _AT_MOST = 16, 64
"""So many places are found even if they do not clearly stand out, and at most so many."""
_MEAN_OF_LOWER_HALF = 0.46
"""Mean of the lower half of the absolute differences of two numbers with normal noise, in sd of the noise."""
_NEIGHBOURS = np.ones((5, 5), np.uint8)

_WINDOW = 5
"""Side of the window around a place, in px of its octave. The place is the maximum of its window."""
_BRIGHT = 0.5
"""Share of a place's contrast: pixels no further than this below the place's level belong to its light."""
_ACROSS = np.arange(_WINDOW)
_ROW, _COLUMN = np.divmod(np.arange(_WINDOW**2), _WINDOW)
_MOMENTS = np.stack([np.ones(_WINDOW**2), _COLUMN, _ROW], axis=1).astype(np.float32)


Layout: TypeAlias = Callable[[NDArray[np.float64], NDArray[np.float32]], tuple[NDArray[np.bool_], NDArray[np.float64]]]
"""Returns which places of a loaded picture count, (N,), and what to add to get them in the whole picture, (N, 2) px.

Its arguments: the places' centres (N, 2), px of the loaded picture, and their octaves' steps (N,), px."""


@dataclass(slots=True, eq=False)
class Proposals:
    """Places where a light may be, the most outstanding first; arrays of length N.

    centre_px: (N, 2), px of the whole picture. radius_px: of the bright area around each centre.
    outstanding: contrast (centre minus surround) over noise plus the mean contrast of the neighbourhood.
    """

    centre_px: NDArray[np.float32]
    radius_px: NDArray[np.float32]
    outstanding: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class _Octave:
    """Working memory of one octave. All fields but `quarter` are views into arrays that hold all octaves in a row."""

    level: NDArray[np.uint8]
    contrast: NDArray[np.uint8]
    highest: NDArray[np.uint8]
    quarter: NDArray[np.uint8]
    clutter: NDArray[np.uint8]

    def measure(self, below: NDArray[np.uint8] | None) -> None:
        """Compute the contrast (centre minus surround), its local maximum, and its mean over each neighbourhood.

        below: the grey levels of the next coarser octave, from which the surround is computed; None for the last.
        """
        surround = self.highest
        if below is None:
            cv2.blur(self.level, (9, 9), dst=surround)
        else:
            cv2.pyrUp(cv2.blur(below, (5, 5)), dst=surround, dstsize=self.level.shape[::-1])
        cv2.GaussianBlur(self.level, (3, 3), 0, dst=self.contrast)
        cv2.subtract(self.contrast, surround, dst=self.contrast)
        halve(self.contrast, self.quarter)
        cv2.blur(halve(self.quarter, self.clutter), (_CLUTTER_CELLS, _CLUTTER_CELLS), dst=self.clutter)
        cv2.dilate(self.contrast, _NEIGHBOURS, dst=self.highest)


class ProposalFinder:
    """Finds local maxima of contrast (centre minus surround) in a pyramid of the grey picture.

    A lamp stands alone; caustics, glitter and texture come in fields. So a place's contrast is compared with the mean
    contrast of its neighbourhood, the clutter.
    """

    def __init__(self, focal_px: float | None = None, surround: int | None = None, at_least: int = _ALWAYS) -> None:
        """focal_px: of the pictures; None to take each picture's from its width (see focal_of).

        surround: for parts of pictures, the octave that is only the surround of the one before, and has no places; None
        for whole pictures. at_least: how many places are found, where there are so many.
        """
        self._focal_px = focal_px
        self._surround = surround
        self._at_least = at_least
        self._shape: tuple[int, ...] = ()
        self._octaves: list[_Octave] = []
        self._halves: list[NDArray[np.uint8]] = []
        self._marks = np.zeros(0, np.uint8)
        self._contrast = np.zeros(0, np.uint8)
        self._highest = np.zeros(0, np.uint8)
        self._clutter = np.zeros(0, np.uint8)
        self._cell_of = np.zeros(0, np.int32)
        self._starts = np.zeros(0, np.int64)
        self._sizes = np.zeros((0, 2), np.int64)
        self._level = np.zeros(0, np.uint8)
        self._steps_px = np.zeros(0, np.float32)
        self._base_step_px = 1.0

    @property
    def base_step_px(self) -> int:
        """Side of a pixel of the pyramid's base, px of the loaded picture."""
        return round(self._base_step_px)

    def load(self, image: NDArray[np.uint8]) -> None:
        """Build the pyramid of a (H, W, 3) BGR or (H, W) grey picture."""
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
        # Edges and texture are in the upper half of the differences; the lower half is nearly normal noise.
        lower = steps[: len(steps) // 2 + 1]
        return float(cv2.mean(lower)[0]) / _MEAN_OF_LOWER_HALF

    def find(
        self,
        contrast_min: float,
        clutter_gain: float,
        layout: Layout | None = None,
    ) -> Proposals:
        """Find the most outstanding places of the loaded picture, 16 by default, or up to 64 that clearly stand out.

        A place needs a contrast of contrast_min grey levels plus clutter_gain times the mean contrast of its
        neighbourhood. layout: see Layout; None where all places of a whole picture count.
        """
        below: NDArray[np.uint8] | None = None
        for i, octave in reversed(list(enumerate(self._octaves))):
            if i != self._surround:
                octave.measure(below)
            below = octave.level
        if self._octaves:
            # One long row for OpenCV, which compares it many times faster than numpy does.
            contrast_row, highest, marks = self._contrast[None], self._highest[None], self._marks[None]
            cv2.compare(contrast_row, highest, cv2.CMP_EQ, dst=marks)
            # The local maxima are no longer needed: their array now says whether the contrast is enough.
            cv2.threshold(contrast_row, max(math.ceil(contrast_min), 1) - 1, 255, cv2.THRESH_BINARY, dst=highest)
            cv2.bitwise_and(marks, highest, dst=marks)

        # Eight pixels are tested at once: nearly all of them are no maxima.
        places = (np.flatnonzero(self._marks.view(np.uint64) != 0)[:, None] * _WORD + _WITHIN_WORD).ravel()
        places = places[self._marks[places] != 0]
        contrast = self._contrast[places].astype(np.float32)
        clutter = self._clutter[self._cell_of[places]].astype(np.float32)
        kept = np.flatnonzero(contrast >= np.maximum(contrast_min + clutter_gain * clutter, np.float32(1e-3)))
        places, contrast = places[kept], contrast[kept]
        outstanding = contrast / (_NOISE + clutter[kept])
        which = np.searchsorted(self._starts, places, side="right") - 1
        start, step, size = self._starts[which], self._steps_px[which], self._sizes[which]
        at = np.stack(np.divmod(places - start, size[:, 1]), axis=1)
        origin_px = np.zeros((1, 2))
        if layout is not None:
            inside, origin_px = layout((at[:, ::-1] + 0.5) * step[:, None] - 0.5, step)
            outstanding = np.where(inside, outstanding, np.float32(0.0))
        clear = int(np.count_nonzero(outstanding >= CLEAR))
        order = np.argsort(-outstanding, kind="stable")[: min(max(clear, self._at_least), _AT_MOST)]
        order = order[outstanding[order] > 0.0]
        places, start, step, size, at = places[order], start[order], step[order], size[order], at[order]
        corner = np.minimum(np.maximum(at - _WINDOW // 2, 0), size - _WINDOW)
        across = _ACROSS + (corner[:, 0] * size[:, 1] + corner[:, 1] + start)[:, None]
        level = self._level.take((across[:, None] + (_ACROSS * size[:, 1:])[:, :, None]).reshape(-1, _WINDOW**2))
        middle, radius = _settle(level.astype(np.float32), self._level[places].astype(np.float32), contrast[order])
        # The sum in float64: the same place comes out the same to the last bit, in a part and in the whole picture.
        centre_px = (corner[:, ::-1] + middle + 0.5) * step[:, None] - 0.5
        centre_px += origin_px if layout is None else origin_px[order]
        return Proposals(centre_px.astype(np.float32), radius * step, outstanding[order])

    def _allocate(self, shape: tuple[int, ...]) -> None:
        self._shape = shape
        self._halves = []
        height, width = shape[:2]
        self._base_step_px = 1.0
        focal_px = self._focal_px or focal_of(width)
        while focal_px > _BASE_FOCAL_PX * self._base_step_px and min(height, width) >= 2 * _WINDOW:
            height, width = height // 2, width // 2
            self._base_step_px *= 2.0
            self._halves.append(np.empty((height, width), np.uint8))
        sizes: list[tuple[int, int]] = []
        while min(height, width) >= _WINDOW and len(sizes) < (
            _OCTAVES if self._surround is None else self._surround + 1
        ):
            sizes.append((height, width))
            height, width = height // 2, width // 2
        cells = [(h // _CLUTTER_CELL, w // _CLUTTER_CELL) for h, w in sizes]
        starts = np.cumsum([0, *(h * w for h, w in sizes)])
        cell_starts = np.cumsum([0, *(h * w for h, w in cells)])
        whole_words = -(-int(starts[-1]) // _WORD) * _WORD
        self._level = np.zeros(whole_words, np.uint8)
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
        self._sizes = np.array(sizes, np.int64).reshape(-1, 2)
        self._steps_px = np.float32(self._base_step_px) * np.exp2(np.arange(len(sizes)), dtype=np.float32)
        self._octaves = [
            _Octave(
                self._level[start : start + size[0] * size[1]].reshape(size),
                self._contrast[start : start + size[0] * size[1]].reshape(size),
                self._highest[start : start + size[0] * size[1]].reshape(size),
                np.empty((2 * cell[0], 2 * cell[1]), np.uint8),
                self._clutter[cell_start : cell_start + cell[0] * cell[1]].reshape(cell),
            )
            for start, size, cell_start, cell in zip(starts, sizes, cell_starts, cells, strict=False)
        ]
        if self._halves and self._octaves:
            # The last of the halves is the pyramid's base.
            self._halves[-1] = self._octaves[0].level

    def _fill_base(self, image: NDArray[np.uint8], base: NDArray[np.uint8]) -> None:
        """Halve the picture down to the pyramid's base."""
        level = image
        halves = self._halves
        if row_step_of(self.base_step_px) > 1:
            height, width = halves[1].shape
            level = halve(_grey(level[: 4 * height : 2, : 4 * width]), halves[0][:height, : 2 * width])
            level = np.asarray(cv2.resize(level, (width, height), dst=halves[1]), np.uint8)
            halves = halves[2:]
        level = _grey(level)
        for half in halves:
            level = halve(level, half)
        if not self._halves:
            base[...] = level


def _settle(
    level: NDArray[np.float32], peak: NDArray[np.float32], contrast: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the centroid (N, 2) of the bright pixels in N windows, from the window's corner, and their radius (N,).

    level: (N, window), row by row; peak, contrast: (N,), of the places. Results in px of the octave.
    """
    peak = np.minimum(peak, CLIPPED)
    bright = np.minimum(level, peak[:, None]) - (peak - _BRIGHT * contrast)[:, None]
    area = (bright >= 0.0) @ _MOMENTS[:, 0]
    moments = np.maximum(bright, 1e-3) @ _MOMENTS
    return moments[:, 1:] / moments[:, :1], np.sqrt(area / np.pi)


def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def row_step_of(base_step_px: int) -> int:
    """Return which rows of a picture are read, where a pixel of the pyramid's base has this side: all, or every other.

    A picture that is halved at least twice has such a resolution that the lens blurs over more than two rows.
    """
    return 2 if base_step_px > 2 else 1


def grey_into(image: NDArray[np.uint8], into: NDArray[np.uint8]) -> None:
    """Write the grey levels of a (H, W, 3) BGR or (H, W) grey picture, or of a part of one, into an array (H, W)."""
    if image.ndim == 2:
        into[...] = image
    else:
        cv2.cvtColor(image, cv2.COLOR_BGR2GRAY, dst=into)


def halve(image: NDArray[np.uint8], into: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Average 2x2 pixels. An odd last row or column is dropped, because OpenCV's fast path needs even sizes."""
    height, width = into.shape
    even = image[: 2 * height, : 2 * width]
    return np.asarray(cv2.resize(even, (width, height), dst=into, interpolation=cv2.INTER_AREA), np.uint8)
