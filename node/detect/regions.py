"""Propose places within regions of a picture, from tiles around them: as the whole picture's search does, cheaper."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.node.detect.detection import Region
from buddyline.node.detect.proposals import ProposalFinder, Proposals
from numpy.typing import NDArray

# The sides of the tiles, px of the pyramid's base.
SIDES: Final = (48, 64, 80, 96, 112, 128, 160, 192, 240)
# A place's contrast depends on so many pixels of its octave on every side.
MARGIN: Final = 8
# No light is proposed by a coarser octave, except one that fills a quarter of the picture.
LARGEST_OCTAVE: Final = 3
# By so much the octaves' limits are lower than a light's radius.
REACH: Final = 1.2
# Each tile costs some time whatever its size: as much as so many px of the base.
TILE_COSTS_PX2: Final = 15_000
# Tiles that cost more than this share of the whole picture save too little.
MOST_COST: Final = 0.6
# Places that are found in a tile.
AT_LEAST: Final = 6


@dataclass(frozen=True, slots=True)
class _Tile:
    """A square of the picture around some regions.

    origin_px: (u, v) of its first pixel. side: px of the pyramid's base. octaves: of its pyramid, with one that only
    serves as the surround of the last but one.
    """

    regions: tuple[Region, ...]
    origin_px: tuple[int, int]
    side: int
    octaves: int

    @property
    def cost_px2(self) -> int:
        """What its search costs, px of the base."""
        return self.side * self.side + TILE_COSTS_PX2


class RegionFinder:
    """Finds the local maxima of contrast within regions.

    focal_px: of the pictures. step_px: side of a pixel of the pyramid's base, px of the picture.
    """

    def __init__(self, focal_px: float, step_px: int) -> None:
        self._step_px = step_px
        self._finders = {
            (side, octaves): ProposalFinder(focal_px, octaves, AT_LEAST)
            for side in SIDES
            for octaves in range(2, LARGEST_OCTAVE + 3)
        }

    def find(
        self, image: NDArray[np.uint8], regions: Sequence[Region], contrast_min: float, clutter_gain: float
    ) -> Proposals | None:
        """Find the places within the regions, the most outstanding first; None where the whole picture costs less.

        contrast_min, clutter_gain: as in ProposalFinder.find.
        """
        tiles = self._tiles(image.shape, regions)
        if tiles is None:
            return None
        found = []
        for tile in tiles:
            (u_px, v_px), side_px = tile.origin_px, tile.side * self._step_px
            finder = self._finders[tile.side, tile.octaves]
            finder.load(image[v_px : v_px + side_px, u_px : u_px + side_px])
            keep = _InRegions(tile.regions, self._step_px << (tile.octaves - 2))
            found.append(finder.find(contrast_min, clutter_gain, keep, tile.origin_px))
        return Proposals.joined(found)

    def _tiles(self, shape: tuple[int, ...], regions: Sequence[Region]) -> list[_Tile] | None:
        """Return tiles for the regions, one for several where that costs less; None where they cost too much."""
        tiles: list[_Tile] = []
        for region in regions:
            alone = self._tile(shape, (region,))
            if alone is None:
                return None
            best, saved = None, 0
            for i, tile in enumerate(tiles):
                joined = self._tile(shape, (*tile.regions, region))
                if joined is not None and tile.cost_px2 + alone.cost_px2 - joined.cost_px2 > saved:
                    best, saved = (i, joined), tile.cost_px2 + alone.cost_px2 - joined.cost_px2
            if best is None:
                tiles.append(alone)
            else:
                tiles[best[0]] = best[1]
        cost_px2 = sum(tile.cost_px2 for tile in tiles) * self._step_px**2
        return tiles if cost_px2 <= MOST_COST * shape[0] * shape[1] else None

    def _tile(self, shape: tuple[int, ...], regions: tuple[Region, ...]) -> _Tile | None:
        """Return the smallest tile that holds these regions, with what their places depend on; None for none."""
        reach_px = [self._reach_px(region) for region in regions]
        spans = []
        for axis in (0, 1):
            low = min(region.centre_px[axis] - reach for region, reach in zip(regions, reach_px, strict=True))
            high = max(region.centre_px[axis] + reach for region, reach in zip(regions, reach_px, strict=True))
            spans.append((low, high))
        octaves = max(map(self._octave, regions)) + 2
        # A tile begins where a pixel of its last octave does, so that its pixels are those of the whole picture.
        aligned_px = self._step_px << (octaves - 1)
        wanted = (max(high - low for low, high in spans) + aligned_px) / self._step_px
        side = next((side for side in SIDES if side >= wanted), None)
        if side is None:
            return None
        origin = []
        for (low, high), size_px in zip(spans, (shape[1], shape[0]), strict=True):
            last_px = size_px - side * self._step_px
            if last_px < 0:
                return None
            begin_px = round((0.5 * (low + high) - 0.5 * side * self._step_px) / aligned_px) * aligned_px
            origin.append(max(min(begin_px, last_px // aligned_px * aligned_px), 0))
        return _Tile(regions, (origin[0], origin[1]), side, octaves)

    def _reach_px(self, region: Region) -> float:
        """Return how far around a region's centre the pixels count."""
        return region.radius_px + (MARGIN << self._octave(region)) * self._step_px

    def _octave(self, region: Region) -> int:
        """Return the coarsest octave that proposes a light of a region's size: its pixels are at most its radius.

        A light whose radius is just below a power of two may be proposed by the next octave: it then stands out as
        much there, and its centre comes out a few hundredths of a pixel elsewhere.
        """
        return min(int(math.log2(max(REACH * region.light_px / self._step_px, 1.0))), LARGEST_OCTAVE)


class _InRegions:
    """Keeps the places within some regions, of octaves with pixels of at most coarsest_px."""

    def __init__(self, regions: Sequence[Region], coarsest_px: int) -> None:
        self._coarsest_px = coarsest_px
        self._centre_px = np.array([region.centre_px for region in regions])
        self._radius_px = np.array([region.radius_px for region in regions])

    def __call__(self, centre_px: NDArray[np.float64], step_px: NDArray[np.float32]) -> NDArray[np.bool_]:
        away = centre_px[:, None] - self._centre_px
        near = np.hypot(away[..., 0], away[..., 1]) <= self._radius_px + step_px[:, None]
        kept: NDArray[np.bool_] = near.any(1) & (step_px <= self._coarsest_px)
        return kept
