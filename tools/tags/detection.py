"""Tags in a picture, by OpenCV, with corners refined."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from buddyline.tools.evaluation.rotation import Floats
from buddyline.tools.tags.layout import FAMILIES, Layout
from numpy.typing import NDArray

# Water leaves little contrast: with OpenCV's default of 7 grey levels, tags in turbid water are lost at half the range.
_CONTRAST_LEVELS: Final = 3


class TagFinder:
    """Finds the tags of one layout in pictures."""

    def __init__(self, layout: Layout) -> None:
        self._known = layout.corners_m.keys()
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        parameters.adaptiveThreshConstant = _CONTRAST_LEVELS
        dictionary = cv2.aruco.getPredefinedDictionary(FAMILIES[layout.family])
        self._detector = cv2.aruco.ArucoDetector(dictionary, parameters)

    def find(self, picture: NDArray[np.uint8]) -> dict[int, list[Floats]]:
        """Return the corners, (4, 2) px each, of everything that reads as a tag of the layout, by id.

        picture: (H, W, 3) BGR or (H, W) grey. One id may be read in several places, of which at most one is true.
        """
        grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
        corners, ids, _ = self._detector.detectMarkers(grey)
        found: dict[int, list[Floats]] = {}
        listed = [] if ids is None else [int(tag_id) for tag_id in np.ravel(ids)]
        for tag_id, corner in zip(listed, corners, strict=True):
            if tag_id in self._known:
                found.setdefault(tag_id, []).append(np.asarray(corner, dtype=np.float64).reshape(4, 2))
        return found
