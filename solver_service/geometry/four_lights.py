"""All four lights seen: eight coordinates for six unknowns, the redundant two being the gaps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.batch import Batch
from buddyline.solver_service.geometry.closed_form import Bars, ClosedForm, closed_form, solve_exact
from buddyline.solver_service.geometry.evidence import (
    CHANCE_ODDS,
    POOR_FIT,
    Support,
    log_chance,
    log_false_light,
    log_gaps,
    weigh,
)
from buddyline.solver_service.geometry.fix import in_metres
from buddyline.solver_service.geometry.observation import Reason
from buddyline.solver_service.geometry.quads import Quads, find_quads
from buddyline.solver_service.geometry.ragged import largest, rank, starts_of
from buddyline.solver_service.geometry.readings import Poses, Read, Readings
from buddyline.solver_service.geometry.refinement import Refined, light_rows, refine
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats, Index, Indices, inner
from buddyline.solver_service.geometry.se3 import SE3
from numpy.typing import NDArray

# At most this many of the best are refined, and none whose log ratio is further below the best one's: the past cannot
# make up for that.
_REFINED: Final = 8
_NEGLIGIBLE: Final = 16.0
# Two rounds leave an error below the noise, and the refinement removes it.
_SPLIT_ROUNDS: Final = 2
# Bars whose middle is nearer to the camera than this, relative to their length, need only one round.
_SMALL_OFFSET: Final = 0.02


@dataclass(eq=False, slots=True)
class FourLights:
    """The quads of T triggers, of which the best are read.

    why: the reason, where a trigger has no reading. by_method: the readings' poses by the closed form that the settings
    name; None where the refined poses are published.
    """

    read: Read
    why: list[tuple[Reason, str] | None]
    by_method: ClosedForm | None

    def doubtful(self, batch: Batch) -> NDArray[np.bool_]:
        """Tell in which triggers (T,) no reading is likely enough by pictures and sensors alone, or fits poorly."""
        settings, triggers, readings = batch.settings, batch.triggers, self.read.readings
        trigger = np.arange(triggers).repeat(self.read.starts[1:] - self.read.starts[:-1])
        fit = log_gaps(readings.refined.solved.chi2, settings.gaps)
        log_ratio = readings.log_ratio + fit
        log_ratio[~readings.refined.sound] = -np.inf
        best = largest(trigger, log_ratio, triggers, -np.inf)
        total = np.bincount(trigger, np.exp(log_ratio), minlength=triggers)
        poor = (log_ratio == best[trigger]) & (log_false_light(fit, readings.clutter) > POOR_FIT)
        unlikely = ~(np.exp(best) > settings.min_probability * (CHANCE_ODDS + total))
        return unlikely | (np.bincount(trigger[poor], minlength=triggers) > 0)


def read_four_lights(batch: Batch) -> FourLights:
    """Search, weigh and refine."""
    settings, rigs = batch.settings, batch.rigs
    variance = _motion_variance(batch)
    quads, near = find_quads(batch.candidates, batch.pairs, rigs, variance, settings)
    solved = solve_exact(
        quads.spans, Bars.of(rigs), split_rounds=_SPLIT_ROUNDS, offset_rounds=1 if _centred(rigs) else 4
    )
    T_a_b = rigs.between_cameras(solved.T_a_b)
    support = weigh(T_a_b, quads.trigger, quads.variance, rigs, batch.sensors)
    base = support.log_ratio + quads.log_weight + log_chance(rigs, batch.candidates.in_whole, settings)[quads.trigger]
    if "attitude" not in settings.checks:
        # The reading is upright; of half a turn nothing is known.
        base -= math.log(math.pi)
    base -= 0.5 * settings.gaps * np.log(2.0 * math.pi * quads.variance)
    gap_chi2 = _gap_chi2(batch, solved, quads.variance)
    range2 = inner(T_a_b.t_m, T_a_b.t_m)
    log_ratio = base + log_gaps(gap_chi2, settings.gaps)
    inside = (range2 >= settings.range_min_m**2) & (range2 <= settings.range_max_m**2) & np.isfinite(log_ratio)
    log_ratio[~inside] = -np.inf
    order, place = rank(quads.trigger, -log_ratio, batch.triggers)
    trigger, ranked = quads.trigger[order], log_ratio[order]
    likeliest = largest(trigger, ranked, batch.triggers, -np.inf)
    best = order[(place < _REFINED) & (ranked > likeliest[trigger] - _NEGLIGIBLE)]
    frames = batch.candidates.frames[quads.lights[:, best].T]
    refined = refine_lights(T_a_b[best], frames, rigs.lights_in_camera_m)
    readings = _readings(batch, quads, solved, support, base, gap_chi2, best, refined)
    return FourLights(
        read=Read(
            pose_starts=starts_of(np.bincount(quads.trigger, minlength=batch.triggers)),
            poses=Poses(T_a_b, log_ratio, support.turn, support.log_each[1], 0.25 * quads.variance),
            starts=starts_of(np.bincount(quads.trigger[best], minlength=batch.triggers)),
            pose=best,
            readings=readings,
        ),
        why=[
            _why_none(batch, i, bool(near[i]), range2[quads.trigger == i]) if likeliest[i] == -np.inf else None
            for i in range(batch.triggers)
        ],
        by_method=_by_method(batch, quads.lights[:, best]),
    )


def _why_none(batch: Batch, trigger: int, near: bool, range2: Floats) -> tuple[Reason, str]:
    """Say why a trigger has no reading; range2: of its quads."""
    in_a, in_b = batch.candidates.counts[trigger]
    if min(in_a, in_b) < 2:
        return "too_few_candidates", f"{in_a} candidates in A's picture, {in_b} in B's: not 2 each"
    pairs_a, pairs_b = batch.pairs.counts[trigger]
    if not min(pairs_a, pairs_b):
        return "out_of_range", f"no two candidates stand as far apart as the lights would {batch.range_limits}"
    if len(range2):
        return "out_of_range", f"what agrees, at {in_metres(math.sqrt(range2[0]))}, is not {batch.range_limits}"
    combinations = f"{pairs_a} pairs in A's picture and {pairs_b} in B's"
    if near or "range" not in batch.settings.checks:
        return "twist_gap", f"no two of {combinations} have the same twist where their ranges agree"
    return "range_gap", f"no two of {combinations} have the same range"


def _gap_chi2(batch: Batch, solved: ClosedForm, variance: Floats) -> Floats:
    """Give chi^2 (K,) of the gaps that may speak."""
    total = np.zeros(len(variance))
    if "range" in batch.settings.checks:
        total += np.log(solved.range_m[0] / solved.range_m[1]) ** 2
    if "twist" in batch.settings.checks:
        total += solved.twist_gap_rad**2
    chi2: Floats = total / variance
    return chi2


def _readings(
    batch: Batch,
    quads: Quads,
    solved: ClosedForm,
    support: Support,
    base: Floats,
    gap_chi2: Floats,
    best: Indices,
    refined: Refined,
) -> Readings:
    """Put together what is known of the best quads (M,)."""
    seen, rigs = batch.candidates, batch.rigs
    lights = quads.lights[:, best].T
    counts = seen.in_whole[quads.trigger[best]].repeat(2, 1)
    clutter = inner(seen.sigma_px[lights] ** 2, counts / rigs.area_px2.repeat(2))
    return Readings(
        lights=seen.index[lights],
        refined=refined,
        dt_s=seen.dt_s[lights].repeat(2, 1),
        log_ratio=base[best],
        tilt_chi2=support.chi2[0, best],
        depth_chi2=support.chi2[2, best],
        gap_chi2=gap_chi2[best],
        range_m=solved.range_m[:, best].T,
        twist_gap_rad=solved.twist_gap_rad[best],
        clutter=clutter if batch.settings.gaps == 2 else np.zeros(len(best)),
        lone_odds=np.zeros(len(best)),
        lone_density=np.zeros(len(best)),
    )


def _by_method(batch: Batch, lights: Indices) -> ClosedForm | None:
    """Solve lights (4, M) by the method that the settings name."""
    if batch.settings.method == "refined":
        return None
    # (3, 4, M) into both views' left and right lights (2, 3, M), camera frames.
    ends = batch.candidates.bearing[:, lights].reshape(3, 2, 2, -1).transpose(2, 1, 0, 3)
    left, right = batch.rigs.R_bar_camera.swapaxes(1, 2) @ ends
    return closed_form(left, right, *batch.rigs.rigs, batch.settings.method)


def refine_lights(T_a_b: SE3, frames: Floats, lights_m: Floats) -> Refined:
    """Refine K poses by their lights alone; frames, lights_m: as `light_rows` takes them."""

    def rows_at(T_a_b: SE3, chosen: Index) -> tuple[Floats, Floats]:
        return light_rows(T_a_b, frames[chosen], lights_m)

    return refine(T_a_b, rows_at)


def _motion_variance(batch: Batch) -> Floats:
    """Give what relative motion between the exposures may add to ln range and twist, rad^2: (P,), for pairs of A's."""
    seen, settings, pairs = batch.candidates, batch.settings, batch.pairs
    if settings.still and not seen.dt_s.any():
        return np.zeros(len(pairs.chord))
    total_s = np.bincount(seen.image, seen.dt_s, minlength=2 * batch.triggers).reshape(-1, 2)
    mean_s = total_s / np.maximum(seen.counts, 1)
    square_s2 = (mean_s[:, 0] - mean_s[:, 1]) ** 2 + settings.skew_sigma_s**2 + 2.0 * settings.stamp_sigma_s**2
    speed_per_chord_mps = settings.speed_mps / float(batch.rigs.length_m[1])
    variance: Floats = square_s2[pairs.trigger] * ((speed_per_chord_mps * pairs.chord) ** 2 + settings.turn_radps**2)
    return variance


def _centred(rigs: RigPair) -> bool:
    """Tell whether one round of moving the bearings to the bars' middles is enough."""
    return rigs.offset_m < _SMALL_OFFSET * float(rigs.length_m.min())
