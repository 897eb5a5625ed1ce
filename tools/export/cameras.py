"""Pictures with the cameras that took them, in a net's frame, as photogrammetry programs begin with them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage, NodeInfo, NodePose
from buddyline.protocol.topics import IMAGE, NET_POSE
from buddyline.tools.columns import in_order
from buddyline.tools.dives import Dive, first_with_net
from buddyline.tools.evaluation.rotation import Floats, rotate
from buddyline.tools.evaluation.truth import PoseHistory
from buddyline.tools.export.enu import R_ENU_NED
from buddyline.tools.newfile import check_new

PICTURES: Final = "images"


@dataclass(frozen=True, eq=False)
class CameraView:
    """A picture: its file's name, its node, place (3,) east, north, up, m, and R_world_camera (3, 3)."""

    name: str
    node: str
    place_m: Floats
    R_world_camera: Floats


def write_views(dive: Dive, folder: Path) -> tuple[list[CameraView], dict[str, NodeInfo]]:
    """Write a dive's pictures into folder/images; return those that have a pose, and their nodes' calibrations."""
    poses: dict[str, list[NodePose]] = {}
    for envelope in first_with_net([dive]).messages(NET_POSE.name, doing="read"):
        if isinstance(envelope.message, NodePose):
            poses.setdefault(envelope.message.node, []).append(envelope.message)
    placed = {node: PoseHistory.of_node(in_order(found)) for node, found in poses.items()}
    infos, views = dive.infos(), []
    (folder / PICTURES).mkdir()
    for envelope in dive.messages(IMAGE.name, doing="export"):
        picture = envelope.message
        if not isinstance(picture, CompressedImage):
            continue
        node = picture.frame_id.removesuffix("_camera")
        at = placed[node].at(picture.stamp_ns) if node in placed else None
        if at is None or node not in infos:
            continue
        name = f"{node}-{picture.stamp_ns}.{'png' if picture.format == 'png' else 'jpg'}"
        (folder / PICTURES / name).write_bytes(picture.data)
        R = np.column_stack([rotate(at[1], axis) for axis in np.eye(3)])
        views.append(CameraView(name, node, R_ENU_NED @ at[0], R_ENU_NED @ R))
    if not views:
        raise BuddylineError(f"{dive.name}: no picture in it that has a pose of the net")
    return views, {node: infos[node] for node in sorted({view.node for view in views})}


@contextmanager
def whole_folder(output: Path) -> Iterator[Path]:
    """Yield a folder that becomes output when all is written.

    Raises BuddylineError if output exists, or cannot be written.
    """
    check_new(output)
    try:
        with TemporaryDirectory(dir=output.parent, prefix=f".{output.name}.") as parent:
            folder = Path(parent) / "new"
            folder.mkdir()
            yield folder
            folder.rename(output)
    except OSError as error:
        raise BuddylineError(f"{output}: cannot be written: {error.strerror}") from error
