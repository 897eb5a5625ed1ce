"""The detector's recall with the preset of each environment, and with `auto`, which has no preset.

It is measured on the pictures of the given dives, which need light truth, or on rendered pictures.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from buddyline.node.detect import ENVIRONMENTS, METHODS
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.measure.pictures import simulated_world, views
from buddyline.tools.measure.tables import cells_of, text_table
from buddyline.tools.tune import Picture, judge, load_pictures

RENDERED: Final = ("cavern", "night_reef", "lake", "basin", "day_reef")
SEED: Final = 5
STEP_S: Final = 1.9


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument(
        "dives", nargs="*", metavar="DIVE.mcap", help="one environment each; default: rendered pictures"
    )
    parser.add_argument("--truth", nargs="+", metavar="T.mcap", help="light truth of each dive, if the dives have none")
    parser.add_argument("--pictures", type=int, default=40, metavar="N", help="of each environment; default: 40")


def measure(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return each source's recall within 2 px and false candidates per picture, by preset."""
    truths = args.truth or [None] * len(args.dives)
    if args.pictures < 1 or len(truths) != len(args.dives):
        raise BuddylineError("--pictures: at least 1; --truth: as many as dives")
    cv2.setNumThreads(1)
    rows = []
    for source, truth in zip(args.dives, truths, strict=True):
        pictures, by = load_pictures([source], truth, args.pictures)
        if by != "truth":
            raise BuddylineError(f"{source}: has no light truth; give --truth")
        rows.append(judged(Path(source).stem, pictures))
    return rows or [judged(environment, _rendered(environment, args.pictures)) for environment in RENDERED]


def judged(source: str, pictures: Sequence[Picture]) -> dict[str, Any]:
    """Return the row for these pictures."""
    found = {name: judge(METHODS[0], name, {}, pictures) for name in ENVIRONMENTS}
    return {
        "source": source,
        "pictures": len(pictures),
        "recall": {name: result.close for name, result in found.items()},
        "false": {name: result.false for name, result in found.items()},
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the figures for a person."""
    columns = {
        "recall, 2 px (false)": "{source}",
        **{name: f"{{recall[{name}]:.3f}} ({{false[{name}]:.2f}})" for name in ENVIRONMENTS},
        "auto - best": "{behind:.3f}",
    }
    compared = [row | {"behind": row["recall"]["auto"] - max(row["recall"].values())} for row in rows]
    return text_table(cells_of(compared, columns))


def _rendered(environment: str, count: int) -> list[Picture]:
    world = simulated_world(environment, SEED)
    pictures = []
    for i, (node, stamp_ns) in enumerate(views(world, count, STEP_S)):
        seen = [light for light in world.light_truth(node, stamp_ns, i).lights if light.visible]
        lights_px = np.array([(light.u_px, light.v_px) for light in seen]).reshape(-1, 2)
        pictures.append(Picture(f"{environment} {i}", world.render(node, stamp_ns), lights_px))
    return pictures
