"""The tags on a node and their places: from NodeInfo, or from a JSON file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import msgspec
import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import ArTag
from buddyline.tools.evaluation.rotation import Floats

FAMILIES: Final = {
    "36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "16h5": cv2.aruco.DICT_APRILTAG_16h5,
}


@dataclass(frozen=True, eq=False)
class Layout:
    """One family's tags on one body. corners_m: by id, (4, 3) in the body's frame, as ArTag has them."""

    family: str
    corners_m: dict[int, Floats]


def layout_of(tags: Iterable[ArTag], source: str) -> Layout:
    """Return a layout; source: its name in errors. Raises BuddylineError if it cannot be used."""
    listed = list(tags)
    if not listed:
        raise BuddylineError(f"{source}: holds no tags")
    families = sorted({tag.family for tag in listed})
    if len(families) > 1 or families[0] not in FAMILIES:
        raise BuddylineError(f"{source}: family {', '.join(families)}: give one of {', '.join(FAMILIES)}")
    corners_m: dict[int, Floats] = {}
    for tag in listed:
        if tag.id in corners_m:
            raise BuddylineError(f"{source}: two tags of id {tag.id}; give each its own")
        corners_m[tag.id] = np.array(tag.corners_m)
    return Layout(families[0], corners_m)


def load_layout(path: str) -> Layout:
    """Read a JSON file: a list of tags, each with id, corners_m and family."""
    try:
        tags = msgspec.json.decode(Path(path).read_bytes(), type=list[ArTag])
    except OSError as error:
        raise BuddylineError(f"{path}: cannot be read: {error.strerror}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise BuddylineError(f"{path}: {error}") from error
    return layout_of(tags, path)
