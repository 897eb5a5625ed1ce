"""A picture sampled on rings around places, many places at once.

Rings grow geometrically, so that a light is seen alike at every size. N places, M rings, K rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.floating[Any]]

RAYS = 24
_ANGLES = np.arange(RAYS) * (2.0 * np.pi / RAYS)
RAY_COS = np.cos(_ANGLES).astype(np.float32)
RAY_SIN = np.sin(_ANGLES).astype(np.float32)
RAY_HARMONICS = np.stack([np.ones(RAYS), RAY_COS, RAY_SIN, RAY_COS**2, RAY_COS * RAY_SIN, RAY_SIN**2], axis=1).astype(
    np.float32
)
"""(K, 6): 1, c, s, cc, cs, ss of each ray's direction."""


@dataclass(frozen=True, slots=True)
class Rings:
    """Samples around N places. radius_px: (N, M). pixels: (N, M, K, C) grey levels, C 1 or 3. inside: (N, M, K)."""

    radius_px: Floats
    pixels: Floats
    inside: NDArray[np.bool_]


def sample_rings(image: NDArray[np.uint8], centre_px: Floats, radius_px: Floats) -> Rings:
    """Sample a picture bilinearly. centre_px: (N, 2); radius_px: (N, M), both in px."""
    n, m = radius_px.shape
    u = radius_px[:, :, None] * RAY_COS
    v = radius_px[:, :, None] * RAY_SIN
    u += centre_px[:, 0, None, None]
    v += centre_px[:, 1, None, None]
    pixels = cv2.remap(
        image,
        u.reshape(n * m, RAYS),
        v.reshape(n * m, RAYS),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    height, width = image.shape[:2]
    inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
    return Rings(radius_px, np.asarray(pixels, np.float32).reshape(n, m, RAYS, -1), inside)


def geometric_radii(first_px: Floats, last_px: Floats, count: int) -> Floats:
    """Give (N, count) float32 radii that grow by a constant factor from first_px (N,) to last_px (N,)."""
    share = np.arange(count, dtype=np.float32) / np.float32(count - 1)
    radii = first_px[:, None] * (last_px / first_px)[:, None] ** share
    return radii.astype(np.float32)


def follow_edges(
    level: Floats, inside: NDArray[np.bool_], radius_px: Floats, threshold: Floats
) -> tuple[Floats, Floats]:
    """Follow each ray outward to where it first falls below a threshold: the outline of a star-shaped region.

    level: (N, M, K) grey levels on rings of radius_px (N, M); threshold: (N,). The picture's border ends a region,
    too: inside (N, M, K). Returns the distance to the outline along each ray, (N, K) px, and the share of rays that
    never fall below the threshold, (N,).
    """
    n, m, rays = level.shape
    below = (level < threshold[:, None, None]) | ~inside
    first = below.argmax(axis=1)
    places = np.arange(n)[:, None]
    ray = np.arange(rays)[None, :]
    is_open = (first == 0) & ~below[:, 0]
    first[is_open] = m - 1
    before = np.maximum(first - 1, 0)
    outer, inner = level[places, first, ray], level[places, before, ray]
    share = (inner - threshold[:, None]) / np.maximum(inner - outer, 1e-3)
    np.clip(share, 0.0, 1.0, out=share)
    near, far = radius_px[places, before], radius_px[places, first]
    edge = near + share * (far - near)
    edge[is_open] = far[is_open]
    edge[first == 0] *= 0.5
    return edge, is_open @ np.full(rays, 1.0 / rays, np.float32)


@dataclass(frozen=True, slots=True)
class Shapes:
    """Outlines and moments of star-shaped regions around N places, at S levels.

    edge_px: (S, N, K) distance to the outline along each ray; open_share: (S, N) share of rays without one.
    centre_px: (S, N, 2) centroid relative to the place. radius_px: (S, N) of the circle of equal area. elongation:
    (S, N) long over short axis.
    """

    edge_px: Floats
    open_share: Floats
    centre_px: Floats
    radius_px: Floats
    elongation: Floats


def measure_shapes(edge_px: Floats, open_share: Floats, levels: int) -> Shapes:
    """Measure regions from their outlines' distances along the rays, (S N, K) px."""
    square = edge_px * edge_px
    area = np.maximum(square @ RAY_HARMONICS[:, 0] * (0.5 / RAYS), 1e-6)
    centre = (square * edge_px) @ RAY_HARMONICS[:, 1:3] / (3.0 * RAYS * area[:, None])
    second = (square * square) @ RAY_HARMONICS[:, 3:] / (4.0 * RAYS * area[:, None])
    uu = second[:, 0] - centre[:, 0] ** 2
    uv = second[:, 1] - centre[:, 0] * centre[:, 1]
    vv = second[:, 2] - centre[:, 1] ** 2
    mean = 0.5 * (uu + vv)
    spread = np.hypot(0.5 * (uu - vv), uv)
    elongation = np.sqrt((mean + spread) / np.maximum(mean - spread, 1e-3 * mean + 1e-9))
    return Shapes(
        edge_px.reshape(levels, -1, RAYS),
        open_share.reshape(levels, -1),
        centre.reshape(levels, -1, 2),
        np.sqrt(2.0 * area).reshape(levels, -1),
        elongation.reshape(levels, -1),
    )
