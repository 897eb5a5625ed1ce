"""The project's own detector: find the sources of light, not just what is bright.

Proposals from the grey pyramid (proposals.py), their outlines on rings (rings.py), a score from what tells a lamp from
a caustic, a particle or texture, and the source inside each likely one (centre.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from node.detect.centre import LUMA_BGR, Centres, locate_sources
from node.detect.detection import Detection, check_image
from node.detect.proposals import ProposalFinder, Proposals
from node.detect.rings import (
    RAY_COS,
    RAY_SIN,
    Floats,
    Rings,
    Shapes,
    follow_edges,
    geometric_radii,
    measure_shapes,
    sample_rings,
)
from protocol.messages import Blob

PRESETS: Final[Mapping[str, Mapping[str, float]]] = MappingProxyType(
    {
        "cavern": {"contrast_min": 5.0, "clutter_gain": 2.0},
        "night_reef": {"contrast_min": 5.0, "clutter_gain": 2.0},
        "lake": {"contrast_min": 4.0, "clutter_gain": 2.0},
        "basin": {"contrast_min": 5.0, "clutter_gain": 3.0},
    }
)
_AUTO: Final = {"contrast_min": 5.0, "clutter_gain": 2.0}
_MAX_PROPOSALS: Final = 24
_MAX_MEASURED: Final = 12
_MAX_FOUND: Final = 8
_CORE_RINGS: Final = 7
_WEAKEST_FROM_PX: Final = 3.0
_CLIPPED: Final = 249.0


_LEVELS: Final = np.array([0.9, 0.7, 0.5, 0.3], np.float32)
_HALF: Final = 2
_SCORE_AT_ZERO: Final = -5.2
_SCORE_WEIGHTS: Final = np.array([2.2, 1.7, -2.8, -5.8], np.float32)
_SCORE_LIMIT: Final = np.array([9.0, 9.0, 2.0, 1.0], np.float32)
"""Log odds of a lamp: for standing out of its neighbourhood, for its height, against being long, against having no
edge. Fitted to the places found in rendered dives of five environments, in colour and grey, and in real caustics."""


@dataclass(frozen=True, slots=True)
class _Lights:
    """What the rings tell about N proposals.

    centre_px: (N, 2) and core_px: (N,) of the brightest region in the channel that locates; ground: (N,) what the
    water itself shows in that channel; weakest: (N,) whether that is the weakest one. peak: (N,) luminance. edge_px:
    (N, K) outline at half height around edge_at_px (N, 2). features: (N, F), see _FEATURES.
    """

    centre_px: Floats
    core_px: Floats
    ground: Floats
    weakest: NDArray[np.bool_]
    scattered: Floats
    peak: Floats
    edge_px: Floats
    edge_at_px: Floats
    area_px: Floats
    elongation: Floats
    features: Floats


class SourceDetector:
    """The default detector; adapts to the picture and its predecessors where the environment is `auto`."""

    def __init__(self, environment: str, overrides: Mapping[str, float]) -> None:
        self._values = {**PRESETS.get(environment, _AUTO), **overrides}
        self._finder = ProposalFinder()

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """Find the candidates of one picture, the likeliest first."""
        check_image(image)
        proposals = self._finder.find(image, self._values["contrast_min"], self._values["clutter_gain"], _MAX_PROPOSALS)
        if len(proposals.step_px) == 0:
            return []
        centre, radius_px, kept = _settle(*self._finder.base, proposals)
        lights = _measure(image, centre, radius_px, proposals.at(kept))
        score = _score(lights.features)
        order = np.argsort(-score, kind="stable")
        chosen = order[_distinct(lights.centre_px[order], lights.core_px[order])][:_MAX_FOUND]
        found = locate_sources(
            image,
            lights.centre_px[chosen],
            lights.core_px[chosen],
            lights.ground[chosen],
            lights.weakest[chosen],
            lights.scattered[chosen],
        )
        return _detections(lights, found, score, chosen, image.shape)


def _settle(base: NDArray[np.uint8], base_step: float, proposals: Proposals) -> tuple[Floats, Floats, NDArray[np.intp]]:
    """Move each proposal to the middle of its bright region, and leave out those that end up in one.

    base: the pyramid's grey base, of base_step px a pixel. Returns centres (N, 2) and radii (N,) in px of the whole
    picture, and which proposals they are.
    """
    step = proposals.step_px / np.float32(base_step)
    at = (proposals.centre_px + 0.5) / np.float32(base_step) - 0.5
    radius = geometric_radii(0.35 * step, 7.0 * step, 12)
    rings = sample_rings(base, at, radius)
    level = rings.pixels[..., 0]
    peak = level[:, :7].max(axis=(1, 2))
    ground = _low(level[:, -4:], 0.2)
    edge, opened = follow_edges(level, rings.inside, radius, ground + 0.8 * (np.minimum(peak, _CLIPPED) - ground))
    shape = measure_shapes(edge, opened, 1)
    centre = (at + shape.centre_px[0] + 0.5) * np.float32(base_step) - 0.5
    radius_px = shape.radius_px[0] * np.float32(base_step)
    kept = _distinct(centre, radius_px)[:_MAX_MEASURED]
    return centre[kept], radius_px[kept], kept


def _distinct(centre_px: Floats, radius_px: Floats) -> NDArray[np.intp]:
    """Leave out what lies inside an earlier one; give the indices of the rest."""
    apart = np.hypot(centre_px[:, None, 0] - centre_px[:, 0], centre_px[:, None, 1] - centre_px[:, 1])
    same = (apart < np.maximum(0.7 * np.maximum(radius_px[:, None], radius_px), 2.0)).tolist()
    kept: list[int] = []
    for i, row in enumerate(same):
        if not any(row[k] for k in kept):
            kept.append(i)
    return np.array(kept, np.intp)


def _measure(image: NDArray[np.uint8], centre: Floats, radius_px: Floats, proposals: Proposals) -> _Lights:
    """Follow the outlines of N bright regions, given roughly by centre (N, 2) and radius_px (N,), at four levels."""
    radius = geometric_radii(np.maximum(0.3 * radius_px, 0.5), np.maximum(5.0 * radius_px, 12.0), 16)
    rings = sample_rings(image, centre, radius)
    level = _luma(rings.pixels)
    peak = np.minimum(level[:, :_CORE_RINGS].max(axis=(1, 2)), _CLIPPED)
    ground = _low(level[:, -4:], 0.2)
    shapes = [_follow_levels(level, rings, ground, peak)]
    weakest = np.zeros(len(radius), bool)
    below = ground
    if image.ndim == 3:
        pixels = rings.pixels
        weak = np.minimum(np.minimum(pixels[..., 0], pixels[..., 1]), pixels[..., 2])
        weak_ground = np.minimum(_low(weak[:, -4:], 0.15), _water_level(image))
        weak_peak = np.minimum(weak[:, :_CORE_RINGS].max(axis=(1, 2)), _CLIPPED)
        shapes.append(_follow_levels(weak, rings, weak_ground, weak_peak))
        weakest = shapes[1].radius_px[:2].mean(axis=0) >= _WEAKEST_FROM_PX
        below = np.where(weakest, weak_ground, ground)
    rims = [_rim(shape) for shape in shapes]
    core_px = np.where(weakest, rims[-1][1], rims[0][1])
    features = np.empty((len(radius), len(_SCORE_WEIGHTS)), np.float32)
    features[:, 0] = np.log(proposals.contrast / (4.0 + proposals.clutter))
    features[:, 1] = np.log(np.maximum(peak - ground, 1.0) / 50.0)
    features[:, 2] = shapes[0].elongation[_HALF] - 1.0
    features[:, 3] = shapes[0].open_share[_HALF]
    return _Lights(
        centre + np.where(weakest[:, None], rims[-1][0], rims[0][0]),
        core_px,
        below,
        weakest,
        _scattered(shapes[0], peak),
        peak,
        shapes[0].edge_px[_HALF],
        centre,
        np.pi * shapes[0].radius_px[_HALF] ** 2,
        shapes[0].elongation[_HALF],
        features,
    )


def _follow_levels(level: Floats, rings: Rings, ground: Floats, peak: Floats) -> Shapes:
    """Follow the outlines at shares of the height of N lights: shapes of S levels, arrays (S, N, ...)."""
    n, many = len(ground), len(_LEVELS)
    threshold = ground + _LEVELS[:, None] * (peak - ground)
    edge, open_share = follow_edges(
        np.broadcast_to(level, (many, *level.shape)).reshape(-1, *level.shape[1:]),
        np.broadcast_to(rings.inside, (many, *level.shape)).reshape(-1, *level.shape[1:]),
        np.broadcast_to(rings.radius_px, (many, *rings.radius_px.shape)).reshape(many * n, -1),
        threshold.ravel(),
    )
    return measure_shapes(edge, open_share, many)


def _rim(shapes: Shapes) -> tuple[Floats, Floats]:
    """Give each light's rim, where its profile falls the fastest: centre (N, 2) relative to the place, radius (N,).

    It is the lamp's own face where that shows, and the edge of what is clipped where the glow is all there is.
    """
    radius, centre = shapes.radius_px, shapes.centre_px
    fall = 1.0 / np.maximum(np.diff(radius, axis=0), 0.15)
    k = fall.argmax(axis=0)
    n = np.arange(len(k))
    return 0.5 * (centre[k, n] + centre[k + 1, n]), 0.5 * (radius[k, n] + radius[k + 1, n])


def _scattered(shapes: Shapes, peak: Floats) -> Floats:
    """Tell dim lights that show only what the water scatters, (N,) 0-1: not clipped, and yet with a halo.

    A core's own profile falls as steeply below half its height as above it; a glow flattens out.
    """
    halo = np.clip((shapes.radius_px[3] / shapes.radius_px[2] - 1.35) / 0.2, 0.0, 1.0)
    dim = np.clip((240.0 - peak) / 40.0, 0.0, 1.0)
    return np.asarray(halo * dim, np.float32)


def _water_level(image: NDArray[np.uint8]) -> Floats:
    """Give what a fifth of a BGR picture lies below, in the weakest channel."""
    coarse = image[::16, ::16]
    weak = np.minimum(np.minimum(coarse[..., 0], coarse[..., 1]), coarse[..., 2]).ravel()
    k = len(weak) // 5
    return np.asarray(np.partition(weak, k)[k], np.float32)


def _luma(pixels: Floats) -> Floats:
    luma: Floats = pixels[..., 0] if pixels.shape[3] == 1 else pixels @ LUMA_BGR
    return luma


def _low(level: Floats, share: float) -> Floats:
    """Give the level that a share of each place's samples lies below, (N,)."""
    flat = level.reshape(len(level), -1)
    k = int(share * flat.shape[1])
    return np.partition(flat, k, axis=1)[:, k]


