"""Triggers: what two nodes saw, and the one pose that explains it, or why there is none.

What pictures and sensors say is worked out for many triggers at once, without the past (`read_triggers`); what earlier
fixes say is then applied trigger by trigger (`TriggerReadings.decide`). Pure functions: the same input gives the same
output, whatever was solved before or beside it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.batch import Batch
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.compasses import Contradiction, HeadingGap, compare_headings
from buddyline.solver_service.geometry.evidence import AGREES, CHANCE_ODDS, POOR_FIT, UNFIT_CHI2
from buddyline.solver_service.geometry.fix import Fix, NoFix, in_metres
from buddyline.solver_service.geometry.four_lights import FourLights, read_four_lights
from buddyline.solver_service.geometry.observation import (
    Heading,
    Observation,
    Prior,
    Reason,
    Sensed,
    Settings,
    View,
)
from buddyline.solver_service.geometry.past import Past
from buddyline.solver_service.geometry.readings import Read, Readings
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.geometry.sensors import heading_offset
from buddyline.solver_service.geometry.three_lights import read_three_lights, three_lights_tell
from buddyline.solver_service.geometry.weighing import Weighed, weigh_readings
from numpy.typing import NDArray

__all__ = [
    "Camera",
    "Fix",
    "NoFix",
    "Observation",
    "Prior",
    "Reason",
    "Rig",
    "Sensed",
    "Settings",
    "View",
    "read_triggers",
    "solve_triggers",
]

# Poses nearer than this, relative to the range, and turned by less than 0.1 rad (their trace) are one pose.
_SAME_POSITION: Final = 0.04
_SAME_TRACE: Final = 1.0 + 2.0 * math.cos(0.1)
# Three lights have no gap to check them, and the headings tell no better than this which of two lights a node sees.
# They must be likelier where the motion prior decides for or against them, and more so than any other hypothesis: it
# knows nothing of how a diver turns aside. In 210 simulated dives of half a minute none of 11,059 poses of three lights
# is wrong; with 0.995 against the others, too, 2 of 11,622 are, and with 0.98 against a false light 3 of 11,587.
_THREE_PROBABILITY: Final = 0.98
_FOLLOWED_PROBABILITY: Final = 0.99
_UNRIVALLED_PROBABILITY: Final = 0.999
# Four lights that no earlier pose supports, where both attitudes are known. In 64 dives among strangers' lamps 0.997
# gave as many wrong poses (7 of 4,672 triggers), and it costs whole rests their poses.
_ALONE_PROBABILITY: Final = 0.99
# chi^2 of two degrees of freedom from which on a gross error is likelier than the noise.
_GROSS_CHI2: Final = 11.3
# Where a position is known better than this share of the range (1 sd), a false light does not make it wrong.
_SURE_POSITION: Final = 0.02
# What is this much less likely widens no covariance.
_NEGLIGIBLE: Final = 1e-6
# A rival within this log ratio is named.
_RIVAL: Final = 6.0


def solve_triggers(
    observations: Sequence[Observation], rig_a: Rig, rig_b: Rig, settings: Settings
) -> list[Fix | NoFix]:
    """Solve triggers without a past, all at once."""
    readings = read_triggers(observations, rig_a, rig_b, settings)
    return [readings.decide(k, None, None) for k in range(len(observations))]


def read_triggers(observations: Sequence[Observation], rig_a: Rig, rig_b: Rig, settings: Settings) -> TriggerReadings:
    """Work out what the pictures and sensors of some triggers say, without the past."""
    for name, rig in (("A", rig_a), ("B", rig_b)):
        if not rig.usable:
            return TriggerReadings(NoFix("degenerate", f"the lights of {name} are less than 1 mm apart"))
    with _silent():
        return TriggerReadings(_Batched.of(Batch.of(observations, (rig_a, rig_b), settings)))


def _silent() -> np.errstate:
    """Silence numpy's warnings: absurd values end as infinite or NaN likelihoods, and those as rejections."""
    return np.errstate(all="ignore")


