"""What the rings around a place tell: outlines, rim, the channel that locates best, and the figures for the score."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import NDArray

from node.detect.proposals import Proposals
from node.detect.rings import (
    Floats,
    Shapes,
    find_shapes,
    geometric_radii,
    luminance,
    sample_rings,
    weakest_channel,
)

_ALWAYS_MEASURED, _MAX_MEASURED = 8, 24
_CORE_RINGS: Final = 7
_WEAKEST_FROM_PX: Final = 3.0
_CLIPPED: Final = 249.0
_LEVELS: Final = np.array([0.9, 0.7, 0.5, 0.3], np.float32)
_CORE, _HALF = 1, 2
_UNCLIPPED, _UNCLIPPED_OVER = 240.0, 40.0
VEIL: Final = 40.0
"""Level of the weakest channel from which on the water counts as veiled."""
_GLOW_BACK, _GLOW_BACK_MOST = 2.0, 0.7
_GUESS, _GUESS_MOST = 0.5, 0.4


@dataclass(frozen=True, slots=True)
class Lights:
    """N bright regions.

    centre_px (N, 2), core_px (N,): the rim, in the channel that locates. guess_px: (N, 2) about where the source is.
    ground: (N,) what the water itself shows in that channel. weakest: (N,) whether it is the weakest one, else the
    luminance. core_elongation: (N,) in it, near the top. unclipped: (N,) 0-1. scattered: (N,) 0-1, see _scattered;
    the centre of those is where their glow begins. peak, height: (N,) luminance. edge_px: (N, K) outline at half
    height around edge_at_px (N, 2), of area_px, elongation and open_share (of rays that find no edge). contrast,
    clutter: (N,) as proposed.
    """

    centre_px: Floats
    core_px: Floats
    guess_px: Floats
    ground: Floats
    weakest: NDArray[np.bool_]
    core_elongation: Floats
    unclipped: Floats
    scattered: Floats
    peak: Floats
    height: Floats
    edge_px: Floats
    edge_at_px: Floats
    area_px: Floats
    elongation: Floats
    open_share: Floats
    contrast: Floats
    clutter: Floats

    def at(self, index: NDArray[np.intp]) -> Lights:
        """Give some of them."""
        return Lights(*(getattr(self, field.name)[index] for field in fields(self)))


def measure_lights(
    image: NDArray[np.uint8], base: NDArray[np.uint8], base_step_px: float, proposals: Proposals
) -> Lights:
    """Measure what was proposed in a BGR (H, W, 3) or grey (H, W) picture; base: its grey, base_step_px a pixel."""
    centre, radius_px, proposals = _settle(base, base_step_px, proposals)
    radius = geometric_radii(np.maximum(0.3 * radius_px, 0.5), np.maximum(5.0 * radius_px, 12.0), 16)
    rings = sample_rings(image, centre, radius)
    colour = image.ndim == 3
    level = np.empty((1 + colour, *rings.pixels.shape[:3]), np.float32)
    level[0] = luminance(rings.pixels)
    if colour:
        level[1] = weakest_channel(rings.pixels)
    peak = np.minimum(level[:, :, :_CORE_RINGS].max(axis=(2, 3)), _CLIPPED)
    ground = _low(level[:, :, -4:], 0.2)
    water = _water_level(image)
    if colour:
        np.minimum(ground[1], water, out=ground[1])
    height = peak - ground
    shapes = find_shapes(level, rings.inside, radius, ground[:, None] + _LEVELS[:, None] * height[:, None])
    elongation = shapes.elongation()
    # The weakest channel clips last; the luminance is sharper, as JPEG halves the resolution of colour.
    weakest = shapes.radius_px[-1, :2].mean(axis=0) >= _WEAKEST_FROM_PX if colour else np.zeros(len(radius), bool)
    own = weakest.astype(np.intp), np.arange(len(radius))
    rim_px, core_px = (values[own] for values in _rims(shapes))
    unclipped = np.clip((_UNCLIPPED - peak[0]) / _UNCLIPPED_OVER, 0.0, 1.0)
    scattered = _scattered(shapes, unclipped, water)
    rim_px += scattered[:, None] * (_where_glow_begins(shapes) - rim_px)
    centroid_px = shapes.centre_px.swapaxes(1, 2)[own]
    guess_px = rim_px + _at_most(_GUESS * (centroid_px[:, 0] - centroid_px[:, _HALF]), _GUESS_MOST * core_px)
    return Lights(
        centre + rim_px,
        core_px,
        centre + guess_px,
        ground[own],
        weakest,
        elongation.swapaxes(1, 2)[own][:, _CORE],
        unclipped,
        scattered,
        peak[0],
        height[0],
        shapes.edge_px[0, _HALF],
        centre,
        np.pi * shapes.radius_px[0, _HALF] ** 2,
        elongation[0, _HALF],
        shapes.open_share[0, _HALF],
        proposals.contrast,
        proposals.clutter,
    )


def distinct(centre_px: Floats, radius_px: Floats) -> NDArray[np.intp]:
    """Leave out what lies inside an earlier one; give the indices of the rest. centre_px: (N, 2); radius_px: (N,)."""
    u, v = centre_px.T
    apart = np.hypot(u[:, None] - u, v[:, None] - v)
    reach_px = np.maximum(0.7 * radius_px, 2.0)
    same = apart < np.maximum(reach_px[:, None], reach_px)
    # Each row as the bits of one number.
    rows = (same @ (np.uint64(1) << np.arange(len(same), dtype=np.uint64))).tolist()
    kept: list[int] = []
    taken = 0
    for i, row in enumerate(rows):
        if not row & taken:
            kept.append(i)
            taken |= 1 << i
    return np.array(kept, np.intp)


def _settle(base: NDArray[np.uint8], base_step_px: float, proposals: Proposals) -> tuple[Floats, Floats, Proposals]:
    """Move each proposal to the middle of its bright region, and leave out those that end up in one.

    Returns centres (N, 2) and radii (N,) in px of the whole picture, and the proposals they were.
    """
    scale = np.float32(base_step_px)
    step = proposals.step_px / scale
    at = (proposals.centre_px + 0.5) / scale - 0.5
    radius = geometric_radii(0.4 * step, 7.0 * step, 10)
    rings = sample_rings(base, at, radius)
    level = rings.pixels[None, ..., 0]
    peak = np.minimum(level[:, :, :5].max(axis=(2, 3)), _CLIPPED)
    ground = _low(level[:, :, -3:], 0.2)
    shapes = find_shapes(level, rings.inside, radius, (ground + 0.8 * (peak - ground))[:, None])
    centre = (at + shapes.centre_px[0, 0] + 0.5) * scale - 0.5
    radius_px = shapes.radius_px[0, 0] * scale
    kept = distinct(centre, radius_px)[:_MAX_MEASURED]
    kept = kept[: max(_ALWAYS_MEASURED, int(np.count_nonzero(proposals.clear[kept])))]
    return centre[kept], radius_px[kept], proposals.at(kept)


def _low(level: Floats, share: float) -> Floats:
    """Give the level that a share of each place's samples lies below: (C, N) from (C, N, M, K)."""
    flat = level.reshape(*level.shape[:2], -1)
    k = int(share * flat.shape[2])
    return np.partition(flat, k, axis=2)[:, :, k]


