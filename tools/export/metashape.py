"""A net's cameras and pictures for Metashape: cameras.xml to import as cameras, and images/."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from buddyline.protocol.messages import NodeInfo
from buddyline.tools.dives import Dive
from buddyline.tools.export.cameras import whole_folder, write_views


def export(dive: Dive, output: Path, _what: str | None = None) -> int:
    """Write cameras.xml and pictures into a new folder; return the number of pictures. World: east, north, up, m."""
    document = ElementTree.Element("document", version="1.2.0")
    chunk = ElementTree.SubElement(document, "chunk")
    sensors, cameras = (ElementTree.SubElement(chunk, name) for name in ("sensors", "cameras"))
    with whole_folder(output) as folder:
        views, infos = write_views(dive, folder)
        for number, (node, info) in enumerate(infos.items()):
            _add_sensor(sensors, number, node, info)
        for number, view in enumerate(views):
            of_node = str(list(infos).index(view.node))
            camera = ElementTree.SubElement(cameras, "camera", id=str(number), sensor_id=of_node, label=view.name)
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = view.R_world_camera, view.place_m
            ElementTree.SubElement(camera, "transform").text = " ".join(map(repr, T.ravel().tolist()))
        ElementTree.indent(document)
        ElementTree.ElementTree(document).write(folder / "cameras.xml", encoding="utf-8", xml_declaration=True)
    return len(views)


def _add_sensor(sensors: ElementTree.Element, number: int, node: str, info: NodeInfo) -> None:
    """Add a node's camera: one focal length, b1 for the other, the centre from the picture's middle."""
    camera, width, height = info.camera, info.width_px, info.height_px
    fisheye = camera.model == "fisheye"
    kind = "equidistant_fisheye" if fisheye else "frame"
    sensor = ElementTree.SubElement(sensors, "sensor", id=str(number), label=node, type=kind)
    ElementTree.SubElement(sensor, "resolution", width=str(width), height=str(height))
    calibration = ElementTree.SubElement(sensor, "calibration", {"type": kind, "class": "adjusted"})
    ElementTree.SubElement(calibration, "resolution", width=str(width), height=str(height))
    k = camera.distortion
    # Metashape's p1 and p2 are OpenCV's p2 and p1.
    lens = dict(zip(("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p2", "p1", "k3"), k, strict=True))
    middle = {"cx": camera.cx_px + 0.5 - width / 2, "cy": camera.cy_px + 0.5 - height / 2}
    for name, value in ({"f": camera.fy_px, **middle, "b1": camera.fx_px - camera.fy_px} | lens).items():
        ElementTree.SubElement(calibration, name).text = repr(float(value))
