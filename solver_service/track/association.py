"""Which candidate is which light: all assignments of one picture, weighed by the joint predicted covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from numpy.typing import NDArray

# A light is used where its marginal probability is above this.
SURE: Final = 0.99
# Share of lights found wrongly by many pixels (flares, half-hidden lights), and how far, 1 sd.
GROSS_SHARE: Final = 0.03
GROSS_PX: Final = 7.0
# Beyond this chi^2 (2 degrees of freedom) an assignment is not weighed: a chance of 1e-6.
GATE: Final = 27.6
MAX_OPTIONS: Final = 10
# The residual of a light behind the camera.
NOWHERE_PX: Final = 1e8
_LOG_SHARES: Final = np.log((1.0 - GROSS_SHARE, GROSS_SHARE))

Case: TypeAlias = tuple[tuple[int, int] | None, tuple[int, int] | None]
"""For both lights the candidate and whether it is off by a gross error, None where the light is missing."""


@dataclass(frozen=True, eq=False)
class Association:
    """What one picture says of the lights.

    chosen: (candidate, light, variance in px^2) of those that are sure; the variance is that of the mixture where a
    gross error cannot be told from a common one. seen (L,): the probability that each light is among the
    candidates. evidence: log of the picture's probability over that of clutter alone.
    """

    chosen: tuple[tuple[int, int, float], ...]
    seen: Floats
    evidence: float


def associate(
    y: Floats, H: Floats, P: Floats, sigma_px: Floats, detection: Floats, clutter_per_px2: float
) -> Association:
    """Weigh every assignment of candidates (K) to two lights, each of which may be missing; arguments as of `weigh`."""
    cases, logs = weigh(y, H, P, sigma_px, detection, clutter_per_px2)
    top = float(logs.max())
    weights = np.exp(logs - top)
    total = float(weights.sum())
    weights /= total
    marginal: dict[tuple[int, int], list[float]] = {}
    seen = np.zeros(2)
    for case, weight in zip(cases, weights.tolist(), strict=True):
        for light, picked in enumerate(case):
            if picked is not None:
                seen[light] += weight
                marginal.setdefault((picked[0], light), [0.0, 0.0])[picked[1]] += weight
    chosen: list[tuple[int, int, float]] = []
    for (k, light), (common, gross) in sorted(marginal.items()):
        if common + gross > SURE:
            chosen.append((k, light, variance_of(float(sigma_px[k]), common, gross)))
    return Association(tuple(chosen), seen, top + math.log(total))


def variance_of(sigma_px: float, common: float, gross: float) -> float:
    """Give a light's variance, px^2: the mixture's where a gross error cannot be told from a common one."""
    doubt = gross / (common + gross)
    added_px2 = doubt * GROSS_PX**2 if doubt > 1.0 - SURE else 0.0
    return sigma_px**2 + added_px2


def weigh(
    y: Floats, H: Floats, P: Floats, sigma_px: Floats, detection: Floats, clutter_per_px2: float
) -> tuple[list[Case], Floats]:
    """Give every assignment of candidates (K) to two lights, each of which may be missing, and the logs of their odds.

    y (K, 2, 2), H (K, 2, 2, C): residuals and Jacobians, by candidate and light; P (C, C): covariance of the errors.
    detection (2,): how likely each light is to be among the candidates. The odds are against clutter alone.
    """
    options: tuple[list[tuple[float, int, int]], list[tuple[float, int, int]]] = ([], [])
    if len(y):
        y = np.where(np.isfinite(y), y, NOWHERE_PX)
        _weigh_single(options, y, H, P, sigma_px, detection, math.log(clutter_per_px2))
    misses = [math.log(max(1.0 - detection[light], 1e-6)) for light in range(2)]

    cases: list[Case] = [(None, None)]
    logs = [misses[0] + misses[1]]
    for log_l, k, mode in options[0]:
        cases.append(((k, mode), None))
        logs.append(log_l + misses[1])
    for log_l, k, mode in options[1]:
        cases.append((None, (k, mode)))
        logs.append(log_l + misses[0])
    pairs = [(one[1:], two[1:]) for one in options[0] for two in options[1] if one[1] != two[1]]
    if pairs:
        cases += pairs
        logs += _weigh_pairs(np.array(pairs), y, H, P, sigma_px, detection, math.log(clutter_per_px2))
    return cases, np.array(logs)


def _weigh_single(
    options: tuple[list[tuple[float, int, int]], list[tuple[float, int, int]]],
    y: Floats,
    H: Floats,
    P: Floats,
    sigma_px: Floats,
    detection: Floats,
    log_clutter: float,
) -> None:
    """Add, for each light, the likeliest candidates in their order: log of the density over clutter, candidate, mode.

    mode: 1 where the candidate is off by a gross error.
    """
    S = H @ P @ np.swapaxes(H, -1, -2)
    variance = _variances(sigma_px)[:, :, None]  # (2 modes, K, 1)
    a, b, c = S[..., 0, 0] + variance, S[..., 0, 1], S[..., 1, 1] + variance
    u, v = y[..., 0], y[..., 1]
    det = a * c - b * b
    chi2 = (c * (u * u) - 2.0 * b * (u * v) + a * (v * v)) / det
    log_l = -0.5 * (chi2 + np.log(det)) - (math.log(2.0 * math.pi) + log_clutter) + _LOG_SHARES[:, None, None]
    # A lamp that is nowhere in the picture is no candidate's, however little the track knows.
    for mode, k, light in np.argwhere((chi2 < GATE) & (np.abs(y).max(axis=-1) < NOWHERE_PX)).tolist():
        if detection[light] > 0.0:
            options[light].append((float(log_l[mode, k, light]) + math.log(detection[light]), k, mode))
    for found in options:
        found.sort(reverse=True)
        del found[MAX_OPTIONS:]


def _weigh_pairs(
    pairs: NDArray[np.intp],
    y: Floats,
    H: Floats,
    P: Floats,
    sigma_px: Floats,
    detection: Floats,
    log_clutter: float,
) -> list[float]:
    """Give the logs of the joint densities over clutter; pairs (N, 2 lights, 2): candidate, mode."""
    k, mode = pairs[:, :, 0], pairs[:, :, 1]
    light = np.array((0, 1))
    H_both = H[k, light].reshape(len(pairs), 4, -1)
    y_both = y[k, light].reshape(len(pairs), 4)
    S = H_both @ P @ np.swapaxes(H_both, 1, 2)
    S[:, range(4), range(4)] += np.repeat(_variances(sigma_px)[mode, k], 2, axis=1)
    chi2 = (y_both * np.linalg.solve(S, y_both[..., None])[..., 0]).sum(axis=1)
    logs = -0.5 * (chi2 + np.linalg.slogdet(S)[1]) + _LOG_SHARES[mode].sum(axis=1)
    logs += math.log(detection[0] * detection[1]) - 2.0 * (math.log(2.0 * math.pi) + log_clutter)
    weighed: list[float] = logs.tolist()
    return weighed


def _variances(sigma_px: Floats) -> Floats:
    """Give the variances (2 modes, K) of candidates that are off by a common, or by a gross error."""
    return np.add.outer((0.0, GROSS_PX**2), sigma_px * sigma_px)
