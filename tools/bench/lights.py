"""The lights that the default detector finds in rendered pictures, and whether sigma and score tell the truth.

Each scene is a dive at 5 Hz in one water. Its pictures have the exposure that the node's own loop chooses; with
`--scene` they have the scene's. Pictures before the loop has locked count as well, but not those of the first second.
Pictures of the scene, which the loop takes every few frames for people, do not count. With `--guided` the other node's
lights are expected, as a solver with a track expects them, with the errors that a track has at 10 Hz.

A light is one of the other node's that is in view. It is found by the candidate nearest to it, within 1 % of the
picture's width. NEES: the mean squared error over the variance, per axis; 1 if sigma is true. Beyond: the share of
errors outside of the circle that should hold 99.73 % of them, which is 3 sigma of one number. False: a candidate with
score 0.5 or more that is near no lamp of anyone.

With folders of pictures that show no lamp, the figures are those of what is taken for one in them. They go by the name
of their folder, as deep as it may be.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np
from buddyline.node.capture.loop import ExposureLoop
from buddyline.node.config import ExposureConfig
from buddyline.node.detect import make_detector
from buddyline.node.detect.detection import LIKELY
from buddyline.node.devices import Frame
from buddyline.node.drivers.stored import picture_files, read_picture
from buddyline.node.guide import Guide
from buddyline.node.pipeline import Pipeline
from buddyline.protocol.clock import S_NS, trigger_index
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Blob, Expect, ExpectedLight
from buddyline.protocol.options import finite
from buddyline.tools.evaluation.lights import tolerance_px
from buddyline.tools.measure.pictures import simulated_world
from buddyline.tools.measure.tables import cells_of, text_table
from buddyline.tools.tune.score import score_error
from buddyline.tools.tune.sigma import BEYOND
from numpy.typing import NDArray

if TYPE_CHECKING:
    from buddyline.node.sim.world import World

ENVIRONMENTS: Final = ("cavern", "night_reef", "lake", "basin", "day_reef")
PERIOD_NS: Final = S_NS // 5
SIGMA: Final = 0.0025
"""How far the track foretells a light off its place at 10 Hz, 1 sd, as a share of the picture's width."""
FIRST_SEED: Final = 5000
FIRST_COUNTED: Final = 5
"""Number of each scene's first picture that counts: those of the first second do not."""
CLOSE_PX: Final = 2.0
"""A light with a candidate this near counts as found in the share `within 2 px`."""
FIRST: Final = 3
"""So many candidates, the likeliest, should have both lights."""
RANGES_M: Final = (0.0, 2.0, 3.0, 5.0, 50.0)
UNCLIPPED: Final = 240.0
"""A candidate whose peak is below this grey level counts as not clipped."""


@dataclass(frozen=True, slots=True)
class Light:
    """A light in view of one picture. away_px: of the nearest candidate (inf for none), which is `blob`.

    border_px: from the candidate to the picture's border. first: whether a candidate near it is among the first FIRST.
    """

    range_m: float
    away_px: float
    blob: Blob | None
    near: bool
    first: bool
    border_px: float

    @property
    def square(self) -> float:
        """The squared error over the variance per axis."""
        return math.inf if self.blob is None else (self.away_px / self.blob.sigma_px) ** 2


@dataclass(slots=True)
class SeenLights:
    """What was found in the pictures of one water. scores: of all candidates; lamp: whether each is one, of anyone."""

    pictures: int = 0
    pairs: int = 0
    pairs_first: int = 0
    false: int = 0
    lights: list[Light] = field(default_factory=list)
    scores: list[float] = field(default_factory=list)
    lamp: list[bool] = field(default_factory=list)

    def add(self, blobs: Sequence[Blob], lights: Sequence[Light], of_lamp: Sequence[bool]) -> None:
        """Count a picture with its candidates, of which some are lamps, and the lights in view."""
        self.pictures += 1
        self.lights += lights
        if len(lights) == 2:
            self.pairs += 1
            self.pairs_first += all(light.first for light in lights) and lights[0].blob is not lights[1].blob
        scores = [float(blob.score or 0.0) for blob in blobs]
        self.false += sum(score >= LIKELY and not lamp for score, lamp in zip(scores, of_lamp, strict=True))
        self.scores += scores
        self.lamp += of_lamp


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the benchmark's arguments."""
    parser.add_argument(
        "folders", nargs="*", metavar="FOLDER", help="of pictures without lamps; default: rendered ones"
    )
    parser.add_argument("--environment", nargs="+", choices=ENVIRONMENTS, default=list(ENVIRONMENTS), metavar="WATER")
    parser.add_argument("--seed", type=int, default=FIRST_SEED, help=f"of the first scene; default: {FIRST_SEED}")
    parser.add_argument("--scenes", type=int, default=3, metavar="N", help="in each water; default: 3")
    parser.add_argument("--seconds", type=finite, default=24.0, help="of each scene; default: 24")
    parser.add_argument("--strange", type=int, default=1, metavar="N", help="other divers' lamps; default: 1")
    parser.add_argument("--guided", action="store_true", help="with the other node's lights expected")
    parser.add_argument("--scene", action="store_true", help="with the scene's exposure instead of the lamps'")


