"""The project's own detector: find the sources of light, not only bright areas.

It proposes places in a grey pyramid (proposals.py), measures their outlines on rings (lights.py), scores how likely
each is a lamp and not a caustic, a particle or texture, and locates the source of the likely ones (centre.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

import numpy as np
from buddyline.node.detect.centre import Centres, locate_sources
from buddyline.node.detect.detection import Detection, Region, check_image, focal_of
from buddyline.node.detect.lights import Lights, distinct, measure_lights, water_level
from buddyline.node.detect.masks import Masks, unmasked
from buddyline.node.detect.proposals import Layout, ProposalFinder, Proposals
from buddyline.node.detect.regions import RegionFinder
from buddyline.node.detect.rings import RAY_UV, Floats
from buddyline.protocol.messages import Blob
from numpy.typing import NDArray

PRESETS: Final[Mapping[str, Mapping[str, float]]] = MappingProxyType(
    {
        "cavern": {"contrast_min": 5.0, "clutter_gain": 2.0},
        "night_reef": {"contrast_min": 5.0, "clutter_gain": 2.0},
        "lake": {"contrast_min": 4.0, "clutter_gain": 2.0},
        "basin": {"contrast_min": 5.0, "clutter_gain": 3.0},
    }
)
_CLUTTER_GAIN: Final = 2.0
_CONTRAST_MIN: Final = (4.0, 16.0)
_CONTRAST_TO_NOISE: Final = 2.0
_MEMORY: Final = 0.8
_FAINTER: Final = 0.5
"""Share of the thresholds on contrast that holds where a light is expected."""
_KEPT: Final = ((5, 0.0), (8, 0.02), (16, 0.5))
"""(number, least score): 5 candidates are always kept, up to 8 with score 0.02 or more, up to 16 with 0.5 or more."""
_KEPT_NEAR: Final = ((2, 0.0), *_KEPT[1:])
"""Where only regions are searched: nearly all that is faint in them is no lamp."""

_SCORE_AT_ZERO: Final = -5.2
_SCORE_WEIGHTS: Final = np.array([2.2, 1.7, -2.8, -5.8], np.float32)
_SCORE_LIMIT: Final = np.array([9.0, 9.0, 2.0, 1.0], np.float32)
"""Weights of the log odds of a lamp. For: standing out of its neighbourhood, height above the ground. Against: being
elongated, having an open outline. Fitted to the places found in rendered dives of five environments, in colour and
grey, and in real caustics."""


class SourceDetector:
    """The default detector. With the environment `auto` it adapts to the noise of this picture and those before."""

    def __init__(
        self,
        environment: str,
        overrides: Mapping[str, float],
        focal_px: float | None = None,
        masks: Masks | None = None,
    ) -> None:
        """focal_px: of the pictures; None to take each picture's from its width. masks: what is never searched."""
        self._masks = masks
        self._focal_px = focal_px
        self._values = {**PRESETS.get(environment, {}), **overrides}
        self._clutter_gain = self._values.get("clutter_gain", _CLUTTER_GAIN)
        self._finder = ProposalFinder(focal_px)
        self._noise: float | None = None
        # Of the last whole picture.
        self._contrast_min = _CONTRAST_MIN[0]
        self._water = 0.0
        self._shape: tuple[int, ...] = ()
        self._near: RegionFinder | None = None

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """Find the candidates of one picture, the most likely first."""
        check_image(image)
        self._finder.load(image)
        contrast_min = self._values.get("contrast_min")
        self._contrast_min = self._adapt() if contrast_min is None else contrast_min
        if image.shape != self._shape:
            focal_px = self._focal_px or focal_of(image.shape[1])
            self._shape, self._near = image.shape, RegionFinder(focal_px, self._finder.base_step_px, self._masks)
        self._water = water_level(image)
        return self._measured(image, self._finder.find(self._contrast_min, self._clutter_gain, self._layout(image)))

    def _layout(self, image: NDArray[np.uint8]) -> Layout | None:
        """Return which places of a whole picture count; None for all."""
        masks = self._masks
        if masks is None:
            return None
        height, width = image.shape[:2]
        return lambda centre_px, _: (~masks.hide(centre_px, width, height), np.zeros_like(centre_px))

    def detect_near(self, image: NDArray[np.uint8], regions: Sequence[Region]) -> list[Detection] | None:
        """Find the candidates within some regions, also fainter ones than in a whole picture.

        A lamp that stands out enough for the whole picture's search is found at the same place as there, because it is
        proposed and measured from the same pixels. Its score may differ a little: the clutter of the coarser octaves
        is that of the tile around the region, not of a wider neighbourhood. The noise and
        the water's brightness are those of the last whole picture.
        """
        check_image(image)
        if self._near is None or image.shape != self._shape:
            return None
        thresholds = self._contrast_min * _FAINTER, self._clutter_gain * _FAINTER
        proposals = self._near.find(image, regions, *thresholds)
        return None if proposals is None else self._measured(image, proposals, _KEPT_NEAR)

    def _measured(
        self, image: NDArray[np.uint8], proposals: Proposals, table: Sequence[tuple[int, float]] = _KEPT
    ) -> list[Detection]:
        """Measure, score and locate the proposed places, and keep the likeliest."""
        if len(proposals.radius_px) == 0:
            return []
        lights = measure_lights(image, proposals, self._water)
        score = _score(lights)
        order = np.argsort(-score, kind="stable")
        order = order[distinct(lights.centre_px[order], lights.core_px[order], table[-1][0])]
        ranked = score[order].tolist()
        chosen = order[: max(sum(likely >= least for likely in ranked[:many]) for many, least in table)]
        likely = lights.at(chosen)
        focal_px = self._focal_px or focal_of(image.shape[1])
        found = _detections(likely, locate_sources(image, likely, focal_px), score[chosen], image.shape)
        return unmasked(found, self._masks, image.shape)

    def _adapt(self) -> float:
        """Return the least contrast of a place, in grey levels: from the noise of this picture and those before."""
        noise = self._finder.noise()
        self._noise = noise if self._noise is None else _MEMORY * self._noise + (1.0 - _MEMORY) * noise
        return min(max(_CONTRAST_TO_NOISE * self._noise, _CONTRAST_MIN[0]), _CONTRAST_MIN[1])