@dataclass(eq=False, slots=True)
class _Batched:
    """The readings of T triggers.

    oriented: whether both attitudes are known. three_told: whether three lights can give a pose. tried: (T,) whether
    three lights have been read.
    """

    batch: Batch
    four: FourLights
    three: Read | None
    tried: NDArray[np.bool_]
    oriented: list[bool]
    three_told: list[bool]

    @staticmethod
    def of(batch: Batch) -> _Batched:
        """Read all; of many triggers, with three lights where four may not be enough."""
        four = read_four_lights(batch)
        told = three_lights_tell(batch)
        tried = np.zeros(batch.triggers, dtype=bool)
        if batch.triggers > 1 and told.any():
            tried = told & four.doubtful(batch)
        three = read_three_lights(batch, tried) if tried.any() else None
        return _Batched(batch, four, three, tried, batch.sensors.both.tolist(), told.tolist())

    def decide(self, trigger: int, prior: Prior | None, heading: Heading | None, rarity: float = 1.0) -> Fix | NoFix:
        """Apply the past to one trigger, and choose."""
        settings = self.batch.settings
        if not self.oriented[trigger]:
            heading = None
        past = Past.of(prior, heading, self.batch.candidates.variance_of(trigger), self.batch.rigs, settings)
        four, why = None, self.four.why[trigger]
        found: Fix | NoFix
        all_four = 0.0
        if why is None:
            four = weigh_readings(self.four.read, trigger, past, settings, three=False)
            all_four = _all_four(four)
            four = four.rarer(rarity)
            found = self._choose(trigger, four, heading)
        else:
            found = NoFix(*why)
        if self.three_told[trigger] and _is_doubtful(found, four):
            read = self.three
            if read is None or not self.tried[trigger]:
                read = read_three_lights(self.batch, np.arange(self.batch.triggers) == trigger)
            if read.readings.refined.sound[read.places_of(trigger)].any():
                three = weigh_readings(read, trigger, past, settings, three=True)
                chosen = self._choose(trigger, three if four is None else four.joined(three), heading)
                # That four lights do not fit says more than that the other three tell nothing.
                if isinstance(chosen, Fix) or four is None or four.log_ratio.max() > -np.inf:
                    found = chosen
        return replace(found, all_four=all_four)

    def _choose(self, trigger: int, weighed: Weighed, learned: Heading | None) -> Fix | NoFix:
        """Publish the likeliest reading where it stands alone."""
        settings, others = self.batch.settings, weighed.others
        k = int(weighed.log_ratio.argmax())
        t = weighed.T_a_b.t_m
        if weighed.log_ratio[k] == -np.inf:
            k = int((weighed.chi2 > UNFIT_CHI2).argmax())
            if weighed.chi2[k] > UNFIT_CHI2:
                return NoFix(*_why_unfit(weighed, k, "a light of another, or a gross error"))
            return NoFix("degenerate", "the directions do not determine a pose")
        range_m = math.hypot(*t[k].tolist())
        if not settings.range_min_m <= range_m <= settings.range_max_m:
            return NoFix("out_of_range", f"what agrees, at {in_metres(range_m)}, is not {self.batch.range_limits}")
        same = _like(weighed, k, range_m)
        ratio = agreeing = math.exp(weighed.log_ratio[k])
        if len(weighed) > 1:
            ratios = np.exp(weighed.log_ratio)
            agreeing = float(ratios[same].sum())
            others += float(ratios[~same].sum())
        readings, place = weighed.sources[k]
        short = int(readings.lights[place].min()) < 0
        chi2 = float(weighed.chi2[k])
        # One of four lights may be off by more than its noise; which one, two residuals cannot tell.
        widened = 0.5 * chi2 if chi2 > _GROSS_CHI2 and not short else 1.0
        sigma_m = math.sqrt(widened * float(weighed.covariance[k, :3, :3].trace()))
        unsure = sigma_m > _SURE_POSITION * range_m
        if short and unsure:
            return NoFix("ambiguous", f"three lights give {in_metres(range_m)} to {sigma_m:.2g} m only")
        # Three lights have no gap that tells a false one. Among four, it is off by as much as the covariance has been
        # widened for; what is widened for a gross error may as well be wrong by more: the lights do not fit each other.
        false_light = ratio * math.exp(weighed.log_false[k]) if short or unsure or widened > 1.0 else 0.0
        probability = agreeing / (CHANCE_ODDS + agreeing + others + false_light)
        oriented = self.oriented[trigger] and "attitude" in settings.checks
        required = settings.min_oriented_probability if oriented else settings.min_probability
        if oriented and weighed.log_prior[k] <= 0.0:
            required = max(required, _ALONE_PROBABILITY)
        if short:
            required = _THREE_PROBABILITY
            if weighed.log_prior[k] != 0.0:
                alone = agreeing / (CHANCE_ODDS + agreeing + others) >= _UNRIVALLED_PROBABILITY
                required = _FOLLOWED_PROBABILITY if alone else _UNRIVALLED_PROBABILITY
        if probability >= required:
            covariance = widened * _spread(weighed, k, same)
            against = self._against_headings(trigger, weighed, k, covariance, learned)
            if against is not None and against.contradicts:
                off_deg = math.degrees(abs(against.gap_rad))
                what = f"what agrees, at {in_metres(range_m)}, is {off_deg:.0f} deg off both headings:"
                if not against.explicable:
                    return NoFix("other_lights", f"{what} a third's bar, seen by both")
                why = "a third's bar, seen by both, or a compass that the motion has not yet shown to be off"
                return NoFix(
                    "heading", f"{what} {why}", contradiction=None if short else Contradiction(against, range_m)
                )
            return self._fix(trigger, weighed, k, covariance, probability, against)
        tilt_chi2, depth_chi2 = float(readings.tilt_chi2[place]), float(readings.depth_chi2[place])
        what = f"the best of the hypotheses, at {in_metres(range_m)},"
        if tilt_chi2 > AGREES:
            return NoFix("attitude", f"{what} is {math.sqrt(tilt_chi2):.1f} sigma off the attitudes")
        if depth_chi2 > AGREES:
            return NoFix("depth", f"{what} is {math.sqrt(depth_chi2):.1f} sigma off the depths")
        why = "one light may be a false candidate" if false_light > CHANCE_ODDS else "chance may give it"
        if widened > 1.0 and false_light > CHANCE_ODDS + others:
            return NoFix(*_why_unfit(weighed, k, why))
        rivals = np.where(same, -np.inf, weighed.log_ratio)
        rival = int(rivals.argmax())
        if rivals[rival] > weighed.log_ratio[k] - _RIVAL:
            why = f"another stands at {in_metres(math.hypot(*t[rival].tolist()))}"
        return NoFix("ambiguous", f"{what} is {_too_unlikely(probability, required)}: {why} (chi2 {chi2:.1f})")

    def _against_headings(
        self, trigger: int, weighed: Weighed, k: int, covariance: Floats, learned: Heading | None
    ) -> HeadingGap | None:
        """Compare pose k with both headings, None where they are not known or may not speak."""
        sensors = self.batch.sensors
        if not self.oriented[trigger] or "attitude" not in self.batch.settings.checks:
            return None
        R_ned_a, R_ned_b = sensors.R_ned_camera[trigger]
        gap_rad, variance = heading_offset(weighed.T_a_b[k], covariance, R_ned_a, R_ned_b)
        follows = bool(weighed.log_prior[k] > 0.0)
        north, east, _ = (R_ned_a @ weighed.T_a_b.t_m[k]).tolist()
        stated = float(sensors.heading_variance[trigger])
        return compare_headings(gap_rad, variance, math.atan2(east, north), stated, learned, follows=follows)

    def _checks(self, trigger: int, readings: Readings, place: int) -> tuple[str, ...]:
        """Name what speaks for the pose."""
        settings, sensors = self.batch.settings, self.batch.sensors
        checks: list[str] = []
        if int(readings.lights[place].min()) >= 0:
            checks += [name for name in ("range", "twist") if name in settings.checks]
        if not self.oriented[trigger] or "attitude" not in settings.checks:
            checks.append("upright_assumed")
        elif readings.tilt_chi2[place] <= AGREES:
            checks.append("attitude")
        measured = "depth" in settings.checks and math.isfinite(sensors.depth_m[trigger])
        if measured and readings.depth_chi2[place] <= AGREES:
            checks.append("depth")
        return tuple(checks)

    def _fix(
        self,
        trigger: int,
        weighed: Weighed,
        k: int,
        covariance: Floats,
        probability: float,
        heading: HeadingGap | None,
    ) -> Fix:
        """Publish reading k."""
        method = self.batch.settings.method
        readings, place = weighed.sources[k]
        T_a_b, twist_gap_rad = weighed.T_a_b[k], float(readings.twist_gap_rad[place])
        range_a_m, range_b_m = readings.range_m[place].tolist()
        b_left, b_right, a_left, a_right = readings.lights[place].tolist()
        solved = self.four.by_method
        if solved is not None:
            T_a_b, twist_gap_rad = solved.T_a_b[place], float(solved.twist_gap_rad[place])
            range_a_m, range_b_m = solved.range_m[:, place].tolist()
        in_a, in_b = self.batch.candidates.counts[trigger].tolist()
        return Fix(
            T_a_b=T_a_b,
            covariance=0.5 * (covariance + covariance.T),
            range_a_m=range_a_m,
            range_b_m=range_b_m,
            range_gap_m=range_a_m - range_b_m,
            twist_gap_rad=twist_gap_rad,
            chi2=float(weighed.chi2[k]),
            hypotheses=in_a * (in_a - 1) * in_b * (in_b - 1),
            pair_a=(b_left, b_right),
            pair_b=(a_left, a_right),
            method=method if min(b_left, b_right, a_left, a_right) >= 0 else "three_lights",
            checks=(*self._checks(trigger, readings, place), *(("heading",) if heading and heading.agrees else ())),
            probability=probability,
            heading=heading,
        )


