"""`buddyline tune --fit-sigma`: fit the sigma of located lights to their errors in the simulator's pictures.

The pictures are those of the score's fit (scenes.py), as they are, through a Bayer mosaic, or as JPEG; and those of
dives with light truth, if any are given: another renderer's waters. Each light counts alike. Lights count that are
likely, not cut by the border, and where the model of glow and core holds: sigma's other parts are not fitted. Of each
lamp the nearest counts, because a fragment beside a lamp that is found is no error of its place.
"""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from buddyline.node.detect.centre import locate_sources
from buddyline.node.detect.detection import focal_of
from buddyline.node.detect.lights import distinct
from buddyline.node.detect.score import probability
from buddyline.node.detect.sigma import NAMES, Doubt, direct_px2, long_px2
from buddyline.node.detect.source import SourceDetector
from buddyline.tools.evaluation.lights import tolerance_px
from buddyline.tools.progress import Progress
from buddyline.tools.tune.scenes import FitPicture, named_fit, named_held_out, scenes, to_fit_and_held_out
from numpy.typing import NDArray

Floats = NDArray[np.float64]

DIVES: Final = "dives"
LIKELY: Final = 0.3
JPEG_QUALITY: Final = 90
MOST_SCATTERED: Final = 0.02
TAILS: Final = 8.0
"""Degrees of freedom of the errors' distribution, Student's t in two dimensions: a hidden or merged light is no reason
to doubt all others."""
RANGES: Final[Mapping[str, tuple[float, float]]] = {
    "model": (0.1, 2.0),
    "halo": (0.0, 4.0),
    "lean": (0.0, 4.0),
    "focal": (0.0, 1.5),
    "growth": (0.2, 4.0),
    "floor_px": (0.0, 0.1),
    "long_px": (0.0, 4.0),
}
ROUNDS: Final = 40
GOLDEN: Final = 0.381966
CLOSER: Final = 18
"""Steps of each golden-section search: each leaves 0.62 of the range."""
BEYOND: Final = 11.83
"""Squared error over the variance per axis that 99.73 % of the errors do not exceed."""


@dataclass(frozen=True)
class Errors:
    """Located lights of some pictures, N: what their sigma is made of, and their squared errors in px^2 (N,)."""

    source: str
    doubt: Doubt
    square_px2: Floats


def variance_px2(doubt: Doubt, sizes: Mapping[str, float]) -> Floats:
    """Return the variance per axis, (N,)."""
    return np.asarray(direct_px2(doubt, sizes) + sizes["floor_px"] ** 2 + long_px2(doubt, sizes), np.float64)


def fit(errors: Sequence[Errors]) -> dict[str, float]:
    """Return the sizes that make the errors likeliest, each within its range: one after the other, until none moves."""
    doubt, square_px2 = _together(errors)

    def unlikely(name: str, value: float) -> float:
        return unlikelihood(doubt, square_px2, {**sizes, name: value})

    sizes = {name: 0.5 * sum(RANGES[name]) for name in NAMES}
    for _ in range(ROUNDS):
        before = dict(sizes)
        for name, (low, high) in RANGES.items():
            sizes[name] = _least(partial(unlikely, name), low, high)
        if max(abs(sizes[name] - before[name]) / (RANGES[name][1] - RANGES[name][0]) for name in NAMES) < 1e-3:
            break
    return sizes


def unlikelihood(doubt: Doubt, square_px2: Floats, sizes: Mapping[str, float]) -> float:
    """Return the mean negative logarithm of the errors' likelihood, without its constant."""
    spread = np.maximum(variance_px2(doubt, sizes), 1e-12) * (TAILS - 2.0) / TAILS
    return float(np.mean(np.log(spread) + 0.5 * (TAILS + 2.0) * np.log1p(square_px2 / (TAILS * spread))))


