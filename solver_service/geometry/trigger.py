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
from solver_service.geometry.candidates import Candidates, find_candidates
from solver_service.geometry.closed_form import Bars, ClosedForm, closed_form, dot, solve_exact
from solver_service.geometry.evidence import (
    AGREES,
    CHANCE_ODDS,
    Prediction,
    Sensors,
    combine,
    intruder_odds,
    log_chance,
    log_gaps,
    weigh,
)
from solver_service.geometry.hypotheses import Pairs, find_pairs, search
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
# A rival within this log ratio is named.
_RIVAL: Final = 6.0
# Bars whose middle is nearer to the camera than this, relative to their length, need but one round.
_SMALL_OFFSET: Final = 0.02
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
        rigs, levels = (rig_a, rig_b), (rig_a.level, rig_b.level)
        candidates = find_candidates((view_a, view_b), rigs)
        in_a, in_b = candidates.counts
        if min(in_a, in_b) < 2:
            return NoFix("too_few_candidates", f"{in_a} candidates in A's picture, {in_b} in B's: not 2 each")
        sensors = _sensors(levels, (sensed_a, sensed_b))
        prediction, motion = _prediction(prior, rigs), _motion(prior, rig_a, settings)
        return _Trigger(rigs, levels, candidates, sensors, prediction, motion, settings).solve()


