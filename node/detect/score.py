"""The probability that a place is a lamp, from what was measured of it: a logistic model with a few physical features.

The weights stand in score.toml, which `buddyline tune --fit` writes and which says what they were fitted to.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from buddyline.node.detect.detection import FOCAL_PX
from buddyline.node.detect.lights import Lights
from buddyline.node.detect.rings import Floats
from numpy.typing import NDArray

WEIGHTS: Final = Path(__file__).with_name("score.toml")
LIMITS: Final[Mapping[str, tuple[float, float]]] = {
    "stands_out": (-1.0, 3.5),
    "texture": (-1.2, 2.0),
    "height": (-3.0, 1.7),
    "size": (-0.5, 4.0),
    "largest": (-0.5, 4.0),
    "plateau": (-1.2, 0.0),
    "halo": (0.0, 1.2),
    "out_of_round": (0.0, 1.0),
    "unclipped": (0.0, 0.3),
}
"""The features, with the limits to which they are clipped: nothing is extrapolated beyond what the fit has seen.

For the logarithm of the odds of a lamp:
stands_out: log of the contrast over noise plus clutter. texture: log of the same of the picture's fifth to sixteenth
lights, which are no lamps as a rule: shells and caustics come in fields, and an exposure for lamps shows nothing else.
height: log of the peak above the ground over 50 levels. out_of_round: least elongation of the outlines from half height
upward, minus 1; lower down, a bar that a lamp lights may hang on to it. size: log of the radius at half height in px at
FOCAL_PX. largest: the size of the picture's largest light: small lights are particles beside a lamp's large glow, and
lamps where the exposure is so short that nothing glows. plateau: log of the radius at 0.9 of the height over that at
0.5; 0 for a flat top with sharp edges. halo: log of the radius at 0.3 over that at 0.5; 0 for a sharp edge.
unclipped: how far the peak is below 240, in 100 levels.
"""
PRODUCTS: Final = (
    ("size", "size"),
    ("size", "halo"),
    ("size", "unclipped"),
    ("plateau", "halo"),
)
"""Features that count together: a small lamp may be sharp and unclipped, a large one has a halo and clips; a flat top
has sharp edges, or is a clipped core with a halo."""
NAMES: Final = ("constant", *LIMITS, *(f"{a}_{b}" for a, b in PRODUCTS))

_LOWEST: Final = np.array([low for low, _ in LIMITS.values()], np.float32)
_HIGHEST: Final = np.array([high for _, high in LIMITS.values()], np.float32)
_FIRST: Final = np.array([list(LIMITS).index(a) for a, _ in PRODUCTS])
_SECOND: Final = np.array([list(LIMITS).index(b) for _, b in PRODUCTS])


def texture(outstanding: NDArray[np.float32]) -> float:
    """Return how much a picture's fifth to sixteenth most outstanding lights stand out.

    outstanding: (N,), falling, one place of each light.
    """
    return (float(outstanding[4:16].sum()) + 0.3 * min(max(16 - len(outstanding), 0), 12)) / 12.0


def features(lights: Lights, focal_px: float, textured: float) -> Floats:
    """Return the features of N lights, (N, len(NAMES)). textured: of the picture, see texture."""
    found = np.empty((len(lights.peak), len(NAMES)), np.float32)
    r90, _, r50, r30 = np.maximum(lights.radii_px.T, 0.3)
    alone = found[:, 1 : 1 + len(LIMITS)]
    alone[:, 0] = np.maximum(lights.outstanding, 0.1)
    alone[:, 1] = textured
    alone[:, 2] = np.maximum(lights.height, 1.0) / 50.0
    alone[:, 3] = r50 * (FOCAL_PX / focal_px)
    alone[:, 4] = alone[:, 3].max()
    alone[:, 5] = r90 / r50
    alone[:, 6] = r30 / r50
    np.log(alone[:, :7], out=alone[:, :7])
    alone[:, 7] = lights.roundest - 1.0
    alone[:, 8] = (240.0 - lights.peak) / 100.0
    np.minimum(np.maximum(alone, _LOWEST, out=alone), _HIGHEST, out=alone)
    found[:, 0] = 1.0
    found[:, 1 + len(LIMITS) :] = alone[:, _FIRST] * alone[:, _SECOND]
    return found


def probability(found: Floats, weights: Floats | None = None) -> Floats:
    """Return each light's probability of being a lamp, (N,). found: (N, len(NAMES)); weights: those of score.toml."""
    logit = found @ (fitted() if weights is None else weights)
    return np.asarray(1.0 / (1.0 + np.exp(-np.minimum(np.maximum(logit, -20.0), 20.0))), np.float32)


@cache
def fitted() -> Floats:
    """Return the weights of score.toml, (len(NAMES),)."""
    values = tomllib.loads(WEIGHTS.read_text())["weights"]
    return np.array([values[name] for name in NAMES], np.float32)