def _least(of: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function of one number is least, by golden section."""
    left, right = low + GOLDEN * (high - low), high - GOLDEN * (high - low)
    at_left, at_right = of(left), of(right)
    for _ in range(CLOSER):
        if at_left < at_right:
            high, right, at_right = right, left, at_left
            left = low + GOLDEN * (high - low)
            at_left = of(left)
        else:
            low, left, at_left = left, right, at_right
            right = high - GOLDEN * (high - low)
            at_right = of(right)
    return 0.5 * (low + high)


def simulated(seeds: Iterable[int], progress: Progress, done: int = 0) -> Iterator[Errors]:
    """Yield the located lights of rendered pictures."""
    for seed, views in scenes(seeds, progress, done):
        rng = np.random.default_rng(seed)
        for view in views:
            yield from _located(view, rng)


def _located(view: FitPicture, rng: np.random.Generator) -> Iterator[Errors]:
    lamps_px = np.array([lamp[:2] for lamp in view.world.lamps(view.node, view.stamp_ns) if lamp[2]]).reshape(-1, 2)
    picture = _taken(view.picture, rng)
    yield from located(view.detector, picture, focal_of(picture.shape[1]), lamps_px, view.world.scenario.environment)


def located(
    detector: SourceDetector, picture: NDArray[np.uint8], focal_px: float, lamps_px: Floats, source: str
) -> Iterator[Errors]:
    """Yield what a picture's located lights say, at most once. lamps_px: (L, 2), where lamps are."""
    seen = detector.examine(picture)
    if seen is None or not len(lamps_px):
        return
    # Of several places on one light the detector keeps the first.
    apart = np.array(distinct(seen.lights.centre_px, seen.lights.core_px, len(seen.lights.peak)))
    lights = seen.lights.at(apart)
    counts = (probability(seen.features[apart]) >= LIKELY) & ~lights.border_px.any(axis=1)
    lights = lights.at(np.flatnonzero(counts & (lights.scattered < MOST_SCATTERED)))
    if not len(lights.peak):
        return
    found = locate_sources(picture, lights, focal_px)
    of_each_px = np.linalg.norm(found.centre_px[:, None] - lamps_px, axis=-1)
    away_px, lamp = of_each_px.min(axis=1), of_each_px.argmin(axis=1)
    nearest = of_each_px.argmin(axis=0)[lamp] == np.arange(len(lamp))
    kept = nearest & found.holds & (away_px <= tolerance_px(picture.shape[1]))
    own = found.doubt._replace(focal=np.full(len(away_px), found.doubt.focal))
    doubt = Doubt._make(np.asarray(values)[kept] for values in own)
    yield Errors(source, doubt, away_px[kept].astype(np.float64) ** 2)


def _taken(picture: NDArray[np.uint8], rng: np.random.Generator) -> NDArray[np.uint8]:
    """Return half of the colour pictures as they are, a quarter through a mosaic, a quarter through JPEG."""
    how = rng.integers(4)
    if picture.ndim == 2 or how < 2:
        return picture
    if how == 2:
        mosaic = picture[:, :, 1].copy()
        mosaic[::2, ::2], mosaic[1::2, 1::2] = picture[::2, ::2, 0], picture[1::2, 1::2, 2]
        return np.asarray(cv2.cvtColor(mosaic, cv2.COLOR_BayerRG2BGR), np.uint8)
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8)


def run(dives: Sequence[str], known: Iterable[Errors]) -> int:
    """Fit sigma to simulated pictures, and to lights of dives; write its sizes to stdout as TOML; return 0.

    dives: their names. known: of their pictures.
    """
    others = list(known)
    errors, held_out = to_fit_and_held_out(simulated)
    errors += others
    sys.stdout.write(described(fit(errors), errors, held_out, dives))
    return 0


def described(
    sizes: Mapping[str, float], errors: Sequence[Errors], held_out: Sequence[Errors], dives: Sequence[str]
) -> str:
    """Return the sizes as TOML, with their provenance and how true they are on other pictures."""
    count = Counter[str]()
    for one in errors:
        count[one.source] += len(one.square_px2)
    by_water = {name: [one for one in held_out if one.source == name] for name in sorted(count)}
    truth = {name: truth_of(found, sizes) for name, found in by_water.items() if found}
    lines = [
        "# Written by `buddyline tune --fit-sigma`. sigma.py says what the sizes are.",
        "",
        "[provenance]",
        f'simulator = "{named_fit()}"',
        f"dives = {json.dumps([Path(dive).stem for dive in dives])}",
        "",
        "[provenance.lights]",
        *(f"{name} = {number}" for name, number in sorted(count.items())),
        "",
        f"# On {named_held_out()}:",
        "# mean squared error over the variance per axis, and the share of errors beyond 3 sigma.",
        "[nees]",
        *(f"{name} = {nees:.2f}" for name, (nees, _) in truth.items()),
        "",
        "[beyond]",
        *(f"{name} = {beyond:.3f}" for name, (_, beyond) in truth.items()),
        "",
        "[sizes]",
        *(f"{name} = {sizes[name]:.4f}" for name in NAMES),
    ]
    return "\n".join(lines) + "\n"


def truth_of(errors: Sequence[Errors], sizes: Mapping[str, float]) -> tuple[float, float]:
    """Return the mean squared error over the variance per axis, and the share of errors beyond 3 sigma."""
    doubt, square_px2 = _together(errors)
    square = square_px2 / variance_px2(doubt, sizes)
    return float(square.mean()) / 2.0, float((square > BEYOND).mean())


def _together(errors: Sequence[Errors]) -> tuple[Doubt, Floats]:
    doubt = Doubt._make(np.concatenate([np.asarray(one.doubt[k]) for one in errors]) for k in range(len(Doubt._fields)))
    return doubt, np.concatenate([one.square_px2 for one in errors])
