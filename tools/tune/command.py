"""`buddyline tune`: propose a detector's values from a site's own pictures, and write those pictures with marks.

The values are judged by the dive's light truth, if it has any. Otherwise the likely candidates of the default detector
replace it, and the proposed values are the strictest ones that keep these candidates.

With `--fit` the pictures show no lamp, and the detector's score is fitted to them and to simulated ones (score.py).
`--fit-sigma` fits the sigma of what the detector finds to simulated pictures, and to dives with light truth
(sigma.py).
"""

from __future__ import annotations

import argparse
import json
import logging
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, TypeAlias

import cv2
import numpy as np
from buddyline.node.detect import Detector, make_detector, values_of
from buddyline.node.detect.detection import focal_of, is_likely
from buddyline.node.detect.source import SourceDetector
from buddyline.node.drivers.stored import PictureError, decode_picture, picture_files, read_picture
from buddyline.protocol.clock import trigger_index
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage, LightTruth
from buddyline.protocol.topics import IMAGE, LIGHT_TRUTH
from buddyline.tools import losses
from buddyline.tools.dives import Dive
from buddyline.tools.draw.marks import mark_candidates
from buddyline.tools.measure.pictures import spread
from buddyline.tools.newfile import new_folder, write_picture
from buddyline.tools.progress import Progress
from buddyline.tools.tune import score, sigma
from buddyline.tools.tune.still import Rectangle, still_parts
from numpy.typing import NDArray

log = logging.getLogger(__name__)

Values: TypeAlias = dict[str, float]
Points: TypeAlias = NDArray[np.float64]

GRIDS: Final[Mapping[str, Sequence[float]]] = {
    "contrast_min": (3, 4, 5, 6, 8, 10, 13, 16),
    "clutter_gain": (0.5, 1, 1.5, 2, 3, 4),
    "value_min": (120, 140, 160, 180, 200, 220, 235, 245, 250),
    "saturation_max": (40, 60, 90, 120, 150, 200, 255),
    "close_px": (1, 3, 5, 9),
    "area_min_px": (1, 2, 4, 6, 10, 20),
}
FIRST: Final = 8
NEAR_WIDTHS: Final = 0.01
CLOSE_PX: Final = 2.0
COST_OF_FALSE: Final = 0.01
ROUNDS: Final = 2
MASK_BGR: Final = (255, 160, 60)
BY_TRUTH: Final = "truth"
EVERY: Final = 1_000_000
NO_LIGHTS: Final = np.empty((0, 2))


@dataclass(frozen=True)
class Picture:
    """A picture with the lights that should be found in it, (L, 2) px. focal_px: of its camera, if that is known."""

    name: str
    pixels: NDArray[np.uint8]
    lights_px: Points
    focal_px: float | None = None


@dataclass(frozen=True)
class Judged:
    """The quality of a set of values. recall: share of lights near one of the first candidates.

    false: false candidates per picture. close: share of lights within 2 px of any candidate.
    """

    recall: float
    false: float
    close: float

    @property
    def worth(self) -> float:
        """Recall, reduced for false candidates: the figure of merit."""
        return self.recall - COST_OF_FALSE * self.false


def run(args: argparse.Namespace) -> int:
    """Propose values; return 0."""
    cv2.setNumThreads(1)
    if args.fit_sigma:
        return sigma.run(args.inputs, _located(args.inputs))
    if args.fit:
        return score.run(args.inputs, (pixels for _, pixels in _readable(_files(args.inputs))), args.note)
    if not args.inputs:
        raise BuddylineError("give pictures, a folder of them or a dive log")
    if args.pictures < 1:
        raise BuddylineError("--pictures: at least 1")
    pictures, by = load_pictures(args.inputs, args.truth, args.pictures)
    lights = sum(len(picture.lights_px) for picture in pictures)
    if lights == 0:
        raise BuddylineError("no lights in these pictures to tune on; give pictures with the lamps on, or --truth")
    masks = still_parts([picture.pixels for picture in pictures], _true_lights(pictures, by))
    if args.method == "paper" and args.environment == "auto":
        raise BuddylineError("--environment: where the paper's method is to start from; it has a set for each water")
    present = dict(values_of(args.method, args.environment))
    folder = new_folder(args.draw)
    proposed, before, after = propose(args.method, args.environment, present, pictures)
    _write(folder, args.method, args.environment, proposed, pictures, masks)
    report = {
        "method": args.method,
        "environment": args.environment,
        "pictures": len(pictures),
        "lights": lights,
        "judged_by": by,
        "present": present | {"recall": before.recall, "false_a_picture": before.false},
        "masks": masks,
        "proposed": proposed | {"recall": after.recall, "false_a_picture": after.false},
        "marked": str(folder),
    }
    if args.json:
        json.dump(report, sys.stdout, indent=1)
        sys.stdout.write("\n")
    else:
        sys.stdout.write(_text(report, proposed, before, after))
    return 0


