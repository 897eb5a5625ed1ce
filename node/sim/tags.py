"""AR tags on a node's bar, to compare poses from tags with poses from lights: their places and their rendering."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from buddyline.node.sim.rotation import Vector
from numpy.typing import NDArray

Image = NDArray[np.float32]

FAMILY: Final = "36h11"
SIDE_M: Final = 0.16
CELLS: Final = 8
"""Cells along the side of the black square; a white margin of one cell surrounds it."""
TEXTURE_CELL_PX: Final = 16
WHITE: Final = 0.85
BLACK: Final = 0.04
BLUR_PX: Final = 0.7
PLACES_M: Final = ((-0.2, 0.14, 0.0), (0.2, 0.14, 0.0))


@dataclass(frozen=True)
class Tag:
    """One tag of a node. corners_m: (4, 3) of the black square in the node's camera frame.

    Their order, as seen by an observer who faces the node: top left, top right, bottom right, bottom left.
    """

    id: int
    corners_m: Vector


@dataclass(frozen=True)
class SeenTag:
    """A tag as one camera sees it. board_px: (4, 2), corners of the white margin.

    light: (3,), radiance of a white tag at the tag. through: (3,), the share of it that reaches the camera.
    """

    id: int
    board_px: Vector
    light: Vector
    through: Vector


def layout(index: int) -> tuple[Tag, ...]:
    """Return the two tags of a node; they face along the camera's axis."""
    corners_m = np.array([(0.5, -0.5, 0.0), (-0.5, -0.5, 0.0), (-0.5, 0.5, 0.0), (0.5, 0.5, 0.0)]) * SIDE_M
    return tuple(Tag(2 * index + i, corners_m + place_m) for i, place_m in enumerate(PLACES_M))


def board(corners_m: Vector) -> Vector:
    """Return the outer corners of the white margin around a tag's black square, (4, 3)."""
    centre_m = corners_m.mean(axis=0)
    return np.asarray(centre_m + (corners_m - centre_m) * (CELLS + 2) / CELLS)


def paint(full: Image, tag: SeenTag) -> None:
    """Draw a tag over the full picture."""
    height_px, width_px = full.shape[:2]
    u0, v0 = np.clip(np.floor(tag.board_px.min(axis=0)).astype(int) - 3, 0, (width_px, height_px))
    u1, v1 = np.clip(np.ceil(tag.board_px.max(axis=0)).astype(int) + 4, 0, (width_px, height_px))
    away = (tag.board_px[1, 0] - tag.board_px[0, 0]) * (tag.board_px[2, 1] - tag.board_px[1, 1]) - (
        tag.board_px[1, 1] - tag.board_px[0, 1]
    ) * (tag.board_px[2, 0] - tag.board_px[1, 0]) <= 0
    if u0 >= u1 or v0 >= v1 or away:
        return
    # Texels about as large as pixels: much finer ones would alias.
    side_px = float(np.linalg.norm(np.roll(tag.board_px, -1, axis=0) - tag.board_px, axis=1).max())
    texture = _texture(tag.id, int(np.clip(np.ceil(2 * side_px / (CELLS + 2)), 2, TEXTURE_CELL_PX)))
    edge = texture.shape[0] - 0.5
    square = np.array([(-0.5, -0.5), (edge, -0.5), (edge, edge), (-0.5, edge)], np.float32)
    H = cv2.getPerspectiveTransform(square, (tag.board_px - (u0, v0)).astype(np.float32))
    size = int(u1 - u0), int(v1 - v0)
    white, cover = (
        cv2.GaussianBlur(cv2.warpPerspective(source, H, size, flags=cv2.INTER_AREA), (5, 5), BLUR_PX)
        for source in (texture, np.ones_like(texture))
    )
    patch = full[v0:v1, u0:u1]
    seen = (white[..., None] * tag.light - cover[..., None] * patch) * tag.through
    patch += seen.astype(np.float32)


@lru_cache(maxsize=64)
def _texture(tag_id: int, cell_px: int) -> Image:
    """Return a tag's reflectance with its margin, cell_px pixels for each cell."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    marker = np.asarray(cv2.aruco.generateImageMarker(dictionary, tag_id, CELLS))
    cells = np.pad(marker, 1, constant_values=255) > 127
    return np.where(np.kron(cells, np.ones((cell_px, cell_px))) > 0, WHITE, BLACK).astype(np.float32)
