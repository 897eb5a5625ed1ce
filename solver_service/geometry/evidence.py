"""How much likelier the pictures and sensors are if four candidates are the lights than if they are chance.

Logarithms of likelihood ratios, natural, against candidates that fall independently and evenly on the picture.
Under that null the ratios of all hypotheses of a trigger add up to one on average, whatever their number: a
hypothesis stands out only where it beats what so many candidates give by chance.

The four coordinates that two pairs of lights leave after their directions are ln l_A, ln l_B, tau_A and tau_B.
Chance spreads them as alpha^2 d(ln l) d(tau) per pair; a true pair has one range and one twist, so that both
gaps are noise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.closed_form import dot
from buddyline.solver_service.geometry.observation import Heading, Settings
from buddyline.solver_service.geometry.rig import Rig, RigPair
from buddyline.solver_service.geometry.rotation import Floats, matrix_of, rotation_exp, skew
from buddyline.solver_service.geometry.scalars import EIGHTH, HALF, MINUS_TWO, ONE, QUARTER, TURN, TWO, scalar

# One light in ten quadruples stands off by a gross error, five times its noise.
GROSS_PROBABILITY: Final = 0.1
GROSS_SCALE: Final = 5.0
# A tilt that contradicts the pictures is a broken sensor this often, a heading more often: steel stands beside it.
_TILT_BROKEN: Final = 1e-5
_HEADING_BROKEN: Final = 0.15
_DEPTH_BROKEN: Final = 0.02
# Added to what the sensors say of themselves: mount, and a heading's slow bias.
_MOUNT_SIGMA_RAD: Final = math.radians(1.0)
_HEADING_SIGMA_RAD: Final = math.radians(3.0)
_DEFAULT_SIGMA_RAD: Final = (math.radians(2.0), math.radians(2.0), math.radians(10.0))
# Down alone, no turn at all, and a quarter about down, in NED.
_ABOUT_DOWN: Final = np.array((np.diag([0.0, 0.0, 1.0]), np.eye(3), skew(np.array([0.0, 0.0, 1.0]))))
_UPRIGHT_DOWN: Final = np.array([0.0, 1.0, 0.0])
_DEPTH_SIGMA_M: Final = 0.02
# A diver who is not known to lie otherwise is upright to about this (1 sd).
_UPRIGHT_SIGMA_RAD: Final = 0.45
# How often one light is missing, to being seen, and the other where one is; and chance alone, to all four being seen.
MISSING_ODDS: Final = 0.2
CHANCE_ODDS: Final = 0.3
# Eight coordinates leave two residuals: of a light's two, the other three leave a quarter of the variance open each.
# Seen from there, the position foretold has four times the light's own variance.
_FORETOLD_VARIANCE: Final = 4.0
# What chance gives: the spread of relative pitch (rad) and heading (rad), and of depth differences (m).
PITCH_SPREAD: Final = 1.1
HEADING_SPREAD: Final = 1.5
DEPTH_SPREAD_M: Final = 6.0
# A prediction from earlier poses is wrong this often, and where it is right it is believed this much at most (log).
_PRIOR_WRONG: Final = 0.15
_MAX_LOG_PRIOR: Final = 7.0
# Densities over what chance gives: of a sensor that works, where it is right, and of one that is broken.
_TILT_PEAK: Final = scalar(PITCH_SPREAD * (1.0 - _TILT_BROKEN) / (2.0 * math.pi))
_TILT_FLOOR: Final = scalar(PITCH_SPREAD * _TILT_BROKEN / (4.0 * math.pi))
_HEADING_PEAK: Final = scalar(HEADING_SPREAD * (1.0 - _HEADING_BROKEN))
_HEADING_FLOOR: Final = scalar(HEADING_SPREAD * _HEADING_BROKEN / (2.0 * math.pi))
_DEPTH_PEAK: Final = scalar(DEPTH_SPREAD_M * (1.0 - _DEPTH_BROKEN))
_DEPTH_FLOOR: Final = scalar(_DEPTH_BROKEN)
# Of no, one and both gaps: log densities without and with a gross error, where they are right.
_LOG_USUAL: Final = scalar(math.log(1.0 - GROSS_PROBABILITY))
_LOG_GROSS: Final = tuple(scalar(math.log(GROSS_PROBABILITY * GROSS_SCALE**-gaps)) for gaps in range(3))
_GROSS_SLOPE: Final = scalar(0.5 / GROSS_SCALE**2)
_MINUS_HALF: Final = scalar(-0.5)
# The matrices whose products with a rotation, summed, are the vector part sin(angle) axis, and the trace.
_TURNS: Final = np.concatenate((0.5 * skew(np.eye(3)), np.eye(3)[None]))
# Agreement of a sensor with a pose: chi^2 below this, of one or two degrees of freedom.
AGREES: Final = 20.0


@dataclass(eq=False, slots=True)
class Sensors:
    """What attitude and depth of both nodes say, in the terms that a pose can be tried against.

    down_a, down_b: (3,) in each camera's frame. tilt_variance: of both together, rad^2. both: whether both attitudes
    are known. heading_variance: of both headings' difference. depth_m: of B's port below A's, None where unknown.
    attitude_a: whether A's is known; fall_variance: of the tilt of A's down, or else of B's. turns: (3, 9), times a
    pose's R_a_b (9,): the cosine between both downs and, where both attitudes are known, the trace of the turn between
    R_a_b and them, and twice its sine about A's down.
    """

    down_a: Floats
    down_b: Floats
    tilt_variance: float
    both: bool
    heading_variance: float
    depth_m: float | None
    depth_variance: float
    attitude_a: bool
    fall_variance: float
    turns: Floats


@dataclass(eq=False, slots=True)
class Support:
    """Log likelihood ratios (K,) of hypotheses without their gaps.

    log_prior: (K,) the prediction's part. tilt_chi2, depth_chi2: (K,) by themselves.
    """

    log_ratio: Floats
    log_prior: Floats
    tilt_chi2: Floats
    depth_chi2: Floats


@dataclass(eq=False, slots=True)
class Prediction:
    """Where earlier poses put this one: t_a_b_m (3,), and the information (6, 6) of a pose against it.

    turns: (4, 9), times a pose's R_a_b (9,): the vector part of its turn R_a_b R_predicted^T, and the trace of that.
    log_gain: of a pose that is exactly there, against chance.
    """

    t_a_b_m: Floats
    turns: Floats
    information: Floats
    log_gain: float

    @staticmethod
    def of(
        t_a_b_m: Floats,
        R_a_b: Floats,
        covariance: Floats,
        bearing_variance: float,
        rigs: RigPair,
        settings: Settings,
    ) -> Prediction:
        """Take a prediction; bearing_variance: rad^2, by which a pose found there scatters on top of it."""
        range2 = float(t_a_b_m @ t_a_b_m) + 1e-6
        sight = t_a_b_m[:, None] * (t_a_b_m / range2)
        # Of ln range and of the twist, by both pictures.
        relative = bearing_variance * range2 * rigs.gap_per_bearing_m2
        total = covariance.copy()
        total[:3, :3] += relative * range2 * sight
        total[3:, 3:] += relative * sight
        spread = math.log(settings.range_max_m / settings.range_min_m)
        # Chance puts a pose anywhere in both pictures, at any range and twist.
        log_chance = -math.log(range2 * math.sqrt(range2) * spread * rigs.views_sr * 2.0 * math.pi)
        log_area = 0.5 * float(np.linalg.slogdet(total)[1]) + 3.0 * math.log(2.0 * math.pi)
        information: Floats = np.asarray(np.linalg.inv(total), dtype=np.float64)
        return Prediction(t_a_b_m, (_TURNS @ R_a_b).reshape(4, 9), information, -log_area - log_chance)


def combine(
    rigs: tuple[Rig, Rig],
    attitudes: tuple[Floats | None, Floats | None],
    sigmas_rad: tuple[Floats | None, Floats | None],
    depth_m: float | None,
    depth_variance: float,
    learned: Heading | None,
) -> Sensors:
    """Put both nodes' attitudes (body to NED) and the difference of their depths together; learned: of the headings."""
    down, tilts, heading, R_ned_camera = [], [], 0.0, []
    for rig, q_ned_body, sigma_rad in zip(rigs, attitudes, sigmas_rad, strict=True):
        if q_ned_body is None:
            down.append(_UPRIGHT_DOWN)
            tilts.append(_UPRIGHT_SIGMA_RAD**2)
            continue
        R_ned_body = _from_magnetic_north(rig, q_ned_body)
        R_ned_camera.append(R_ned_body @ rig.R_body_camera)
        down.append(R_ned_camera[-1][2])
        # Roll turns about the body's x axis, pitch about the horizontal across it, yaw about the vertical.
        steep2 = float(R_ned_body[2, 0]) ** 2
        sigma = _DEFAULT_SIGMA_RAD if sigma_rad is None else sigma_rad.tolist()
        roll2, pitch2, yaw2 = sigma[0] ** 2, sigma[1] ** 2, sigma[2] ** 2
        tilts.append(0.5 * (pitch2 + roll2 * (1.0 - steep2)) + _MOUNT_SIGMA_RAD**2)
        heading += yaw2 + roll2 * steep2 + _HEADING_SIGMA_RAD**2
    both = len(R_ned_camera) == 2
    if both:
        about_down = _ABOUT_DOWN
        if learned is not None:
            about_down = _ABOUT_DOWN @ rotation_exp(np.array([0.0, 0.0, learned.offset_rad]))
            heading = learned.variance
        turns = R_ned_camera[0].T @ (about_down @ R_ned_camera[1])
    else:
        turns = np.zeros((3, 3, 3))
        turns[0] = down[0][:, None] * down[1]
    return Sensors(
        down_a=down[0],
        down_b=down[1],
        tilt_variance=sum(tilts),
        both=both,
        heading_variance=heading,
        depth_m=depth_m if R_ned_camera else None,
        depth_variance=depth_variance + _DEPTH_SIGMA_M**2,
        attitude_a=attitudes[0] is not None,
        fall_variance=tilts[0] if attitudes[0] is not None else tilts[1],
        turns=turns.reshape(3, 9),
    )