def _located(dives: Iterable[str]) -> Iterator[sigma.Errors]:
    """Yield the located lights of dives. The truth of NAME.mcap is in it, or in NAME.truth.mcap beside it."""
    for dive in dives:
        beside = Path(dive).with_suffix(".truth.mcap")
        pictures, by = load_pictures([dive], str(beside) if beside.exists() else None, EVERY)
        if by != BY_TRUTH:
            raise BuddylineError(f"{dive}: --fit-sigma needs the true places of the lights, in it or in {beside.name}")
        detectors: dict[float, SourceDetector] = {}
        for picture in pictures:
            focal_px = picture.focal_px or focal_of(picture.pixels.shape[1])
            detector = detectors.setdefault(focal_px, SourceDetector({}, focal_px))
            yield from sigma.located(detector, picture.pixels, focal_px, picture.lights_px, sigma.DIVES)


def _true_lights(pictures: Sequence[Picture], by: str) -> list[Points] | None:
    return [picture.lights_px for picture in pictures] if by == BY_TRUTH else None


def propose(
    method: str, environment: str, present: Values, pictures: Sequence[Picture]
) -> tuple[Values, Judged, Judged]:
    """Try one value after the other on its grid; return the best set, and the quality of the present and the best one.

    A value changes only where that improves the result.
    """
    best = dict(present)
    before = judged = judge(method, environment, best, pictures)
    trials = [(name, value) for name in present for value in GRIDS[name]]
    with Progress("tune", ROUNDS * len(trials)) as progress:
        for round_ in range(ROUNDS):
            improved = False
            for i, (name, value) in enumerate(trials):
                progress.show(round_ * len(trials) + i, f"{name} = {value:g}")
                if value == best[name]:
                    continue
                trial = best | {name: float(value)}
                result = judge(method, environment, trial, pictures)
                if result.worth > judged.worth + 1e-9:
                    best, judged, improved = trial, result, True
            if not improved:
                break
    return best, before, judged


def judge(method: str, environment: str, values: Values, pictures: Sequence[Picture]) -> Judged:
    """Return the quality of a set of values on these pictures."""
    detectors: dict[float | None, Detector] = {}
    found = close = lights = false = 0
    for picture in pictures:
        if picture.focal_px not in detectors:
            detectors[picture.focal_px] = make_detector(method, environment, values, picture.focal_px)
        blobs = [d.blob for d in detectors[picture.focal_px].detect(picture.pixels)]
        at_px = np.array([(blob.u_px, blob.v_px) for blob in blobs]).reshape(-1, 2)
        apart = np.hypot(*(at_px[:, None] - picture.lights_px).transpose(2, 0, 1))
        near = apart < NEAR_WIDTHS * picture.pixels.shape[1]
        close += int((apart <= CLOSE_PX).any(axis=0).sum())
        found += int(near[:FIRST].any(axis=0).sum())
        false += int((~near.any(axis=1)).sum())
        lights += len(picture.lights_px)
    return Judged(found / max(lights, 1), false / max(len(pictures), 1), close / max(lights, 1))


def load_pictures(inputs: Sequence[str], truth: str | None, limit: int) -> tuple[list[Picture], str]:
    """Return the pictures with their lights, and the source of the lights in words."""
    dives = [name for name in inputs if Path(name).suffix == ".mcap"]
    if dives and len(dives) != len(inputs):
        raise BuddylineError("give either pictures or dive logs, not both at once")
    if truth and not dives:
        raise BuddylineError("--truth: is a dive's; pictures have none")
    known = _truths([*dives, *([truth] if truth else [])]) if dives else {}
    if dives:
        pictures = list(_dive_pictures(dives, known, limit))
    else:
        pictures = [Picture(str(file), pixels, NO_LIGHTS) for file, pixels in _readable(spread(_files(inputs), limit))]
    if not pictures:
        raise BuddylineError("no pictures " + ("with truth " if known else "") + f"in {', '.join(inputs)}")
    if known:
        return pictures, BY_TRUTH
    return [_with_likely_lights(picture) for picture in pictures], "likely candidates of the default detector"


