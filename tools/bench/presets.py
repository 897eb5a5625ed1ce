"""How much the detector finds with each environment's preset, and with `auto`, which has to do without one.

On the pictures of the dives named, which say where the lights are, or else on rendered ones.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from buddyline.node.detect import ENVIRONMENTS, METHODS
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.tune import Picture, judge, load_pictures

RENDERED: Final = ("cavern", "night_reef", "lake", "basin", "day_reef")
SEED: Final = 5


def main(argv: list[str]) -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m buddyline.tools.bench presets", description=__doc__)
    parser.add_argument(
        "dives", nargs="*", metavar="DIVE.mcap", help="one environment each; default: rendered pictures"
    )
    parser.add_argument("--truth", nargs="+", metavar="T.mcap", help="one for each dive, where it does not say itself")
    parser.add_argument("--pictures", type=int, default=40, metavar="N", help="of each environment; default: 40")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    truths = args.truth or [None] * len(args.dives)
    if args.pictures < 1 or len(truths) != len(args.dives):
        raise BuddylineError("--pictures: at least 1; --truth: as many as dives")
    cv2.setNumThreads(1)
    rows = []
    for source, truth in zip(args.dives, truths, strict=True):
        pictures, by = load_pictures([source], truth, args.pictures)
        if by != "truth":
            raise BuddylineError(f"{source}: does not say where the lights are; give --truth")
        rows.append(figures(Path(source).stem, pictures))
    if not args.dives:
        rows = [figures(environment, _rendered(environment, args.pictures)) for environment in RENDERED]
    if args.json:
        json.dump(rows, sys.stdout, indent=1)
        sys.stdout.write("\n")
    else:
        sys.stdout.write(table(rows))
    return 0


def figures(source: str, pictures: Sequence[Picture]) -> dict[str, Any]:
    """Return the recall within 2 px, and the false candidates a picture, by environment set."""
    judged = {name: judge(METHODS[0], name, {}, pictures) for name in ENVIRONMENTS}
    return {
        "source": source,
        "pictures": len(pictures),
        "recall": {name: result.close for name, result in judged.items()},
        "false": {name: result.false for name, result in judged.items()},
    }


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return the figures for a person."""
    lines = [
        f"{'recall, 2 px (false)':22s}" + "".join(f"{name:>16s}" for name in ENVIRONMENTS) + f"{'auto - best':>14s}"
    ]
    for row in rows:
        cells = [f"{row['recall'][name]:.3f} ({row['false'][name]:4.2f})" for name in ENVIRONMENTS]
        behind = row["recall"]["auto"] - max(row["recall"].values())
        lines.append(f"{row['source']:22s}" + "".join(f"{cell:>16s}" for cell in cells) + f"{behind:14.3f}")
    return "\n".join(lines) + "\n"


def _rendered(environment: str, count: int) -> list[Picture]:
    from buddyline.node.sim.scenario import Scenario
    from buddyline.node.sim.world import World

    scenario = Scenario(environment=environment, seed=SEED)  # type: ignore[arg-type]
    world = World(scenario)
    pictures = []
    for i in range(count):
        node, stamp_ns = (scenario.node_a, scenario.node_b)[i % 2], round((1.0 + 1.9 * i) * 1e9)
        seen = [light for light in world.light_truth(node, stamp_ns, i).lights if light.visible]
        lights_px = np.array([(light.u_px, light.v_px) for light in seen]).reshape(-1, 2)
        pictures.append(Picture(f"{environment} {i}", world.render(node, stamp_ns), lights_px))
    return pictures
