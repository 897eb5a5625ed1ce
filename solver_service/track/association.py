"""Which candidate is which light: all assignments of one picture, weighed by the joint predicted covariance."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats

# A light is used where its marginal probability is above this.
SURE: Final = 0.99
# Share of lights found wrongly by many pixels (flares, half-hidden lights), and how far, 1 sd.
GROSS_SHARE: Final = 0.03
GROSS_PX: Final = 7.0
# Beyond this chi^2 (2 degrees of freedom) an assignment is not weighed: a chance of 1e-6.
GATE: Final = 27.6
MAX_OPTIONS: Final = 10


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
    open_lights: int


def associate(
    y: Floats, H: Floats, P: Floats, sigma_px: Floats, detection: Floats, clutter_per_px2: float
) -> Association:
    """Weigh every assignment of candidates (K) to two lights, each of which may be missing.

    y (K, 2, 2), H (K, 2, 2, C): residuals and Jacobians, by candidate and light; P (C, C): covariance of the errors.
    detection (2,): how likely each light is to be among the candidates.
    """
    K = len(y)
    options: list[list[tuple[int, int]]] = [[], []]
    singles: dict[tuple[int, int, int], float] = {}
    blocks: dict[tuple[int, int], tuple[Floats, Floats]] = {}
    log_clutter = math.log(clutter_per_px2)
    for light in range(2):
        if K == 0 or detection[light] <= 0.0:
            continue
        near = np.flatnonzero(np.isfinite(y[:, light]).all(1))
        if not len(near):
            continue
        Hn, yn = H[near, light], y[near, light]
        S = Hn @ P @ np.swapaxes(Hn, 1, 2)
        found = []
        for mode in range(2):
            variance = sigma_px[near] ** 2 + (GROSS_PX**2 if mode else 0.0)
            Sm = S + variance[:, None, None] * np.eye(2)
            det = Sm[:, 0, 0] * Sm[:, 1, 1] - Sm[:, 0, 1] ** 2
            chi2 = (
                Sm[:, 1, 1] * yn[:, 0] ** 2 - 2.0 * Sm[:, 0, 1] * yn[:, 0] * yn[:, 1] + Sm[:, 0, 0] * yn[:, 1] ** 2
            ) / det
            share = GROSS_SHARE if mode else 1.0 - GROSS_SHARE
            log_l = -0.5 * chi2 - 0.5 * np.log(det) - math.log(2.0 * math.pi) - log_clutter
            log_l += math.log(share * detection[light])
            found += [(float(log_l[j]), int(near[j]), mode) for j in np.flatnonzero(chi2 < GATE)]
        found.sort(reverse=True)
        for log_l, k, mode in found[:MAX_OPTIONS]:
            options[light].append((k, mode))
            singles[light, k, mode] = log_l
            blocks[light, k] = (H[k, light], y[k, light])
    misses = [math.log(max(1.0 - detection[light], 1e-6)) for light in range(2)]

    cases: list[tuple[tuple[int, int] | None, tuple[int, int] | None]] = [(None, None)]
    logs = [misses[0] + misses[1]]
    for light in range(2):
        for option in options[light]:
            cases.append((option, None) if light == 0 else (None, option))
            logs.append(singles[light, *option] + misses[1 - light])
    pairs = [(one, two) for one in options[0] for two in options[1] if one[0] != two[0]]
    if pairs:
        Hp = np.stack([np.concatenate((blocks[0, a[0]][0], blocks[1, b[0]][0])) for a, b in pairs])
        yp = np.stack([np.concatenate((blocks[0, a[0]][1], blocks[1, b[0]][1])) for a, b in pairs])
        S = Hp @ P @ np.swapaxes(Hp, 1, 2)
        extra = np.array([[GROSS_PX**2 * a[1]] * 2 + [GROSS_PX**2 * b[1]] * 2 for a, b in pairs])
        noise = np.array([[sigma_px[a[0]] ** 2] * 2 + [sigma_px[b[0]] ** 2] * 2 for a, b in pairs])
        S[:, range(4), range(4)] += extra + noise
        chi2 = np.einsum("pi,pi->p", yp, np.linalg.solve(S, yp[..., None])[..., 0])
        _, logdet = np.linalg.slogdet(S)
        for (a, b), c, ld in zip(pairs, chi2.tolist(), logdet.tolist(), strict=True):
            share = sum(math.log(GROSS_SHARE if mode else 1.0 - GROSS_SHARE) for mode in (a[1], b[1]))
            cases.append((a, b))
            logs.append(
                -0.5 * (c + ld)
                - 2.0 * math.log(2.0 * math.pi)
                - 2.0 * log_clutter
                + share
                + math.log(detection[0] * detection[1])
            )
    logs_array = np.array(logs)
    top = float(logs_array.max())
    weights = np.exp(logs_array - top)
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
            doubt = gross / (common + gross)
            added_px2 = doubt * GROSS_PX**2 if doubt > 1.0 - SURE else 0.0
            chosen.append((k, light, float(sigma_px[k]) ** 2 + added_px2))
    taken = {light for _, light, _ in chosen}
    left = sum(1 for light in range(2) if light not in taken and seen[light] > 0.5)
    return Association(tuple(chosen), seen, top + math.log(total), left)
