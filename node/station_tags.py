"""Stations that mark themselves: printed tags on line markers, read in pictures of the scene, as marks."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from buddyline.node.config import StationTagsConfig
from buddyline.node.devices import Frame
from buddyline.node.picking import RateLimiter
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Mark

DICTIONARY: Final = cv2.aruco.DICT_APRILTAG_36h11
# Lower numbers are for tags on nodes (NodeInfo.tags).
NUMBERS: Final = range(100, 587)
# Where all pictures have one exposure, so many of them are looked at in a second.
RATE_HZ: Final = 0.5
# A tag is read when so many pictures within this time show it, and no other one: not while a diver swims past it.
LOOKS: Final = 3
WITHIN_NS: Final = 9 * S_NS
# Of two tags in a picture the nearer one counts, if the other one is this many times as far.
CLEARLY: Final = 1.5
# A larger picture is halved: near tags have pixels enough.
WIDE_PX: Final = 1000
# Share of what the code can correct. Fewer corrected bits make fewer tags out of nothing: about one in a million quads.
CORRECTED: Final = 0.2
# Water leaves little contrast: OpenCV's default, 7 grey levels, loses tags.
CONTRAST_LEVELS: Final = 3


def name_of(number: int) -> str:
    """Return the station's name that a tag gives, as it is printed beside it."""
    return f"T{number}"


class StationTags:
    """Reads one camera's pictures. fx_px: the focal length."""

    def __init__(self, node: str, config: StationTagsConfig, fx_px: float) -> None:
        self._node, self._config, self._fx_px = node, config, fx_px
        parameters = cv2.aruco.DetectorParameters()
        parameters.errorCorrectionRate = CORRECTED
        parameters.adaptiveThreshConstant = CONTRAST_LEVELS
        self._detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARY), parameters)
        self._limit = RateLimiter(RATE_HZ)
        self._seen_ns: list[int] = []
        self._number = -1

    def read(self, frame: Frame) -> Mark | None:
        """Return the node's station where this picture and earlier ones show one tag from near."""
        due = self._limit.allow(frame.stamp_ns) if frame.context is None else frame.context
        if not self._config.side_m or not due:
            return None
        found = sorted(self._distances_m(frame))
        if not found or found[0][0] > self._config.within_m:
            return None
        away_m, number = found[0]
        if number != self._number:
            self._number, self._seen_ns = number, []
        if len(found) > 1 and found[1][0] < CLEARLY * away_m:
            return None
        self._seen_ns = [one for one in self._seen_ns if abs(frame.stamp_ns - one) < WITHIN_NS] + [frame.stamp_ns]
        if len(self._seen_ns) < LOOKS:
            return None
        return Mark(
            node=self._node,
            stamp_ns=frame.stamp_ns,
            name=name_of(number),
            note=f"tag {number}, {away_m:.1f} m away",
            tag=number,
        )

    def _distances_m(self, frame: Frame) -> list[tuple[float, int]]:
        """Return how far each station's tag in a picture is, and its number."""
        grey = frame.image if frame.image.ndim == 2 else cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        fx_px = self._fx_px
        if grey.shape[1] > WIDE_PX:
            grey, fx_px = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), fx_px / 2
        corners, ids, _ = self._detector.detectMarkers(grey)
        found = []
        numbers = [] if ids is None else [int(number) for number in np.ravel(ids)]
        for number, corner in zip(numbers, corners, strict=True):
            if number in NUMBERS:
                square = np.asarray(corner, dtype=np.float64).reshape(4, 2)
                # A tag that is seen aslant keeps its longest side.
                side_px = float(np.linalg.norm(np.roll(square, -1, axis=0) - square, axis=1).max())
                found.append((fx_px * self._config.side_m / side_px, number))
        return found
