"""One trigger's terms: candidates, sensors, prediction and motion, all in the rigs' level frames."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.candidates import Candidates, find_candidates
from buddyline.solver_service.geometry.evidence import Prediction, Sensors, combine
from buddyline.solver_service.geometry.observation import Heading, Prior, Sensed, Settings, View
from buddyline.solver_service.geometry.refinement import Motion
from buddyline.solver_service.geometry.rig import Rig, RigPair, pair_of
from buddyline.solver_service.geometry.rotation import Floats, matrix_of

# Nobody knows a moving diver to less than a millimetre and a milliradian.
_LEAST_KNOWN: Final = 1e-6 * np.eye(6)


@dataclass(eq=False)
class Terms:
    """What a trigger is solved from."""

    rigs: RigPair
    candidates: Candidates
    sensors: Sensors
    prior: Prior | None
    motion: Motion
    settings: Settings

    @staticmethod
    def of(
        views: tuple[View, View],
        rigs: tuple[Rig, Rig],
        sensed: tuple[Sensed, Sensed],
        settings: Settings,
        prior: Prior | None,
        heading: Heading | None = None,
    ) -> Terms:
        """Bring everything into the level frames; what is not finite is as good as not there."""
        pair = pair_of(*rigs)
        candidates = find_candidates(views, pair)
        return Terms(
            rigs=pair,
            candidates=candidates,
            sensors=_sensors(pair.levels, sensed, heading),
            prior=prior,
            motion=_motion(prior, rigs[0], settings),
            settings=settings,
        )

    @cached_property
    def prediction(self) -> Prediction | None:
        """What earlier poses say; only asked for where there are hypotheses to weigh."""
        return _prediction(self.prior, self.rigs, self.candidates, self.settings)

    @property
    def range_limits(self) -> str:
        """The range limits in words."""
        return f"between {self.settings.range_min_m:g} and {self.settings.range_max_m:g} m"


def _finite(value: Floats | None, shape: tuple[int, ...]) -> Floats | None:
    """Give an array of this shape and finite numbers, None for everything else."""
    if value is None:
        return None
    array = np.asarray(value, dtype=np.float64)
    return array if array.shape == shape and math.isfinite(sum(array.ravel().tolist())) else None


def _sensors(levels: tuple[Rig, Rig], sensed: tuple[Sensed, Sensed], heading: Heading | None) -> Sensors:
    attitudes: list[Floats | None] = []
    for one in sensed:
        q = _finite(one.q_ned_body_xyzw, (4,))
        attitudes.append(q if q is not None and math.hypot(*q.tolist()) > 0.5 else None)
    sigmas = [_finite(one.sigma_rad, (3,)) for one in sensed]
    depth_a_m, depth_b_m = sensed[0].depth_m, sensed[1].depth_m
    depth_m, variance = None, 0.0
    if depth_a_m is not None and depth_b_m is not None and math.isfinite(depth_b_m - depth_a_m):
        depth_m = depth_b_m - depth_a_m
        for one in sensed:
            sigma_m = one.depth_sigma_m
            variance += sigma_m**2 if sigma_m is not None and math.isfinite(sigma_m) else 0.0
    return combine(levels, (attitudes[0], attitudes[1]), (sigmas[0], sigmas[1]), depth_m, variance, heading)


def _prediction(prior: Prior | None, pair: RigPair, candidates: Candidates, settings: Settings) -> Prediction | None:
    if prior is None or not candidates.variance.size:
        return None
    t, q, covariance = _finite(prior.t_a_b_m, (3,)), _finite(prior.q_a_b_xyzw, (4,)), _finite(prior.covariance, (6, 6))
    if t is None or q is None or covariance is None or not q @ q > 0.25:
        return None
    rig_a, rig_b = pair.rigs
    turn_a, turn_b, both = rig_a.R_level_camera, rig_b.R_level_camera, rig_a.both_level_camera
    covariance = both @ covariance @ both.T + _LEAST_KNOWN
    noise = float(np.add.reduce(candidates.variance)) / len(candidates.variance)
    return Prediction.of(turn_a @ t, turn_a @ matrix_of(q) @ turn_b.T, covariance, noise, pair, settings)


def _motion(prior: Prior | None, rig_a: Rig, settings: Settings) -> Motion:
    rates = _finite(prior.rates, (6,)) if prior is not None else None
    covariance = _finite(prior.rates_covariance, (6, 6)) if prior is not None else None
    if rates is None or covariance is None:
        return _unknown_motion(settings.speed_mps, settings.turn_radps, settings.skew_sigma_s)
    both = rig_a.both_level_camera
    return Motion(both @ rates, both @ covariance @ both.T, settings.skew_sigma_s)


@lru_cache(maxsize=16)
def _unknown_motion(speed_mps: float, turn_radps: float, skew_sigma_s: float) -> Motion:
    """Alike in all directions: the same in every frame."""
    motion = Motion(np.zeros(6), np.diag(np.repeat((speed_mps**2, turn_radps**2), 3)), skew_sigma_s)
    motion.rates.flags.writeable = motion.covariance.flags.writeable = False
    return motion
