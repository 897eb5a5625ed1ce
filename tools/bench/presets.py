"""How much the detector finds with each environment's preset, and with `auto`, which has to do without one.

On the pictures of the dives named, which say where the lights are, or else on rendered ones.
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
    parser.add_argument("--truth", nargs="+", metavar="T.mcap", help="one for each dive, where it does not say itself")
    parser.add_argument("--pictures", type=int, default=40, metavar="N", help="of each environment; default: 40")


def measure(args: argparse.Namespace) -> list[dict[str, Any]]:
    """Return the recall within 2 px and the false candidates a picture of each source, by environment set."""
    truths = args.truth or [None] * len(args.dives)
    if args.pictures < 1 or len(truths) != len(args.dives):
        raise BuddylineError("--pictures: at least 1; --truth: as many as dives")
    cv2.setNumThreads(1)
    rows = []
    for source, truth in zip(args.dives, truths, strict=True):
        pictures, by = load_pictures([source], truth, args.pictures)
        if by != "truth":
            raise BuddylineError(f"{source}: does not say where the lights are; give --truth")
        rows.append(judged(Path(source).stem, pictures))
    return rows or [judged(environment, _rendered(environment, args.pictures)) for environment in RENDERED]


def judged(source: str, pictures: Sequence[Picture]) -> dict[str, Any]:
    """Return the row of these pictures."""
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
