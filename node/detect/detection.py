"""What a detector takes and gives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Blob
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Detection:
    """One light candidate, and what a person needs to see why it was found.

    outline_px: (N, 2) corners of the region it was found in. axis_px: (2, 2), the region's axis as [chosen end,
    other end]. Both in px, pixel centres at integers. why: the figures behind the score, in words.
    """

    blob: Blob
    outline_px: NDArray[np.float64]
    axis_px: NDArray[np.float64]
    why: str


class Detector(Protocol):
    """Finds light candidates; one instance a camera, used from one thread.

    It keeps nothing but what it adapted to and its working memory.
    """

    def detect(self, image: NDArray[np.uint8]) -> list[Detection]:
        """Find the candidates of one picture, the likeliest lights first.

        image: (H, W, 3) BGR, or (H, W) grey (a Y plane). Raises ImageError where it is neither.
        """
        ...


class ImageError(BuddylineError):
    """A picture that no detector can work on."""


def check_image(image: NDArray[np.uint8]) -> None:
    """Refuse what is not an 8-bit BGR or grey picture of at least one pixel; raise ImageError."""
    if not isinstance(image, np.ndarray):
        raise ImageError(f"picture: {type(image).__name__} is not an array; was it decoded?")
    if image.dtype != np.uint8:
        raise ImageError(f"picture: {image.dtype} pixels; convert it to 8 bit")
    if image.ndim != 2 and (image.ndim != 3 or image.shape[2] != 3):
        raise ImageError(f"picture: shape {image.shape} is neither grey (H, W) nor BGR (H, W, 3)")
    if image.size == 0:
        raise ImageError(f"picture: shape {image.shape} holds no pixel")
