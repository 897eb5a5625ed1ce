"""One trigger: what two nodes saw, and the one pose that explains it, or why there is none.

A pure function: the same input gives the same output, bit for bit, whatever was solved before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from solver_service.geometry.camera import Camera
from solver_service.geometry.closed_form import Bars, ClosedForm, closed_form
from solver_service.geometry.evidence import (
    AGREES,
    CHANCE_ODDS,
    Evidence,
    Prediction,
    Sensors,
    Weighed,
    combine,
    log_intruder,
)
from solver_service.geometry.hypotheses import Hypotheses, Pairs, Sky, find_pairs, find_sky, search
from solver_service.geometry.observation import Prior, Sensed, Settings, View
from solver_service.geometry.refinement import Motion, Refined, Sightings, refine
from solver_service.geometry.rig import Rig
from solver_service.geometry.rotation import Floats, matrix_of, quaternion_of

__all__ = ["Camera", "Fix", "NoFix", "Prior", "Reason", "Rig", "Sensed", "Settings", "View", "solve_trigger"]

Reason: TypeAlias = Literal[
    "too_few_candidates",
    "range_gap",
    "twist_gap",
    "attitude",
    "depth",
    "out_of_range",
    "ambiguous",
    "degenerate",
]


@dataclass(frozen=True, eq=False)
class Fix:
    """A pose. T_a_b maps B's camera frame into A's.

    covariance: (6, 6), position in A's camera frame, then the small rotation w with R_true = exp(w) R_a_b, in
    A's camera frame. pair_a: indices into view A of B's (left, right) light, -1 where it was not seen; pair_b
    likewise. chi2: of the picture coordinates, two degrees of freedom. probability: against chance and others.
    """

    t_a_b_m: Floats
    q_a_b_xyzw: Floats
    covariance: Floats
    range_a_m: float
    range_b_m: float
    range_gap_m: float
    twist_gap_rad: float
    chi2: float
    hypotheses: int
    pair_a: tuple[int, int]
    pair_b: tuple[int, int]
    method: str
    checks: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class NoFix:
    """Why there is no pose: detail is for a person."""

    reason: Reason
    detail: str


_REFINED: Final = 6
# What lies further below the best (log ratio) does not change its probability.
_NEGLIGIBLE: Final = 16.0
# Poses nearer than this, relative to the range and in rad, are one pose.
_SAME_POSITION: Final = 0.04
_SAME_ROTATION: Final = 0.1
# chi^2 of two degrees of freedom from which on a gross error is likelier than the noise.
_GROSS_CHI2: Final = 11.3


def solve_trigger(
    view_a: View,
    view_b: View,
    rig_a: Rig,
    rig_b: Rig,
    sensed_a: Sensed,
    sensed_b: Sensed,
    settings: Settings,
    prior: Prior | None = None,
) -> Fix | NoFix:
    """Find the four lights among both nodes' candidates, and T_a_b from them, or say why there is none."""
    for name, rig in (("A", rig_a), ("B", rig_b)):
        if not rig.usable:
            return NoFix("degenerate", f"the lights of {name} are less than 1 mm apart")
    with np.errstate(all="ignore"):
        offset_s = 0.5e-9 * (view_a.stamp_ns - view_b.stamp_ns)
        skies = find_sky(view_a, rig_a.camera, offset_s), find_sky(view_b, rig_b.camera, -offset_s)
        counts = len(skies[0].index), len(skies[1].index)
        if min(counts) < 2:
            return NoFix("too_few_candidates", f"{counts[0]} candidates in A's picture, {counts[1]} in B's: not 2 each")
        rigs = rig_a, rig_b
        evidence = Evidence(rigs, counts, _sensors(rigs, (sensed_a, sensed_b)), _prediction(prior), settings)
        return _Trigger(skies, evidence, _motion(prior, settings)).solve()


