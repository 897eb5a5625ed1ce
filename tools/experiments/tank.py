"""AR tags on the floor of a real tank: the accuracy of poses from tags in real water, against the published layout.

Tags, camera and video: github.com/mark-belbin/underwater-apriltags (MIT). The user provides the video.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CameraModel
from buddyline.tools.tags.detection import TagFinder
from buddyline.tools.tags.layout import Layout
from buddyline.tools.tags.pose import TagPose, readings_of, tag_pose

CAMERA: Final = CameraModel(
    model="pinhole", fx_px=1127.7, fy_px=1139.3, cx_px=314.7352, cy_px=226.3186, distortion=[0.0] * 5
)
_FAMILY: Final = "16h5"
_SIDE_M: Final = 0.1555
_CENTRES_M: Final = {
    0: (0.750, 0.500),
    1: (1.548, 0.500),
    2: (2.343, 0.500),
    3: (0.750, 1.265),
    4: (1.550, 1.295),
    5: (2.350, 1.285),
    12: (0.750, 2.057),
    14: (1.545, 2.065),
    16: (2.340, 2.077),
}


def layout() -> Layout:
    """Return the floor's tags in metres: x and y along the floor, as published; z up."""
    corners_m = np.array([(0.5, -0.5), (-0.5, -0.5), (-0.5, 0.5), (0.5, 0.5)]) * _SIDE_M
    flat = {tag_id: corners_m + centre_m for tag_id, centre_m in _CENTRES_M.items()}
    return Layout(_FAMILY, {tag_id: np.column_stack([corners, np.zeros(4)]) for tag_id, corners in flat.items()})


def poses_of(video: Path, step: int) -> tuple[int, int, list[TagPose]]:
    """Return the number of pictures used (every step-th), the number with two or more tags, and the poses."""
    floor = layout()
    finder = TagFinder(floor)
    capture = cv2.VideoCapture(str(video))
    pictures = several = 0
    poses = []
    try:
        while capture.grab():
            pictures += 1
            if (pictures - 1) % step:
                continue
            picture = np.asarray(capture.retrieve()[1], dtype=np.uint8)
            readings = readings_of(finder.find(picture), floor, CAMERA, by_a=True)
            several += len(readings) >= 2
            pose = tag_pose(readings)
            poses += [pose] if pose is not None else []
    finally:
        capture.release()
    if not pictures:
        raise BuddylineError(f"{video}: cannot be read as a video")
    return -(-pictures // step), several, poses


def figures(video: Path, step: int) -> dict[str, Any]:
    """Return the figures of the video."""
    pictures, several, poses = poses_of(video, step)
    return {
        "pictures": pictures,
        "with_two_tags": several,
        "poses": len(poses),
        "readings_used": sum(pose.readings for pose in poses),
        "readings_left_out": sum(pose.left_out for pose in poses),
        "residual_median_px": float(np.median([pose.residual_px for pose in poses])) if poses else None,
        "range_median_m": float(np.median([pose.range_a_m for pose in poses])) if poses else None,
    }