def _score(features: Floats) -> Floats:
    """Give each proposal's probability of being a lamp, (N,): logistic in the first of the features."""
    logit = _SCORE_AT_ZERO + np.minimum(features[:, : len(_SCORE_WEIGHTS)], _SCORE_LIMIT) @ _SCORE_WEIGHTS
    return np.asarray(1.0 / (1.0 + np.exp(-logit)), np.float32)


def _detections(
    lights: _Lights, found: Centres, score: Floats, chosen: NDArray[np.intp], shape: tuple[int, ...]
) -> list[Detection]:
    """Put the findings into words and figures; what lies outside the picture is dropped."""
    centre = found.centre_px.astype(np.float64)
    edge = lights.edge_px[chosen]
    outline = np.stack([edge * RAY_COS, edge * RAY_SIN], axis=2) + lights.edge_at_px[chosen][:, None]
    ahead = np.matmul(outline - centre[:, None], found.lean[:, :, None])[:, :, 0]
    far = outline[np.arange(len(chosen)), ahead.argmax(axis=1)]
    sigma = np.sqrt(0.5 * np.trace(found.covariance_px2, axis1=1, axis2=2)).tolist()
    lean = np.hypot(found.lean[:, 0], found.lean[:, 1]).tolist()
    table = np.stack(
        [
            lights.area_px,
            np.minimum(lights.peak, 255.0),
            lights.elongation,
            score,
            np.exp(lights.features[:, 0]),
            50.0 * np.exp(lights.features[:, 1]),
            lights.core_px,
        ],
        axis=1,
    )[chosen].tolist()
    detections = []
    for i, (u, v) in enumerate(centre.tolist()):
        if not (-0.5 <= u <= shape[1] - 0.5 and -0.5 <= v <= shape[0] - 0.5):
            continue
        area, peak, elongation, likely, stands_out, height, core = table[i]
        blob = Blob(u_px=u, v_px=v, sigma_px=sigma[i], area_px=area, peak=peak, elongation=elongation, score=likely)
        why = f"stands out {stands_out:.1f}x, +{height:.0f} levels, core {core:.1f} px, lean {lean[i]:.1f}"
        detections.append(Detection(blob, outline[i], np.array([centre[i], far[i]]), why))
    return detections
