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
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from node.detect.rings import RAY_COS, RAY_SIN, RAYS, geometric, sample_rings

Floats: TypeAlias = NDArray[np.floating[Any]]

_RINGS = 20
_ROUNDS = 3
_CLIPPED = 249.0
_FLOOR_PX = 0.05
_FIRST_HARMONICS = np.stack(
    [np.ones(RAYS), RAY_COS, RAY_SIN, RAY_COS**2, RAY_COS * RAY_SIN, RAY_SIN**2], axis=1
).astype(np.float32)
LUMA_BGR = np.array([0.114, 0.587, 0.299], np.float32)

MODEL: Mapping[str, float] = {
    "growth": 0.7,
    "growth_veil": 0.45,
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


def locate_sources(
    image: NDArray[np.uint8],
    start_px: Floats,
    radius_px: Floats,
    ground: Floats,
    weakest: NDArray[np.bool_],
    model: Mapping[str, float] = MODEL,
) -> Centres:
    """Locate the sources of N lights in a BGR (H, W, 3) or grey (H, W) picture.

    start_px: (N, 2) centres and radius_px: (N,) radii of their brightest regions. ground: (N,) what the water itself
    shows there. weakest: (N,) whether the weakest channel is used, which clips last, or the luminance, which is
    sharper (JPEG halves the resolution of colour).
    """
    n = len(start_px)
    prior_sd = model["core_share"] * radius_px + 0.5
    centre = start_px.astype(np.float64)
    covariance = np.eye(2) * (prior_sd**2)[:, None, None]
    lean = np.zeros((n, 2))
    if n == 0:
        return Centres(centre.astype(np.float32), covariance.astype(np.float32), lean.astype(np.float32))
    radius = geometric(
        np.maximum(model["inner"] * radius_px, 0.7).astype(np.float32),
        np.maximum(model["outer"] * radius_px, model["outer_min_px"]).astype(np.float32),
        _RINGS,
    )
    log_step = np.log(radius[:, -1] / radius[:, 0]) / (_RINGS - 1)
    scale = model.get("scale", image.shape[1] / 820.0)
    growth = (
        model["growth"]
        - model["growth_veil"] * np.minimum(ground / 60.0, 1.0)
        - model["growth_size"] * np.log(np.maximum(radius_px / scale, 3.0) / 12.0)
    )
    alive = np.ones(n, bool)
    for _ in range(_ROUNDS):
        rings = sample_rings(image, centre.astype(np.float32), radius)
        level = _one_channel(rings.pixels, weakest)
        step, step_covariance, step_lean, solved = _solve(
            level, rings.inside, radius, log_step, ground, growth, prior_sd, start_px - centre, model
        )
        length = np.hypot(step[:, 0], step[:, 1])
        step *= np.minimum(1.0, (0.6 * radius_px + 1.0) / np.maximum(length, 1e-9))[:, None]
        moved = centre + step
        strayed = np.hypot(*(moved - start_px).T) > radius_px + 3.0
        alive &= solved & ~strayed
        centre = np.where(alive[:, None], moved, np.where(strayed[:, None], start_px, centre))
        covariance = np.where(alive[:, None, None], step_covariance, covariance)
        lean = np.where(alive[:, None], step_lean, lean)
    # Where the model does not hold, the centre of the region stands with the prior's uncertainty.
    covariance = np.where(alive[:, None, None], covariance, np.eye(2) * (prior_sd**2)[:, None, None])
    covariance = covariance + np.eye(2) * _FLOOR_PX**2
    return Centres(centre.astype(np.float32), covariance.astype(np.float32), lean.astype(np.float32))


def _one_channel(pixels: Floats, weakest: NDArray[np.bool_]) -> Floats:
    """Give (N, M, K) levels from (N, M, K, C): the weakest channel where asked for, else the luminance."""
    if pixels.shape[3] == 1:
        return pixels[..., 0]
    luma = pixels @ LUMA_BGR
    weak = np.minimum(np.minimum(pixels[..., 0], pixels[..., 1]), pixels[..., 2])
    return np.where(weakest[:, None, None], weak, luma)


def _solve(
    level: Floats,
    inside: NDArray[np.bool_],
    radius: Floats,
    log_step: Floats,
    ground: Floats,
    growth: Floats,
    prior_sd: Floats,
    prior_px: Floats,
    model: Mapping[str, float],
) -> tuple[Floats, Floats, Floats, NDArray[np.bool_]]:
    """Solve for the step to the source (N, 2), its covariance (N, 2, 2), the lean (N, 2), and where that worked."""
    above = level - ground[:, None, None]
    usable = inside & (level < _CLIPPED) & (above > 3.0 * model["noise"])
    above = np.maximum(above, 1.0)
    log_level = np.log(above)
    weight = usable / ((model["noise"] / above) ** 2 + model["model_noise"] ** 2)

    paired = usable[:, 2:] & usable[:, :-2]
    count = paired.sum(axis=2)
    slope = np.zeros(radius.shape, np.float32)
    difference = (log_level[:, 2:] - log_level[:, :-2]) * paired
    slope[:, 1:-1] = difference.sum(axis=2) / np.maximum(count, 1) / (2.0 * log_step[:, None])
    seen = np.zeros(radius.shape, bool)
    seen[:, 1:-1] = (count >= 0.4 * RAYS) & (usable[:, 1:-1].sum(axis=2) >= 0.5 * RAYS)
    solved = seen.sum(axis=1) >= 4
    weight *= seen[:, :, None]

    steep = np.clip(np.where(seen, -slope, 1.0), 0.0, model["steep_max"])
    shift = np.where(seen, -slope, 0.0) / radius
    shares = [
        _glow_share(growth[:, None] + k * model["growth_sd"] + model["steepness"] * steep, log_step, seen)
        for k in (0.0, -1.0, 1.0)
    ]
    prior = np.zeros((len(radius), 4))
    prior[:, :2] = (1.0 / prior_sd**2)[:, None]
    prior[:, 2:] = 1.0 / model["lean_sd"] ** 2
    wanted = np.zeros((len(radius), 4))
    wanted[:, :2] = prior[:, :2] * prior_px

    sums, first = _ring_sums(weight, log_level)
    x, _ = _least_squares(shift, shares[0], sums, first, prior, wanted, model["inflation"])
    mean = np.where(sums[..., 0] > 0, first[..., 0] / np.maximum(sums[..., 0], 1e-9), 0.0)
    u = shift * x[:, None, 0] + shares[0] * x[:, None, 2]
    v = shift * x[:, None, 1] + shares[0] * x[:, None, 3]
    residual = log_level - (mean[..., None] + u[..., None] * RAY_COS + v[..., None] * RAY_SIN).astype(np.float32)
    weight = weight / (1.0 + weight * residual**2 / 9.0)
    sums, first = _ring_sums(weight, log_level)
    solutions = [_least_squares(shift, share, sums, first, prior, wanted, model["inflation"]) for share in shares]
    middle, covariance = solutions[0]
    apart = 0.5 * (solutions[2][0][:, :2] - solutions[1][0][:, :2])
    total = covariance[:, :2, :2] + apart[:, :, None] * apart[:, None, :]
    return middle[:, :2], total, middle[:, 2:], solved


def _glow_share(growth: Floats, log_step: Floats, seen: NDArray[np.bool_]) -> Floats:
    """Integrate d ln w / d ln rho along the rings; w is 1 at the outermost ring that is seen, (N, M)."""
    growth = np.maximum(growth, -0.3)
    log_share = np.zeros_like(growth)
    log_share[:, 1:] = np.cumsum(0.5 * (growth[:, 1:] + growth[:, :-1]), axis=1) * log_step[:, None]
    last = np.where(seen, log_share, -np.inf).max(axis=1, keepdims=True)
    last = np.where(np.isfinite(last), last, 0.0)
    return np.exp(np.minimum(log_share - last, 0.0))


def _ring_sums(weight: Floats, log_level: Floats) -> tuple[Floats, Floats]:
    """Sum weights times 1, c, s, cc, cs, ss, and weighted levels times 1, c, s, over each ring's rays."""
    sums = (weight @ _FIRST_HARMONICS).astype(np.float64)
    first = ((weight * log_level) @ _FIRST_HARMONICS[:, :3]).astype(np.float64)
    return sums, first


def _least_squares(
    shift: Floats,
    share: Floats,
    sums: Floats,
    first: Floats,
    prior: Floats,
    wanted: Floats,
    inflation: float,
) -> tuple[Floats, Floats]:
    """Solve for (s, k), (N, 4), with each ring's mean eliminated; neighbouring samples are correlated (inflation)."""
    total = np.maximum(sums[..., 0], 1e-9)
    c, s = sums[..., 1], sums[..., 2]
    cc = sums[..., 3] - c * c / total
    cs = sums[..., 4] - c * s / total
    ss = sums[..., 5] - s * s / total
    yc = first[..., 1] - first[..., 0] * c / total
    ys = first[..., 2] - first[..., 0] * s / total
    a = np.zeros((len(shift), 4, 4))
    g = np.zeros((len(shift), 4))
    basis = (shift.astype(np.float64), share.astype(np.float64))
    for i in (0, 1):
        g[:, 2 * i] = (basis[i] * yc).sum(axis=1)
        g[:, 2 * i + 1] = (basis[i] * ys).sum(axis=1)
        for j in (0, 1):
            both = basis[i] * basis[j]
            a[:, 2 * i, 2 * j] = (both * cc).sum(axis=1)
            a[:, 2 * i, 2 * j + 1] = a[:, 2 * i + 1, 2 * j] = (both * cs).sum(axis=1)
            a[:, 2 * i + 1, 2 * j + 1] = (both * ss).sum(axis=1)
    a /= inflation
    a[:, range(4), range(4)] += prior
    covariance = np.linalg.inv(a)
    x = (covariance @ (g / inflation + wanted)[:, :, None])[:, :, 0]
    return x, covariance
