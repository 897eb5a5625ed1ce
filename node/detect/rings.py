"""A picture sampled on rings around places, many places at once.

Rings grow geometrically, so that a light is seen alike at every size. N places, M rings, K rays.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

RAYS = 32
_ANGLES = np.arange(RAYS) * (2.0 * np.pi / RAYS)
RAY_COS = np.cos(_ANGLES).astype(np.float32)
RAY_SIN = np.sin(_ANGLES).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Rings:
    """Samples around N places. radius_px: (N, M). pixels: (N, M, K, C) grey levels, C 1 or 3. inside: (N, M, K)."""

    radius_px: NDArray[np.float32]
    pixels: NDArray[np.float32]
    inside: NDArray[np.bool_]


def sample_rings(image: NDArray[np.uint8], centre_px: NDArray[np.float32], radius_px: NDArray[np.float32]) -> Rings:
    """Sample a picture bilinearly. centre_px: (N, 2); radius_px: (N, M), both in px."""
    n, m = radius_px.shape
    u = (centre_px[:, 0, None, None] + radius_px[:, :, None] * RAY_COS).reshape(n * m, RAYS)
    v = (centre_px[:, 1, None, None] + radius_px[:, :, None] * RAY_SIN).reshape(n * m, RAYS)
    height, width = image.shape[:2]
    pixels = cv2.remap(
        image,
        u.astype(np.float32, copy=False),
        v.astype(np.float32, copy=False),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    inside = (u > -0.5) & (v > -0.5) & (u < width - 0.5) & (v < height - 0.5)
    return Rings(
        radius_px,
        np.asarray(pixels, np.float32).reshape(n, m, RAYS, -1),
        inside.reshape(n, m, RAYS),
    )


def geometric(first_px: NDArray[np.float32], last_px: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Give (N, count) radii that grow by a constant factor from first_px (N,) to last_px (N,)."""
    share = np.linspace(0.0, 1.0, count, dtype=np.float32)
    ratio: NDArray[np.float32] = first_px[:, None] * (last_px / first_px)[:, None] ** share
    return ratio


@dataclass(frozen=True, slots=True)
class Regions:
    """The connected surroundings of N places brighter than a level, as seen from within: star-shaped outlines.

    edge_px: (N, K) distance to the outline along each ray. centre_px: (N, 2) centroid, relative to the place.
    radius_px: (N,) of the circle of equal area. elongation: (N,) long over short axis. open_share: (N,) share of
    rays that never fall below the level.
    """

    edge_px: NDArray[np.float32]
    centre_px: NDArray[np.float32]
    radius_px: NDArray[np.float32]
    elongation: NDArray[np.float32]
    open_share: NDArray[np.float32]


def find_regions(level: NDArray[np.float32], radius_px: NDArray[np.float32], threshold: NDArray[np.float32]) -> Regions:
    """Follow each ray outward to where it first falls below the threshold.

    level: (N, M, K) grey levels on rings of radius_px (N, M); threshold: (N,).
    """
    n, m, _ = level.shape
    below = level < threshold[:, None, None]
    closed = below.any(axis=1)
    first = np.where(closed, below.argmax(axis=1), m - 1)
    before = np.maximum(first - 1, 0)
    rows = np.arange(n)[:, None]
    rays = np.arange(level.shape[2])[None, :]
    outer, inner = level[rows, first, rays], level[rows, before, rays]
    share = np.clip((inner - threshold[:, None]) / np.maximum(inner - outer, 1e-3), 0.0, 1.0)
    r_outer, r_inner = radius_px[rows, first], radius_px[rows, before]
    edge = np.where(closed, r_inner + share * (r_outer - r_inner), r_outer)
    edge = np.where(first == 0, 0.5 * radius_px[:, :1], edge).astype(np.float32)

    # Moments of a star-shaped region in polar coordinates.
    square = edge * edge
    area = np.maximum(square.mean(axis=1), 1e-6) * 0.5
    cube = square * edge / 3.0
    centre = np.stack([(cube * RAY_COS).mean(axis=1), (cube * RAY_SIN).mean(axis=1)], axis=1) / area[:, None]
    fourth = square * square / 4.0
    uu = (fourth * RAY_COS * RAY_COS).mean(axis=1) / area - centre[:, 0] ** 2
    vv = (fourth * RAY_SIN * RAY_SIN).mean(axis=1) / area - centre[:, 1] ** 2
    uv = (fourth * RAY_COS * RAY_SIN).mean(axis=1) / area - centre[:, 0] * centre[:, 1]
    half_trace = 0.5 * (uu + vv)
    spread = np.sqrt((0.5 * (uu - vv)) ** 2 + uv**2)
    elongation = np.sqrt((half_trace + spread) / np.maximum(half_trace - spread, 1e-3 * half_trace + 1e-9))
    return Regions(
        edge,
        centre.astype(np.float32),
        np.sqrt(2.0 * area).astype(np.float32),
        elongation.astype(np.float32),
        (1.0 - closed.mean(axis=1)).astype(np.float32),
    )