def _from_magnetic_north(rig: Rig, q_ned_body: Floats) -> Floats:
    """Turn an attitude into its matrix, and take back what its heading has been corrected by: both count alike."""
    R_ned_body = matrix_of(q_ned_body)
    if rig.declination_rad:
        R_ned_body = rotation_exp(np.array([0.0, 0.0, -rig.declination_rad])) @ R_ned_body
    return R_ned_body


def heading_offset(
    R_a_b: Floats, rotation_covariance: Floats, rigs: tuple[Rig, Rig], attitudes: tuple[Floats, Floats]
) -> tuple[float, float]:
    """Give what is to be added to B's heading for both to agree with a pose, rad, and the pose's own variance of it.

    R_a_b: (3, 3) between the cameras' frames; rotation_covariance: (3, 3), in A's. attitudes: body to NED.
    """
    of_a, of_b = (_from_magnetic_north(*each) @ each[0].R_body_camera for each in zip(rigs, attitudes, strict=True))
    turn = of_a @ R_a_b @ of_b.T
    offset_rad = math.atan2(float(turn[1, 0] - turn[0, 1]), float(turn[0, 0] + turn[1, 1]))
    return offset_rad, float(of_a[2] @ rotation_covariance @ of_a[2])


def log_gaps(chi2: Floats, gaps: int) -> Floats:
    """Give the log density of the gaps over their sds and (2 pi)^(1/2): Gaussian, with a share of gross errors."""
    density: Floats = np.logaddexp(_LOG_USUAL - HALF * chi2, _LOG_GROSS[gaps] - _GROSS_SLOPE * chi2)
    return density


