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

from node.detect.centre import LUMA_BGR, MODEL, Centres, locate_sources
from node.detect.detection import Detection, check_image
from node.detect.proposals import ProposalFinder, Proposals
from node.detect.rings import RAY_COS, RAY_SIN, Regions, find_regions, geometric, sample_rings
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
_MAX_PROPOSALS: Final = 20
_MAX_LOCATED: Final = 10
_MAX_FOUND: Final = 8
_WEAKEST_FROM_PX: Final = 3.0
_CLIPPED: Final = 249.0


@dataclass(frozen=True, slots=True)
class _Lights:
    """What the rings tell about N proposals; arrays of length N."""

    centre_px: NDArray[np.float32]
    core_px: NDArray[np.float32]
    ground: NDArray[np.float32]
    weakest: NDArray[np.bool_]
    peak: NDArray[np.float32]
    outline: Regions
    outline_at_px: NDArray[np.float32]
    features: NDArray[np.float32]


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
        lights = _measure(image, proposals)
        score = _score(lights.features)
        chosen = _distinct(lights, score)[:_MAX_LOCATED]
        found = locate_sources(
            image,
            lights.centre_px[chosen],
            lights.core_px[chosen],
            lights.ground[chosen],
            lights.weakest[chosen],
            MODEL,
        )
        height, width = image.shape[:2]
        detections = [
            _detection(lights, found, score, i, j)
            for i, j in enumerate(chosen)
            if -0.5 <= found.centre_px[i, 0] <= width - 0.5 and -0.5 <= found.centre_px[i, 1] <= height - 0.5
        ]
        return detections[:_MAX_FOUND]


def _measure(image: NDArray[np.uint8], proposals: Proposals) -> _Lights:
    """Follow each proposal's outline, first around where it was found, then around its own centre."""
    step = proposals.step_px
    radius = geometric(0.35 * step, 7.0 * step, 14)
    rings = sample_rings(image, proposals.centre_px, radius)
    level = _luma(rings.pixels)
    peak = level[:, :8].max(axis=(1, 2))
    ground = _low(level[:, -4:], 0.2)
    region = find_regions(level, radius, ground + 0.8 * (np.minimum(peak, _CLIPPED) - ground))
    centre = proposals.centre_px + region.centre_px

    radius = geometric(np.maximum(0.3 * region.radius_px, 0.5), np.maximum(5.0 * region.radius_px, 12.0), 20)
    rings = sample_rings(image, centre, radius)
    level = _luma(rings.pixels)
    core = radius <= np.maximum(1.5 * region.radius_px, 1.5)[:, None]
    peak = np.where(core[:, :, None], level, 0.0).max(axis=(1, 2))
    ground = _low(level[:, -5:], 0.2)
    top = np.minimum(peak, _CLIPPED)
    bright = find_regions(level, radius, ground + 0.8 * (top - ground))
    half = find_regions(level, radius, ground + 0.5 * (top - ground))
    low = find_regions(level, radius, ground + 0.25 * (top - ground))
    weakest = np.zeros(len(step), bool)
    start, core_px, below = centre + bright.centre_px, bright.radius_px, ground
    if image.ndim == 3:
        weak = rings.pixels.min(axis=3)
        water = float(np.percentile(image[::16, ::16].min(axis=2), 20))
        weak_peak = np.where(core[:, :, None], weak, 0.0).max(axis=(1, 2))
        weak_ground = np.minimum(_low(weak[:, -5:], 0.15), water)
        weak_region = find_regions(weak, radius, weak_ground + 0.8 * (np.minimum(weak_peak, _CLIPPED) - weak_ground))
        weakest = weak_region.radius_px >= _WEAKEST_FROM_PX
        start = np.where(weakest[:, None], centre + weak_region.centre_px, start)
        core_px = np.where(weakest, weak_region.radius_px, core_px)
        below = np.where(weakest, weak_ground, ground)
    features = np.stack(
        [
            np.log(proposals.contrast / (4.0 + proposals.clutter)),
            np.log(np.maximum(peak - ground, 1.0) / 50.0),
            half.elongation - 1.0,
            half.open_share,
            np.log(half.radius_px / bright.radius_px),
            np.log(low.radius_px / half.radius_px),
            np.log(half.radius_px * 820.0 / image.shape[1]),
            np.log(1.0 + proposals.clutter),
            low.elongation - 1.0,
            low.open_share,
            peak / 255.0,
            ground / 255.0,
        ],
        axis=1,
    )
    return _Lights(
        start.astype(np.float32),
        core_px.astype(np.float32),
        below.astype(np.float32),
        weakest,
        peak,
        half,
        centre.astype(np.float32),
        features.astype(np.float32),
    )


def _luma(pixels: NDArray[np.float32]) -> NDArray[np.float32]:
    luma: NDArray[np.float32] = pixels[..., 0] if pixels.shape[3] == 1 else pixels @ LUMA_BGR
    return luma


def _low(level: NDArray[np.float32], share: float) -> NDArray[np.float32]:
    """Give the level that a share of each place's samples lies below, (N,)."""
    flat = level.reshape(len(level), -1)
    k = int(share * flat.shape[1])
    return np.partition(flat, k, axis=1)[:, k]


def _score(features: NDArray[np.float32]) -> NDArray[np.float32]:
    """Give each proposal's probability of being a lamp, (N,)."""
    logit = -2.0 + 1.5 * features[:, 0] + 1.0 * features[:, 1] - 1.0 * features[:, 2] - 2.0 * features[:, 3]
    score: NDArray[np.float32] = 1.0 / (1.0 + np.exp(-logit))
    return score


def _distinct(lights: _Lights, score: NDArray[np.float32]) -> NDArray[np.intp]:
    """Order by score and leave out what lies inside a likelier light."""
    order = np.argsort(-score, kind="stable")
    kept: list[int] = []
    for i in order:
        apart = np.hypot(*(lights.centre_px[kept] - lights.centre_px[i]).T)
        inside = np.maximum(0.7 * np.maximum(lights.core_px[kept], lights.core_px[i]), 2.0)
        if not (apart < inside).any():
            kept.append(int(i))
    return np.array(kept, np.intp)


def _detection(lights: _Lights, found: Centres, score: NDArray[np.float32], i: int, j: int) -> Detection:
    centre = found.centre_px[i].astype(np.float64)
    edge = lights.outline.edge_px[j]
    outline = np.stack([edge * RAY_COS, edge * RAY_SIN], axis=1) + lights.outline_at_px[j]
    lean = found.lean[i]
    ahead = (outline - centre) @ lean
    far = outline[int(ahead.argmax())]
    f = lights.features[j]
    sigma = float(np.sqrt(0.5 * np.trace(found.covariance_px2[i])))
    return Detection(
        blob=Blob(
            u_px=float(centre[0]),
            v_px=float(centre[1]),
            sigma_px=sigma,
            area_px=float(np.pi * lights.outline.radius_px[j] ** 2),
            peak=float(min(lights.peak[j], 255.0)),
            elongation=float(lights.outline.elongation[j]),
            score=float(score[j]),
        ),
        outline_px=outline.astype(np.float64),
        axis_px=np.array([centre, far], np.float64),
        why=(
            f"stands out {float(np.exp(f[0])):.1f}x, +{50 * float(np.exp(f[1])):.0f} grey levels, "
            f"core {float(lights.core_px[j]):.1f} px, lean {float(np.hypot(*lean)):.1f}"
        ),
    )
