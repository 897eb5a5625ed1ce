"""Where the source of a light is, although its core is clipped and its glow leans along the beam.

Scattered light along the beam adds a dipole to a light's rings of equal brightness, so that the centre of what is
clipped is not the source. Outside the clipped core, the logarithm of the brightness around a point near the source is

    Y(rho, phi) = Y0(rho) - Y0'(rho) s.n(phi) + w(rho) k.n(phi)

s: from the point to the source, n: the ray's direction, k: the lean of the glow. w is the glow's share in the light:
it grows outward, the faster the steeper the profile falls (the core's own light falls steeply, and does not lean):
d ln w / d ln rho = growth + steepness * p, p = -d Y0 / d ln rho. s and k follow by weighted least squares over all
unclipped samples, with a prior that keeps s inside the core. This is the extrapolation of the centres of iso-intensity
regions to radius 0, with every pixel used and the core's profile accounted for; how far it carries depends on the
growth, whose own uncertainty goes into sigma.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from node.detect.lights import Lights
from node.detect.rings import (
    RAY_HARMONICS,
    RAYS,
    Floats,
    geometric_radii,
    luminance,
    sample_rings,
    weakest_channel,
)

_RINGS = 16
_CLIPPED = 249.0
_WIDTH_OF_MODEL_PX = 820
_ROBUST_SD = 3.0

# Sigma: what the errors on pictures rendered in many waters (this project's simulator, and dives kept for tuning)
# were, by what they follow from; a little more than they were on average, as other waters will be different.
_FLOOR_PX: Final = 0.045
# Of the core's radius: the rim of what is clipped is no perfect circle.
_RIM_SHARE: Final = 0.008
_NOISE_SCALE: Final = 0.155
_GROWTH_SCALE: Final = 0.45
# Of the way from the region's centre to the source; where nothing is clipped, the way itself is in doubt.
_MOVED_SHARE, _MOVED_SHARE_UNCLIPPED = 0.28, 0.7
# Of the core's radius, times by how much it is longer than wide: something stands before it, or another light beside.
_ELONGATED_SHARE: Final = 0.15
_SCATTERED_PX: Final = 2.0

MODEL: Mapping[str, float] = {
    "growth": 0.7,
    "growth_veil": 0.55,
    "growth_size": 0.45,
    "growth_sd": 0.35,
    "steepness": 0.75,
    "inner": 0.6,
    "outer": 2.2,
    "outer_min_px": 11.0,
    "noise": 2.0,
    "model_noise": 0.12,
    "core_share": 0.3,
    "inflation": 8.0,
    "lean_sd": 3.0,
    "steep_max": 6.0,
}


@dataclass(frozen=True, slots=True)
class Centres:
    """Sources of N lights: centre_px (N, 2), covariance_px2 (N, 2, 2), lean (N, 2): the glow's, towards the beam."""

    centre_px: Floats
    covariance_px2: Floats
    lean: Floats


def locate_sources(image: NDArray[np.uint8], lights: Lights, model: Mapping[str, float] = MODEL) -> Centres:
    """Locate the sources of N lights in a BGR (H, W, 3) or grey (H, W) picture."""
    start_px, radius_px, ground, weakest = lights.centre_px, lights.core_px, lights.ground, lights.weakest
    prior_sd = model["core_share"] * radius_px + 0.5
    radius = geometric_radii(
        np.maximum(model["inner"] * radius_px, 0.7),
        np.maximum(model["outer"] * radius_px, model["outer_min_px"]),
        _RINGS,
    )
    log_step = np.log(radius[:, -1] / radius[:, 0]) / (_RINGS - 1)
    growth = _growth(radius_px * (_WIDTH_OF_MODEL_PX / image.shape[1]), ground, model)
    prior = np.zeros((len(radius), 4, 4))
    prior[:, (0, 1), (0, 1)] = 1.0 / prior_sd[:, None] ** 2
    prior[:, (2, 3), (2, 3)] = 1.0 / model["lean_sd"] ** 2
    guess = lights.guess_px
    equations = _Equations(image, guess, radius, log_step, ground, weakest, growth, model)
    x, covariance = equations.solve(prior, start_px - guess)
    found = guess + x[:, :2]
    # Where the model does not hold, the centre of the region stands with the prior's uncertainty.
    moved = found - start_px
    holds = equations.solvable & (np.hypot(moved[:, 0], moved[:, 1]) <= radius_px + 3.0)
    moved *= (holds * (1.0 - lights.scattered))[:, None]
    own_px2 = (_ELONGATED_SHARE * radius_px * (lights.core_elongation - 1.0)) ** 2 + np.where(
        holds, _FLOOR_PX**2 + (_RIM_SHARE * radius_px) ** 2 + (_SCATTERED_PX * lights.scattered) ** 2, prior_sd**2
    )
    covariance = covariance * holds[:, None, None] + own_px2[:, None, None] * np.eye(2)
    share = _MOVED_SHARE + (_MOVED_SHARE_UNCLIPPED - _MOVED_SHARE) * lights.unclipped
    moved_px = share[:, None] * moved
    covariance += moved_px[:, :, None] * moved_px[:, None, :]
    return Centres(start_px + moved, covariance, x[:, 2:] * holds[:, None])


