"""Sample a picture on rings around many places at once.

The radii grow geometrically, so that lights of all sizes are sampled alike. N places, M rings, K rays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.floating[Any]]
LUMA_BGR = np.array([0.114, 0.587, 0.299], np.float32)

RAYS = 24
_ANGLES = np.arange(RAYS) * (2.0 * np.pi / RAYS)
RAY_UV = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1).astype(np.float32)
"""(K, 2): each ray's direction."""

_AT_ALL_RAYS = np.tile(np.eye(2, dtype=np.float32), RAYS)
_DOUBLED = np.stack([np.ones(RAYS), np.cos(2.0 * _ANGLES), np.sin(2.0 * _ANGLES)], axis=1)
_SECOND = (_DOUBLED / (2.0 * RAYS)).astype(np.float32)
_CENTROID = RAY_UV / np.float32(1.5 * RAYS)
MEAN: Final = np.full(RAYS, 1.0 / RAYS, np.float32)
"""Sums over rays are matrix products with vectors such as this: many times faster than sums along the last axis."""


@dataclass(slots=True, eq=False)
class Rings:
    """Samples around N places. radius_px: (N, M). pixels: (N, M, K) grey or (N, M, K, 3) blue green red.

    inside: (N, M, K), whether a sample lies in the picture; None if all do.
    """

    radius_px: Floats
    pixels: NDArray[np.uint8]
    inside: NDArray[np.bool_] | None


def sample_rings(image: NDArray[np.uint8], centre_px: Floats, radius_px: Floats) -> Rings:
    """Sample a picture by bilinear interpolation. centre_px: (N, 2) px; radius_px: (N, M) px, ascending."""
    n, m = radius_px.shape
    uv = radius_px[:, :, None] * RAY_UV.ravel()
    uv += (centre_px @ _AT_ALL_RAYS)[:, None]
    pixels = cv2.remap(  # type: ignore[call-overload]
        image,
        uv.reshape(n * m, RAYS, 2),
        None,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    far = np.array(image.shape[1::-1], np.float32) - np.float32(0.5)
    inside = None
    if (np.minimum(centre_px + np.float32(0.5), far - centre_px) <= radius_px[:, -1:]).any():
        u, v = uv[:, :, ::2], uv[:, :, 1::2]
        inside = (u > -0.5) & (v > -0.5) & (u < far[0]) & (v < far[1])
    return Rings(radius_px, np.asarray(pixels, np.uint8).reshape(n, m, RAYS, *image.shape[2:]), inside)


def geometric_radii(first_px: Floats, last_px: Floats, share: Floats) -> Floats:
    """Return (N, M) radii, float32, from first_px (N,) to last_px (N,): log-spaced at share (M,), 0-1."""
    return np.asarray(first_px[:, None] * (last_px / first_px)[:, None] ** share, np.float32)


@dataclass(slots=True, eq=False)
class Shapes:
    """Outlines and moments of star-shaped regions around N places, in C channels at S levels.

    edge_px: (C, S, N, K), distance from the place to the outline along each ray; the last ring's where a ray does not
    meet it. circle_px: (C, S, N, 3), the centroid relative to the place, and the radius of the circle of equal area.
    """

    edge_px: Floats
    circle_px: Floats


def elongation(edge_px: Floats, circle_px: Floats) -> Floats:
    """Return the long over the short axis of outlines, (N,). edge_px: (N, K), circle_px: (N, 3), as in Shapes."""
    square = edge_px * edge_px
    second = (square * square) @ _SECOND
    u, v, radius = circle_px.T
    second /= (radius * radius)[:, None]
    uu, vv = u * u, v * v
    mean = second[:, 0] - (uu + vv)
    spread = np.hypot(second[:, 1] - (uu - vv), second[:, 2] - 2.0 * u * v)
    ratio: Floats = np.sqrt((mean + spread) / np.maximum(mean - spread, 1e-3 * mean + 1e-9))
    return ratio


def find_shapes(level: Floats, rings: Rings, threshold: Floats) -> Shapes:
    """Follow each ray outward to the outline: where the level first falls below a threshold or the picture ends.

    level: (C, N, M, K), grey levels on the rings. threshold: (C, S, N), grey levels.
    """
    channels, places, many = level.shape[:3]
    radius_px = rings.radius_px
    # The rings become the last axis: all that follows runs along a ray.
    outward = np.ascontiguousarray(level.swapaxes(2, 3))
    threshold = threshold[..., None]
    below = outward[:, None] < threshold[..., None]
    if rings.inside is not None:
        below |= ~rings.inside.swapaxes(1, 2)
    below[..., -1] = True
    first = below.argmax(axis=4)
    before = np.maximum(first - 1, 0)
    start = np.arange(0, outward.size, many).reshape(channels, 1, places, RAYS)
    inner, outer = outward.take(start + before), outward.take(start + first)
    share = (inner - threshold) / np.maximum(inner - outer, 1e-3)
    np.minimum(np.maximum(share, 0.0, out=share), 1.0, out=share)
    start = np.arange(0, radius_px.size, many)[:, None]
    near = radius_px.take(start + before)
    edge = near + share * (radius_px.take(start + first) - near)
    np.multiply(edge, 0.5, out=edge, where=first == 0)
    rows = edge.reshape(-1, RAYS)
    square = rows * rows
    area = np.maximum(square @ MEAN, 1e-6)
    circle = np.empty((len(rows), 3), np.float32)
    np.divide((square * rows) @ _CENTROID, area[:, None], out=circle[:, :2])
    np.sqrt(area, out=circle[:, 2])
    return Shapes(edge, circle.reshape(*first.shape[:3], 3))


def luminance(pixels: NDArray[np.uint8]) -> Floats:
    """Return the luminance (N, M, K), grey levels, of (N, M, K) grey or (N, M, K, 3) blue green red."""
    level: Floats = pixels.astype(np.float32)
    return level if pixels.ndim == 3 else level @ LUMA_BGR


def weakest_channel(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return (...,) the lowest of three channels (..., 3). A core is white and keeps it high; the glow is coloured."""
    return np.minimum(np.minimum(pixels[..., 0], pixels[..., 1]), pixels[..., 2])
