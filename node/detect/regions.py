"""Propose places within regions of a picture, from tiles around them: as the whole picture's search does, cheaper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.node.detect.detection import Region
from buddyline.node.detect.masks import Masks
from buddyline.node.detect.proposals import ProposalFinder, Proposals, grey_into, row_step_of
from numpy.typing import NDArray

# The sides of the tiles, px of the pyramid's base.
SIDES: Final = (48, 64, 80, 96, 112, 128, 160, 192, 240)
# A place's contrast depends on so many pixels of its octave on every side.
MARGIN: Final = 8
# No light is proposed by a coarser octave, except one that fills a quarter of the picture.
LARGEST_OCTAVE: Final = 3
# An octave may propose a light if its pixels are at most so many times as large as the light's radius.
REACH: Final = 1.2
# Tiles that cover more than this share of the picture save too little.
MOST_COVERED: Final = 0.5
# Places that are found for each region.
AT_LEAST: Final = 3


@dataclass(frozen=True, slots=True)
class _Tile:
    """A square of the picture around a region. origin_px: (u, v) of its first pixel.

    cut: whether the pixels that the region's places depend on reach beyond the picture's upper or lower edge.
    """

    region: Region
    origin_px: tuple[int, int]
    cut: bool


class RegionFinder:
    """Finds the local maxima of contrast within regions.

    focal_px: of the pictures. step_px: side of a pixel of the pyramid's base, px of the picture. masks: where no
    places are looked for.
    """

    def __init__(self, focal_px: float, step_px: int, masks: Masks | None = None) -> None:
        self._masks = masks
        self._focal_px = focal_px
        self._step_px = step_px
        self._mosaics: dict[tuple[int, int, int], _Mosaic] = {}

    def find(
        self, image: NDArray[np.uint8], regions: Sequence[Region], contrast_min: float, clutter_gain: float
    ) -> Proposals | None:
        """Find the places within the regions, the most outstanding first; None where the whole picture costs less.

        contrast_min, clutter_gain: as in ProposalFinder.find.
        """
        octaves = max(map(self._octave, regions)) + 2
        # A tile begins where a pixel of its last octave does, so that its pixels are those of the whole picture.
        aligned_px = self._step_px << (octaves - 1)
        wanted_px = 2.0 * max(map(self._reach_px, regions)) + aligned_px
        side_px = next((side * self._step_px for side in SIDES if side * self._step_px >= wanted_px), None)
        height, width = image.shape[:2]
        if side_px is None or side_px > min(height, width):
            return None
        if len(regions) * side_px * side_px > MOST_COVERED * height * width:
            return None
        tiles = [self._tile(region, side_px, aligned_px, width, height) for region in regions]
        # In a mosaic, a tile's upper and lower edge are not the picture's, but other tiles follow there.
        mosaics = [[tile] for tile in tiles] if any(tile.cut for tile in tiles) else [tiles]
        found = []
        for group in mosaics:
            mosaic = self._mosaics.get((len(group), side_px, octaves))
            if mosaic is None:
                finder = ProposalFinder(self._focal_px, octaves - 1, AT_LEAST * len(group))
                mosaic = _Mosaic(finder, side_px, row_step_of(self._step_px), self._masks)
                self._mosaics[len(group), side_px, octaves] = mosaic
            found.append(mosaic.find(image, group, self._step_px << (octaves - 2), contrast_min, clutter_gain))
        return found[0] if len(found) == 1 else _joined(found)

    def _tile(self, region: Region, side_px: int, aligned_px: int, width: int, height: int) -> _Tile:
        origin = []
        for centre_px, size_px in zip(region.centre_px, (width, height), strict=True):
            begin_px = round((centre_px - 0.5 * side_px) / aligned_px) * aligned_px
            origin.append(max(min(begin_px, (size_px - side_px) // aligned_px * aligned_px), 0))
        reach_px = self._reach_px(region)
        cut = not reach_px <= region.centre_px[1] <= height - reach_px
        return _Tile(region, (origin[0], origin[1]), cut)

    def _reach_px(self, region: Region) -> float:
        """Return how far around a region's centre the pixels count."""
        return region.radius_px + (MARGIN << self._octave(region)) * self._step_px

    def _octave(self, region: Region) -> int:
        """Return the coarsest octave that proposes the light of a region: its pixels are about as large as its radius.

        The whole picture's search may propose the light from the next coarser octave, if it stands out as much there.
        The two centres then differ by a few hundredths of a pixel.
        """
        return min(int(math.log2(max(REACH * region.light_px / self._step_px, 1.0))), LARGEST_OCTAVE)


class _Mosaic:
    """Tiles of a picture, one below the other, searched as one picture: the cost of a search is mostly fixed."""

    def __init__(self, finder: ProposalFinder, side_px: int, row_step: int, masks: Masks | None) -> None:
        """row_step: the finder reads every row_step-th row; the others stay empty."""
        self._finder = finder
        self._row_step = row_step
        self._masks = masks
        self._side_px = side_px
        self._pixels = np.zeros((0, 0), np.uint8)

    def find(
        self,
        image: NDArray[np.uint8],
        tiles: Sequence[_Tile],
        coarsest_px: int,
        contrast_min: float,
        clutter_gain: float,
    ) -> Proposals:
        """Find the places within the tiles' regions, of octaves with pixels of at most coarsest_px."""
        side_px = self._side_px
        shape = (len(tiles) * side_px, side_px)
        if self._pixels.shape != shape:
            self._pixels = np.zeros(shape, np.uint8)
        for i, tile in enumerate(tiles):
            u, v = tile.origin_px
            part = image[v : v + side_px : self._row_step, u : u + side_px]
            grey_into(part, self._pixels[i * side_px : (i + 1) * side_px : self._row_step])
        # A place in the mosaic plus its tile's origin is the place in the picture.
        origin = np.array([tile.origin_px for tile in tiles], np.float64)
        origin[:, 1] -= np.arange(len(tiles)) * side_px
        centre = np.array([tile.region.centre_px for tile in tiles]) - origin
        radius = np.array([tile.region.radius_px for tile in tiles])

        def layout(
            centre_px: NDArray[np.float64], step_px: NDArray[np.float32]
        ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
            of = (centre_px[:, 1] // side_px).astype(np.intp)
            away = centre_px - centre[of]
            near = (away * away).sum(1) <= (radius[of] + step_px) ** 2
            kept = near & (step_px <= coarsest_px)
            if self._masks is not None:
                kept &= ~self._masks.hide(centre_px + origin[of], image.shape[1], image.shape[0])
            return kept, origin[of]

        self._finder.load(self._pixels)
        return self._finder.find(contrast_min, clutter_gain, layout)


def _joined(parts: Sequence[Proposals]) -> Proposals:
    """Return the places of all parts, the most outstanding first."""
    outstanding = np.concatenate([part.outstanding for part in parts])
    order = np.argsort(-outstanding, kind="stable")
    centre_px = np.concatenate([part.centre_px for part in parts])
    radius_px = np.concatenate([part.radius_px for part in parts])
    return Proposals(centre_px[order], radius_px[order], outstanding[order])
