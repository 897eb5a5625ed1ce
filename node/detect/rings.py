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
LUMA_BGR = np.array([0.114, 0.587, 0.299], np.float32)

_RAYS = np.stack([RAY_COS, RAY_SIN])[:, None, None]
_CENTROID = RAY_HARMONICS[:, 1:3] / np.float32(1.5 * RAYS)
_MEAN = np.full(RAYS, 1.0 / RAYS, np.float32)


@dataclass(frozen=True, slots=True)
class Rings:
    """Samples around N places. radius_px: (N, M). pixels: (N, M, K, C) grey levels, C 1 or 3.

    inside: (N, M, K), which lie in the picture; None where all do.
    """

    radius_px: Floats
    pixels: Floats
    inside: NDArray[np.bool_] | None


def sample_rings(image: NDArray[np.uint8], centre_px: Floats, radius_px: Floats) -> Rings:
    """Sample a picture bilinearly. centre_px: (N, 2); radius_px: (N, M), growing, both in px."""
    n, m = radius_px.shape
    u, v = uv = radius_px[:, :, None] * _RAYS
    uv += centre_px.T[:, :, None, None]
    pixels = cv2.remap(
        image,
        u.reshape(n * m, RAYS),
        v.reshape(n * m, RAYS),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    height, width = image.shape[:2]
    inside = None
    if uv.min() < 0.0 or u.max() > width - 1 or v.max() > height - 1:
        inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
    return Rings(radius_px, np.asarray(pixels, np.float32).reshape(n, m, RAYS, -1), inside)


def geometric_radii(first_px: Floats, last_px: Floats, count: int) -> Floats:
    """Give (N, count) float32 radii that grow by a constant factor from first_px (N,) to last_px (N,)."""
    share = np.arange(count, dtype=np.float32) / np.float32(count - 1)
    return np.asarray(first_px[:, None] * (last_px / first_px)[:, None] ** share, np.float32)


@dataclass(frozen=True, slots=True)
class Shapes:
    """Outlines and moments of star-shaped regions around N places, in C channels at S levels.

    edge_px: (C, S, N, K) distance to the outline along each ray; open_share: (C, S, N) share of rays without one.
    centre_px: (C, S, N, 2) centroid relative to the place. radius_px: (C, S, N) of the circle of equal area.
    """

    edge_px: Floats
    open_share: Floats
    centre_px: Floats
    radius_px: Floats

    def elongation(self) -> Floats:
        """Measure the long over the short axis, (C, S, N)."""
        square = self.edge_px * self.edge_px
        u, v = self.centre_px[..., 0], self.centre_px[..., 1]
        second = (square * square) @ RAY_HARMONICS[:, 3:] / (2.0 * RAYS * (self.radius_px * self.radius_px)[..., None])
        uu, uv, vv = second[..., 0] - u * u, second[..., 1] - u * v, second[..., 2] - v * v
        mean = 0.5 * (uu + vv)
        spread = np.hypot(0.5 * (uu - vv), uv)
        ratio: Floats = np.sqrt((mean + spread) / np.maximum(mean - spread, 1e-3 * mean + 1e-9))
        return ratio


def find_shapes(level: Floats, inside: NDArray[np.bool_] | None, radius_px: Floats, threshold: Floats) -> Shapes:
    """Follow each ray outward to where it first falls below a threshold, or leaves the picture.

    level: (C, N, M, K) grey levels on rings of radius_px (N, M); inside: (N, M, K), None: all; threshold:
    (C, S, N).
    """
    channels, places, rings = level.shape[:3]
    # Rings last: what follows runs along them.
    outward = np.ascontiguousarray(level.swapaxes(2, 3))
    below = outward[:, None] < threshold[..., None, None]
    if inside is not None:
        below |= ~inside.swapaxes(1, 2)
    first = below.argmax(axis=4)
    is_open = (first == 0) & ~below[..., 0]
    first[is_open] = rings - 1
    before = np.maximum(first - 1, 0)
    start = np.arange(0, outward.size, rings).reshape(channels, 1, places, RAYS)
    inner, outer = outward.take(start + before), outward.take(start + first)
    share = (inner - threshold[..., None]) / np.maximum(inner - outer, 1e-3)
    np.minimum(np.maximum(share, 0.0, out=share), 1.0, out=share)
    start = np.arange(0, radius_px.size, rings)[:, None]
    near, far = radius_px.take(start + before), radius_px.take(start + first)
    edge = near + share * (far - near)
    edge[is_open] = far[is_open]
    edge[first == 0] *= 0.5
    square = edge * edge
    area = np.maximum(square @ _MEAN, 1e-6)
    centre = (square * edge) @ _CENTROID / area[..., None]
    return Shapes(edge, is_open @ _MEAN, centre, np.sqrt(area))


def luminance(pixels: Floats) -> Floats:
    """Give (...,) levels from (..., C) pixels, blue green red or grey."""
    luma: Floats = pixels[..., 0] if pixels.shape[-1] == 1 else pixels @ LUMA_BGR
    return luma


def weakest_channel(pixels: Floats | NDArray[np.uint8]) -> Floats:
    """Give (...,) the lowest of three channels: a core is white, and the water colours the glow."""
    weakest: Floats = np.minimum(np.minimum(pixels[..., 0], pixels[..., 1]), pixels[..., 2])
    return weakest