def _with_likely_lights(picture: Picture) -> Picture:
    found = make_detector(focal_px=picture.focal_px).detect(picture.pixels)
    likely = [(d.blob.u_px, d.blob.v_px) for d in found if is_likely(d.blob)]
    return replace(picture, lights_px=np.array(likely).reshape(-1, 2))


def _truths(paths: Sequence[str]) -> dict[tuple[str, int], Points]:
    """Return the visible lights (L, 2), px, by node and trigger, from the logs' LightTruth."""
    known = {}
    with Dive(list(paths)) as dive:
        for envelope in dive.messages(LIGHT_TRUTH.name):
            said = envelope.message
            if not isinstance(said, LightTruth):
                continue
            lights = [(light.u_px, light.v_px) for light in said.lights if light.visible]
            known[said.node, said.trigger] = np.array(lights).reshape(-1, 2)
    return known


def _dive_pictures(paths: Sequence[str], known: Mapping[tuple[str, int], Points], limit: int) -> Iterator[Picture]:
    """Yield the pictures of dives; where any light is known, those with known lights."""
    with Dive(list(paths)) as dive:
        infos = dive.infos()
        listed = []
        for envelope in dive.messages(IMAGE.name):
            node, image = envelope.node, envelope.message
            if not isinstance(image, CompressedImage):
                continue
            trigger = trigger_index(image.stamp_ns, infos[node].trigger_period_ns) if node in infos else 0
            if not known or (node, trigger) in known:
                listed.append((node, trigger, image.data))
        for node, trigger, data in spread(listed, limit):
            name = f"{node}_{trigger}"
            try:
                focal_px = infos[node].camera.fx_px if node in infos else None
                yield Picture(name, decode_picture(data, name), known.get((node, trigger), NO_LIGHTS), focal_px)
            except PictureError as error:
                losses.report([str(error)])


def _files(inputs: Sequence[str]) -> list[Path]:
    files: list[Path] = []
    for name in inputs:
        files += picture_files(Path(name))
    return files


def _readable(files: Iterable[Path]) -> Iterator[tuple[Path, NDArray[np.uint8]]]:
    """Yield the pictures that can be read; report the others as losses."""
    for file in files:
        try:
            yield file, read_picture(file)
        except PictureError as error:
            losses.report([str(error)])


def _write(
    folder: Path,
    method: str,
    environment: str,
    values: Values,
    pictures: Sequence[Picture],
    masks: Sequence[Rectangle],
) -> None:
    """Write every picture with the candidates found by the proposed values, and its lights as crosses."""
    for picture in pictures:
        detector = make_detector(method, environment, values, picture.focal_px)
        marked = mark_candidates(
            picture.pixels, detector.detect(picture.pixels), [(u, v) for u, v in picture.lights_px]
        )
        height, width = picture.pixels.shape[:2]
        for (u0, v0), (u1, v1) in masks:
            corners = (round(u0 * width), round(v0 * height)), (round(u1 * width), round(v1 * height))
            cv2.rectangle(marked, *corners, MASK_BGR, 2)
        write_picture(folder, Path(picture.name).stem, marked)


def _text(report: Mapping[str, Any], proposed: Values, before: Judged, after: Judged) -> str:
    lines = [
        f"{report['pictures']} pictures, {report['lights']} lights, judged by {report['judged_by']}",
        f"{'':16s}{'present':>10s}{'proposed':>10s}",
        *(f"{name:16s}{report['present'][name]:10g}{value:10g}" for name, value in proposed.items()),
        f"{'lights found':16s}{before.recall:10.1%}{after.recall:10.1%}",
        f"{'false a picture':16s}{before.false:10.2f}{after.false:10.2f}",
        f"marked pictures: {report['marked']}/",
        "",
        "[detector]",
        f'method = "{report["method"]}"',
        f'environment = "{report["environment"]}"',
        "overrides = { " + ", ".join(f"{name} = {value:.1f}" for name, value in proposed.items()) + " }",
    ]
    if report["masks"]:
        corners = [f"[[{u0:g}, {v0:g}], [{u1:g}, {v1:g}]]" for (u0, v0), (u1, v1) in report["masks"]]
        lines += [f"masks = [{', '.join(corners)}]  # what stays still; look at the marked pictures first"]
    else:
        lines += ["# masks: nothing stays still in these pictures"]
    lines += ["", "These lines belong in the node's configuration (docs/node.md); `detect --mask` tries a mask."]
    return "\n".join(lines) + "\n"