def intruder_odds(chi2: float, clutter: float) -> float:
    """Give the odds that one of four lights is missing and a false candidate stands in for it.

    chi2: of the pose. clutter: candidates that chance puts into the variance of the lights' positions. The other
    three foretell where a light stands; a false candidate falls there by chance.
    """
    usual = (1.0 - GROSS_PROBABILITY) * math.exp(-0.5 * chi2)
    gross = GROSS_PROBABILITY * GROSS_SCALE**-2 * math.exp(-0.5 * chi2 / GROSS_SCALE**2)
    return MISSING_ODDS * clutter * 2.0 * math.pi * _FORETOLD_VARIANCE / max(usual + gross, 1e-300)


@lru_cache(maxsize=64)
def log_chance(rigs: RigPair, counts: tuple[int, int], settings: Settings) -> float:
    """Give the part of the log ratio that all hypotheses of a trigger share; counts: candidates in each picture."""
    pairings = counts[0] * (counts[0] - 1) * counts[1] * (counts[1] - 1)
    # A gap that nobody looks at says what chance says: about one turn, or an e-fold of range.
    spread = math.log(settings.range_max_m / settings.range_min_m) * (2.0 * math.pi) ** (2 - settings.gaps)
    return math.log(rigs.views_sr / (pairings * spread))


