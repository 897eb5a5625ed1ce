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
# A sensor that contradicts the pictures is broken this often, a heading more often: steel stands beside it.
_TILT_BROKEN: Final = 1e-5
_HEADING_BROKEN: Final = 0.15
_DEPTH_BROKEN: Final = 0.02
# How often one light is missing, to being seen, and the other where one is; and chance alone, to all four being seen.
MISSING_ODDS: Final = 0.2
CHANCE_ODDS: Final = 0.3
# Predicted from the other three, a light's position has four times its own variance.
_PREDICTED_VARIANCE: Final = 4.0
# What chance gives: the spread of relative pitch (rad) and heading (rad), and of depth differences (m).
PITCH_SPREAD: Final = 1.1
HEADING_SPREAD: Final = 1.5
DEPTH_SPREAD_M: Final = 6.0
# Odds of a false candidate among four lights from which on three are tried.
POOR_FIT: Final = 2e-3
# Agreement of a sensor with a pose: chi^2 below this, of one or two degrees of freedom.
AGREES: Final = 20.0


@dataclass(eq=False, slots=True)
class Support:
    """What the sensors say of K poses.

    log_ratio: (K,) of all together. turn: (3, K) against both headings, log_heading (K,) what it counts for.
    tilt_chi2, depth_chi2: (K,).
    """

    log_ratio: Floats
    turn: Floats
    log_heading: Floats
    tilt_chi2: Floats
    depth_chi2: Floats


def log_gaps(chi2: Floats, gaps: int) -> Floats:
    """Give the log density of the gaps over their sds and (2 pi)^(1/2): Gaussian, with a share of gross errors."""
    usual = math.log(1.0 - GROSS_PROBABILITY) - 0.5 * chi2
    gross = math.log(GROSS_PROBABILITY) - gaps * math.log(GROSS_SCALE) - 0.5 * chi2 / GROSS_SCALE**2
    density: Floats = np.logaddexp(usual, gross)
    return density


def false_light_odds(chi2: Floats, clutter: Floats) -> Floats:
    """Give the odds that one of four lights is missing and a false candidate stands in for it.

    chi2: of the pose. clutter: candidates that chance puts into the variance of the lights' positions. The other
    three predict where a light stands; a false candidate falls there by chance.
    """
    density = np.maximum(np.exp(log_gaps(chi2, 2)), 1e-300)
    odds: Floats = MISSING_ODDS * clutter * 2.0 * math.pi * _PREDICTED_VARIANCE / density
    return odds


def log_chance(rigs: RigPair, counts: Indices, settings: Settings) -> Floats:
    """Give the part of the log ratio that all quads of a trigger share (T,); counts: (T, 2) candidates."""
    in_a, in_b = np.maximum(counts, 2).T
    # A gap that nobody looks at says what chance says: about one turn, or an e-fold of range.
    spread = math.log(settings.range_max_m / settings.range_min_m) * (2.0 * math.pi) ** (2 - settings.gaps)
    chance: Floats = np.log(rigs.views_sr2 / (in_a * (in_a - 1) * in_b * (in_b - 1) * spread))
    return chance


def weigh(
    T_a_b: SE3, trigger: Indices, variance: Floats, rigs: RigPair, sensors: Sensors, checks: frozenset[str]
) -> Support:
    """Weigh K poses between the bar frames by attitude and depth.

    trigger: (K,). variance: (K,) of the gaps of ln range and of twist.
    """
    R_ned_a, R_ned_b = sensors.R_ned_bar[trigger].swapaxes(0, 1)
    turn = turn_of(T_a_b.R, R_ned_a, R_ned_b)
    log_heading = np.zeros(len(variance))
    if "attitude" in checks:
        # The picture's own noise turns B about the line of sight by half the twist gap's.
        spread2 = sensors.tilt_variance.sum(1)[trigger] + 0.125 * variance
        tilt_chi2 = 2.0 * (1.0 - turn[0]) / spread2
        right = (1.0 - _TILT_BROKEN) * np.exp(-0.5 * tilt_chi2) / spread2
        log_ratio = np.log(PITCH_SPREAD / (2.0 * math.pi) * (right + 0.5 * _TILT_BROKEN))
        log_heading = weigh_heading(off_rad(turn), sensors.heading_variance[trigger] + 0.25 * variance)
        log_ratio += np.where(sensors.both[trigger], log_heading, 0.0)
    else:
        # The reading is upright; of half a turn nothing is known.
        tilt_chi2 = np.zeros(len(variance))
        log_ratio = np.full(len(variance), -math.log(math.pi))
    depth_chi2 = np.zeros(len(variance))
    measured = np.isfinite(sensors.depth_m)[trigger]
    if "depth" in checks and measured.any():
        below = T_a_b @ rigs.port_m[1] - rigs.port_m[0]
        down_a, down_b = R_ned_a[:, 2], R_ned_b[:, 2]
        known_a = sensors.known[trigger, 0]
        down = np.where(known_a[:, None], down_a, (T_a_b.R @ down_b[:, :, None])[:, :, 0])
        fall = inner(down, below)
        fall2 = fall * fall
        tilt_variance = np.where(known_a, *sensors.tilt_variance[trigger].T)
        spread2 = sensors.depth_variance[trigger] + tilt_variance * (inner(below, below) - fall2)
        spread2 += 0.25 * variance * fall2
        depth_chi2 = np.where(measured, (fall - sensors.depth_m[trigger]) ** 2 / spread2, 0.0)
        density = DEPTH_SPREAD_M * np.exp(-0.5 * depth_chi2) / np.sqrt(2.0 * math.pi * spread2)
        log_ratio += np.where(measured, np.log((1.0 - _DEPTH_BROKEN) * density + _DEPTH_BROKEN), 0.0)
    return Support(log_ratio, turn, log_heading, tilt_chi2, depth_chi2)


def weigh_heading(angle_rad: Floats, variance: Floats) -> Floats:
    """Weigh turns (K,) about the vertical between poses and attitudes; variance: (K,) of both headings' difference."""
    right = (
        (1.0 - _HEADING_BROKEN) * np.exp(-0.5 * angle_rad * angle_rad / variance) / np.sqrt(2.0 * math.pi * variance)
    )
    log_ratio: Floats = np.log(HEADING_SPREAD * (right + _HEADING_BROKEN / (2.0 * math.pi)))
    return log_ratio
