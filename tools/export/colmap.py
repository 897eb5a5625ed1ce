"""A net's cameras and pictures as COLMAP's text model: cameras.txt, images.txt, points3D.txt, and images/."""

from __future__ import annotations

from pathlib import Path

from buddyline.protocol.messages import NodeInfo
from buddyline.solver_service.geometry.rotation import matrix_to_quat
from buddyline.tools.dives import Dive
from buddyline.tools.export.cameras import whole_folder, write_views


def export(dive: Dive, output: Path, _what: str | None = None) -> int:
    """Write the model into a new folder; return the number of pictures. World: east, north, up, m."""
    with whole_folder(output) as folder:
        views, infos = write_views(dive, folder)
        number = {node: i for i, node in enumerate(infos, 1)}
        cameras = [f"{number[node]} {_camera(info)}\n" for node, info in infos.items()]
        (folder / "cameras.txt").write_text("# CAMERA_ID MODEL WIDTH HEIGHT PARAMS\n" + "".join(cameras))
        rows = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then the points of it, none\n"]
        for i, view in enumerate(views, 1):
            R_camera_world = view.R_world_camera.T
            x, y, z, w = matrix_to_quat(R_camera_world).tolist()
            numbers = (w, x, y, z, *(-R_camera_world @ view.place_m).tolist())
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
