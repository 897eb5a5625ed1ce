"""Readings of one trigger with what the past says: ready to choose from."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.evidence import UNFIT_CHI2, log_false_light, log_gaps
from buddyline.solver_service.geometry.observation import Settings
from buddyline.solver_service.geometry.past import Past
from buddyline.solver_service.geometry.readings import Read, Readings
from buddyline.solver_service.geometry.refinement import at_one_instant, least_squares
from buddyline.solver_service.geometry.rotation import Floats, Indices
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.three_lights import UNCHECKED, log_fit

# At most this many of the best are weighed against each other, and none whose log ratio is further below the best's.
_CHOSEN: Final = 6
_NEGLIGIBLE: Final = 16.0
# Which residuals a later clock of B moves, and where to: A's picture of B's lights, B's of A's, then the sensors.
_SKEW_SIGN: Final = np.array((1.0,) * 4 + (-1.0,) * 4 + (0.0,) * 3)


@dataclass(eq=False, slots=True)
class Weighed:
    """M readings of one trigger, poses between the cameras' frames.

    covariance (M, 6, 6), chi2 (M,). log_ratio: (M,) against chance, -inf where the pose is not sound, or its four
    lights do not fit. log_prior: (M,) the prediction's part in it, log_past (M,) all that the past says. log_false:
    (M,) log odds that a false candidate stands in for one of four lights, or for the only light of a node. others: the
    sum of the likelihood ratios of all that is not here. sources: the readings that each is one of, and its place
    there.
    """

    T_a_b: SE3
    covariance: Floats
    chi2: Floats
    log_ratio: Floats
    log_prior: Floats
    log_past: Floats
    log_false: Floats
    others: float
    sources: list[tuple[Readings, int]]

    def __len__(self) -> int:
        """Count them."""
        return len(self.sources)

    def rarer(self, rarity: float) -> Weighed:
        """Give readings of four lights where these are found so many times more rarely than usual."""
        if rarity == 1.0:
            return self
        log_rarity = math.log(rarity)
        # That one of them is a false candidate is as likely as before.
        return replace(
            self,
            log_ratio=self.log_ratio - log_rarity,
            log_false=self.log_false + log_rarity,
            others=self.others / rarity,
        )

    def joined(self, more: Weighed) -> Weighed:
        """Give both together, these first."""

        def both(mine: Floats, others: Floats) -> Floats:
            return np.concatenate((mine, others))

        return Weighed(
            T_a_b=SE3(both(self.T_a_b.R, more.T_a_b.R), both(self.T_a_b.t_m, more.T_a_b.t_m)),
            covariance=both(self.covariance, more.covariance),
            chi2=both(self.chi2, more.chi2),
            log_ratio=both(self.log_ratio, more.log_ratio),
            log_prior=both(self.log_prior, more.log_prior),
            log_past=both(self.log_past, more.log_past),
            log_false=both(self.log_false, more.log_false),
            others=self.others + more.others,
            sources=self.sources + more.sources,
        )


def weigh_readings(read: Read, trigger: int, past: Past, settings: Settings, *, three: bool) -> Weighed:
    """Apply the past to the readings of one trigger; three: of three lights, so that no gap is left."""
    poses, of_trigger, places = read.poses, read.poses_of(trigger), read.places_of(trigger)
    log_prior = past.weigh(poses.T_a_b[of_trigger], three=three)
    log_past = log_prior
    if past.heading is not None and "attitude" in settings.checks:
        turned = poses.turn[:, of_trigger], poses.log_heading[of_trigger], poses.turn_variance[of_trigger]
        log_past = log_prior + past.weigh_heading(*turned)
    so_far = poses.log_ratio[of_trigger] + log_past
    read_at = read.pose[places] - of_trigger.start
    chosen = _likeliest(so_far, read_at)
    pose, place = read_at[chosen], places.start + chosen
    others = 0.0
    if not three and len(pose) < len(so_far):
        ratios = np.exp(so_far)
        ratios[pose] = 0.0
        others = float(ratios.sum())
    log_prior, log_past = log_prior[pose], log_past[pose]
    readings = read.readings
    rows, noise = _rows(readings, place, past)
    solved = readings.refined.solved[place] if noise is None else least_squares(rows, noise)
    chi2, covariance = solved.chi2, solved.covariance
    sound = readings.refined.sound[place]
    if three:
        fit = log_fit(solved)
        covariance = UNCHECKED * covariance
        # A learned heading stands for the sensors' own, in the light's density without the prediction.
        learned = log_past - log_prior
        density = readings.lone_density[place] * np.exp(learned)
        foretold = past.weigh_lone(readings.refined.T_a_b[place], rows, noise, _lone(readings.lights[place]), density)
        log_false = np.log(readings.lone_odds[place]) - learned - foretold
        sound = sound & ~np.isnan(log_false)
    else:
        # Without both gaps the picture's chi2 would bring in what the settings leave out.
        chi2 = chi2 if settings.gaps == 2 else readings.gap_chi2[place]
        fit = log_gaps(chi2, settings.gaps)
        sound = sound & (chi2 < UNFIT_CHI2)
        log_false = log_false_light(fit, readings.clutter[place])
    log_ratio = readings.log_ratio[place] + fit + log_past
    log_ratio[~(sound & np.isfinite(log_ratio))] = -np.inf
    return Weighed(
        T_a_b=readings.refined.T_a_b[place].retract(solved.step),
        covariance=covariance,
        chi2=chi2,
        log_ratio=log_ratio,
        log_prior=log_prior,
        log_past=log_past,
        log_false=log_false,
        others=others,
        sources=[(readings, k) for k in place.tolist()],
    )


def _likeliest(log_ratio: Floats, read_at: Indices) -> Indices:
    """Give those of the readings that are worth solving for the motion, the likeliest first.

    log_ratio: (K,) of all poses. read_at: (M,) the readings' poses among them.
    """
    if len(read_at) == 1:
        return np.zeros(1, dtype=np.intp)
    order = (-log_ratio[read_at]).argsort(kind="stable")[:_CHOSEN]
    likely = log_ratio[read_at[order]] > log_ratio.max() - _NEGLIGIBLE
    likely[0] = True
    chosen: Indices = order[likely]
    return chosen


def _rows(readings: Readings, place: Indices, past: Past) -> tuple[Floats, Floats | None]:
    """Give the readings' rows (M, n, 7) and their residuals' covariance (M, n, n), for what is known of the motion.

    None in its place: of unit noise.
    """
    rows, dt_s = readings.refined.rows[place], readings.dt_s[place]
    if past.settings.still and not dt_s.any():
        return rows, None
    return at_one_instant(rows, dt_s, _SKEW_SIGN[: rows.shape[1]], past.motion)


def _lone(lights: Indices) -> Indices:
    """Give the two rows (M, 2) of the light whose bar's other one is not among lights (M, 4)."""
    missing = lights.argmin(1)
    rows: Indices = 2 * (missing ^ 1)[:, None] + np.arange(2)
    return rows
