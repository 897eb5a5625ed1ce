"""What earlier fixes say of a trigger: where B is, how it moves, how far the headings are off.

All of it is applied to readings that the pictures and sensors of the trigger have given without it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.evidence import weigh_heading
from buddyline.solver_service.geometry.observation import Heading, Prior, Settings
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats, Indices, inner, skew
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.sensors import off_rad

# Nobody knows a moving diver to less than a millimetre and a milliradian.
_LEAST_KNOWN: Final = 1e-6 * np.eye(6)
# So large a variance of ln range, and of the twist (rad^2), tells nothing; a larger one would only spoil the inverse.
_UNKNOWN: Final = 1e4
# A prediction from earlier fixes is wrong this often. Where it is right, the predicted pose gains this much at most
# (log), and a pose beside it less: with one bound for all poses near it, a false light close to the right one would
# gain as much as the right one.
_PRIOR_WRONG: Final = 0.15
_MAX_LOG_PRIOR: Final = 7.0
# Divers swim and turn no faster than this: a pose further from the prediction is wrong, or all earlier fixes are, and
# each that agreed with those before makes that less likely by _PRIOR_WRONG, up to so many.
_REACH_MPS: Final = 2.0
_REACH_RADPS: Final = 3.0
_MOST_AGREED: Final = 5
# So large a variance, in units of the noise, leaves nothing of a residual.
_UNTOLD: Final = 1e12
# A matrix (9,) times this: half its antisymmetric part as a vector, and its trace.
_SINES_AND_TRACE: Final = np.column_stack((0.5 * skew(np.eye(3)).reshape(3, 9).T, np.eye(3).ravel()))


@dataclass(eq=False)
class Motion:
    """How the pose moves: d/dt of t_a_b (m/s), then of the small rotation w (rad/s), in A's axes.

    rates: (6,), covariance: (6, 6). skew_sigma_s, stamp_sigma_s: as of Settings.
    """

    rates: Floats
    covariance: Floats
    skew_sigma_s: float
    stamp_sigma_s: float

    @staticmethod
    def of(prior: Prior | None, settings: Settings) -> Motion:
        """Take what is predicted, or what a pair may do."""
        rates, covariance = (None, None) if prior is None else (prior.rates, prior.rates_covariance)
        if rates is None or covariance is None:
            speed2, turn2 = settings.speed_mps**2, settings.turn_radps**2
            rates, covariance = np.zeros(6), np.diag((speed2, speed2, speed2, turn2, turn2, turn2))
        return Motion(rates, covariance, settings.skew_sigma_s, settings.stamp_sigma_s)


@dataclass(eq=False, slots=True)
class Prediction:
    """Where earlier fixes put this one: T_a_b, and the information (6, 6) of a pose against it.

    log_gain: of a pose that is exactly there, against chance, at most _MAX_LOG_PRIOR. reach_m: how far the nodes may
    have moved otherwise. all_wrong: how likely all of the earlier fixes are wrong.
    """

    T_a_b: SE3
    information: Floats
    log_gain: float
    reach_m: float
    all_wrong: float

    @staticmethod
    def of(prior: Prior, bearing_variance: float, rigs: RigPair, settings: Settings) -> Prediction:
        """Take a prediction; bearing_variance: rad^2, by which a pose found there scatters on top of it.

        Raises ArithmeticError or LinAlgError where values that are not numbers leave no finite information.
        """
        t = prior.T_a_b.t_m
        range2 = float(t @ t) + 1e-6
        sight = t[:, None] * t / range2
        # Of ln range and of the twist, by both pictures.
        relative = min(bearing_variance * range2 * rigs.gap_per_bearing_m2, _UNKNOWN)
        total = prior.covariance + _LEAST_KNOWN
        total[:3, :3] += relative * range2 * sight
        total[3:, 3:] += relative * sight
        spread = math.log(settings.range_max_m / settings.range_min_m)
        # Chance puts a pose anywhere in both pictures, at any range and twist.
        log_chance = -math.log(range2**1.5 * spread * rigs.views_sr2 * 2.0 * math.pi)
        log_area = 0.5 * float(np.linalg.slogdet(total)[1]) + 3.0 * math.log(2.0 * math.pi)
        information: Floats = np.asarray(np.linalg.inv(total), dtype=np.float64)
        if not np.isfinite(information).all():
            raise ArithmeticError("what earlier poses tell is not finite")
        log_gain = min(-log_area - log_chance, _MAX_LOG_PRIOR)
        sigma_m = math.sqrt(float(np.trace(total[:3, :3])))
        reach_m = (_REACH_MPS + _REACH_RADPS * math.sqrt(range2)) * prior.since_s + 4.0 * sigma_m
        all_wrong = _PRIOR_WRONG ** (1 + min(prior.agreed, _MOST_AGREED))
        return Prediction(prior.T_a_b, information, log_gain, reach_m, all_wrong)

    def weigh(self, T_a_b: SE3, *, three: bool) -> Floats:
        """Weigh K poses between the cameras' frames: give a bounded gain and a bounded loss (log), (K,).

        three: whether they are of three lights. Then all_wrong does not count: no gap checks such a pose, and rivals
        out of reach show how far chance may go.
        """
        off, trace = self._off(T_a_b)
        chi2 = np.where(trace > 1.0, inner(off @ self.information, off), np.inf)
        in_reach = inner(off[:, :3], off[:, :3]) < self.reach_m**2
        wrong = np.where(in_reach | three, _PRIOR_WRONG, self.all_wrong)
        gain: Floats = np.log(wrong + (1.0 - _PRIOR_WRONG) * np.exp(self.log_gain - 0.5 * chi2))
        return gain

    def weigh_lone(self, T_a_b: SE3, rows: Floats, noise: Floats | None, lone: Indices, density: Floats) -> Floats:
        """Give what the prediction adds (log) to the density of the only light of a node, K poses of three lights.

        That the other node's two lights agree with the prediction says nothing of it. rows: (K, n, 7) at T_a_b, of
        lights and sensors, noise (K, n, n) of them. lone: (K, 2) its rows. density: (K,) of it, per square of its
        sigma, by the other lights, tilts and headings.
        """
        k, n = np.arange(len(rows))[:, None], rows.shape[1]
        N = np.tile(np.eye(n), (len(rows), 1, 1)) if noise is None else noise.copy()
        own = N[k[..., None], lone[:, :, None], lone[:, None]]
        # Nothing is foretold by the light itself.
        N[k, lone, lone] += _UNTOLD
        J, r = rows[:, :, :6], rows[:, :, 6:]
        weighted = J.swapaxes(1, 2) @ np.linalg.inv(N)
        covariance = np.linalg.inv(weighted @ J + self.information)
        off, trace = self._off(T_a_b)
        step = -covariance @ (weighted @ r + self.information @ off[:, :, None])
        J, r = J[k, lone], r[k, lone]
        left, spread = r + J @ step, own + J @ covariance @ J.swapaxes(1, 2)
        chi2 = (left.swapaxes(1, 2) @ np.linalg.solve(spread, left))[:, 0, 0]
        foretold = np.exp(-0.5 * chi2) / (2.0 * math.pi * np.sqrt(np.linalg.det(spread)))
        foretold = np.where(trace > 1.0, foretold, 0.0)
        gain: Floats = np.log(_PRIOR_WRONG + (1.0 - _PRIOR_WRONG) * foretold / density)
        return gain

    def _off(self, T_a_b: SE3) -> tuple[Floats, Floats]:
        """Give how far K poses are from the prediction, and the trace of the turn from there.

        (K, 6) m and the sines about each axis; half a turn away the sine is short again.
        """
        turned = (T_a_b.R @ self.T_a_b.R.T).reshape(-1, 9) @ _SINES_AND_TRACE
        return np.concatenate((T_a_b.t_m - self.T_a_b.t_m, turned[:, :3]), axis=1), turned[:, 3]


@dataclass(eq=False, slots=True)
class Past:
    """What earlier fixes say of one trigger."""

    prediction: Prediction | None
    heading: Heading | None
    prior: Prior | None
    settings: Settings

    @staticmethod
    def of(
        prior: Prior | None, heading: Heading | None, bearing_variance: float, rigs: RigPair, settings: Settings
    ) -> Past:
        """Take the prediction, None where there is none, and what is learned of the headings."""
        prediction = None if prior is None else Prediction.of(prior, bearing_variance, rigs, settings)
        return Past(prediction, heading, prior, settings)

    @property
    def motion(self) -> Motion:
        """How the pose moves."""
        return Motion.of(self.prior, self.settings)

    def weigh(self, T_a_b: SE3, *, three: bool) -> Floats:
        """Weigh K poses between the cameras' frames by the prediction; three: whether they are of three lights."""
        return np.zeros(len(T_a_b)) if self.prediction is None else self.prediction.weigh(T_a_b, three=three)

    def weigh_lone(self, T_a_b: SE3, rows: Floats, noise: Floats | None, lone: Indices, density: Floats) -> Floats:
        """Give what the prediction adds to the density of the only lights of a node (K,), 0 without a prediction."""
        if self.prediction is None:
            return np.zeros(len(T_a_b))
        return self.prediction.weigh_lone(T_a_b, rows, noise, lone, density)

    def weigh_heading(self, turn: Floats, log_heading: Floats, variance: Floats) -> Floats:
        """Give what the learned heading adds (K,), in place of the sensors' own word of their headings, log_heading.

        turn: (3, K) as `turn_of`'s. variance: (K,) of it by the pictures.
        """
        if self.heading is None:
            return np.zeros(len(log_heading))
        angle_rad = off_rad(turn, self.heading.offset_rad)
        return weigh_heading(angle_rad, self.heading.variance + variance) - log_heading
