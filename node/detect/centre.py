"""Locate the source of a light whose core is clipped and whose glow leans along the beam.

Light that the water scatters along the beam makes the glow asymmetric. The centre of the clipped core is therefore
not the source. Outside the clipped core, the logarithm of the brightness around a point near the source is modelled as

    Y(rho, phi) = Y0(rho) - Y0'(rho) s.n(phi) + w(rho) k.n(phi)

rho, phi: polar coordinates around the point. s: vector from the point to the source. n: direction of the ray at phi.
k: the lean, the direction and size of the glow's asymmetry. w: the glow's share of the light. The core's own light
falls steeply outward and does not lean, so w grows outward, and it grows faster where the profile is steeper:
d ln w / d ln rho = growth + steepness * p, with p = -d Y0 / d ln rho. Weighted least squares over all unclipped
samples gives s and k; a prior keeps s inside the core.

In effect this extrapolates the centres of iso-intensity regions to radius 0. It uses every pixel and accounts for the
core's profile. The result depends on `growth`; the uncertainty of `growth` is part of the sigma.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.node.detect.detection import CLIPPED, FOCAL_PX
from buddyline.node.detect.lights import HALF, VEIL, Lights
from buddyline.node.detect.rings import RAY_UV, RAYS, Floats, geometric_radii, luminance, sample_rings, weakest_channel
from buddyline.node.detect.sigma import Doubt, direct_px2, fitted, long_px2
from numpy.typing import NDArray

_RINGS = 16
_SHARES = np.linspace(0.0, 1.0, _RINGS, dtype=np.float32)
_ROBUST_SD = 3.0

# The model. The growth d ln w / d ln rho of a flat profile, for a core of 12 px in clear water; how much less it is in
# veiled water, and for a core e times as large; its 1 sd. Then the `steepness` of the module's docstring. All five are
# fitted to the errors in pictures of two renderers, half and half: this project's simulator and the dives kept for
# tuning. A water's own growth cannot be seen in its pictures, so the errors of large cores in one water are alike.
_GROWTH, _GROWTH_VEIL, _GROWTH_SIZE, _GROWTH_SD = 0.3, 0.4, 0.6, 0.39
_STEEPNESS: Final = 1.05
# The rings, in radii of the core. The outermost is at least so many px from the centre.
_INNER, _OUTER, _OUTER_MIN_PX = 0.6, 2.2, 11.0
# Noise of a sample in grey levels, and of the model in the logarithm of the brightness, 1 sd.
_NOISE, _MODEL_NOISE = 2.0, 0.12
# Neighbouring samples are correlated: they hold less information than as many independent samples, by this factor.
_INFLATION: Final = 8.0
# The prior, 1 sd: the distance from the core's centre to the source, as a share of its radius (and half a pixel); the
# lean.
_CORE_SHARE, _LEAN_SD = 0.3, 3.0

# The sizes of sigma's other terms are in sigma.toml.
# Radii are at least this: what shows on no ray has the radius 0.
_LEAST_PX: Final = 0.3
# For a light that shows only its scattered glow: share of the glow's radius, fitted as the growth is.
_SCATTERED_SHARE: Final = 0.27
# The middle of an outline that the border cuts is at least this share of its depth inside of the border, or the light
# may be outside of the picture: then it may be anywhere within about this share of the depth.
_OUTSIDE_FROM, _OUTSIDE_SHARE = 0.3, 0.5


@dataclass(slots=True, eq=False)
class Centres:
    """Sources of N lights: centre_px (N, 2), sigma_px (N,) per axis, lean (N, 2) of the glow, towards the beam.

    doubt: what sigma is made of, where the model of glow and core holds (N,).
    """

    centre_px: Floats
    sigma_px: Floats
    lean: Floats
    doubt: Doubt
    holds: NDArray[np.bool_]


def locate_sources(image: NDArray[np.uint8], lights: Lights, focal_px: float) -> Centres:
    """Locate the sources of N lights in a BGR (H, W, 3) or grey (H, W) picture of focal length focal_px."""
    start_px, radius_px, guess_px = lights.centre_px, lights.core_px, lights.guess_px
    prior_px2 = (_CORE_SHARE * radius_px + 0.5) ** 2
    growth = _growth(radius_px * (FOCAL_PX / focal_px), lights.ground)
    equations = _Equations(image, lights, growth)
    glow_px = np.maximum(lights.radii_px[:, HALF], _LEAST_PX)
    halo = np.maximum(lights.radii_px[:, HALF + 1], _LEAST_PX) / glow_px
    step_px, lean, model_px2, growth_px2 = equations.solve(prior_px2, start_px - guess_px)
    leaning = np.hypot(lean[:, 0], lean[:, 1])
    # Larger pictures show more of what the model leaves out; smaller ones, to which nothing is fitted, no less.
    doubt = Doubt(model_px2, growth_px2, halo, leaning, max(focal_px / FOCAL_PX, 1.0), lights.core_elongation)
    sizes = fitted()
    # Where the model does not hold, the result is the region's centre with the prior's uncertainty.
    moved = guess_px + step_px - start_px
    square = moved * moved
    moved_px2 = square[:, 0] + square[:, 1]
    holds = equations.solvable & (moved_px2 <= (radius_px + 3.0) ** 2)
    direct = 1.0 - lights.scattered
    scattered_px2 = lights.scattered * (_SCATTERED_SHARE * glow_px) ** 2
    variance_px2 = np.where(holds, direct * direct_px2(doubt, sizes) + scattered_px2, prior_px2)
    variance_px2 += sizes["floor_px"] ** 2 + long_px2(doubt, sizes)
    centre_px = start_px + (holds * direct)[:, None] * moved
    if lights.border_px.any():
        variance_px2 += _outside_px(_to_border(centre_px, image), *lights.border_px.T) ** 2
    return Centres(centre_px, np.sqrt(variance_px2), lean * holds[:, None], doubt, holds)


def _to_border(centre_px: Floats, image: NDArray[np.uint8]) -> Floats:
    """Return the distance of places (N, 2) from the picture's nearest border, (N,), px; 0 outside."""
    far_px = np.array(image.shape[1::-1], np.float32) - np.float32(0.5)
    return np.asarray(np.maximum(np.minimum(centre_px + np.float32(0.5), far_px - centre_px).min(axis=1), 0.0))