def _score(lights: Lights) -> Floats:
    """Return each light's probability of being a lamp, (N,)."""
    features = np.empty((len(lights.peak), len(_SCORE_WEIGHTS)), np.float32)
    features[:, 0] = np.log(lights.outstanding)
    features[:, 1] = np.log(np.maximum(lights.height, 1.0) / 50.0)
    features[:, 2] = lights.elongation - 1.0
    features[:, 3] = lights.open_share
    logit = _SCORE_AT_ZERO + np.minimum(features, _SCORE_LIMIT) @ _SCORE_WEIGHTS
    return np.asarray(1.0 / (1.0 + np.exp(-logit)), np.float32)


def _detections(lights: Lights, found: Centres, score: Floats, shape: tuple[int, ...]) -> list[Detection]:
    """Make the Detections of N lights. shape: of the picture; sources outside of it are dropped."""
    outline = lights.edge_px.astype(np.float64)[..., None] * RAY_UV
    outline += lights.edge_at_px[:, None]
    ahead = (outline @ found.lean[:, :, None])[:, :, 0]
    axis = np.empty((len(outline), 2, 2))
    axis[:, 0] = found.centre_px
    axis[:, 1] = outline[np.arange(len(outline)), ahead.argmax(axis=1)]
    table = zip(
        axis[:, 0].tolist(),
        found.sigma_px.tolist(),
        np.hypot(found.lean[:, 0], found.lean[:, 1]).tolist(),
        lights.area_px.tolist(),
        lights.peak.tolist(),
        lights.elongation.tolist(),
        score.tolist(),
        lights.outstanding.tolist(),
        lights.height.tolist(),
        lights.core_px.tolist(),
        strict=True,
    )
    detections = []
    for i, ((u, v), sigma, lean, area, peak, elongation, likely, stands_out, height, core) in enumerate(table):
        if not (-0.5 <= u <= shape[1] - 0.5 and -0.5 <= v <= shape[0] - 0.5):
            continue
        blob = Blob(u_px=u, v_px=v, sigma_px=sigma, area_px=area, peak=peak, elongation=elongation, score=likely)
        why = f"stands out {stands_out:.1f}x, +{height:.0f} levels, core {core:.1f} px, lean {lean:.1f}"
        detections.append(Detection(blob, outline[i], axis[i], why))
    return detections
