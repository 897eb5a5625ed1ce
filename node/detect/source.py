"""The project's own detector: find the sources of light, not only bright areas.

It proposes places in a grey pyramid (proposals.py), measures their outlines on rings (lights.py), scores how likely
each is a lamp and not a caustic, a particle or texture, and locates the source of the likely ones (centre.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import ClassVar, Final, NamedTuple

import numpy as np
from buddyline.node.detect.centre import Centres, locate_sources
from buddyline.node.detect.detection import Detection, Region, check_image, focal_of
from buddyline.node.detect.lights import Lights, distinct, measure_lights, water_level
from buddyline.node.detect.masks import Masks, unmasked
from buddyline.node.detect.proposals import Layout, ProposalFinder, Proposals
from buddyline.node.detect.regions import RegionFinder
from buddyline.node.detect.rings import RAY_UV, Floats
from buddyline.node.detect.score import features, probability, texture
from buddyline.protocol.messages import Blob
from numpy.typing import NDArray

_CONTRAST_MIN: Final = (4.0, 16.0)
_CONTRAST_TO_NOISE: Final = 2.0
"""A place needs so many sd of the noise as contrast, but at least and at most so many grey levels."""
_MEMORY: Final = 0.8
"""Share of the former pictures in the estimate of the noise."""
_FAINTER: Final = 0.5
"""Share of the thresholds on contrast that holds where a light is expected."""
_MAX_MEASURED: Final = 24
"""More lights than this in one picture are not looked at."""
_KEPT: Final = ((5, 0.0), (8, 0.02), (16, 0.3))
"""(number, least score): 5 candidates are always kept, up to 8 with score 0.02 or more, up to 16 with 0.3 or more.

The solver chooses among them with both gaps and the sensors; generous lists serve it better than strict ones.
"""
_KEPT_NEAR: Final = ((2, 0.0), *_KEPT[1:])
"""Where only regions are searched: nearly all that is faint in them is no lamp."""


class Examined(NamedTuple):
    """What was measured at the places of one picture: N lights, and the features of their score (N, F)."""

    lights: Lights
    features: Floats


class SourceDetector:
    """The default detector. It adapts to the noise of this picture and those before.

    A place needs the contrast contrast_min, in grey levels (0: it follows the picture's noise), plus clutter_gain times
    the mean contrast of its neighbourhood.
    """

    VALUES: ClassVar[Mapping[str, float]] = MappingProxyType({"contrast_min": 0.0, "clutter_gain": 2.0})

    def __init__(self, values: Mapping[str, float], focal_px: float | None = None, masks: Masks | None = None) -> None:
        """focal_px: of the pictures; None to take each picture's from its width. masks: what is never searched."""
        self._masks = masks
        self._focal_px = focal_px
        self._values = {**self.VALUES, **values}
        self._finder = ProposalFinder(focal_px)
        self._noise: float | None = None
        # Of the last whole picture.
        self._contrast_min = _CONTRAST_MIN[0]
        self._water = 0.0
        self._texture = 0.5
        self._shape: tuple[int, ...] = ()
        self._near: RegionFinder | None = None

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """Find the candidates of one picture, the most likely first."""
        check_image(image)
        return self._chosen(image, self.examine(image), _KEPT)

    def examine(self, image: NDArray[np.uint8]) -> Examined | None:
        """Measure all places of one picture where a light may be; None where there are none."""
        self._finder.load(image)
        self._contrast_min = self._values["contrast_min"] or self._adapt()
        if image.shape != self._shape:
            self._shape = image.shape
            self._near = RegionFinder(self._focal_of(image), self._finder.base_step_px, self._masks)
        self._water = water_level(image)
        proposals = _apart(self._finder.find(self._contrast_min, self._values["clutter_gain"], self._layout(image)))
        self._texture = texture(proposals.outstanding)
        return self._measured(image, proposals)

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
        is that of the tile around the region, not of a wider neighbourhood. The noise, the water's brightness and the
        texture are those of the last whole picture.
        """
        check_image(image)
        if self._near is None or image.shape != self._shape:
            return None
        thresholds = self._contrast_min * _FAINTER, self._values["clutter_gain"] * _FAINTER
        proposals = self._near.find(image, regions, *thresholds)
        return None if proposals is None else self._chosen(image, self._measured(image, _apart(proposals)), _KEPT_NEAR)

    def _measured(self, image: NDArray[np.uint8], proposals: Proposals) -> Examined | None:
        if len(proposals.radius_px) == 0:
            return None
        lights = measure_lights(image, proposals, self._water)
        if len(lights.peak) == 0:
            return None
        return Examined(lights, features(lights, self._focal_of(image), self._texture))

    def _chosen(
        self, image: NDArray[np.uint8], seen: Examined | None, table: Sequence[tuple[int, float]]
    ) -> list[Detection]:
        """Score the measured places, and locate the source of the likeliest ones, as many as the table says."""
        if seen is None:
            return []
        score = probability(seen.features)
        # Of several places on one light, the one that stands out most has the scale that locates it best.
        apart = np.array(distinct(seen.lights.centre_px, seen.lights.core_px, len(score)))
        order = apart[np.argsort(-score[apart], kind="stable")]
        ranked = score[order].tolist()
        kept = order[: max(sum(likely >= least for likely in ranked[:many]) for many, least in table)]
        likely = seen.lights.at(kept)
        found = _detections(likely, locate_sources(image, likely, self._focal_of(image)), score[kept], image.shape)
        return unmasked(found, self._masks, image.shape)

    def _focal_of(self, image: NDArray[np.uint8]) -> float:
        return self._focal_px or focal_of(image.shape[1])

    def _adapt(self) -> float:
        """Return the least contrast of a place, in grey levels: from the noise of this picture and those before."""
        noise = self._finder.noise()
        self._noise = noise if self._noise is None else _MEMORY * self._noise + (1.0 - _MEMORY) * noise
        return min(max(_CONTRAST_TO_NOISE * self._noise, _CONTRAST_MIN[0]), _CONTRAST_MIN[1])


def _apart(proposals: Proposals) -> Proposals:
    """Return one place of each light, the most outstanding first."""
    kept = distinct(proposals.centre_px, proposals.radius_px, _MAX_MEASURED)
    return Proposals(proposals.centre_px[kept], proposals.radius_px[kept], proposals.outstanding[kept])


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
