"""Readings of one trigger with what the past says: ready to choose from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.evidence import log_gaps
from buddyline.solver_service.geometry.observation import Settings
from buddyline.solver_service.geometry.past import Past
from buddyline.solver_service.geometry.readings import Poses, Readings
from buddyline.solver_service.geometry.rotation import Floats, Indices
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.three_lights import UNCHECKED, log_fit

# So many of the best are weighed against each other; what lies further below the best (log ratio) does not matter.
_CHOSEN: Final = 6
_NEGLIGIBLE: Final = 16.0


@dataclass(eq=False, slots=True)
class Weighed:
    """M readings of one trigger, poses between the cameras' frames.

    covariance (M, 6, 6), chi2 (M,). log_ratio: (M,) against chance, -inf where the pose is not sound. log_prior: (M,)
    the prediction's part in it. others: the likelihood ratios of all that is not here, together. Else as in Readings.
    """

    T_a_b: SE3
    covariance: Floats
    chi2: Floats
    log_ratio: Floats
    log_prior: Floats
    lights: Indices
    tilt_chi2: Floats
    depth_chi2: Floats
    range_m: Floats
    twist_gap_rad: Floats
    clutter: Floats
    lone_odds: Floats
    others: float

    def __len__(self) -> int:
        """Count them."""
        return len(self.log_ratio)

    def joined(self, more: Weighed) -> Weighed:
        """Give both together, these first."""

        def both(name: str) -> Floats:
            return np.concatenate((getattr(self, name), getattr(more, name)))

        T_a_b = SE3(
            np.concatenate((self.T_a_b.R, more.T_a_b.R)),
            np.concatenate((self.T_a_b.t_m, more.T_a_b.t_m)),
        )
        rest = {name: both(name) for name in self.__slots__ if name not in ("T_a_b", "others")}
        return Weighed(T_a_b=T_a_b, others=self.others + more.others, **rest)  # type: ignore[arg-type]


def weigh_readings(poses: Poses, readings: Readings, past: Past, settings: Settings, *, three: bool) -> Weighed:
    """Apply the past to the readings of one trigger; poses: of these first, then of the quads that were not refined.

    three: whether only three of the lights are seen, so that no gap is left.
    """
    log_prior = past.weigh(poses.T_a_b)
    log_past = log_prior
    if past.heading is not None and "attitude" in settings.checks:
        log_past = log_prior + past.weigh_turn(poses.turn, poses.sensed_variance, poses.picture_variance)
    so_far = poses.log_ratio + log_past
    chosen = _likeliest(so_far[: len(readings)], float(so_far.max()))
    others = 0.0
    if not three:
        ratios = np.exp(so_far)
        ratios[chosen] = 0.0
        others = float(ratios.sum())
    readings, log_prior, log_past = readings[chosen], log_prior[chosen], log_past[chosen]
    solved = readings.solve(past.motion)
    chi2, covariance, lone_odds = solved.chi2, solved.covariance, readings.lone_odds
    if three:
        fit = log_fit(solved)
        covariance = UNCHECKED * covariance
        lone_odds = lone_odds * np.exp(-log_past)
    else:
        # Without both gaps the picture's chi2 would bring in what the settings leave out.
        chi2 = chi2 if settings.gaps == 2 else readings.gap_chi2
        fit = log_gaps(chi2, settings.gaps)
    log_ratio = readings.log_ratio + fit + log_past
    return Weighed(
        T_a_b=readings.T_a_b.retract(solved.step),
        covariance=covariance,
        chi2=chi2,
        log_ratio=np.where(readings.sound & np.isfinite(log_ratio), log_ratio, -np.inf),
        log_prior=log_prior,
        lights=readings.lights,
        tilt_chi2=readings.tilt_chi2,
        depth_chi2=readings.depth_chi2,
        range_m=readings.range_m,
        twist_gap_rad=readings.twist_gap_rad,
        clutter=readings.clutter,
        lone_odds=lone_odds,
        others=others,
    )


def _likeliest(log_ratio: Floats, likeliest: float) -> Indices:
    """Give the readings, the likeliest first, that are worth solving for the motion."""
    order = (-log_ratio).argsort(kind="stable")[:_CHOSEN]
    return order[log_ratio[order] > likeliest - _NEGLIGIBLE]
