"""Measure proposed places on rings: outlines, rim, the channel that locates best, and the figures for the score."""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from buddyline.node.detect.detection import CLIPPED
from buddyline.node.detect.proposals import CLEAR, Proposals
from buddyline.node.detect.rings import (
    RAY_UV,
    Floats,
    elongation,
    find_shapes,
    geometric_radii,
    luminance,
    sample_rings,
    weakest_channel,
)
from numpy.typing import NDArray

# So many places are measured even if they do not clearly stand out.
_ALWAYS_MEASURED: Final = 8
# Of _SHARES' rings: the peak is looked for in so many of the inner ones.
_CORE_RINGS: Final = 7
# The weakest channel locates cores from this radius on; in smaller ones JPEG's half resolution of colour counts more.
_WEAKEST_FROM_PX: Final = 3.0
# Shares of the height at which outlines are followed; those of the core and of half the height.
_LEVELS: Final = np.array([0.9, 0.7, 0.5, 0.3], np.float32)
_CORE, HALF = 1, 2
# A light with a peak below the first grey level is not clipped; by so many levels less, it surely is not.
_UNCLIPPED, _UNCLIPPED_OVER = 240.0, 40.0
VEIL: Final = 40.0
"""The water counts as veiled from this grey level of the weakest channel upward."""
# The glow begins so far behind its top, as a share of the way from its faint outline's centre to its top's; at most so
# many radii at half height.
_GLOW_BACK, _GLOW_BACK_MOST = 2.0, 0.7
# The source is guessed so far from the rim's centre, as a share of the way from the outline at half height to that at
# 0.9; at most so many radii of the core. Without it, 92 % of the lights are within 2 px in place of 95 %.
_GUESS, _GUESS_MOST = 0.5, 0.4
# Logarithmic steps of the rings, from the innermost to the outermost.
_SHARES: Final = np.linspace(0.0, 1.0, 16, dtype=np.float32)
_DARK: Final = 0.51
"""Where the first ring is below a level on every ray, the outline has half its radius (rings.find_shapes)."""
_AT_BORDER_PX: Final = 1.0
"""An outline that ends this near to the border is cut by it."""
_FAINT: Final = 25.0
"""The rim of a light of less height, in grey levels, is looked for between its lowest outlines alone: a step from one
outline to the next is then about two sd of the noise."""


class Lights(NamedTuple):
    """N bright regions. All fields have length N; positions are (N, 2), in px.

    Each light is located in one channel: the weakest colour channel where `weakest` is set, else the luminance.
    In that channel: centre_px and core_px, centre and radius of the rim; guess_px, a first guess of the source;
    ground, the grey level of the water around it; core_elongation, long over short axis near the top.
    unclipped: 0 (clipped) to 1. scattered: 0 to 1, see _scattered; for such a light centre_px is where its glow begins.
    border_px: (N, 2), of the outline at half height that the picture's border cuts: how far its middle is inside of the
    border, and how deep it reaches into the picture; 0, 0 where the border cuts nothing.
    In luminance: peak; height, the peak above the ground; edge_px (N, K), distances along the rays from edge_at_px to
    the outline at half height; area_px and elongation of that outline; roundest, the least elongation of the outlines
    at 0.5, 0.7 and 0.9 of the height (lower down, the bar that a lamp lights may hang on to it); radii_px (N, 4), of
    the circles of equal area at 0.9, 0.7, 0.5 and 0.3 of the height.
    outstanding: as in Proposals.
    """

    centre_px: Floats
    core_px: Floats
    guess_px: Floats
    ground: Floats
    weakest: NDArray[np.bool_]
    core_elongation: Floats
    unclipped: Floats
    scattered: Floats
    border_px: Floats
    peak: Floats
    height: Floats
    edge_px: Floats
    edge_at_px: Floats
    area_px: Floats
    elongation: Floats
    roundest: Floats
    radii_px: Floats
    outstanding: Floats

    def at(self, index: NDArray[np.intp]) -> Lights:
        """Return the lights at these indices."""
        return Lights._make(values[index] for values in self)


