"""A net's cameras and pictures as COLMAP's text model: cameras.txt, images.txt, points3D.txt, and images/."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NodeInfo
from buddyline.tools.dives import Dive
from buddyline.tools.evaluation.rotation import Floats
from buddyline.tools.export_cameras import whole_folder, write_views


def export(dive: Dive, output: Path, what: str | None = None) -> int:
    """Write the model into a new folder; return the number of pictures. World: east, north, up, m."""
    if what not in (None, "net"):
        raise BuddylineError(f"--format colmap --what {what}: it has all nodes")
    with whole_folder(output) as folder:
        views, infos = write_views(dive, folder)
        number = {node: i for i, node in enumerate(infos, 1)}
        cameras = [f"{number[node]} {_camera(info)}\n" for node, info in infos.items()]
        (folder / "cameras.txt").write_text("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n" + "".join(cameras))
        rows = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then the points of it, none\n"]
        for i, view in enumerate(views, 1):
            R_camera_world = view.R_world_camera.T
            numbers = (*_quaternion_wxyz(R_camera_world), *(-R_camera_world @ view.place_m).tolist())
            rows.append(f"{i} {' '.join(map(repr, numbers))} {number[view.node]} {view.name}\n\n")
        (folder / "images.txt").write_text("".join(rows))
        (folder / "points3D.txt").write_text("")
    return len(views)


def _camera(info: NodeInfo) -> str:
    """Return model, size and parameters; COLMAP counts from the corner of a pixel, we from its centre."""
    camera = info.camera
    k = list(camera.distortion)
    pinhole = camera.model == "pinhole"
    name = "FULL_OPENCV" if pinhole else "OPENCV_FISHEYE"
    values = [camera.fx_px, camera.fy_px, camera.cx_px + 0.5, camera.cy_px + 0.5, *k, *([0.0] * 3 if pinhole else [])]
    return f"{name} {info.width_px} {info.height_px} {' '.join(map(repr, values))}"


def _quaternion_wxyz(R: Floats) -> tuple[float, float, float, float]:
    """Return the quaternion of a rotation, w not negative (Shepperd 1978)."""
    trace = float(np.trace(R))
    parts = np.array([trace, *np.diag(R).tolist()])
    largest = int(np.argmax(parts))
    if largest == 0:
        q = np.array([1 + trace, R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    else:
        i = largest - 1
        j, k = (i + 1) % 3, (i + 2) % 3
        q = np.empty(4)
        q[0], q[1 + i] = R[k, j] - R[j, k], 1 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j], q[1 + k] = R[j, i] + R[i, j], R[k, i] + R[i, k]
    q = q / np.linalg.norm(q) * (1.0 if q[0] >= 0 else -1.0)
    w, x, y, z = q.tolist()
    return w, x, y, z