def _outside_px(inside_px: Floats, middle_px: Floats, depth_px: Floats) -> Floats:
    """Return how far sources (N,) may be from where they were found, because they may be outside of the picture, px.

    inside_px: (N,), from the border to where they were found. middle_px, depth_px: (N,), see Lights.border_px.
    """
    doubt = np.minimum(np.maximum(1.0 - middle_px / np.maximum(_OUTSIDE_FROM * depth_px, 1e-6), 0.0), 1.0)
    away_px = np.maximum(inside_px - middle_px, 0.0)
    return np.where(doubt * depth_px > 0.0, np.hypot(_OUTSIDE_SHARE * doubt * depth_px, away_px), 0.0)


def _growth(radius_px: Floats, ground: Floats) -> Floats:
    """Return the growth d ln w / d ln rho of a flat profile, (N,): smaller in veiled water and for large discs.

    radius_px: (N,), scaled to the focal length FOCAL_PX. ground: (N,), grey levels. A veil (bright ground in the
    weakest channel) shows turbid water: light scattered far from the beam hides the core. Large discs are mostly glow.
    """
    veil = np.minimum(ground / VEIL, 1.0)
    growth = _GROWTH - _GROWTH_VEIL * veil - _GROWTH_SIZE * np.log(np.maximum(radius_px, 3.0) / 12.0)
    return np.asarray(growth, np.float32)


def _one_channel(pixels: NDArray[np.uint8], weakest: NDArray[np.bool_]) -> Floats:
    """Return (N, M, K) levels: the weakest channel for the lights in `weakest` (N,), the luminance for the others."""
    level = luminance(pixels)
    if pixels.ndim > 3 and weakest.any():
        level[weakest] = weakest_channel(pixels[weakest])
    return level


