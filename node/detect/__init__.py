"""Find the other node's lights in a picture.

`source` looks for the sources of light themselves and adapts to the water; `paper` is the baseline. Others come from
outside: an installed distribution names its detector in the entry point group GROUP.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Final

from buddyline.node.choices import DETECTORS, PRESETS
from buddyline.node.detect import paper, source
from buddyline.node.detect.detection import (
    Detection,
    Detector,
    DetectorFactory,
    GuidedDetector,
    ImageError,
    Region,
)
from buddyline.node.detect.masks import Corners, MaskedDetector, Masks
from buddyline.protocol.errors import BuddylineError

GROUP: Final = "buddyline.detectors"

__all__ = [
    "GROUP",
    "Detection",
    "Detector",
    "GuidedDetector",
    "ImageError",
    "Region",
    "make_detector",
    "values_of",
]


def values_of(method: str, environment: str = "auto") -> Mapping[str, float]:
    """Return the values of a detector that can be overridden, as they are by default.

    environment: it selects values of `paper` only (`auto`: those of the night reef). The other detectors adapt to each
    picture, and have the same values in every environment. Raises BuddylineError for an unknown method or environment.
    """
    if environment not in PRESETS:
        raise BuddylineError(f"environment {environment!r}: choose one of {', '.join(PRESETS)}")
    if method == "paper":
        return paper.PRESETS["night_reef" if environment == "auto" else environment]
    return _factory(method).VALUES


def make_detector(
    method: str = "source",
    environment: str = "auto",
    overrides: Mapping[str, float] | None = None,
    focal_px: float | None = None,
    masks: Sequence[Corners] = (),
) -> Detector:
    """Make the detector of one camera.

    environment: of `paper` only; `auto` chooses its thresholds for each picture. overrides: replace values of the
    detector, under the names that `values_of` returns. focal_px: of the pictures, for the size of lamps in them; if it
    is None, each picture counts as one of 49 degrees across. masks: parts of the picture that are never searched, see
    Masks. Raises BuddylineError for an unknown method, environment or name, for a negative or non-finite value, and for
    a mask outside of the picture.
    """
    names = values_of(method, environment)
    for name, value in (overrides or {}).items():
        if name not in names:
            raise BuddylineError(f"detector value {name!r}: {method} has {', '.join(names) or 'none'}")
        if not 0 <= value < float("inf"):
            raise BuddylineError(f"detector value {name} = {value}: must be a finite number, 0 or more")
    if focal_px is not None and not 0 < focal_px < float("inf"):
        raise BuddylineError(f"focal_px = {focal_px}: must be a finite number above 0")
    hidden = Masks(masks) if masks else None
    if method == "paper":
        plain: Detector = paper.PaperDetector(environment, overrides or {}, focal_px)
    elif method == "source":
        return source.SourceDetector(overrides or {}, focal_px, hidden)
    else:
        plain = _factory(method)(overrides or {}, focal_px)
    return plain if hidden is None else MaskedDetector(plain, hidden)


def _factory(method: str) -> DetectorFactory:
    """Return what makes the detector of this name, of this project or of another distribution."""
    if method == "source":
        return source.SourceDetector
    outside = {point.name: point for point in entry_points(group=GROUP) if point.name not in DETECTORS}
    if method not in outside:
        raise BuddylineError(f"detector method {method!r}: choose one of {', '.join((*DETECTORS, *outside))}")
    return _loaded(outside[method])


def _loaded(point: EntryPoint) -> DetectorFactory:
    by = f"detector {point.name!r} ({point.value}" + (f" of {point.dist.name})" if point.dist else ")")
    try:
        factory: Any = point.load()
    except (ImportError, AttributeError) as error:
        raise BuddylineError(f"{by}: {error}") from error
    if not isinstance(factory, Callable) or not isinstance(getattr(factory, "VALUES", None), Mapping):  # type: ignore[arg-type]
        raise BuddylineError(f"{by}: is no detector: it needs a mapping VALUES, and to be callable")
    return factory  # type: ignore[no-any-return]
