"""The simulated scenes to which the detector's score and sigma are fitted, in five waters.

They have decoys or none, several exposures and resolutions, and the nodes' lamps lit or dark.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

import numpy as np
from buddyline.node.detect.source import SourceDetector
from buddyline.protocol.clock import MS_NS
from buddyline.tools.progress import Progress
from numpy.typing import NDArray

if TYPE_CHECKING:
    from buddyline.node.capture.exposure import Exposure
    from buddyline.node.sim.world import World

T = TypeVar("T")

SEEDS: Final = range(1000, 1050)
HELD_OUT: Final = range(2000, 2012)
"""Seeds of the scenes: to fit, and to say how well it fits. Each makes a scene in every water."""
VIEWS: Final = 6
SECONDS: Final = 60.0
CLEAN_SHARE: Final = 0.65
"""Share of the scenes without decoys."""
FAR: Final = (0.6, 1.4)
"""Greatest range of a scene, as a share of the water's own: lamps that only just show count as well."""
DARK_SHARE: Final = 0.2
"""Share of the scenes in which the nodes' lamps are dark: pictures without lamps, or with other divers' alone."""
STOPS: Final = (0.0, 0.0, 1.0, -1.0, -2.0, -3.0)
LAMPS_SHARE, LAMPS_MS = 0.65, (0.014, 0.15)
"""So many scenes are exposed for lamps, as a node does nearly always: so many ms, evenly on a logarithmic scale, which
is what its loop comes to. The others are exposed relative to the scene's exposure."""
OTHER_LAMPS: Final = (0, 0, 1, 2, 4, 8)
SIZES: Final = ((820, 616), (820, 616), (820, 616), (1640, 1232))
GREY_SHARE: Final = 0.15
DECOYS: Final = (
    ("shells",),
    ("shells", "slabs"),
    ("bubbles",),
    ("shells", "lasers", "slabs"),
    ("bubbles", "clock"),
    ("shells", "bubbles", "slabs", "lasers", "clock"),
    ("walls",),
    ("walls", "slabs", "clock"),
)


class FitPicture(NamedTuple):
    """One picture of a scene, and the detector that has seen the scene's earlier ones."""

    detector: SourceDetector
    picture: NDArray[np.uint8]
    world: World
    node: str
    stamp_ns: int


def to_fit_and_held_out(simulated: Callable[[Iterable[int], Progress, int], Iterator[T]]) -> tuple[list[T], list[T]]:
    """Return what a function yields for SEEDS, and for HELD_OUT. Its arguments are those of `scenes`."""
    from buddyline.node.sim.scenario import ENVIRONMENTS

    first, others = len(SEEDS) * len(ENVIRONMENTS), len(HELD_OUT) * len(ENVIRONMENTS)
    with Progress("fit", first + others) as progress:
        return list(simulated(SEEDS, progress, 0)), list(simulated(HELD_OUT, progress, first))


def named_fit() -> str:
    """Return which pictures are fitted to, for the provenance."""
    return f"seeds {SEEDS.start} to {SEEDS.stop - 1} in each water, {VIEWS} pictures each"


def named_held_out() -> str:
    """Return which pictures say how well it fits, for a comment."""
    return f"pictures of seeds {HELD_OUT.start} to {HELD_OUT.stop - 1}"


def scenes(seeds: Iterable[int], progress: Progress, done: int = 0) -> Iterator[tuple[int, Iterator[FitPicture]]]:
    """Yield the seed and the views of each scene, in every water. done: scenes that the progress counts already."""
    from buddyline.node.sim.scenario import ENVIRONMENTS

    for i, seed in enumerate(seeds):
        for k, environment in enumerate(ENVIRONMENTS):
            progress.show(done + i * len(ENVIRONMENTS) + k, f"{environment}, seed {seed}")
            yield seed, views(environment, seed)


def views(environment: str, seed: int) -> Iterator[FitPicture]:
    """Yield VIEWS pictures of one scene, which the seed draws: size, range, decoys, lamps, exposure."""
    from buddyline.node.sim.scenario import WATERS, Scenario
    from buddyline.node.sim.world import World

    rng = np.random.default_rng(seed * 10 + sum(environment.encode()))
    width_px, height_px = SIZES[rng.integers(len(SIZES))]
    dark = rng.random() < DARK_SHARE
    far_m = WATERS[environment].range_max_m * rng.uniform(*FAR)
    scenario = Scenario(
        environment=environment,  # type: ignore[arg-type]
        seed=seed,
        width_px=width_px,
        height_px=height_px,
        range_max_m=float(far_m),
        decoys=() if rng.random() < CLEAN_SHARE else DECOYS[rng.integers(len(DECOYS))],
        other_lamps=int(rng.choice(OTHER_LAMPS)),
        dead_lamps=("a.left", "a.right", "b.left", "b.right") if dark else (),
    )
    world = World(scenario)
    exposure = _exposure(world, rng)
    grey = rng.random() < GREY_SHARE
    detector = SourceDetector({}, None)
    for k in range(VIEWS):
        node = (scenario.node_a, scenario.node_b)[k % 2]
        stamp_ns = round(1e9 * (1.0 + SECONDS * rng.random()))
        picture = world.render(node, stamp_ns, exposure)
        yield FitPicture(detector, picture[:, :, 1].copy() if grey else picture, world, node, stamp_ns)


def _exposure(world: World, rng: np.random.Generator) -> Exposure | None:
    """Return an exposure for lamps, or one that is longer or shorter than the scene's; None for the scene's own."""
    from buddyline.node.capture.exposure import Exposure
    from buddyline.node.sim.sensor import scene_exposure

    lamps_ms = math.exp(rng.uniform(*np.log(LAMPS_MS)))
    stops = float(rng.choice(STOPS))
    if rng.random() < LAMPS_SHARE:
        return Exposure(round(lamps_ms * MS_NS))
    return Exposure(round(scene_exposure(world.scenario.water).amount * 2.0**stops * MS_NS)) if stops else None