def _growth(radius_px: Floats, ground: Floats, model: Mapping[str, float]) -> Floats:
    """Give d ln w / d ln rho of a plain glow, (N,): less in veiled water, and less for larger discs.

    radius_px: at a picture 820 px wide. A veil (bright ground in the weakest channel) tells turbid water, where
    light scattered far from the beam hides the core's own, and large discs are mostly glow already.
    """
    veil = np.minimum(ground / 40.0, 1.0)
    growth = (
        model["growth"] - model["growth_veil"] * veil - model["growth_size"] * np.log(np.maximum(radius_px, 3.0) / 12.0)
    )
    return np.asarray(growth, np.float32)


def _one_channel(pixels: Floats, weakest: NDArray[np.bool_]) -> Floats:
    """Give (N, M, K) levels from (N, M, K, C): the weakest channel where asked for, else the luminance."""
    level = luminance(pixels)
    if pixels.shape[3] > 1 and weakest.any():
        level[weakest] = weakest_channel(pixels[weakest])
    return level


class _Equations:
    """The linear equations of N lights, from levels on rings around their present centres."""

    def __init__(
        self,
        image: NDArray[np.uint8],
        centre_px: Floats,
        radius: Floats,
        log_step: Floats,
        ground: Floats,
        weakest: NDArray[np.bool_],
        growth: Floats,
        model: Mapping[str, float],
    ) -> None:
        self._model = model
        rings = sample_rings(image, centre_px, radius)
        level = _one_channel(rings.pixels, weakest)
        above = level - ground[:, None, None]
        usable = (level < _CLIPPED) & (above > 3.0 * model["noise"])
        if rings.inside is not None:
            usable &= rings.inside
        np.maximum(above, 1.0, out=above)
        self._y = np.log(above)
        np.divide(model["noise"], above, out=above)
        # Sums over rays as products with ones: many times faster than sums along the last axis.
        ones = RAY_HARMONICS[:, 0]
        used = usable.astype(np.float32)
        self._weight = used / (above * above + model["model_noise"] ** 2)
        paired = used[:, 2:] * used[:, :-2]
        count = paired @ ones
        difference = ((self._y[:, 2:] - self._y[:, :-2]) * paired) @ ones
        seen = np.zeros(radius.shape, bool)
        seen[:, 1:-1] = (count >= 0.4 * RAYS) & (used[:, 1:-1] @ ones >= 0.5 * RAYS)
        falling = np.zeros(radius.shape, np.float32)
        falling[:, 1:-1] = difference / np.maximum(count, 1) / (-2.0 * log_step[:, None])
        falling[~seen] = 0.0
        self._weight *= seen[:, :, None]
        self._seen = seen
        self._shift = falling / radius
        self._log_step = log_step
        plain = np.where(seen, np.clip(falling, 0.0, model["steep_max"]), 1.0)
        self._growth = growth[:, None] + model["steepness"] * plain
        self.solvable = seen.sum(axis=1) >= 4

    def solve(self, prior: Floats, prior_px: Floats) -> tuple[Floats, Floats]:
        """Solve for the step to the source and the lean, (N, 4), and the step's covariance (N, 2, 2).

        prior: (N, 4, 4) information on both, about prior_px (N, 2) for the step and none for the lean. What the model
        does not explain, something in front or another light, has less weight the second time. The covariance
        contains the growth's own uncertainty.
        """
        sd = self._model["growth_sd"]
        share = self._glow_share(np.array([0.0, -sd, sd], np.float32))
        x, _ = self._least_squares(share[:1], prior, prior_px)
        mean = (self._weight * self._y) @ RAY_HARMONICS[:, 0]
        mean /= np.maximum(self._weight @ RAY_HARMONICS[:, 0], 1e-6)
        expected = np.empty((*mean.shape, 3), np.float32)
        expected[..., 0] = mean
        expected[..., 1:] = self._shift[..., None] * x[0, :, None, :2] + share[0][..., None] * x[0, :, None, 2:]
        residual = self._y - expected @ _FIRST_HARMONICS
        self._weight /= 1.0 + self._weight * residual**2 * (1.0 / _ROBUST_SD**2)
        x, covariance = self._least_squares(share, prior, prior_px)
        apart = _GROWTH_SCALE * 0.5 * (x[2, :, :2] - x[1, :, :2])
        return x[0], _NOISE_SCALE**2 * covariance[0] + apart[:, :, None] * apart[:, None, :]

    def _glow_share(self, more_growth: Floats) -> Floats:
        """Integrate d ln w / d ln rho along the rings, for S growths; w is 1 at the outermost ring seen, (S, N, M)."""
        growth = np.maximum(self._growth + more_growth[:, None, None], -0.3)
        log_share = np.zeros_like(growth)
        steps = (growth[..., 1:] + growth[..., :-1]) * (0.5 * self._log_step[:, None])
        np.cumsum(steps, axis=-1, out=log_share[..., 1:])
        last = np.where(self._seen, log_share, -1e9).max(axis=-1, keepdims=True)
        return np.asarray(np.exp(np.minimum(log_share - last, 0.0)), np.float32)

    def _least_squares(self, share: Floats, prior: Floats, prior_px: Floats) -> tuple[Floats, Floats]:
        """Solve for (s, k), (S, N, 4), for S shares, each ring's mean eliminated; and the covariances of s."""
        sums = self._weight @ RAY_HARMONICS
        first = (self._weight * self._y) @ RAY_HARMONICS[:, :3]
        means = sums[..., 1:3] / np.maximum(sums[..., :1], 1e-6)
        spread = sums[..., 3:]
        spread[..., :2] -= sums[..., 1:2] * means
        spread[..., 2] -= sums[..., 2] * means[..., 1]
        level = first[..., 1:] - first[..., :1] * means
        basis = np.empty((*share.shape[:2], 2, share.shape[2]), np.float32)
        basis[:, :, 0] = self._shift
        basis[:, :, 1] = share
        products = np.empty((*share.shape[:2], 3, share.shape[2]), np.float32)
        products[:, :, :2] = basis * self._shift[:, None]
        products[:, :, 2] = share * share
        # Neighbouring samples are correlated: the information is less than their number says.
        less = 1.0 / self._model["inflation"]
        g = (basis @ level).reshape(*share.shape[:2], 4) * less
        g[..., :2] += prior[:, :2, 0].sum(axis=1)[:, None] * prior_px
        a = (products @ spread).reshape(*share.shape[:2], 9)[..., _BLOCKS] * less + prior
        covariance = np.linalg.inv(a)
        x = (covariance @ g[..., None])[..., 0]
        return x.astype(np.float32), covariance[..., :2, :2]


_FIRST_HARMONICS = np.ascontiguousarray(RAY_HARMONICS[:, :3].T)
_BLOCKS = np.array([[0, 1, 3, 4], [1, 2, 4, 5], [3, 4, 6, 7], [4, 5, 7, 8]])
"""Where the 4x4 normal matrix of (s_u, s_v, k_u, k_v) finds its entries in (ss, sw, ww) x (cc, cs, ss)."""
