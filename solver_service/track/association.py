"""Which candidate is which light: all assignments of one picture, weighed by the joint predicted covariance."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, islice
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from buddyline.solver_service.geometry.evidence import GROSS_PX, GROSS_SHARE
from buddyline.solver_service.geometry.rotation import Floats
from numpy.typing import NDArray

# A light is used where its marginal probability is above SURE; by a track that is confirmed above LIKELY, with the
# doubt in its variance.
SURE: Final = 0.99
LIKELY: Final = 0.8
# Beyond this chi^2 (2 degrees of freedom) an assignment is not weighed: a chance of 1e-6.
GATE: Final = 27.6
MAX_OPTIONS: Final = 10
# The residual of a light behind the camera.
NOWHERE_PX: Final = 1e8
IN_PICTURE: Final[Floats] = np.ones(2)
"""Both lights are surely within the picture."""
_LOG_SHARES: Final = np.log((1.0 - GROSS_SHARE, GROSS_SHARE))

Case: TypeAlias = tuple[tuple[int, int] | None, tuple[int, int] | None]
"""For both lights the candidate and whether it is off by a gross error, None where the light is missing."""
_Option: TypeAlias = tuple[float, int, int]


class Association(NamedTuple):
    """What one picture says of the lights.

    chosen: (candidate, light, variance in px^2) of those that are sure or likely; the variance is that of the mixture
    where a gross error cannot be told from a common one, or the light may be elsewhere. seen (L,): the probability that
    each light is among the candidates. evidence: log of the picture's probability over that of clutter alone.
    ambiguous: whether a candidate may well be either light.
    """

    chosen: tuple[tuple[int, int, float], ...]
    seen: Floats
    evidence: float
    ambiguous: bool = False


class Odds(NamedTuple):
    """Every assignment of one picture's candidates, and the logs (N,) of their densities over clutter.

    How likely each light is found is left out: that is learned from picture to picture. y_px (K, 2, 2): how far each
    candidate stands off each light; spread_px2 (K, 2): the variance of that by what is predicted, in the direction in
    which it is largest.
    """

    cases: list[Case]
    logs: Floats
    y_px: Floats
    spread_px2: Floats

    def times(self, logs: Floats) -> Odds:
        """Give the odds where each candidate (K) is each light with odds that differ by these logs (K, 2)."""
        more = [sum(logs[one[0], light] for light, one in enumerate(case) if one is not None) for case in self.cases]
        return self._replace(logs=self.logs + more)

    def weighed(self, detection: Floats, within: Floats = IN_PICTURE) -> tuple[list[Case], Floats]:
        """Give the assignments and the logs of their odds.

        within (2,): how likely each light is within the picture; detection (2,): how likely it is found there.
        """
        cases, logs, lit = self.cases, self.logs, detection.tolist()
        if not all(lit):
            kept = [n for n, case in enumerate(cases) if all(lit[k] or one is None for k, one in enumerate(case))]
            cases, logs = [cases[n] for n in kept], logs[kept]
        first, second = (
            (math.log(max(1.0 - found * inside, 1e-6)), math.log(found) if found > 0.0 else -math.inf)
            for found, inside in zip(lit, within.tolist(), strict=True)
        )
        return cases, logs + [first[one is not None] + second[two is not None] for one, two in cases]

    def associate(
        self, sigma_px: Floats, detection: Floats, within: Floats = IN_PICTURE, least: float = SURE
    ) -> Association:
        """Choose the lights that are more likely than least.

        sigma_px (K,): of the candidates, for the variance of the chosen. detection, within: as of `weighed`.
        """
        cases, logs = self.weighed(detection, within)
        top = float(logs.max())
        weights = np.exp(logs - top)
        total = float(weights.sum())
        weights /= total
        # By light: of each candidate, how likely it is that light, off by a common error and by a gross one.
        marginal: tuple[dict[int, list[float]], dict[int, list[float]]] = {}, {}
        for case, weight in zip(cases, weights.tolist(), strict=True):
            for of_light, picked in zip(marginal, case, strict=True):
                if picked is not None:
                    k, mode = picked
                    if k not in of_light:
                        of_light[k] = [0.0, 0.0]
                    of_light[k][mode] += weight
        # Which light such a candidate is, the next pictures mostly tell no better: it is left out, not guessed.
        first, second = marginal
        ambiguous = {k for k in first.keys() & second.keys() if min(sum(first[k]), sum(second[k])) > 1.0 - SURE}
        chosen: list[tuple[int, int, float]] = []
        for light, of_light in enumerate(marginal):
            for k, (common, gross) in of_light.items():
                if common + gross > least and k not in ambiguous:
                    doubt_px2 = 0.0 if common + gross > SURE else self._doubt_px2(k, light, of_light)
                    chosen.append((k, light, variance_of(float(sigma_px[k]), common, gross) + doubt_px2))
        seen = [sum(map(sum, of_light.values())) for of_light in marginal]
        return Association(tuple(sorted(chosen)), np.array(seen), top + math.log(total), bool(ambiguous))

    def _doubt_px2(self, k: int, light: int, of_light: Mapping[int, Sequence[float]]) -> float:
        """Give what the variance of a light, candidate k, gains because it may be another candidate or none.

        That is how far off k would be, as a mean square; a light that is no candidate is where it was predicted. One
        variance stands poorly for places far apart, so the prediction's is added: no variance is more than halved.
        """
        y = self.y_px[k, light]
        odds = {other: sum(found) for other, found in of_light.items()}
        apart_px2 = sum(share * float(((self.y_px[other, light] - y) ** 2).sum()) for other, share in odds.items())
        missing = max(1.0 - sum(odds.values()), 0.0)
        return apart_px2 + missing * float(y @ y) + float(self.spread_px2[k, light])


def associate(
    y: Floats,
    H: Floats,
    P: Floats,
    sigma_px: Floats,
    detection: Floats,
    clutter_per_px2: float,
    within: Floats = IN_PICTURE,
    least: float = SURE,
    by_last: Floats | None = None,
) -> Association:
    """Weigh every assignment of candidates (K) to two lights, each of which may be missing.

    y (K, 2, 2), H (K, 2, 2, C): residuals and Jacobians, by candidate and light; P (C, C): covariance of the errors.
    within (2,): how likely each light is within the picture; detection (2,): how likely it is then among the
    candidates. The odds are against clutter alone. least: lights that are more likely are chosen. by_last (K, 2): log
    odds of each candidate being each light, by what the last picture did not show.
    """
    [odds] = odds_of(y[None], H[None], P[None], sigma_px[None], np.array((clutter_per_px2,)))
    return (odds if by_last is None else odds.times(by_last)).associate(sigma_px, detection, within, least)


def variance_of(sigma_px: float, common: float, gross: float) -> float:
    """Give a light's variance, px^2: the mixture's where a gross error cannot be told from a common one."""
    doubt = gross / (common + gross)
    added_px2 = doubt * GROSS_PX**2 if doubt > 1.0 - SURE else 0.0
    return sigma_px**2 + added_px2


def doubt_of(variance: float, sigma_px: float) -> float:
    """Give by how much a light's variance exceeds sigma_px^2 because of an unlikely gross error, px^2; else 0.

    The mixture's variance makes a large residual look like an expected one. That is right where a light moves an
    estimate. The spread of residuals must be learned without it: otherwise the tails of a Gaussian would not count.
    """
    added_px2 = variance - sigma_px * sigma_px
    return added_px2 if 0.0 < added_px2 < 0.5 * GROSS_PX**2 else 0.0


def odds_of(y: Floats, H: Floats, P: Floats, sigma_px: Floats, clutter_per_px2: Floats) -> list[Odds]:
    """Give the odds of pictures (N), or of bars, as of `associate`: y (N, K, 2, 2), P (N, C, C), clutter (N,).

    Where a picture has fewer candidates than others, the rest have infinite residuals, H of 0 and sigmas of 1.
    """
    y = np.where(np.isfinite(y), y, NOWHERE_PX)
    log_clutter = np.log(clutter_per_px2) + math.log(2.0 * math.pi)
    variances = np.array((0.0, GROSS_PX**2))[:, None] + (sigma_px * sigma_px)[:, None]  # (N, 2 modes, K)
    options, spread_px2 = _single(y, H, P, variances, log_clutter)
    pairs = [[(one[1:], two[1:]) for one in first for two in second if one[1] != two[1]] for first, second in options]
    counts = list(map(len, pairs))
    joint: Iterator[float] = iter(())
    if any(counts):
        at, picked = np.repeat(np.arange(len(pairs)), counts), np.array([pair for found in pairs for pair in found])
        joint = iter(_both(at, picked, y, H, P, variances, log_clutter))
    every = []
    for (first, second), found, *of_picture in zip(options, pairs, y, spread_px2, strict=True):
        cases: list[Case] = [(None, None), *((one[1:], None) for one in first), *((None, two[1:]) for two in second)]
        logs = [0.0, *(one[0] for one in first), *(two[0] for two in second), *islice(joint, len(found))]
        every.append(Odds([*cases, *found], np.array(logs), *of_picture))
    return every


def _single(
    y: Floats, H: Floats, P: Floats, variances: Floats, log_clutter: Floats
) -> tuple[list[tuple[list[_Option], list[_Option]]], Floats]:
    """Give, for each picture's lights, the likeliest candidates in their order; and Odds.spread_px2 of each picture.

    Of each the log of the density over clutter, the candidate, and its mode: 1 where it is off by a gross error.
    """
    S = (H @ P[:, None, None] @ H.swapaxes(-1, -2))[:, None]  # (N, 1, K, 2, 2, 2)
    a, b, c = S[..., 0, 0] + variances[..., None], S[..., 0, 1], S[..., 1, 1] + variances[..., None]
    u, v = y[:, None, ..., 0], y[:, None, ..., 1]
    det = a * c - b * b
    chi2 = (c * (u * u) - 2.0 * b * (u * v) + a * (v * v)) / det
    log_l = _LOG_SHARES[:, None, None] - 0.5 * (chi2 + np.log(det)) - log_clutter[:, None, None, None]
    # A lamp that is nowhere in the picture is no candidate's, however little the track knows.
    near = ((chi2 < GATE) & (np.abs(y).max(axis=-1) < NOWHERE_PX)[:, None]).nonzero()
    options: list[tuple[list[_Option], list[_Option]]] = [([], []) for _ in y]
    for n, mode, k, light, log in zip(*(each.tolist() for each in (*near, log_l[near])), strict=True):
        options[n][light].append((log, k, mode))
    for found in chain.from_iterable(options):
        found.sort(reverse=True)
        del found[MAX_OPTIONS:]
    first, across, second = S[:, 0, ..., 0, 0], S[:, 0, ..., 0, 1], S[:, 0, ..., 1, 1]
    return options, 0.5 * (first + second) + np.hypot(0.5 * (first - second), across)


def _both(
    at: NDArray[np.intp],
    pairs: NDArray[np.intp],
    y: Floats,
    H: Floats,
    P: Floats,
    variances: Floats,
    log_clutter: Floats,
) -> list[float]:
    """Give the logs of the joint densities over clutter; pairs (M, 2 lights, 2): candidate, mode; at (M,): picture."""
    k, mode, light, of = pairs[:, :, 0], pairs[:, :, 1], np.array((0, 1)), at[:, None]
    H_both = H[of, k, light].reshape(len(pairs), 4, -1)
    y_both = y[of, k, light].reshape(len(pairs), 4)
    S = H_both @ P[at] @ H_both.swapaxes(1, 2)
    S[:, range(4), range(4)] += np.repeat(variances[of, mode, k], 2, axis=1)
    chi2 = (y_both * np.linalg.solve(S, y_both[..., None])[..., 0]).sum(axis=1)
    logs = -0.5 * (chi2 + np.linalg.slogdet(S)[1]) + _LOG_SHARES[mode].sum(axis=1) - 2.0 * log_clutter[at]
    weighed: list[float] = logs.tolist()
    return weighed