def measure_lights(image: NDArray[np.uint8], proposals: Proposals, water: float) -> Lights:
    """Measure the proposed places in a BGR (H, W, 3) or grey (H, W) picture. water: its water_level.

    The places do not overlap (see distinct). A place beside a light is left out: it is darker than half the light's
    height, and so has no outline.
    """
    kept = slice(max(_ALWAYS_MEASURED, int(np.count_nonzero(proposals.outstanding >= CLEAR))))
    centre, radius_px, outstanding = proposals.centre_px[kept], proposals.radius_px[kept], proposals.outstanding[kept]
    radius = geometric_radii(np.maximum(0.3 * radius_px, 0.5), np.maximum(5.0 * radius_px, 12.0), _SHARES)
    rings = sample_rings(image, centre, radius)
    colour = image.ndim == 3
    level = np.empty((1 + colour, *rings.pixels.shape[:3]), np.float32)
    level[0] = luminance(rings.pixels)
    if colour:
        level[1] = weakest_channel(rings.pixels)
    peak = np.minimum(level[:, :, :_CORE_RINGS].max(axis=(2, 3)), CLIPPED)
    ground = _low(level[:, :, -4:], 0.2)
    if colour:
        np.minimum(ground[1], water, out=ground[1])
    height = peak - ground
    shapes = find_shapes(level, rings, ground[:, None] + _LEVELS[:, None] * height[:, None])
    circle = own_circle = shapes.circle_px[0]
    own_edge, own_ground, weakest = shapes.edge_px[0, _CORE : HALF + 1], ground[0], np.zeros(len(radius), bool)
    if colour:
        # The weakest channel clips last. The luminance is sharper, because JPEG halves the resolution of colour.
        weakest = shapes.circle_px[1, 0, :, 2] + shapes.circle_px[1, 1, :, 2] >= 2.0 * _WEAKEST_FROM_PX
        own_circle = np.where(weakest[:, None], shapes.circle_px[1], circle)
        own_edge = np.where(weakest[:, None], shapes.edge_px[1, _CORE : HALF + 1], own_edge)
        own_ground = np.where(weakest, ground[1], own_ground)
    rim_px, core_px = _rims(own_circle, height[0] if not colour else np.where(weakest, height[1], height[0]))
    unclipped = np.minimum(np.maximum((_UNCLIPPED - peak[0]) / _UNCLIPPED_OVER, 0.0), 1.0)
    scattered = _scattered(circle, unclipped, water)
    if scattered.any():
        rim_px += scattered[:, None] * (_where_glow_begins(circle) - rim_px)
    step_px = _at_most(_GUESS * (own_circle[0, :, :2] - own_circle[HALF, :, :2]), _GUESS_MOST * core_px)
    edge = shapes.edge_px[0, HALF]
    border_px = np.zeros((len(radius), 2)) if rings.inside is None else _at_border(centre, own_edge[1], image.shape)
    radius_px = circle[HALF, :, 2]
    bright = np.flatnonzero(radius_px > _DARK * radius[:, 0])
    core_elongation, half_elongation, *higher = elongation(
        np.concatenate([own_edge[0], edge, *shapes.edge_px[0, :HALF]]),
        np.concatenate([own_circle[_CORE], circle[HALF], *circle[:HALF]]),
    ).reshape(2 + HALF, -1)
    lights = Lights(
        centre + rim_px,
        core_px,
        centre + (rim_px + step_px),
        own_ground,
        weakest,
        core_elongation,
        unclipped,
        scattered,
        border_px,
        peak[0],
        height[0],
        edge,
        centre,
        np.pi * (radius_px * radius_px),
        half_elongation,
        np.minimum.reduce([half_elongation, *higher]),
        circle[..., 2].T,
        outstanding,
    )
    return lights if len(bright) == len(radius_px) else lights.at(bright)


def distinct(centre_px: Floats, radius_px: Floats, at_most: int) -> list[int]:
    """Return the indices of at most `at_most` places, in order; skip each place that overlaps an earlier one.

    centre_px: (N, 2); radius_px: (N,). Two places overlap where one's centre is within 0.7 radii of the other's.
    """
    kept: list[tuple[float, float, float]] = []
    indices: list[int] = []
    reach2_px2 = np.maximum(0.7 * radius_px, 2.0) ** 2
    for i, (u, v, reach2) in enumerate(zip(*centre_px.T.tolist(), reach2_px2.tolist(), strict=True)):
        for other_u, other_v, other_reach2 in kept:
            apart2 = (u - other_u) * (u - other_u) + (v - other_v) * (v - other_v)
            if apart2 < reach2 or apart2 < other_reach2:
                break
        else:
            kept.append((u, v, reach2))
            indices.append(i)
            if len(indices) == at_most:
                break
    return indices


