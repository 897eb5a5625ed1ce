"""Pictures to measure with: a dive's own, or rendered ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from buddyline.node.drivers.stored import decode_picture
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage
from buddyline.protocol.topics import IMAGE
from buddyline.tools.dives import Dive
from numpy.typing import NDArray

if TYPE_CHECKING:
    from buddyline.node.sim.world import World

Item = TypeVar("Item")


def stored_pictures(path: Path | str) -> Iterator[NDArray[np.uint8]]:
    """Yield the pictures of a dive, in its order."""
    with Dive([Path(path)]) as dive:
        for picture in dive.all_of(IMAGE, CompressedImage):
            yield decode_picture(picture.data, f"{path}: picture at {picture.stamp_ns}")


def simulated_world(environment: str, seed: int, width_px: int = 0, height_px: int = 0, other_lamps: int = 1) -> World:
    """Return a simulated world (size 0: the simulator's own); raise BuddylineError for an unknown environment."""
    from buddyline.node.sim.scenario import ENVIRONMENTS, Scenario
    from buddyline.node.sim.world import World

    if environment not in ENVIRONMENTS:
        raise BuddylineError(f"{environment}: is neither a dive (.mcap) nor one of {', '.join(ENVIRONMENTS)}")
    size = {"width_px": width_px, "height_px": height_px} if width_px else {}
    return World(Scenario(environment=environment, seed=seed, other_lamps=other_lamps, **size))  # type: ignore[arg-type]


def views(world: World, count: int, step_s: float) -> Iterator[tuple[str, int]]:
    """Yield node and instant (ns) of `count` pictures, of both nodes by turns, from the first second on."""
    nodes = world.scenario.node_a, world.scenario.node_b
    for i in range(count):
        yield nodes[i % 2], world.scenario.start_ns + round((1.0 + step_s * i) * S_NS)


def spread(items: Sequence[Item], count: int) -> list[Item]:
    """Return at most count of some pictures, or of what names them, evenly spread."""
    return [items[round(i)] for i in np.linspace(0, len(items) - 1, min(count, len(items)))]
