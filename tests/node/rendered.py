"""Small pictures of lamps under water for the detector's tests: core, glow, cone, ground, noise, clipping."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

LEANS_FROM_PX = 40.0
WATER_BGR = np.array([1.0, 0.9, 0.45])


def lamp_picture(
    lamps_px: Sequence[tuple[float, float]],
    *,
    size: tuple[int, int] = (410, 308),
    core: float = 900.0,
    core_px: float = 2.0,
    glow: float = 0.0,
    lean: float = 0.0,
    ground: float = 10.0,
    noise: float = 2.0,
    seed: int = 0,
) -> NDArray[np.uint8]:
    """Render lamps into a (H, W, 3) BGR picture.

    A lamp is a gaussian core (peak `core`, sd core_px) and a glow that falls as 1/distance (`glow` at 1 px), leaning
    towards +u by the factor exp(lean cos phi): scattered light along a beam that points to the right. Near the source
    it leans less: there, light scattered by small angles prevails, which comes from all around the beam.
    """
    width, height = size
    v, u = np.mgrid[:height, :width].astype(np.float64)
    light = np.zeros((height, width))
    for u_px, v_px in lamps_px:
        distance = np.hypot(u - u_px, v - v_px)
        light += core * np.exp(-0.5 * (distance / core_px) ** 2)
        if glow:
            cosine = (u - u_px) / np.maximum(distance, 1e-6)
            leans = lean * distance / (distance + LEANS_FROM_PX)
            light += glow * np.exp(leans * (cosine - 1.0)) / np.maximum(distance, 1.0)
    picture = ground + light[:, :, None] * WATER_BGR
    picture += _noise(seed, noise, height, width)
    return np.clip(np.round(picture), 0, 255).astype(np.uint8)


@lru_cache(maxsize=2)
def _noise(seed: int, sigma: float, height: int, width: int) -> NDArray[np.float64]:
    """Return the noise of a picture's three colours; most tests show many pictures of one seed."""
    return np.random.default_rng(seed).normal(0.0, sigma, (height, width, 3))
