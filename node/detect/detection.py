"""The interface of a detector: its input and its output."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Blob
from msgspec import UNSET
from numpy.typing import NDArray

LIKELY: Final = 0.5
"""From this score on, a candidate is likely a lamp: the score is a probability."""
CLIPPED: Final = 249.0
"""From this grey level on, a pixel counts as clipped: JPEG leaves clipped pixels a little below 255."""
FOCAL_PX: Final = 904.0
"""Focal length for which the detectors' lengths in px are given: that of the default rig, with pictures 820 px wide."""
LASTING_S: Final = 1.3
"""For how long the error of a light with a clipped core lasts (Blob.lasting_s), whatever finds the light. Its glow, its
beam and the water tell where it is, and they change as slowly as the divers swim. It is the median of the five dives
kept for tuning, which have 0.7 to 2.2 s. Where the exposure is locked to the lamps, errors last for less than 0.2 s."""


@dataclass(frozen=True, slots=True)
class Detection:
    """One light candidate, with drawings and words that explain it to a person.

    outline_px: (N, 2) corners of the candidate's region. axis_px: (2, 2), the region's axis as [end at the light,
    other end]. Both in px, pixel centres at integers. why: the figures behind the score, in words.
    """

    blob: Blob
    outline_px: NDArray[np.float64]
    axis_px: NDArray[np.float64]
    why: str


@dataclass(frozen=True, slots=True)
class Region:
    """A disc of the picture where a light is looked for. centre_px: (u, v). light_px: radius of the light itself."""

    centre_px: tuple[float, float]
    radius_px: float
    light_px: float


class Detector(Protocol):
    """Finds light candidates. Each camera has its own instance, used from one thread.

    Its only state is what it has adapted to, and working memory.
    """

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """Find the candidates of one picture, the likeliest lights first.

        image: (H, W, 3) BGR, or (H, W) grey (a Y plane), uint8. Raises ImageError for anything else.
        """
        ...


class DetectorFactory(Protocol):
    """Makes a detector. VALUES: what can be overridden, each with its default, a number of 0 or more."""

    VALUES: Mapping[str, float]

    def __call__(self, values: Mapping[str, float], focal_px: float | None, /) -> Detector:
        """Return the detector of one camera.

        values: in place of those in VALUES. focal_px: of the pictures; None where it is not known.
        """
        ...


def score_of(blob: Blob) -> float:
    """Return a candidate's score; LIKELY where its detector gives none."""
    return LIKELY if blob.score is UNSET else blob.score


def is_likely(blob: Blob) -> bool:
    """Return whether a candidate is likely a lamp; one without a score is."""
    return score_of(blob) >= LIKELY


def focal_of(width_px: int) -> float:
    """Return the focal length, px, of a camera of unknown calibration: 49 degrees across, as of the default rig."""
    return FOCAL_PX / 820.0 * width_px


@runtime_checkable
class GuidedDetector(Detector, Protocol):
    """A detector that can search parts of a picture."""

    def detect_near(self, image: NDArray[np.uint8], regions: Sequence[Region]) -> list[Detection] | None:
        """Find the candidates within some regions, also fainter ones than in a whole picture, the likeliest first.

        None where the whole picture has to be searched: the first one, or one whose regions cost as much.
        """
        ...


class ImageError(BuddylineError):
    """An array that is not a picture of 8-bit grey or BGR pixels."""


def check_image(image: NDArray[np.uint8]) -> None:
    """Raise ImageError unless `image` is an 8-bit BGR or grey picture of at least one pixel."""
    if not isinstance(image, np.ndarray):
        raise ImageError(f"picture: {type(image).__name__} is not an array; was it decoded?")
    if image.dtype != np.uint8:
        raise ImageError(f"picture: {image.dtype} pixels; convert it to 8 bit")
    if image.ndim != 2 and (image.ndim != 3 or image.shape[2] != 3):
        raise ImageError(f"picture: shape {image.shape} is neither grey (H, W) nor BGR (H, W, 3)")
    if image.size == 0:
        raise ImageError(f"picture: shape {image.shape} holds no pixel")