def _is_doubtful(found: Fix | NoFix, weighed: Weighed | None) -> bool:
    """Tell whether three of the lights may tell more than four: no pose, a poor fit, or one that nobody expected."""
    if weighed is None or isinstance(found, NoFix):
        return True
    k = int(weighed.log_ratio.argmax())
    return bool(weighed.log_prior[k] < 0.0 or weighed.log_false[k] > POOR_FIT)


def _too_unlikely(probability: float, required: float) -> str:
    """Say how likely a pose is, rounded down, so that what is not enough never reads as enough."""
    return f"{math.floor(1000.0 * probability) / 10.0:g}% likely, where {100.0 * required:g}% is asked for"


def _why_unfit(weighed: Weighed, k: int, why: str) -> tuple[Reason, str]:
    """Say which gap of reading k is too large."""
    readings, place = weighed.sources[k]
    range_a_m, range_b_m = readings.range_m[place].tolist()
    in_range = abs(math.log(range_a_m / range_b_m)) > abs(float(readings.twist_gap_rad[place]))
    range_m, chi2 = math.hypot(*weighed.T_a_b.t_m[k].tolist()), float(weighed.chi2[k])
    what = f"the best of the hypotheses, at {in_metres(range_m)}, does not fit its lights (chi2 {chi2:.1f}): {why}"
    return "range_gap" if in_range else "twist_gap", what


