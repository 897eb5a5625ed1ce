"""The sigma of a located source: a sum of variances, whose sizes are fitted.

The sizes stand in sigma.toml, which `buddyline tune --fit-sigma` writes and which says what they were fitted to.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from buddyline.node.detect.rings import Floats

SIZES: Final = Path(__file__).with_name("sigma.toml")
NAMES: Final = ("model", "halo", "lean", "focal", "growth", "floor_px", "long_px")
"""model: factor on the least squares' own sigma. halo, focal: the powers by which it grows with the light's halo (glow
follows the model less than a core does) and with the focal length (larger pictures show more of what the model leaves
out). lean: by what share it grows for each unit of the glow's lean, which the model has to take off. growth: factor on
what the unknown growth of the glow does. floor_px: of every source. long_px: per unit of elongation above LONG_FROM,
because a long core is partly hidden, or two lights merge in it."""
LONG_FROM: Final = 1.2


class Doubt(NamedTuple):
    """What speaks for an error of N located sources, per axis.

    model_px2: variance of the least squares times the model's misfit. growth_px2: from the unknown growth of the glow.
    halo: radius at 0.3 of the height over that at half of it. lean: length of the glow's lean. focal: focal length over
    FOCAL_PX, of the picture, at least 1. elongation: of the core.
    """

    model_px2: Floats
    growth_px2: Floats
    halo: Floats
    lean: Floats
    focal: Floats | float
    elongation: Floats


def direct_px2(doubt: Doubt, sizes: Mapping[str, float]) -> Floats:
    """Return the variance of the sources, (N,), as far as the model of glow and core tells."""
    leaning = 1.0 + sizes["lean"] * doubt.lean
    scale = sizes["model"] * doubt.halo ** sizes["halo"] * leaning * doubt.focal ** sizes["focal"]
    return np.asarray(scale**2 * doubt.model_px2 + sizes["growth"] ** 2 * doubt.growth_px2)


def long_px2(doubt: Doubt, sizes: Mapping[str, float]) -> Floats:
    """Return the variance that long cores add, (N,)."""
    return np.asarray((sizes["long_px"] * np.maximum(doubt.elongation - LONG_FROM, 0.0)) ** 2)


@cache
def fitted() -> Mapping[str, float]:
    """Return the sizes of sigma.toml, by name."""
    values = tomllib.loads(SIZES.read_text())["sizes"]
    return {name: float(values[name]) for name in NAMES}
