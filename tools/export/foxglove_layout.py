"""A layout file for Foxglove and Lichtblick: scene, pictures with marks, plots, log and state of an exported dive."""

from __future__ import annotations

import json
from collections.abc import Collection
from typing import Any, Final

WORLD: Final = "world"
TRANSFORMS: Final = "/tf"
LOG: Final = "/log"

# Of a track and of a pose: what is plotted, by the panel's title.
_PLOTS: Final = {
    "Range, m": ("range_m",),
    "North, east, down, m": ("t_ned_m[0]", "t_ned_m[1]", "t_ned_m[2]"),
    "Azimuth, inclination, rad": ("azimuth_rad", "inclination_rad"),
}


def layout(topics: Collection[str], pair: tuple[str, str] | None, base: str | None) -> str:
    """Return the layout as JSON, of the topics that a file has. pair: whose track or poses are plotted; base: A."""
    panels: dict[str, Any] = {}
    paths = [topic for topic in topics if topic.endswith(("/path", "/rig"))]
    panels["3D!scene"] = {
        "followTf": WORLD if base is None else f"{base}_camera",
        "followMode": "follow-position",
        "layers": {"grid": {"layerId": "foxglove.Grid", "instanceId": "grid", "size": 20, "divisions": 20}},
        "topics": {topic: {"visible": True} for topic in paths},
        "transforms": {},
    }
    for image in sorted(topic for topic in topics if topic.endswith("/camera/image")):
        camera = image.removesuffix("/image")
        marks = {f"{camera}/{name}": {"visible": True} for name in ("candidates", "chosen")}
        panels[f"Image!{camera.split('/')[1]}"] = {
            "imageMode": {
                "imageTopic": image,
                "calibrationTopic": f"{camera}/calibration",
                "annotations": {topic: said for topic, said in marks.items() if topic in topics},
            }
        }
    for title, fields in _PLOTS.items():
        found = [] if pair is None else [f"buddyline/pair/{pair[0]}/{pair[1]}/{name}" for name in ("track", "pose")]
        series = [
            {"value": f'"{topic}".{field}', "enabled": True, "timestampMethod": "publishTime", "label": field}
            for topic in found
            if topic in topics
            for field in fields
        ]
        panels[f"Plot!{title.split(',')[0].lower()}"] = {"title": title, "paths": series, "isSynced": True}
    panels["RosOut!log"] = {"topicToRender": LOG, "minLogLevel": 1}
    scene, *others = panels
    config = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "splitPercentage": 50, "first": scene, "second": _stacked(others)},
    }
    return json.dumps(config, indent=1) + "\n"


def _stacked(names: list[str]) -> Any:
    """Return panels one below the other, of equal heights."""
    first, *rest = names
    if not rest:
        return first
    return {"direction": "column", "splitPercentage": 100 / len(names), "first": first, "second": _stacked(rest)}
