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
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.observation import Settings
from buddyline.solver_service.geometry.rig import RigPair
from buddyline.solver_service.geometry.rotation import Floats, Indices, inner
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.sensors import Sensors, off_rad, turn_of

# One light in ten quadruples stands off by a gross error, five times its noise.
GROSS_PROBABILITY: Final = 0.1
GROSS_SCALE: Final = 5.0
# Share of lights found wrongly by many pixels (flares, half-hidden lights), and how far, 1 sd.
GROSS_SHARE: Final = 0.03
GROSS_PX: Final = 7.0
# Log densities of no, one and two gaps at zero: of their noise, and of gross errors.
_LOG_USUAL: Final = math.log(1.0 - GROSS_PROBABILITY)
_LOG_GROSS: Final = [math.log(GROSS_PROBABILITY / GROSS_SCALE**gaps) for gaps in range(3)]
# Odds, against all four lights being seen: of one missing (and again of the node's other one, where one is), and of
# chance alone.
MISSING_ODDS: Final = 0.2
CHANCE_ODDS: Final = 0.3
# Predicted from the other three, a light's position has four times its own variance.
_PREDICTED_VARIANCE: Final = 4.0
# What chance gives: the spread of relative pitch (rad) and heading (rad), and of depth differences (m).
PITCH_SPREAD: Final = 1.1
HEADING_SPREAD: Final = 1.5
DEPTH_SPREAD_M: Final = 6.0
# How often tilt, heading and depth are broken; a heading most often, by steel beside it. A broken one may say anything
# within this width (rad^2, rad, m).
_BROKEN: Final = np.array([[1e-5], [0.15], [0.02]])
_ANYTHING: Final = np.array([[2.0], [2.0 * math.pi], [DEPTH_SPREAD_M]])
# The density of a right sensor at chi^2 of 0, times its sds, and of a broken one; both over chance's.
_OVER_CHANCE: Final = np.array([[PITCH_SPREAD / (2.0 * math.pi)], [HEADING_SPREAD], [DEPTH_SPREAD_M]])
_RIGHT: Final = _OVER_CHANCE * (1.0 - _BROKEN) / np.sqrt([[1.0], [2.0 * math.pi], [2.0 * math.pi]])
_WRONG: Final = _OVER_CHANCE * _BROKEN / _ANYTHING
# The odds of a false light, per its density where the lights fit and per candidate within one variance.
_FALSE_LIGHT: Final = MISSING_ODDS * 2.0 * math.pi * _PREDICTED_VARIANCE
# Log odds of a false candidate among four lights from which on three are tried.
POOR_FIT: Final = math.log(2e-3)
# Four lights whose gaps have a larger chi^2 (two degrees of freedom) do not fit: one true pose in 10^4 has, by noise.
UNFIT_CHI2: Final = -2.0 * math.log(1e-4)
# Agreement of a sensor with a pose: chi^2 below this, of one or two degrees of freedom.
AGREES: Final = 20.0


@dataclass(eq=False, slots=True)
class Support:
    """What the sensors say of K poses.

    log_ratio: (K,) of all together. turn: (3, K) as `turn_of`'s. log_each, chi2: (3, K) of tilt, of heading and of
    depth; 0 where one may not speak.
    """

    log_ratio: Floats
    turn: Floats
    log_each: Floats
    chi2: Floats


def log_gaps(chi2: Floats, gaps: int) -> Floats:
    """Give the log density of the gaps over their sds and (2 pi)^(1/2): Gaussian, with a share of gross errors."""
    half = 0.5 * chi2
    density: Floats = np.logaddexp(_LOG_USUAL - half, _LOG_GROSS[gaps] - half / GROSS_SCALE**2)
    return density


def log_false_light(log_fit: Floats, clutter: Floats) -> Floats:
    """Give the log odds (M,) that one of four lights is missing and a false candidate stands in for it.

    log_fit: of both gaps, as `log_gaps` gives it. clutter: candidates that chance puts into the variance of the lights'
    positions; without any the odds are -inf. The other three predict where a light stands; a false candidate falls
    there by chance.
    """
    odds: Floats = np.log(_FALSE_LIGHT * clutter) - log_fit
    return odds


def log_chance(rigs: RigPair, counts: Indices, settings: Settings) -> Floats:
    """Give the part of the log ratio that all quads of a trigger share (T,); counts: (T, 2) candidates."""
    in_order = np.maximum(counts * (counts - 1), 2)
    # A gap that nobody looks at says what chance says: about one turn, or an e-fold of range.
    spread = math.log(settings.range_max_m / settings.range_min_m) * (2.0 * math.pi) ** (2 - settings.gaps)
    chance: Floats = np.log(rigs.views_sr2 / spread / (in_order[:, 0] * in_order[:, 1]))
    return chance


def weigh(T_a_b: SE3, trigger: Indices, variance: Floats, rigs: RigPair, sensors: Sensors) -> Support:
    """Weigh K poses between the cameras' frames by attitude and depth.

    trigger: (K,). variance: (K,) of the gaps of ln range and of twist.
    """
    R_ned_a, R_ned_b = sensors.R_ned_camera[trigger].swapaxes(0, 1)
    turn = turn_of(T_a_b.R, R_ned_a, R_ned_b)
    angle_rad = off_rad(turn)
    # How far B's port lies below A's by the pose and the attitude of A, or where that is unknown, of B.
    down, known_a = R_ned_a[:, 2], sensors.known[trigger, 0]
    if not known_a.all():
        down = np.where(known_a[:, None], down, (T_a_b.R @ R_ned_b[:, 2, :, None])[:, :, 0])
    port_a_m, port_b_m = rigs.port_in_camera_m
    below = T_a_b.t_m + T_a_b.R @ port_b_m - port_a_m
    fall_m = inner(down, below)
    fall2 = fall_m * fall_m
    # The picture's own noise turns B about the line of sight by half the twist gap's.
    tilt2 = sensors.tilts_variance[trigger] + 0.125 * variance
    heading2 = sensors.heading_variance[trigger] + 0.25 * variance
    depth2 = sensors.fall_variance[trigger] * (inner(below, below) - fall2) + 0.25 * variance * fall2
    depth2 += sensors.depth_variance[trigger]
    off_m = fall_m - sensors.depth_m[trigger]
    chi2 = np.array((2.0 * (1.0 - turn[0]) / tilt2, angle_rad * angle_rad / heading2, off_m * off_m / depth2))
    speaks = sensors.speaks[:, trigger]
    # Tilt has two axes.
    density = np.exp(-0.5 * chi2) / np.sqrt((tilt2 * tilt2, heading2, depth2))
    log_each = np.where(speaks, np.log(_RIGHT * density + _WRONG), 0.0)
    return Support(np.add.reduce(log_each, 0), turn, log_each, np.where(speaks, chi2, 0.0))


def weigh_heading(angle_rad: Floats, variance: Floats) -> Floats:
    """Weigh turns (K,) about the vertical between poses and attitudes; variance: (K,) of both headings' difference."""
    density = np.exp(-0.5 * angle_rad * angle_rad / variance) / np.sqrt(variance)
    log_ratio: Floats = np.log(_RIGHT[1] * density + _WRONG[1])
    return log_ratio
