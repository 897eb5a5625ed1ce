"""A picture sampled on rings around places, many places at once.

Rings grow geometrically, so that a light is seen alike at every size. N places, M rings, K rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.floating[Any]]

LUMA_BGR = np.array([0.114, 0.587, 0.299], np.float32)


class Rays:
    """K directions around a place, and what sums over them.

    uv: (K, 2). at_all: (2, 2K) repeats a place's coordinates. mean: (K,), centroid: (K, 2) and second: (K, 3), by
    which powers of the distances to an outline give its area over pi, first and second moments.
    """

    def __init__(self, count: int) -> None:
        angles = np.arange(count) * (2.0 * np.pi / count)
        self.count = count
        self.uv = np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)
        self.at_all = np.tile(np.eye(2, dtype=np.float32), count)
        self.mean = np.full(count, 1.0 / count, np.float32)
        self.centroid = self.uv / np.float32(1.5 * count)
        doubled = np.stack([np.ones(count), np.cos(2.0 * angles), np.sin(2.0 * angles)], axis=1)
        self.second = (doubled / (2.0 * count)).astype(np.float32)


RAYS: Final = Rays(24)
FEW_RAYS: Final = Rays(12)
"""Enough for about where a region is."""


@dataclass(slots=True, eq=False)
class Rings:
    """Samples around N places. radius_px: (N, M). pixels: (N, M, K) grey or (N, M, K, 3) blue green red.

    inside: (N, M, K), which lie in the picture.
    """

    radius_px: Floats
    pixels: NDArray[np.uint8]
    inside: NDArray[np.bool_]


def sample_rings(image: NDArray[np.uint8], centre_px: Floats, radius_px: Floats, rays: Rays = RAYS) -> Rings:
    """Sample a picture bilinearly. centre_px: (N, 2); radius_px: (N, M), growing, both in px."""
    n, m = radius_px.shape
    uv = radius_px[:, :, None] * rays.uv.ravel()
    uv += (centre_px @ rays.at_all)[:, None]
    pixels = cv2.remap(  # type: ignore[call-overload]
        image,
        uv.reshape(n * m, rays.count, 2),
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    half = np.array(image.shape[1::-1], np.float32) @ rays.at_all * np.float32(0.5)
    uv -= half - np.float32(0.5)
    in_range = np.abs(uv, out=uv) < half
    inside = in_range[:, :, ::2] & in_range[:, :, 1::2]
    return Rings(radius_px, np.asarray(pixels, np.uint8).reshape(n, m, rays.count, *image.shape[2:]), inside)


def geometric_radii(first_px: Floats, last_px: Floats, share: Floats) -> Floats:
    """Give (N, M) float32 radii that grow by a constant factor from first_px (N,) to last_px (N,), at shares (M,)."""
    return np.asarray(first_px[:, None] * (last_px / first_px)[:, None] ** share, np.float32)


@dataclass(slots=True, eq=False)
class Shapes:
    """Outlines and moments of star-shaped regions around N places, in C channels at S levels.

    edge_px: (C, S, N, K) distance to the outline along each ray; is_open: (C, S, N, K), rays without one.
    circle_px: (C, S, N, 3), the centroid relative to the place and the radius of the circle of equal area.
    """

    edge_px: Floats
    is_open: NDArray[np.bool_]
    circle_px: Floats


def elongation(edge_px: Floats, circle_px: Floats, rays: Rays = RAYS) -> Floats:
    """Measure the long over the short axis of outlines: (N,) from (N, K) and (N, 3) as in Shapes."""
    square = edge_px * edge_px
    second = (square * square) @ rays.second
    u, v, radius = circle_px.T
    second /= (radius * radius)[:, None]
    uu, vv = u * u, v * v
    mean = second[:, 0] - (uu + vv)
    spread = np.hypot(second[:, 1] - (uu - vv), second[:, 2] - 2.0 * u * v)
    ratio: Floats = np.sqrt((mean + spread) / np.maximum(mean - spread, 1e-3 * mean + 1e-9))
    return ratio


def find_shapes(level: Floats, rings: Rings, threshold: Floats, rays: Rays = RAYS) -> Shapes:
    """Follow each ray outward to where it first falls below a threshold, or leaves the picture.

    level: (C, N, M, K) grey levels on the rings; threshold: (C, S, N).
    """
    channels, places, many = level.shape[:3]
    radius_px = rings.radius_px
    # Rings last: what follows runs along them.
    outward = np.ascontiguousarray(level.swapaxes(2, 3))
    threshold = threshold[..., None]
    below = outward[:, None] < threshold[..., None]
    below |= ~rings.inside.swapaxes(1, 2)
    is_open = ~below[..., -1]
    below[..., -1] = True
    first = below.argmax(axis=4)
    is_open &= first == many - 1
    before = np.maximum(first - 1, 0)
    start = np.arange(0, outward.size, many).reshape(channels, 1, places, rays.count)
    inner, outer = outward.take(start + before), outward.take(start + first)
    share = (inner - threshold) / np.maximum(inner - outer, 1e-3)
    np.minimum(np.maximum(share, 0.0, out=share), 1.0, out=share)
    start = np.arange(0, radius_px.size, many)[:, None]
    near = radius_px.take(start + before)
    edge = near + share * (radius_px.take(start + first) - near)
    np.multiply(edge, 0.5, out=edge, where=first == 0)
    rows = edge.reshape(-1, rays.count)
    square = rows * rows
    area = np.maximum(square @ rays.mean, 1e-6)
    circle = np.empty((len(rows), 3), np.float32)
    np.divide((square * rows) @ rays.centroid, area[:, None], out=circle[:, :2])
    np.sqrt(area, out=circle[:, 2])
    return Shapes(edge, is_open, circle.reshape(*first.shape[:3], 3))


def luminance(pixels: NDArray[np.uint8]) -> Floats:
    """Give (N, M, K) levels from (N, M, K) grey or (N, M, K, 3) blue green red."""
    level: Floats = pixels.astype(np.float32)
    return level if pixels.ndim == 3 else level @ LUMA_BGR


def weakest_channel(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Give (...,) the lowest of three channels: a core is white, and the water colours the glow."""
    return np.minimum(np.minimum(pixels[..., 0], pixels[..., 1]), pixels[..., 2])
