"""Pictures with the cameras that took them, in a net's frame, as photogrammetry programs begin with them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage, NodeInfo, NodePose
from buddyline.protocol.topics import IMAGE, NET_POSE
from buddyline.tools.columns import in_order
from buddyline.tools.dives import Dive
from buddyline.tools.evaluation.rotation import Floats, normalized, rotate
from buddyline.tools.newfile import check_new

# A picture between two poses that are this far apart has none.
MOST_GAP_NS: Final = S_NS // 2
# East, north, up, as surveys and maps have them, from north, east, down.
ENU_NED: Final = np.array(((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
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
    for envelope in dive.messages(NET_POSE.name):
        if isinstance(envelope.message, NodePose):
            poses.setdefault(envelope.message.node, []).append(envelope.message)
    if not poses:
        raise BuddylineError(f"{dive.name}: no poses of a net in it; solve it with three nodes or a fixed one")
    ordered = {node: in_order(found) for node, found in poses.items()}
    infos, views = dive.infos(), []
    (folder / PICTURES).mkdir()
    for envelope in dive.messages(IMAGE.name):
        picture = envelope.message
        if not isinstance(picture, CompressedImage):
            continue
        node = picture.frame_id.removesuffix("_camera")
        at = _pose_at(ordered.get(node, []), picture.stamp_ns)
        if at is None or node not in infos:
            continue
        name = f"{node}-{picture.stamp_ns}.{'png' if picture.format == 'png' else 'jpg'}"
        (folder / PICTURES / name).write_bytes(picture.data)
        R = np.column_stack([rotate(at[1], axis) for axis in np.eye(3)])
        views.append(CameraView(name, node, ENU_NED @ at[0], ENU_NED @ R))
    if not views:
        raise BuddylineError(f"{dive.name}: no picture in it that has a pose of the net")
    return views, {node: infos[node] for node in sorted({view.node for view in views})}


def _pose_at(poses: Sequence[NodePose], stamp_ns: int) -> tuple[Floats, Floats] | None:
    """Return place (3,) and attitude (4,) between the two poses around a time; None where these are far apart."""
    after = int(np.searchsorted([pose.stamp_ns for pose in poses], stamp_ns))
    if after < len(poses) and poses[after].stamp_ns == stamp_ns:
        return np.array(poses[after].p_m), normalized(np.array(poses[after].q_xyzw))
    if not 0 < after < len(poses) or poses[after].stamp_ns - poses[after - 1].stamp_ns > MOST_GAP_NS:
        return None
    one, other = poses[after - 1], poses[after]
    share = (stamp_ns - one.stamp_ns) / (other.stamp_ns - one.stamp_ns)
    p, q = np.array(one.q_xyzw), np.array(other.q_xyzw)
    # Both signs of a quaternion are the same attitude.
    q = q if p @ q >= 0 else -q
    place_m = (1 - share) * np.array(one.p_m) + share * np.array(other.p_m)
    return place_m, normalized((1 - share) * p + share * q)


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
