"""`buddyline tune --fit`: fit the detector's score to the simulator's pictures, and to pictures without any lamp.

The simulator knows where every lamp is in its pictures (scenes.py). Real pictures without lamps are added.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from buddyline.node.detect.score import NAMES, probability
from buddyline.node.detect.source import SourceDetector
from buddyline.tools.evaluation.lights import tolerance_px
from buddyline.tools.progress import Progress
from buddyline.tools.tune.scenes import FitPicture, named_fit, named_held_out, scenes, to_fit_and_held_out
from numpy.typing import NDArray

Floats = NDArray[np.float64]

BESIDE_RADII: Final = 1.5
"""A candidate farther off, but within this many of its core's radii, counts neither as a lamp nor as none."""
MAGNIFIED: Final = (1, 3, 5)
"""Real pictures without lamps count once at each of these sizes: small ones hold few candidates."""
REAL: Final = "real"
RIDGE: Final = 3.0
STEPS: Final = 60
BINS: Final = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 1.0)


@dataclass(frozen=True)
class Sample:
    """Candidates of one picture: their features (N, F), and whether each is a lamp (N,). source: water, or REAL."""

    source: str
    found: Floats
    lamp: NDArray[np.bool_]


def fit(samples: Sequence[Sample]) -> Floats:
    """Return the weights (F,) of the logistic model: maximum likelihood with a small penalty, by Newton's method."""
    found = np.concatenate([sample.found for sample in samples])
    lamp = np.concatenate([sample.lamp for sample in samples]).astype(float)
    weights = np.zeros(found.shape[1])
    for _ in range(STEPS):
        likely = probability(found, weights).astype(float)
        curvature = (found * (likely * (1.0 - likely) + 1e-9)[:, None]).T @ found + RIDGE * np.eye(len(weights))
        step = np.linalg.solve(curvature, found.T @ (lamp - likely) - RIDGE * weights)
        weights += step
        if np.abs(step).max() < 1e-6:
            break
    return weights


def calibration_error(samples: Sequence[Sample], weights: Floats) -> float:
    """Return how far the scores are from the share of lamps, see score_error."""
    likely = np.concatenate([probability(sample.found, weights) for sample in samples]).astype(float)
    return score_error(likely, np.concatenate([sample.lamp for sample in samples]))


def score_error(likely: Floats, lamp: NDArray[np.bool_]) -> float:
    """Return the mean distance between score and share of lamps over bins of the score, weighted by their numbers.

    likely: (N,), scores of candidates. lamp: (N,), whether each is a lamp.
    """
    which = np.digitize(likely, BINS[1:-1])
    apart = [abs(float((likely[which == k] - lamp[which == k]).sum())) for k in range(len(BINS) - 1)]
    return sum(apart) / len(likely)


def simulated(seeds: Iterable[int], progress: Progress, done: int = 0) -> Iterator[Sample]:
    """Yield the candidates of rendered pictures, with what they are."""
    for _, views in scenes(seeds, progress, done):
        for view in views:
            yield from _labelled(view)


def _labelled(view: FitPicture) -> Iterator[Sample]:
    """Yield a picture's candidates, without those beside a lamp and those of a lamp that is hidden."""
    detector, picture, world, node, stamp_ns = view
    seen = detector.examine(picture)
    if seen is None:
        return
    lamps = world.lamps(node, stamp_ns)
    at_px = np.array([lamp[:2] for lamp in lamps]).reshape(-1, 2)
    visible = np.array([lamp[2] for lamp in lamps], bool)
    away_px = np.linalg.norm(seen.lights.centre_px[:, None] - at_px, axis=-1)
    reach_px = tolerance_px(picture.shape[1])
    lamp = (away_px[:, visible] <= reach_px).any(axis=1)
    beside = (away_px <= BESIDE_RADII * np.maximum(seen.lights.core_px, reach_px)[:, None]).any(axis=1)
    kept = lamp | ~beside
    yield Sample(world.scenario.environment, seen.features[kept].astype(float), lamp[kept])


def without_lamps(pictures: Iterable[NDArray[np.uint8]]) -> Iterator[Sample]:
    """Yield the candidates of real pictures that show no lamp."""
    for picture in pictures:
        for times in MAGNIFIED:
            seen = SourceDetector({}, None).examine(
                np.asarray(cv2.resize(picture, None, fx=times, fy=times, interpolation=cv2.INTER_CUBIC), np.uint8)
                if times > 1
                else picture
            )
            if seen is not None:
                yield Sample(REAL, seen.features.astype(float), np.zeros(len(seen.features), bool))


def run(folders: Sequence[str], pictures: Iterable[NDArray[np.uint8]], note: str) -> int:
    """Fit the score to simulated pictures and to real ones without lamps; write it to stdout as TOML; return 0."""
    real = list(without_lamps(pictures))
    rendered, held_out = to_fit_and_held_out(simulated)
    samples = [*rendered, *real]
    sys.stdout.write(described(fit(samples), samples, held_out, folders, note))
    return 0


def described(
    weights: Floats, samples: Sequence[Sample], held_out: Sequence[Sample], folders: Sequence[str], note: str
) -> str:
    """Return the weights as TOML, with their provenance and how well they are calibrated.

    folders: of the real pictures. note: what these are.
    """
    count = Counter(sample.source for sample in samples)
    lines = [
        "# Written by `buddyline tune --fit`. score.py says what the features are.",
        "",
        "[provenance]",
        f'simulator = "{named_fit()}"',
        f"real_pictures_without_lamps = {json.dumps(list(folders))}",
        f"note = {json.dumps(note)}",
        f"candidates = {sum(len(sample.lamp) for sample in samples)}",
        f"lamps = {sum(int(sample.lamp.sum()) for sample in samples)}",
        "",
        "[provenance.pictures]",
        *(f"{name} = {number}" for name, number in sorted(count.items())),
        "",
        f"# Mean distance of score and share of lamps, on {named_held_out()}.",
        "[calibration_error]",
        *(
            f"{name} = {calibration_error([one for one in held_out if one.source == name], weights):.3f}"
            for name in sorted({one.source for one in held_out})
        ),
        "",
        "[weights]",
        *(f"{name} = {weight:.4f}" for name, weight in zip(NAMES, weights, strict=True)),
    ]
    return "\n".join(lines) + "\n"
