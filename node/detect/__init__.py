"""Find the other node's lights in a picture.

`source` looks for the sources of light themselves and adapts to the water; `paper` is the baseline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from buddyline.node.choices import DETECTORS, PRESETS
from buddyline.node.detect import paper, source
from buddyline.node.detect.detection import Detection, Detector, GuidedDetector, ImageError, Region
from buddyline.node.detect.masks import Corners, MaskedDetector, Masks
from buddyline.protocol.errors import BuddylineError

METHODS: Final = DETECTORS
ENVIRONMENTS: Final = PRESETS

__all__ = [
    "ENVIRONMENTS",
    "METHODS",
    "Detection",
    "Detector",
    "GuidedDetector",
    "ImageError",
    "Region",
    "make_detector",
    "presets",
]


def presets(method: str) -> Mapping[str, Mapping[str, float]]:
    """Return a method's preset values for each environment; raise BuddylineError for an unknown method."""
    if method == "source":
        return source.PRESETS
    if method == "paper":
        return paper.PRESETS
    raise BuddylineError(f"detector method {method!r}: choose one of {', '.join(METHODS)}")


def make_detector(
    method: str = "source",
    environment: str = "auto",
    overrides: Mapping[str, float] | None = None,
    focal_px: float | None = None,
    masks: Sequence[Corners] = (),
) -> Detector:
    """Make the detector of one camera.

    overrides: replace values of the environment's preset, under the names that `presets` returns. focal_px: of the
    pictures, for the size of lamps in them; without it, each picture counts as one of 49 degrees across. masks:
    parts of the picture that are never searched, see Masks. Raises BuddylineError for an unknown method, environment or
    name, for a negative or non-finite value, and for a mask outside of the picture.
    """
    known = presets(method)
    if environment not in ENVIRONMENTS:
        raise BuddylineError(f"environment {environment!r}: choose one of {', '.join(ENVIRONMENTS)}")
    names = next(iter(known.values()))
    for name, value in (overrides or {}).items():
        if name not in names:
            raise BuddylineError(f"detector value {name!r}: {method} has {', '.join(names)}")
        if not 0 <= value < float("inf"):
            raise BuddylineError(f"detector value {name} = {value}: must be a finite number, 0 or more")
    if focal_px is not None and not 0 < focal_px < float("inf"):
        raise BuddylineError(f"focal_px = {focal_px}: must be a finite number above 0")
    hidden = Masks(masks) if masks else None
    if method == "paper":
        plain = paper.PaperDetector(environment, overrides or {}, focal_px)
        return plain if hidden is None else MaskedDetector(plain, hidden)
    return source.SourceDetector(environment, overrides or {}, focal_px, hidden)