def _low(level: Floats, share: float) -> Floats:
    """Return the quantile `share` of each place's samples: (C, N) from (C, N, M, K)."""
    flat = level.reshape(*level.shape[:2], -1)
    k = int(share * flat.shape[2])
    return np.partition(flat, k, axis=2)[:, :, k]


def _rims(circle_px: Floats, height: Floats) -> tuple[Floats, Floats]:
    """Return each light's rim, where its profile is steepest: centres (N, 2), radii (N,), from (S, N, 3).

    The rim is the edge of the lamp's face where the face is visible, and else the edge of the clipped glow. height:
    (N,), grey levels; of a faint light only the lowest outlines count, because noise draws the higher ones.
    """
    widening = np.maximum(circle_px[1:, :, 2] - circle_px[:-1, :, 2], 0.15)
    widening[:-1, height < _FAINT] = np.inf
    k = widening.argmin(axis=0)
    rim = (0.5 * (circle_px[1:] + circle_px[:-1]))[k, np.arange(len(k))]
    return rim[:, :2], rim[:, 2]


def _scattered(circle_px: Floats, unclipped: Floats, water: float) -> Floats:
    """Return how surely a light in veiled water shows only scattered light, (N,), 0 to 1.

    Such a light is not clipped and has a halo. The profile of a core is as steep below half its height as above; the
    profile of a glow flattens out. circle_px: (S, N, 3).
    """
    flattening = circle_px[HALF + 1, :, 2] / circle_px[HALF, :, 2]
    halo = np.minimum(np.maximum((flattening - 1.35) / 0.2, 0.0), 1.0)
    return np.asarray(halo * unclipped * min(water / VEIL, 1.0), np.float32)


def _where_glow_begins(circle_px: Floats) -> Floats:
    """Return where a glow without a core begins, (N, 2): on the side away from its fainter parts.

    A beam that passes beside the camera shows as glow along its way; its source is behind the brightest part.
    circle_px: (S, N, 3).
    """
    top, low = circle_px[0, :, :2], circle_px[-1, :, :2]
    return top + _at_most(_GLOW_BACK * (top - low), _GLOW_BACK_MOST * circle_px[HALF, :, 2])


def _at_border(centre_px: Floats, edge_px: Floats, shape: tuple[int, ...]) -> Floats:
    """Return where the border cuts outlines, (N, 2), as in Lights. centre_px: (N, 2); edge_px: (N, K); shape: (H, W).

    The border cuts a chord of half length h out of a circle that reaches D deep into the picture. So the circle's
    middle is (D^2 - h^2) / (2 D) inside of the border. For a light outside of the picture this is small or negative.
    """
    at_px = centre_px[:, None] + edge_px[:, :, None] * RAY_UV
    far_px = np.array(shape[1::-1]) - 0.5
    inside_px = np.concatenate([at_px + 0.5, far_px - at_px], axis=2)  # of the left, upper, right and lower border
    lights = np.arange(len(at_px))
    border = inside_px.min(axis=1).argmin(axis=1)
    inside_px, along_px = inside_px[lights, :, border], at_px[lights, :, 1 - border % 2]
    cut = inside_px < _AT_BORDER_PX
    chord_px = np.where(cut, along_px, -np.inf).max(axis=1) - np.where(cut, along_px, np.inf).min(axis=1)
    depth_px = np.maximum(inside_px.max(axis=1), 0.5)
    found = np.stack([(depth_px * depth_px - 0.25 * chord_px * chord_px) / (2.0 * depth_px), depth_px], axis=1)
    return np.where(cut.any(axis=1, keepdims=True), found, 0.0)


def _at_most(step_px: Floats, length_px: Floats) -> Floats:
    """Limit steps (N, 2) to the lengths (N,)."""
    own_px = np.maximum(np.hypot(step_px[:, 0], step_px[:, 1]), 1e-6)
    return np.asarray(step_px * np.minimum(length_px / own_px, 1.0)[:, None], np.float32)


def water_level(image: NDArray[np.uint8]) -> float:
    """Return the 20 % quantile of a picture's weakest channel, in grey levels."""
    # Few rows, but many pixels of each: the pixels of one row are adjacent in memory.
    some = image[::32, ::16]
    weak = (some if image.ndim == 2 else weakest_channel(some)).ravel()
    k = len(weak) // 5
    return float(np.partition(weak, k)[k])