def _rims(shapes: Shapes) -> tuple[Floats, Floats]:
    """Give each light's rim, where its profile falls the fastest: centres (C, N, 2), radii (C, N).

    It is the lamp's own face where that shows, and the edge of what is clipped where the glow is all there is.
    """
    radius, centre = shapes.radius_px, shapes.centre_px
    fall = 1.0 / np.maximum(radius[:, 1:] - radius[:, :-1], 0.15)
    k = fall.argmax(axis=1)
    channel, place = np.arange(k.shape[0])[:, None], np.arange(k.shape[1])
    return (
        0.5 * (centre[channel, k, place] + centre[channel, k + 1, place]),
        0.5 * (radius[channel, k, place] + radius[channel, k + 1, place]),
    )


def _scattered(shapes: Shapes, unclipped: Floats, water: Floats) -> Floats:
    """Tell lights in veiled water that show only what the water scatters, (N,) 0-1: not clipped, and with a halo.

    A core's own profile falls as steeply below half its height as above it; a glow flattens out.
    """
    flattening = shapes.radius_px[0, _HALF + 1] / shapes.radius_px[0, _HALF]
    halo = np.clip((flattening - 1.35) / 0.2, 0.0, 1.0)
    return np.asarray(halo * unclipped * np.minimum(water / VEIL, 1.0), np.float32)


def _where_glow_begins(shapes: Shapes) -> Floats:
    """Give where a glow without a core comes from, (N, 2): against the way in which its fainter parts lie.

    A beam that passes the camera by shines where it has spread; its source lies behind the brightest part.
    """
    top, low = shapes.centre_px[0, 0], shapes.centre_px[0, -1]
    back = _at_most(_GLOW_BACK * (top - low), _GLOW_BACK_MOST * shapes.radius_px[0, _HALF])
    return np.asarray(top + back, np.float32)


def _at_most(step_px: Floats, length_px: Floats) -> Floats:
    """Shorten steps (N, 2) to lengths (N,) where they are longer."""
    own_px = np.maximum(np.hypot(step_px[:, 0], step_px[:, 1]), 1e-6)
    return np.asarray(step_px * np.minimum(length_px / own_px, 1.0)[:, None], np.float32)


def _water_level(image: NDArray[np.uint8]) -> Floats:
    """Give what a fifth of a picture lies below, in the weakest channel."""
    some = np.ascontiguousarray(image[::16, ::16])
    weak = (some if image.ndim == 2 else weakest_channel(some)).ravel()
    k = len(weak) // 5
    return np.asarray(np.partition(weak, k)[k], np.float32)