def weigh(
    R_a_b: Floats,
    t_a_b_m: Floats,
    variance: Floats,
    rigs: RigPair,
    sensors: Sensors,
    prediction: Prediction | None,
    checks: frozenset[str],
) -> Support:
    """Weigh K poses R_a_b (3, 3, K), t_a_b_m (3, K) by attitude, depth and earlier poses.

    variance: (K,) of the gaps of ln range and of twist.
    """
    level, cosine, sine = sensors.turns @ R_a_b.reshape(9, -1)
    if "attitude" in checks:
        # The picture's own noise turns B about the line of sight by half the twist gap's.
        spread2 = sensors.tilt_variance + EIGHTH * variance
        tilt_chi2 = (TWO - TWO * level) / spread2
        log_ratio = np.log(_TILT_PEAK * np.exp(_MINUS_HALF * tilt_chi2) / spread2 + _TILT_FLOOR)
        if sensors.both:
            log_ratio += weigh_heading(sine, cosine, sensors.heading_variance + QUARTER * variance)
    else:
        # The reading is upright; of half a turn nothing is known.
        tilt_chi2 = np.zeros(len(variance))
        log_ratio = tilt_chi2 - math.log(math.pi)
    depth_chi2 = np.zeros(len(variance))
    if sensors.depth_m is not None and "depth" in checks:
        below = t_a_b_m
        if rigs.ported:
            level_a, level_b = rigs.levels
            below = below - level_a.depth_port_m[:, None] + level_b.depth_port_m @ R_a_b
        fall = sensors.down_a @ below if sensors.attitude_a else dot(sensors.down_b @ R_a_b, below)
        square = fall * fall
        spread2 = sensors.depth_variance + sensors.fall_variance * (dot(below, below) - square)
        spread2 += QUARTER * variance * square
        depth_chi2 = (fall - sensors.depth_m) ** 2 / spread2
        density = _DEPTH_PEAK * np.exp(_MINUS_HALF * depth_chi2) / np.sqrt(TURN * spread2)
        log_ratio += np.log(density + _DEPTH_FLOOR)
    log_prior = np.zeros(len(variance))
    if prediction is not None:
        log_prior = weigh_prediction(R_a_b, t_a_b_m, prediction)
    return Support(log_ratio + log_prior, log_prior, tilt_chi2, depth_chi2)


def weigh_heading(sine: Floats, cosine: Floats, variance: Floats) -> Floats:
    """Weigh the turn about the vertical between poses and attitudes, loosely.

    sine, cosine: (K,) as `Sensors.turns` gives them; variance: (K,) of both headings' difference.
    """
    half_turn = np.arctan2(sine, ONE + cosine)
    density = _HEADING_PEAK * np.exp(MINUS_TWO * half_turn * half_turn / variance) / np.sqrt(TURN * variance)
    log_ratio: Floats = np.log(density + _HEADING_FLOOR)
    return log_ratio


def weigh_prediction(R_a_b: Floats, t_a_b_m: Floats, prediction: Prediction) -> Floats:
    """Weigh K poses against a prediction from earlier ones: a bounded gain and a bounded loss."""
    turns = prediction.turns @ R_a_b.reshape(9, -1)
    e = np.concatenate((t_a_b_m - prediction.t_a_b_m[:, None], turns[:3]))
    chi2 = np.add.reduce(e * (prediction.information @ e))
    # Half a turn away the vector is short again.
    near = turns[3] > 1.0
    log_gain = np.where(near, np.minimum(prediction.log_gain - 0.5 * chi2, _MAX_LOG_PRIOR), -np.inf)
    gain: Floats = np.log(_PRIOR_WRONG + (1.0 - _PRIOR_WRONG) * np.exp(log_gain))
    return gain