def measure(args: argparse.Namespace) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each table: by water and by class of lights, or by folder."""
    if args.scenes < 1 or args.seconds <= FIRST_COUNTED * PERIOD_NS / S_NS or args.strange < 0 or args.seed < 0:
        raise BuddylineError("--scenes: at least 1; --seconds: above 1; --strange, --seed: 0 or more")
    cv2.setNumThreads(1)
    if args.folders:
        return {"folders": [without_lamps(Path(folder)) for folder in args.folders]}
    seen = {water: SeenLights() for water in args.environment}
    for water, found in seen.items():
        for seed in range(args.seed, args.seed + args.scenes):
            for blobs, lights, of_lamp in look(
                water, seed, args.seconds, args.strange, scene=args.scene, guided=args.guided
            ):
                found.add(blobs, lights, of_lamp)
    every = [light for found in seen.values() for light in found.lights]
    return {
        "waters": [_of_water(water, found) for water, found in seen.items()],
        "classes": [_of_class(name, filter(belongs, every)) for name, belongs in CLASSES.items()],
    }


def without_lamps(folder: Path) -> dict[str, Any]:
    """Return the row of a folder with pictures that show no lamp, each seen by a detector of its own."""
    seen = SeenLights()
    for file in (file for place in sorted({folder, *folder.rglob("*/")}) for file in picture_files(place)):
        blobs = [d.blob for d in make_detector().detect(read_picture(file))]
        seen.add(blobs, [], [False] * len(blobs))
    return {"folder": str(folder), **_of_candidates(seen)}


Picture = tuple[list[Blob], list[Light], list[bool]]


def look(environment: str, seed: int, seconds: float, strange: int, *, scene: bool, guided: bool) -> Iterator[Picture]:
    """Yield of each picture of a scene the candidates, the lights in view, and which candidates are lamps."""
    world = simulated_world(environment, seed, other_lamps=strange)
    for node in (world.scenario.node_a, world.scenario.node_b):
        for frame, blobs in loop_frames(world, node, round(seconds * S_NS / PERIOD_NS), scene=scene, guided=guided):
            lights = _lights(world, node, frame, blobs)
            yield blobs, lights, _lamps(world, node, frame, blobs)


def loop_frames(
    world: World, node: str, count: int, *, scene: bool = False, guided: bool = False
) -> Iterator[tuple[Frame, list[Blob]]]:
    """Yield those of a node's first `count` frames that count, each with its candidates.

    scene: at the scene's exposure instead of the loop's. guided: with the other node's lights expected.
    """
    from buddyline.node.sim.sensor import DelayedControls

    controls = DelayedControls()
    loop = ExposureLoop(ExposureConfig(), controls.range)
    focal_px = world.info(node, 0, PERIOD_NS).camera.fx_px
    guide = Guide(node) if guided else None
    pipeline = Pipeline(node, "bench", PERIOD_NS, make_detector(focal_px=focal_px), guide)
    rng = np.random.default_rng(0)
    first = trigger_index(world.scenario.start_ns, PERIOD_NS) + 1
    for trigger in range(first, first + count):
        stamp_ns = trigger * PERIOD_NS
        exposure, context = (None, False) if scene else controls.take(trigger)
        frame = Frame(world.render(node, stamp_ns, exposure), stamp_ns, exposure=exposure, context=context)
        if guide is not None:
            guide.expect(_expectation(world, frame, node, rng))
        candidates = pipeline.candidates(frame)
        if candidates is None:
            continue
        if not scene:
            controls.follow(loop.update(frame, candidates, pipeline.expected))
        if not context and trigger >= first + FIRST_COUNTED:
            yield frame, candidates.blobs


def _expectation(world: World, frame: Frame, node: str, rng: np.random.Generator) -> Expect:
    sigma_px = SIGMA * frame.image.shape[1]
    lights = [
        ExpectedLight(
            side=light.name,
            u_px=light.u_px + sigma_px * rng.standard_normal(),
            v_px=light.v_px + sigma_px * rng.standard_normal(),
            covariance_px2=(sigma_px**2, 0.0, sigma_px**2),
            rate_pxps=(0.0, 0.0),
            sigma_rate_pxps=0.0,
        )
        for light in world.light_truth(node, frame.stamp_ns, 0).lights
        if light.visible
    ]
    seen = next(other for other in (world.scenario.node_a, world.scenario.node_b) if other != node)
    return Expect(node=node, seen=seen, stamp_ns=frame.stamp_ns, valid_ns=PERIOD_NS, lights=lights)


def _lights(world: World, node: str, frame: Frame, blobs: Sequence[Blob]) -> list[Light]:
    height, width = frame.image.shape[:2]
    truth = world.truth(frame.stamp_ns, 0)
    lights = []
    for true in world.light_truth(node, frame.stamp_ns, 0).lights:
        if not true.visible:
            continue
        away_px = [math.hypot(blob.u_px - true.u_px, blob.v_px - true.v_px) for blob in blobs]
        nearest = blobs[int(np.argmin(away_px))] if blobs else None
        near_px = tolerance_px(width)
        border_px = math.inf
        if nearest is not None:
            u, v = nearest.u_px, nearest.v_px
            border_px = min(u, v, width - 1 - u, height - 1 - v)
        least_px = min(away_px, default=math.inf)
        first = min(away_px[:FIRST], default=math.inf) <= near_px
        range_m = float(np.linalg.norm(truth.t_a_b_m))
        lights.append(Light(range_m, least_px, nearest, least_px <= near_px, first, border_px))
    return lights


def _lamps(world: World, node: str, frame: Frame, blobs: Sequence[Blob]) -> list[bool]:
    """Return which candidates are near a lamp, of anyone, that is in view or hidden."""
    near_px = tolerance_px(frame.image.shape[1])
    lamps = world.lamps(node, frame.stamp_ns)
    return [any(math.hypot(blob.u_px - u, blob.v_px - v) <= near_px for u, v, _ in lamps) for blob in blobs]


def _between(least_m: float, most_m: float) -> Callable[[Light], bool]:
    return lambda light: least_m <= light.range_m < most_m


def _blob_is(holds: Callable[[Blob], bool]) -> Callable[[Light], bool]:
    return lambda light: light.blob is not None and holds(light.blob)


def _is_cut(light: Light) -> bool:
    return light.blob is not None and light.border_px < math.sqrt(light.blob.area_px / math.pi) + 5.0


CLASSES: Final[Mapping[str, Callable[[Light], bool]]] = {
    "all": lambda light: True,
    **{f"{a:g} to {b:g} m": _between(a, b) for a, b in pairwise(RANGES_M)},
    "clipped": _blob_is(lambda blob: blob.peak >= UNCLIPPED),
    "not clipped": _blob_is(lambda blob: blob.peak < UNCLIPPED),
    "cut by the border": _is_cut,
}
"""Classes of lights, by name: whether one belongs to it."""


def _of_water(water: str, seen: SeenLights) -> dict[str, Any]:
    lights = seen.lights
    return {
        "water": water,
        "lights": len(lights),
        "recall": _share([light.away_px <= CLOSE_PX for light in lights]),
        "both_first": seen.pairs_first / max(seen.pairs, 1),
        "median_px": _median([light.away_px for light in lights if light.near]),
        **_of_candidates(seen),
        **_truth_of_sigma(lights),
    }


def _of_candidates(seen: SeenLights) -> dict[str, float]:
    return {
        "pictures": seen.pictures,
        "false": seen.false / max(seen.pictures, 1),
        "calibration": score_error(np.array(seen.scores), np.array(seen.lamp, bool)) if seen.scores else 0.0,
    }


def _of_class(name: str, lights: Iterable[Light]) -> dict[str, Any]:
    found = [light for light in lights if light.near]
    return {
        "class": name,
        "lights": len(found),
        "median_px": _median([light.away_px for light in found]),
        **_truth_of_sigma(found),
    }


def _truth_of_sigma(lights: Sequence[Light]) -> dict[str, float]:
    square = np.array([light.square for light in lights if light.near])
    return {
        "nees": float(square.mean()) / 2.0 if square.size else math.nan,
        "beyond": _share(square > BEYOND),
    }


def _share(holds: Sequence[bool] | NDArray[np.bool_]) -> float:
    return float(np.mean(holds)) if len(holds) else math.nan


def _median(values: Sequence[float]) -> float:
    return float(np.median(values)) if values else math.nan


def table(figures: dict[str, list[dict[str, Any]]]) -> str:
    """Return the tables as text."""
    candidates = {"pictures": "{pictures}", "false": "{false:.3f}", "calibration error": "{calibration:.3f}"}
    if "folders" in figures:
        return text_table(cells_of(figures["folders"], {"folder": "{folder}"} | candidates))
    sigma = {"NEES": "{nees:.2f}", "beyond": "{beyond:.3f}"}
    waters = {
        "water": "{water}",
        "pictures": "{pictures}",
        "lights": "{lights}",
        "within 2 px": "{recall:.3f}",
        "both in first 3": "{both_first:.3f}",
        "median px": "{median_px:.3f}",
        "false": "{false:.3f}",
        "calibration error": "{calibration:.3f}",
    }
    classes = {"lights found": "{class}", "number": "{lights}", "median px": "{median_px:.3f}"}
    return (
        f"{text_table(cells_of(figures['waters'], waters | sigma))}\n\n"
        f"{text_table(cells_of(figures['classes'], classes | sigma))}"
    )