@dataclass(frozen=True, eq=False)
class _Trigger:
    """One trigger's terms, all in the rigs' level frames."""

    rigs: tuple[Rig, Rig]
    levels: tuple[Rig, Rig]
    candidates: Candidates
    sensors: Sensors
    prediction: Prediction | None
    motion: Motion
    settings: Settings

    def solve(self) -> Fix | NoFix:
        """Search, weigh, decide."""
        settings = self.settings
        limits = f"between {settings.range_min_m:g} and {settings.range_max_m:g} m"
        pairs = find_pairs(self.candidates, self.levels, (self.sensors.down_a, self.sensors.down_b), settings)
        if not min(pairs.counts):
            return NoFix("out_of_range", f"no two candidates stand as far apart as the lights would {limits}")
        found = search(self.candidates, pairs, self.levels, self._motion_variance(pairs), settings)
        if isinstance(found, str):
            combinations = f"{pairs.counts[0]} pairs in A's picture and {pairs.counts[1]} in B's"
            if found == "twist_gap":
                return NoFix("twist_gap", f"no two of {combinations} have the same twist where their ranges agree")
            return NoFix("range_gap", f"no two of {combinations} have the same range")
        solved = solve_exact(
            found.spans, Bars.of(*self.levels), split_rounds=3, offset_rounds=_offset_rounds(self.levels)
        )
        t, variance = solved.t_a_b_m, found.variance
        support = weigh(solved.R_a_b, t, solved.u[0], variance, self.levels, self.sensors, self.prediction, settings)
        base = support.log_ratio + found.log_weight + log_chance(self.levels, self.candidates.counts, settings)
        chi2 = np.zeros(len(variance))
        if "range" in settings.checks:
            chi2 += np.log(solved.range_m[0] / solved.range_m[1]) ** 2 / variance
        if "twist" in settings.checks:
            chi2 += solved.twist_gap_rad**2 / variance
        gaps = len(settings.checks & {"range", "twist"})
        range2 = dot(t, t)
        inside = (range2 >= settings.range_min_m**2) & (range2 <= settings.range_max_m**2) & np.isfinite(base)
        log_ratio = np.where(inside, base + log_gaps(chi2, variance, gaps), -np.inf)
        best = np.argsort(-log_ratio, kind="stable")[:_REFINED]
        if log_ratio[best[0]] == -np.inf:
            return NoFix("out_of_range", f"what agrees, at {math.sqrt(range2[0]):.3g} m, is not {limits}")
        best = best[log_ratio[best] > log_ratio[best[0]] - _NEGLIGIBLE]
        ratio = np.exp(log_ratio)
        others = float(ratio.sum() - ratio[best].sum())

        lights = found.lights[:, best].T
        seen = Sightings(
            self.candidates.bearings.T[lights], self.candidates.tangents[lights], self.candidates.dt_s[lights]
        )
        refined = refine(t[:, best].T, solved.R_a_b[:, :, best].transpose(2, 0, 1), seen, *self.levels, self.motion)
        # Without both gaps the picture's chi2 would bring in what the settings leave out.
        chi2 = refined.chi2 if gaps == 2 else chi2[best]
        log_ratio = np.where(refined.sound, base[best] + log_gaps(chi2, variance[best], gaps), -np.inf)
        k = int(log_ratio.argmax())
        if log_ratio[k] == -np.inf:
            return NoFix("degenerate", "the directions do not determine a pose")
        t, R, ratio = refined.t_a_b_m, refined.R_a_b, np.exp(log_ratio)
        range_m = math.sqrt(float(t[k] @ t[k]))
        if not settings.range_min_m <= range_m <= settings.range_max_m:
            return NoFix("out_of_range", f"what agrees, at {range_m:.3g} m, is not {limits}")
        same = ((t - t[k]) ** 2).sum(1) < (_SAME_POSITION * range_m) ** 2
        same &= (R * R[k]).sum((1, 2)) > 1.0 + 2.0 * math.cos(_SAME_ROTATION)
        intruder = float(ratio[k]) * self._intruder(lights[k], float(chi2[k]), refined.freedom(k)) if gaps == 2 else 0.0
        probability = float(ratio[same].sum() / (CHANCE_ODDS + ratio.sum() + others + intruder))
        tilt_chi2, depth_chi2 = float(support.tilt_chi2[best[k]]), float(support.depth_chi2[best[k]])
        if probability >= settings.min_probability:
            checks = self._checks(tilt_chi2, depth_chi2)
            return self._fix(solved, int(best[k]), refined, k, lights[k], seen, probability, checks)
        what = f"the best of the hypotheses, at {range_m:.3g} m,"
        if tilt_chi2 > AGREES:
            return NoFix("attitude", f"{what} is {math.sqrt(tilt_chi2):.1f} sigma off the attitudes")
        if depth_chi2 > AGREES:
            return NoFix("depth", f"{what} is {math.sqrt(depth_chi2):.1f} sigma off the depths")
        why = "one light may be a false candidate" if intruder > CHANCE_ODDS else "chance may give it"
        rivals = np.where(same, -np.inf, log_ratio)
        rival = int(rivals.argmax())
        if rivals[rival] > log_ratio[k] - _RIVAL:
            why = f"another stands at {math.sqrt(float(t[rival] @ t[rival])):.3g} m"
        return NoFix("ambiguous", f"{what} is {probability:.0%} likely: {why} (chi2 {chi2[k]:.1f})")

    def _intruder(self, lights: NDArray[np.intp], chi2: float, freedom: Floats) -> float:
        """Give the odds that one of the four lights is missing and a false candidate stands in for it."""
        (in_a, in_b), (a, b) = self.candidates.counts, (rig.camera.area_px2 for rig in self.rigs)
        per_px2 = np.array((in_a / a, in_a / a, in_b / b, in_b / b))
        return intruder_odds(chi2, freedom, per_px2 * self.candidates.sigma_px[lights] ** 2)

    def _checks(self, tilt_chi2: float, depth_chi2: float) -> tuple[str, ...]:
        """Name what speaks for the pose."""
        settings, sensors = self.settings, self.sensors
        checks: list[str] = [name for name in ("range", "twist") if name in settings.checks]
        if sensors.R_a_b is None or "attitude" not in settings.checks:
            checks.append("upright_assumed")
        elif tilt_chi2 <= AGREES:
            checks.append("attitude")
        if sensors.depth_m is not None and "depth" in settings.checks and depth_chi2 <= AGREES:
            checks.append("depth")
        return tuple(checks)

    def _fix(
        self,
        solved: ClosedForm,
        chosen: int,
        refined: Refined,
        k: int,
        lights: NDArray[np.intp],
        seen: Sightings,
        probability: float,
        checks: tuple[str, ...],
    ) -> Fix:
        """Publish a hypothesis, between the cameras' frames; range_a_m and the like follow the closed form."""
        method, (rig_a, rig_b) = self.settings.method, self.rigs
        covariance, chi2 = refined.covariance[k], float(refined.chi2[k])
        if chi2 > _GROSS_CHI2:
            # One light is off by more than its noise; which one, two residuals cannot tell.
            covariance = covariance * (0.5 * chi2)
        covariance = rig_a.both_level_camera.T @ covariance @ rig_a.both_level_camera
        if method == "refined":
            t = rig_a.R_level_camera.T @ refined.t_a_b_m[k]
            R = rig_a.R_level_camera.T @ refined.R_a_b[k] @ rig_b.R_level_camera
        else:
            views = seen.bearings[k].reshape(2, 2, 3)
            views = views @ np.array((rig_a.R_level_camera, rig_b.R_level_camera))
            solved = closed_form(views[:, 0, :, None], views[:, 1, :, None], rig_a, rig_b, method)
            t, R, chosen = solved.t_a_b_m[:, 0], solved.R_a_b[:, :, 0], 0
        range_a_m, range_b_m = solved.range_m[:, chosen].tolist()
        index = self.candidates.index[lights].tolist()
        return Fix(
            t_a_b_m=t,
            q_a_b_xyzw=quaternion_of(R),
            covariance=0.5 * (covariance + covariance.T),
            range_a_m=range_a_m,
            range_b_m=range_b_m,
            range_gap_m=range_a_m - range_b_m,
            twist_gap_rad=float(solved.twist_gap_rad[chosen]),
            chi2=chi2,
            hypotheses=math.prod(n * (n - 1) for n in self.candidates.counts),
            pair_a=(index[0], index[1]),
            pair_b=(index[2], index[3]),
            method=method,
            checks=checks,
            probability=probability,
        )

    def _motion_variance(self, pairs: Pairs) -> Floats:
        """Give what relative motion between the exposures may add to ln range and twist of A's pairs, rad^2."""
        dt_s, split = self.candidates.dt_s, self.candidates.counts[0]
        square_s2 = float(dt_s[:split].sum() / split - dt_s[split:].sum() / (len(dt_s) - split)) ** 2
        square_s2 += self.motion.skew_sigma_s**2
        rates2 = np.diagonal(self.motion.covariance) + self.motion.rates**2
        speed2, turn2 = float(rates2[:3].sum()) / 3.0, float(rates2[3:].sum()) / 3.0
        per_range = pairs.chord[: pairs.split] / self.levels[1].length_m
        variance: Floats = square_s2 * (speed2 * per_range * per_range + turn2)
        return variance