@dataclass(frozen=True, eq=False)
class _Trigger:
    skies: tuple[Sky, Sky]
    evidence: Evidence
    motion: Motion

    def solve(self) -> Fix | NoFix:
        settings, rigs = self.evidence.settings, self.evidence.rigs
        limits = f"between {settings.range_min_m:g} and {settings.range_max_m:g} m"
        pairs_a = find_pairs(self.skies[0], rigs[0], rigs[1], self.evidence.sensors.down_a, settings)
        pairs_b = find_pairs(self.skies[1], rigs[1], rigs[0], self.evidence.sensors.down_b, settings)
        if not len(pairs_a) or not len(pairs_b):
            return NoFix("out_of_range", f"no two candidates stand as far apart as the lights would {limits}")
        motion_variance = self._motion_variance(pairs_a)
        found = search(pairs_a, pairs_b, rigs, motion_variance, settings.checks, settings.gate_sigma)
        if isinstance(found, str):
            combinations = f"{len(pairs_a)} pairs in A's picture and {len(pairs_b)} in B's"
            if found == "twist_gap":
                return NoFix("twist_gap", f"no two of {combinations} have the same twist where their ranges agree")
            return NoFix("range_gap", f"no two of {combinations} have the same range")
        solved = self._closed_form(found)
        chi2 = _gap_chi2(solved, found.variance, settings.checks)
        log_ratio = self.evidence.weigh(
            solved.R_a_b, solved.t_a_b_m, solved.u[0], chi2, found.variance, found.log_weight
        ).log_ratio
        range_m = np.sqrt((solved.t_a_b_m * solved.t_a_b_m).sum(0))
        inside = (range_m >= settings.range_min_m) & (range_m <= settings.range_max_m)
        if not inside.any():
            return NoFix("out_of_range", f"what agrees, at {range_m[0]:.3g} m, is not {limits}")
        log_ratio = np.where(inside & np.isfinite(log_ratio), log_ratio, -np.inf)
        order = np.argsort(-log_ratio, kind="stable")
        best = order[:_REFINED]
        best = best[log_ratio[best] > log_ratio[best[0]] - _NEGLIGIBLE]
        others = float(np.exp(log_ratio[order[len(best) :]]).sum())
        return self._decide(found, solved, best, others)

    def _decide(self, found: Hypotheses, solved: ClosedForm, best: NDArray[np.intp], others: float) -> Fix | NoFix:
        """Refine the best hypotheses and publish the first where it stands alone. others: the rest's ratios."""
        settings = self.evidence.settings
        seen = self._sightings(found.lights[:, best])
        t, R = solved.t_a_b_m[:, best].T, solved.R_a_b[:, :, best].transpose(2, 0, 1)
        steps = None if settings.method == "refined" else 0
        refined = refine(t, R, seen, *self.evidence.rigs, self.motion, steps)
        t, R = refined.t_a_b_m, refined.R_a_b
        chi2 = refined.chi2
        if settings.method != "refined" or not settings.checks >= {"range", "twist"}:
            chi2 = _gap_chi2(solved, found.variance, settings.checks)[best]
        range_m = np.sqrt((t * t).sum(1))
        weighed = self.evidence.weigh(
            R.transpose(1, 2, 0), t.T, (t / range_m[:, None]).T, chi2, found.variance[best], found.log_weight[best]
        )
        log_ratio = np.where(refined.sound & np.isfinite(weighed.log_ratio), weighed.log_ratio, -np.inf)
        k = int(np.argmax(log_ratio))
        if log_ratio[k] == -np.inf:
            return NoFix("degenerate", "the directions do not determine a pose")
        if not settings.range_min_m <= range_m[k] <= settings.range_max_m:
            limits = f"between {settings.range_min_m:g} and {settings.range_max_m:g} m"
            return NoFix("out_of_range", f"what agrees, at {range_m[k]:.3g} m, is not {limits}")
        ratio = np.exp(log_ratio)
        turn = 0.5 * ((R @ R[k].T).trace(axis1=1, axis2=2) - 1.0)
        same = (((t - t[k]) ** 2).sum(1) < (_SAME_POSITION * range_m[k]) ** 2) & (turn > math.cos(_SAME_ROTATION))
        intruder = self._intruder(found.lights[:, best[k]], float(chi2[k]), refined.freedom[k])
        against = CHANCE_ODDS + ratio.sum() + others + intruder * ratio[k]
        probability = float(ratio[same].sum() / against)
        if not probability >= settings.min_probability:
            return self._refuse(probability, k, range_m, chi2, log_ratio, same, weighed)
        return self._fix(found, solved, best, refined, k, probability, weighed)

    def _intruder(self, lights: NDArray[np.intp], chi2: float, freedom: Floats) -> float:
        """Give the odds that one of the four lights is missing and a false candidate stands in for it."""
        if not self.evidence.settings.checks >= {"range", "twist"}:
            return 0.0
        total = 0.0
        for sky, rig, two, room in zip(
            self.skies, self.evidence.rigs, (lights[:2], lights[2:]), (freedom[:2], freedom[2:]), strict=True
        ):
            area_px2 = rig.camera.width_px * rig.camera.height_px
            total += np.exp(log_intruder(chi2, room, len(sky.index), sky.sigma_px[two] ** 2, area_px2)).sum()
        return float(total)

    def _refuse(
        self,
        probability: float,
        k: int,
        range_m: Floats,
        chi2: Floats,
        log_ratio: Floats,
        same: NDArray[np.bool_],
        weighed: Weighed,
    ) -> NoFix:
        """Name what speaks against the best hypothesis."""
        what = f"the best of the hypotheses, at {range_m[k]:.3g} m,"
        if weighed.tilt_chi2[k] > AGREES:
            return NoFix("attitude", f"{what} is {math.sqrt(weighed.tilt_chi2[k]):.1f} sigma off the attitudes")
        if weighed.depth_chi2[k] > AGREES:
            return NoFix("depth", f"{what} is {math.sqrt(weighed.depth_chi2[k]):.1f} sigma off the depths")
        rivals = np.where(same, -np.inf, log_ratio)
        second = int(np.argmax(rivals))
        if rivals[second] > max(0.0, log_ratio[k] - 7.0):
            return NoFix("ambiguous", f"{what} is {probability:.0%} likely, beside another at {range_m[second]:.3g} m")
        return NoFix("ambiguous", f"{what} is {probability:.0%} likely: chance may give it (chi2 {chi2[k]:.1f})")

    def _fix(
        self,
        found: Hypotheses,
        solved: ClosedForm,
        best: NDArray[np.intp],
        refined: Refined,
        k: int,
        probability: float,
        weighed: Weighed,
    ) -> Fix:
        settings, sensors = self.evidence.settings, self.evidence.sensors
        chosen = int(best[k])
        covariance = refined.covariance[k]
        chi2 = float(refined.chi2[k])
        if chi2 > _GROSS_CHI2:
            # One light is off by more than its noise; which one, two residuals cannot tell.
            covariance = covariance * (0.5 * chi2)
        checks: list[str] = sorted(settings.checks & {"range", "twist"})
        if sensors.R_a_b is None or "attitude" not in settings.checks:
            checks.append("upright_assumed")
        elif weighed.tilt_chi2[k] <= AGREES:
            checks.append("attitude")
        if sensors.depth_m is not None and "depth" in settings.checks and weighed.depth_chi2[k] <= AGREES:
            checks.append("depth")
        range_a_m, range_b_m = solved.range_m[:, chosen].tolist()
        lights = found.lights[:, chosen]
        index_a, index_b = self.skies[0].index[lights[:2]].tolist(), self.skies[1].index[lights[2:]].tolist()
        pairs = math.prod(len(sky.index) * (len(sky.index) - 1) for sky in self.skies)
        return Fix(
            t_a_b_m=refined.t_a_b_m[k],
            q_a_b_xyzw=quaternion_of(refined.R_a_b[k]),
            covariance=0.5 * (covariance + covariance.T),
            range_a_m=range_a_m,
            range_b_m=range_b_m,
            range_gap_m=range_a_m - range_b_m,
            twist_gap_rad=float(solved.twist_gap_rad[chosen]),
            chi2=chi2,
            hypotheses=pairs,
            pair_a=(index_a[0], index_a[1]),
            pair_b=(index_b[0], index_b[1]),
            method=settings.method,
            checks=tuple(checks),
            probability=probability,
        )

    def _closed_form(self, found: Hypotheses) -> ClosedForm:
        rigs, method = self.evidence.rigs, self.evidence.settings.method
        seen_a, seen_b = self.skies[0].bearings[:, found.lights[:2]], self.skies[1].bearings[:, found.lights[2:]]
        left, right = np.stack((seen_a[:, 0], seen_b[:, 0])), np.stack((seen_a[:, 1], seen_b[:, 1]))
        bars = Bars.of(*rigs)
        if method == "refined":
            return closed_form(left, right, bars, rounds=3 if bars.centred else 5)
        return closed_form(left, right, bars, method)

    def _sightings(self, lights: NDArray[np.intp]) -> Sightings:
        a, b = self.skies
        of_a, of_b = lights[:2].T, lights[2:].T
        return Sightings(
            bearings=np.concatenate((a.bearings.T[of_a], b.bearings.T[of_b]), axis=1),
            tangents=np.concatenate((a.tangents[of_a], b.tangents[of_b]), axis=1),
            dt_s=np.concatenate((a.dt_s[of_a], b.dt_s[of_b]), axis=1),
        )

    def _motion_variance(self, pairs_a: Pairs) -> Floats:
        """Give what relative motion between the exposures may add to ln range and twist, rad^2."""
        skew_s = float(self.skies[0].dt_s.mean() - self.skies[1].dt_s.mean())
        speed2 = float(np.trace(self.motion.covariance[:3, :3]) + (self.motion.rates[:3] ** 2).sum()) / 3.0
        turn2 = float(np.trace(self.motion.covariance[3:, 3:]) + (self.motion.rates[3:] ** 2).sum()) / 3.0
        per_range = pairs_a.chord / self.evidence.rigs[1].length_m
        variance: Floats = (skew_s**2 + self.motion.skew_sigma_s**2) * (speed2 * per_range * per_range + turn2)
        return variance


