"""What a picture says of its exposure: the light of the lamps' cores, and of the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from buddyline.node.detect.detection import is_likely
from buddyline.protocol.messages import Blob
from numpy.typing import NDArray

LAMPS: Final = 2
CLIPPED: Final = 250
CORE_SHARE: Final = 0.5
CORE_PX: Final = (1.5, 24.0)
"""A core is measured within this share of the candidate's radius, but at least and at most so many px."""
BRIGHTEST: Final = 0.9
"""A core's light is this quantile of its pixels: a hot pixel or a glint is not a core."""
BANDS_RADII, BANDS_PX = 1.5, (4, 24)
"""Bands are looked for as far as this many of the candidate's radii from it, but at least and at most so many px."""
DIM: Final = 0.05
"""Rows are not compared where the column has less than this share of the brightest column's light."""
SPARSE: Final = 8
"""Of the whole picture, one pixel in this many is measured, along rows and columns."""


@dataclass(frozen=True, slots=True)
class Core:
    """The core of one lamp. light: of its brightest channel, as a share of what clips; a lower bound where clipped.

    banding: how much the light of the rows differs from that of the columns, see _banding; None at the border.
    """

    u_px: float
    v_px: float
    light: float
    clipped: bool
    banding: float | None = None


@dataclass(frozen=True, slots=True)
class SceneLight:
    """A whole picture. mean: of its light, as a share of what clips. clipped: share of its pixels that are clipped."""

    mean: float
    clipped: float


def choose_lamps(blobs: Sequence[Blob], expected: int = 0) -> list[Blob]:
    """Return the candidates that are taken for the other node's lamps: the expected ones, else the likeliest two.

    expected: how many of the first candidates are where the solver expects these lamps.
    """
    return [blob for blob in blobs[: expected or LAMPS] if is_likely(blob)]


def measure_cores(image: NDArray[np.uint8], lamps: Sequence[Blob], linear: NDArray[np.float64]) -> list[Core]:
    """Measure the lamps' cores in a BGR (H, W, 3) or grey (H, W) picture. linear: (256,), light of each grey level."""
    height, width = image.shape[:2]
    cores = []
    for lamp in lamps:
        radius_px = min(max(CORE_SHARE * math.sqrt(lamp.area_px / math.pi), CORE_PX[0]), CORE_PX[1])
        u0, u1 = max(math.ceil(lamp.u_px - radius_px), 0), min(math.floor(lamp.u_px + radius_px) + 1, width)
        v0, v1 = max(math.ceil(lamp.v_px - radius_px), 0), min(math.floor(lamp.v_px + radius_px) + 1, height)
        patch = image[v0:v1, u0:u1]
        if patch.size == 0:
            continue
        level = _brightest(patch if patch.ndim == 2 else patch.max(axis=2))
        banding = _banding(image, lamp, linear)
        cores.append(Core(lamp.u_px, lamp.v_px, float(linear[level]), level >= CLIPPED, banding))
    return cores


def _banding(image: NDArray[np.uint8], lamp: Blob, linear: NDArray[np.float64]) -> float | None:
    """Return how much a lamp's light over the rows differs from that over the columns; None too near to the border.

    It is the standard deviation of the logarithm of the two profiles' ratio. A round lamp has two like profiles, but
    its glow leans, as a rule sideways: so the mean of the columns' profile and its mirror image is taken. Pulses make
    bands in the rows of a rolling shutter.
    """
    reach = math.ceil(min(max(BANDS_RADII * math.sqrt(lamp.area_px / math.pi), BANDS_PX[0]), BANDS_PX[1]))
    u, v, margin = round(lamp.u_px), round(lamp.v_px), reach + 2
    patch = image[max(v - margin, 0) : v + margin + 1, max(u - margin, 0) : u + margin + 1]
    if patch.shape[0] != 2 * margin + 1 or patch.shape[1] != 2 * margin + 1:
        return None
    light = linear[patch if patch.ndim == 2 else patch.max(axis=2)].astype(np.float32)
    side = 2 * reach + 1
    light = np.asarray(cv2.getRectSubPix(light, (side, side), (margin + lamp.u_px - u, margin + lamp.v_px - v)))
    middle = slice(reach - reach // 2, reach + reach // 2 + 1)
    rows, columns = light[:, middle].mean(axis=1), light[middle].mean(axis=0)
    columns = 0.5 * (columns + columns[::-1])
    lit = columns > DIM * columns.max()
    return float(np.log((rows[lit] + 0.01 * rows.max()) / columns[lit]).std()) if lit.any() else None


def _brightest(levels: NDArray[np.uint8]) -> int:
    flat = levels.ravel()
    k = int(BRIGHTEST * (flat.size - 1))
    return int(np.partition(flat, k)[k])


def measure_scene(image: NDArray[np.uint8], linear: NDArray[np.float64]) -> SceneLight:
    """Measure a picture as a whole."""
    some = image[::SPARSE, ::SPARSE]
    levels = some if some.ndim == 2 else some.max(axis=2)
    return SceneLight(float(linear[levels].mean()), float((levels >= CLIPPED).mean()))