def _offset_rounds(levels: tuple[Rig, Rig]) -> int:
    """Give how often the closed form moves the bearings to the bars' middles before the refinement takes over."""
    offset = max(level.offset_m / level.length_m for level in levels)
    return 1 if offset < _SMALL_OFFSET else 4


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


def _prediction(prior: Prior | None, rigs: tuple[Rig, Rig]) -> Prediction | None:
    if prior is None:
        return None
    t, q, covariance = _finite(prior.t_a_b_m, (3,)), _finite(prior.q_a_b_xyzw, (4,)), _finite(prior.covariance, (6, 6))
    if t is None or q is None or covariance is None or not q @ q > 0.25:
        return None
    # Nobody knows a moving diver to less than a millimetre and a milliradian.
    turn_a, turn_b, both = rigs[0].R_level_camera, rigs[1].R_level_camera, rigs[0].both_level_camera
    return Prediction(turn_a @ t, turn_a @ matrix_of(q) @ turn_b.T, both @ covariance @ both.T + 1e-6 * np.eye(6))


def _motion(prior: Prior | None, rig_a: Rig, settings: Settings) -> Motion:
    rates = _finite(prior.rates, (6,)) if prior is not None else None
    covariance = _finite(prior.rates_covariance, (6, 6)) if prior is not None else None
    if rates is None or covariance is None:
        # Alike in all directions: the same in every frame.
        sigma2 = settings.speed_mps**2, settings.turn_radps**2
        return Motion(np.zeros(6), np.diag(np.repeat(sigma2, 3)), settings.skew_sigma_s)
    both = rig_a.both_level_camera
    return Motion(both @ rates, both @ covariance @ both.T, settings.skew_sigma_s)