class _Equations:
    """The linear equations of N lights, from grey levels on rings around the first guesses of their sources.

    M: number of rings without the innermost and the outermost. These two serve only for the slope of the profile.
    """

    def __init__(self, image: NDArray[np.uint8], lights: Lights, growth: Floats) -> None:
        core_px = lights.core_px
        radius = geometric_radii(
            np.maximum(_INNER * core_px, 0.7),
            np.maximum(_OUTER * core_px, _OUTER_MIN_PX),
            _SHARES,
        )
        log_step = np.log(radius[:, -1:] / radius[:, :1]) / np.float32(_RINGS - 1)
        rings = sample_rings(image, lights.guess_px, radius)
        level = _one_channel(rings.pixels, lights.weakest)
        above = level - lights.ground[:, None, None]
        usable = (level < CLIPPED) & (above > 3.0 * _NOISE)
        if rings.inside is not None:
            usable &= rings.inside
        np.maximum(above, 1.0, out=above)
        y = np.log(above)
        used = usable.astype(np.float32)
        paired = used[:, 2:] * used[:, :-2]
        count = paired @ _ONES
        difference = ((y[:, 2:] - y[:, :-2]) * paired) @ _ONES
        used, above, self._y = used[:, 1:-1], above[:, 1:-1], y[:, 1:-1]
        self._seen = (count >= 0.4 * RAYS) & (used @ _ONES >= 0.5 * RAYS)
        seen = self._seen.astype(np.float32)
        falling = difference / (np.maximum(count, 1.0) * (-2.0 * log_step)) * seen
        self._shift = falling / radius[:, 1:-1]
        plain = np.where(self._seen, np.maximum(falling, 0.0), 1.0)
        self._growth = growth[:, None] + _STEEPNESS * plain
        self._log_step = log_step
        self.solvable = np.add.reduce(seen, axis=1) >= 4.0
        noise = _NOISE / above
        # For each sample: its weight, and its weight times y.
        self._weighted = np.empty((*seen.shape, 2, RAYS), np.float32)
        weight = self._weighted[:, :, 0]
        used *= seen[:, :, None]
        self._samples = np.maximum(np.add.reduce(used, axis=(1, 2)), 1.0)
        np.divide(used, noise * noise + _MODEL_NOISE**2, out=weight)
        np.multiply(weight, self._y, out=self._weighted[:, :, 1])

    def solve(self, prior_px2: Floats, prior_px: Floats) -> tuple[Floats, Floats, Floats, Floats]:
        """Solve for the step to the source (N, 2), the lean (N, 2), and two parts of the step's variance (N,) per axis.

        The prior on the step has the mean prior_px (N, 2) and the variance prior_px2 (N,); the prior on the lean has
        the mean 0. The equations are solved twice: samples that the first solution does not explain (an obstacle,
        another light) have less weight in the second. The first part of the variance is that of the least squares times
        the misfit, which is the mean squared residual of the first solution over the variance that was assumed: noise,
        JPEG and other lights show in it. The second part is from the uncertainty of the growth.
        """
        prior = np.repeat(_PRIOR[None], len(prior_px2), axis=0)
        information = 1.0 / prior_px2
        prior[:, 0, 0] = prior[:, 1, 1] = information
        prior[:, 2, 2] = prior[:, 3, 3] = 1.0 / _LEAN_SD**2
        prior[:, :2, 4] = information[:, None] * prior_px
        rows = self._rows()
        x, mean = self._least_squares(rows[:1], prior)
        expected = np.empty((*mean.shape, 3), np.float32)
        expected[..., 0] = mean
        expected[..., 1:] = rows[0, :, 3:].swapaxes(1, 2) @ x[0, ..., 0].reshape(-1, 2, 2)
        residual = self._y - (expected.reshape(-1, 3) @ _PLANE).reshape(self._y.shape)
        robust = self._weighted[:, :, 0] * residual
        robust *= residual
        misfit = np.add.reduce(robust, axis=(1, 2)) / self._samples
        robust *= 1.0 / _ROBUST_SD**2
        robust += 1.0
        self._weighted /= robust[:, :, None]
        x, _ = self._least_squares(rows, prior)
        apart = x[2, :, :2, 0] - x[1, :, :2, 0]
        model_px2 = 0.5 * misfit * (x[0, :, 0, 1] + x[0, :, 1, 2])
        growth_px2 = 0.125 * (apart[:, 0] ** 2 + apart[:, 1] ** 2)
        return x[0, :, :2, 0], x[0, :, 2:, 0], model_px2, growth_px2

    def _rows(self) -> Floats:
        """Return the factors of the rings' sums, (3, N, 5, M): the products ss, sw, ww, then s, w.

        s: slope of the profile, -Y0'. w: the glow's share, from d ln w / d ln rho integrated along the rings; it is 1
        at the outermost usable ring. The first axis: the expected growth, 1 sd less, 1 sd more.
        """
        assumed = np.array([[[0.0]], [[-_GROWTH_SD]], [[_GROWTH_SD]]], np.float32)
        growth = np.maximum(self._growth + assumed, 0.0)
        log_share = (growth.reshape(-1, growth.shape[2]) @ _TRAPEZOIDS).reshape(growth.shape)
        log_share *= self._log_step
        last = np.where(self._seen, log_share, np.float32(-1e9)).max(axis=-1, keepdims=True)
        log_share -= last
        np.minimum(log_share, 0.0, out=log_share)
        rows = np.empty((*growth.shape[:2], 5, growth.shape[2]), np.float32)
        rows[:, :, 3] = self._shift
        np.exp(log_share, out=rows[:, :, 4])
        np.multiply(rows[:, :, 3:], self._shift[:, None], out=rows[:, :, :2])
        np.square(rows[:, :, 4], out=rows[:, :, 2])
        return rows

    def _least_squares(self, rows: Floats, prior: Floats) -> tuple[Floats, Floats]:
        """Solve for (s, k) with each ring's mean eliminated, for S assumed growths.

        rows: (S, N, 5, M), see _rows. prior: (N, 4, 7), see _PRIOR. Returns (S, N, 4, 3), the
        solution and the first two columns of its covariance; and the rings' means (N, M).
        """
        n, m = self._seen.shape
        sums = (self._weighted.reshape(n * m, 2 * RAYS) @ _SUMS).reshape(n, m, 10)
        means = sums[..., 1:4] / np.maximum(sums[..., :1], 1e-6)
        spread = sums[..., 4:].reshape(n, m, 3, 2) - sums[..., 1:4, None] * means[..., None, :2]
        products = (rows @ spread.reshape(n, m, 6)).reshape(len(rows), n, 30) * (1.0 / _INFLATION)
        system = np.repeat(prior[None], len(rows), axis=0)
        system[..., :5] += products.take(_SYSTEM, axis=-1)
        return np.linalg.solve(system[..., :4], system[..., 4:]), means[..., 2]