def _all_four(weighed: Weighed) -> float:
    """Return the probability that the candidates are all four lights, by the pictures and sensors of one trigger."""
    total = float(np.exp(weighed.log_ratio - weighed.log_past).sum())
    return total / (total + CHANCE_ODDS) if math.isfinite(total) else 1.0


def _like(weighed: Weighed, k: int, range_m: float) -> NDArray[np.bool_]:
    """Tell which readings (M,) are about the same pose as reading k."""
    if len(weighed) == 1:
        return np.ones(1, dtype=bool)
    R, t = weighed.T_a_b.R, weighed.T_a_b.t_m
    near = ((t - t[k]) ** 2).sum(1) < (_SAME_POSITION * range_m) ** 2
    alike: NDArray[np.bool_] = near & (R.reshape(-1, 9) @ R[k].ravel() > _SAME_TRACE)
    return alike


def _spread(weighed: Weighed, k: int, same: NDArray[np.bool_]) -> Floats:
    """Give the covariance of pose k, which may as well be one of its near neighbours; same: (M,) whether one is."""
    covariance: Floats = weighed.covariance[k]
    if np.count_nonzero(same) < 2:
        return covariance
    # What the last poses said of near neighbours was read from pictures like this one: it does not count again.
    weights = np.where(same, np.exp(weighed.log_ratio - weighed.log_prior), 0.0)
    near = np.flatnonzero(weights > _NEGLIGIBLE * weights[k])
    away = weighed.T_a_b[near].minus(weighed.T_a_b[k])
    shares = weights[near] / weights[near].sum()
    spread: Floats = covariance + (shares[:, None] * away).T @ away
    return spread


@dataclass(eq=False, slots=True)
class TriggerReadings:
    """What the pictures and sensors of some triggers say; where the rigs cannot be used, the reason."""

    readings: _Batched | NoFix

    def decide(self, trigger: int, prior: Prior | None, heading: Heading | None, rarity: float = 1.0) -> Fix | NoFix:
        """Find the four lights of one trigger, and T_a_b from them, or say why there is none.

        prior, heading: what earlier fixes tell of this pose, and of the headings. rarity: as Rarity.factor has it.
        """
        if isinstance(self.readings, NoFix):
            return self.readings
        with _silent():
            return self.readings.decide(trigger, prior, heading, rarity)