def _gap_chi2(solved: ClosedForm, variance: Floats, checks: frozenset[str]) -> Floats:
    chi2 = np.zeros(len(variance))
    if "range" in checks:
        chi2 += np.log(solved.range_m[0] / solved.range_m[1]) ** 2
    if "twist" in checks:
        chi2 += solved.twist_gap_rad**2
    return chi2 / variance


def _finite(value: Floats | None, shape: tuple[int, ...]) -> Floats | None:
    """Give an array of this shape and finite numbers, None for everything else."""
    if value is None:
        return None
    array = np.asarray(value, dtype=np.float64)
    return array if array.shape == shape and np.isfinite(array).all() else None


def _sensors(rigs: tuple[Rig, Rig], sensed: tuple[Sensed, Sensed]) -> Sensors:
    attitudes = [_finite(one.q_ned_body_xyzw, (4,)) for one in sensed]
    attitudes = [q if q is not None and q @ q > 0.25 else None for q in attitudes]
    sigmas = [_finite(one.sigma_rad, (3,)) for one in sensed]
    depth_m, variance = None, 0.0
    if all(one.depth_m is not None and math.isfinite(one.depth_m) for one in sensed):
        depth_m = float(sensed[1].depth_m or 0.0) - float(sensed[0].depth_m or 0.0)
        for one in sensed:
            sigma_m = one.depth_sigma_m
            variance += sigma_m**2 if sigma_m is not None and math.isfinite(sigma_m) else 0.0
    return combine(rigs, (attitudes[0], attitudes[1]), (sigmas[0], sigmas[1]), depth_m, variance)


def _prediction(prior: Prior | None) -> Prediction | None:
    if prior is None:
        return None
    t, q, covariance = _finite(prior.t_a_b_m, (3,)), _finite(prior.q_a_b_xyzw, (4,)), _finite(prior.covariance, (6, 6))
    if t is None or q is None or covariance is None or not q @ q > 0.25:
        return None
    # Nobody knows a moving diver to less than a millimetre and a milliradian.
    return Prediction(t, matrix_of(q), covariance + 1e-6 * np.eye(6))


def _motion(prior: Prior | None, settings: Settings) -> Motion:
    rates = _finite(prior.rates, (6,)) if prior is not None else None
    covariance = _finite(prior.rates_covariance, (6, 6)) if prior is not None else None
    if rates is None or covariance is None:
        rates, covariance = np.zeros(6), np.diag([settings.speed_mps**2] * 3 + [settings.turn_radps**2] * 3)
    return Motion(rates, covariance, settings.skew_sigma_s)
