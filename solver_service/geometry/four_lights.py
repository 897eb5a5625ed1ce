"""All four lights seen: eight coordinates for six unknowns, the redundant two being the gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.candidates import Candidates
from buddyline.solver_service.geometry.closed_form import Bars, dot, solve_exact
from buddyline.solver_service.geometry.evidence import log_chance, log_gaps, weigh
from buddyline.solver_service.geometry.hypotheses import Pairs, search
from buddyline.solver_service.geometry.observation import Reason
from buddyline.solver_service.geometry.readings import Readings
from buddyline.solver_service.geometry.refinement import Sightings, refine
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.geometry.scalars import TURN
from buddyline.solver_service.geometry.terms import Terms
from numpy.typing import NDArray

# So many of the best are refined; what lies further below the best (log ratio) does not matter.
_REFINED: Final = 6
_NEGLIGIBLE: Final = 16.0
# What the refinement does not have to be spared: two rounds leave less than the noise.
_SPLIT_ROUNDS: Final = 2
# Bars whose middle is nearer to the camera than this, relative to their length, need but one round.
_SMALL_OFFSET: Final = 0.02


@dataclass(eq=False, slots=True)
class FourLights:
    """The best readings; others: the sum of all other likelihood ratios. why: the reason where there are none."""

    readings: Readings | None
    others: float = 0.0
    why: tuple[Reason, str] = ("ambiguous", "")


def read_four_lights(terms: Terms, pairs: Pairs) -> FourLights:
    """Search, weigh and refine."""
    settings = terms.settings
    in_a, in_b = terms.candidates.counts
    if min(in_a, in_b) < 2:
        what = f"{in_a} candidates in A's picture, {in_b} in B's: not 2 each"
        return FourLights(None, why=("too_few_candidates", what))
    if not min(pairs.counts):
        what = f"no two candidates stand as far apart as the lights would {terms.range_limits}"
        return FourLights(None, why=("out_of_range", what))
    found = search(terms.candidates, pairs, terms.rigs, _motion_variance(terms, pairs), settings)
    if isinstance(found, str):
        combinations = f"{pairs.counts[0]} pairs in A's picture and {pairs.counts[1]} in B's"
        same = "the same twist where their ranges agree" if found == "twist_gap" else "the same range"
        return FourLights(None, why=(found, f"no two of {combinations} have {same}"))
    solved = solve_exact(
        found.spans, Bars.of(terms.rigs), split_rounds=_SPLIT_ROUNDS, offset_rounds=_offset_rounds(terms.rigs)
    )
    t, variance = solved.t_a_b_m, found.variance
    support = weigh(solved.R_a_b, t, variance, terms.rigs, terms.sensors, terms.prediction, settings.checks)
    gaps = settings.gaps
    base = support.log_ratio + found.log_weight + log_chance(terms.rigs, terms.candidates.counts, settings)
    base -= (0.5 * gaps) * np.log(TURN * variance)
    gap2 = np.zeros(len(variance))
    if "range" in settings.checks:
        gap2 = gap2 + np.log(solved.range_m[0] / solved.range_m[1]) ** 2
    if "twist" in settings.checks:
        gap2 = gap2 + solved.twist_gap_rad**2
    chi2 = gap2 / variance
    range2 = dot(t, t)
    inside = (range2 >= settings.range_min_m**2) & (range2 <= settings.range_max_m**2) & np.isfinite(base)
    log_ratio = np.where(inside, base + log_gaps(chi2, gaps), -np.inf)
    likeliest = float(np.maximum.reduce(log_ratio))
    if likeliest == -np.inf:
        what = f"what agrees, at {math.sqrt(range2[0]):.3g} m, is not {terms.range_limits}"
        return FourLights(None, why=("out_of_range", what))
    best = (log_ratio > likeliest - _NEGLIGIBLE).nonzero()[0]
    if len(best) > _REFINED:
        best = best[(-log_ratio[best]).argsort(kind="stable")[:_REFINED]]
    lights = found.lights.take(best, 1).T
    ratio = np.exp(log_ratio)
    ratio[best] = 0.0
    refined = refine(
        t.take(best, 1).T,
        solved.R_a_b.take(best, 2).transpose(2, 0, 1),
        _sightings(terms.candidates, lights),
        *terms.rigs.levels,
        terms.motion,
    )
    # Without both gaps the picture's chi2 would bring in what the settings leave out.
    chi2 = refined.chi2 if gaps == 2 else chi2[best]
    return FourLights(
        Readings(
            lights=lights,
            t_a_b_m=refined.t_a_b_m,
            R_a_b=refined.R_a_b,
            covariance=refined.covariance,
            chi2=chi2,
            log_ratio=np.where(refined.sound, base[best] + log_gaps(chi2, gaps), -np.inf),
            tilt_chi2=support.tilt_chi2[best],
            depth_chi2=support.depth_chi2[best],
            range_m=solved.range_m.take(best, 1).T,
            twist_gap_rad=solved.twist_gap_rad[best],
            clutter=_clutter(terms, lights) if gaps == 2 else np.zeros(len(best)),
            log_prior=support.log_prior[best],
            lone_odds=np.zeros(len(best)),
        ),
        others=float(np.add.reduce(ratio)),
    )


def _sightings(candidates: Candidates, lights: NDArray[np.intp]) -> Sightings:
    return Sightings(candidates.frames.take(lights, 0), candidates.dt_s[lights])


def _clutter(terms: Terms, lights: NDArray[np.intp]) -> Floats:
    """Give how many candidates chance puts into the variance of the positions of K times four lights (K, 4)."""
    clutter: Floats = terms.candidates.sigma_px[lights] ** 2 @ _density_px2(terms.rigs, *terms.candidates.counts)
    return clutter


@lru_cache(maxsize=64)
def _density_px2(rigs: RigPair, in_a: int, in_b: int) -> Floats:
    """Give the candidates per px^2 of the picture that each of the four lights is seen in."""
    density: Floats = np.array((in_a, in_a, in_b, in_b)) / rigs.area_px2
    density.flags.writeable = False
    return density


def _motion_variance(terms: Terms, pairs: Pairs) -> Floats:
    """Give what relative motion between the exposures may add to ln range and twist of A's pairs, rad^2."""
    in_a, motion = terms.candidates.counts[0], terms.motion
    dt_s = terms.candidates.dt_s.tolist()
    apart_s = sum(dt_s[:in_a]) / in_a - sum(dt_s[in_a:]) / (len(dt_s) - in_a)
    square_s2 = apart_s * apart_s + motion.skew_sigma_s**2
    if square_s2 == 0.0:
        return np.zeros(pairs.split)
    speed2, turn2 = motion.mean_squares
    per_range = pairs.chord[: pairs.split] / float(terms.rigs.length_m[1])
    variance: Floats = square_s2 * (speed2 * per_range * per_range + turn2)
    return variance


def _offset_rounds(rigs: RigPair) -> int:
    """Give how often the closed form moves the bearings to the bars' middles before the refinement takes over."""
    return 1 if rigs.offset_m < _SMALL_OFFSET * float(rigs.length_m.min()) else 4