_ONES = np.ones(RAYS, np.float32)
_PLANE = np.stack([_ONES, *RAY_UV.T])
_RAYS_TWICE = np.zeros((2, RAYS, 10), np.float32)
_RAYS_TWICE[0, :, :3] = _PLANE.T
_RAYS_TWICE[0, :, 4:8] = (RAY_UV[:, :, None] * RAY_UV[:, None]).reshape(-1, 4)
_RAYS_TWICE[1, :, 3] = 1.0
_RAYS_TWICE[1, :, 8:] = RAY_UV
_SUMS = _RAYS_TWICE.reshape(-1, 10)
"""The sums over a ring's rays: of 1, c, s, y, then of (c, s, y) times (c, s). c, s: the ray's cosine and sine."""

_TRAPEZOIDS = np.triu(np.ones((_RINGS - 2, _RINGS - 2), np.float32))
_TRAPEZOIDS[0] = 0.0
_TRAPEZOIDS = 0.5 * (_TRAPEZOIDS + np.triu(np.ones_like(_TRAPEZOIDS), 1))
"""Integrates along the rings from the first one, by the trapezoidal rule with step 1."""

_SYSTEM = np.array([[0, 1, 6, 7, 22], [2, 3, 8, 9, 23], [6, 7, 12, 13, 28], [8, 9, 14, 15, 29]])
"""Indices of the normal equations of (s_u, s_v, k_u, k_v), with the right side as the last column, in the products
(ss, sw, ww, s, w) times (cc, cs, sc, ss, yc, ys)."""

_PRIOR = np.zeros((4, 7))
_PRIOR[0, 5] = _PRIOR[1, 6] = 1.0
"""Layout of the prior's normal equations: a 4x4 matrix, the right side, then two columns of the identity matrix, which
give the covariance."""
