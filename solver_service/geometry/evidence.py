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

from solver_service.geometry.observation import Settings
from solver_service.geometry.rig import Rig
from solver_service.geometry.rotation import Floats, matrix_of, rotation_exp

# One light in ten quadruples stands off by a gross error, five times its noise.
GROSS_PROBABILITY: Final = 0.1
GROSS_SCALE: Final = 5.0
# A tilt that contradicts the pictures is a broken sensor this often, a heading more often: steel stands beside it.
_TILT_BROKEN: Final = 1e-3
_HEADING_BROKEN: Final = 0.15
_DEPTH_BROKEN: Final = 0.02
# Added to what the sensors say of themselves: mount, and a heading's slow bias.
_MOUNT_SIGMA_RAD: Final = math.radians(1.0)
_HEADING_SIGMA_RAD: Final = math.radians(3.0)
_DEFAULT_SIGMA_RAD: Final = np.radians((2.0, 2.0, 10.0))
_DEPTH_SIGMA_M: Final = 0.02
# A diver who is not known to lie otherwise is upright to about this (1 sd).
_UPRIGHT_SIGMA_RAD: Final = 0.45
# How often one light is missing, to being seen; and chance alone, to all four being seen.
_MISSING_ODDS: Final = 0.2
CHANCE_ODDS: Final = 0.3
# What chance gives: the spread of relative pitch (rad) and heading (rad), and of depth differences (m).
_PITCH_SPREAD: Final = 1.1
_HEADING_SPREAD: Final = 1.5
_DEPTH_SPREAD_M: Final = 6.0
# A prediction from earlier poses is believed this much at most, and costs at most half where it is wrong.
_MAX_PRIOR_GAIN: Final = 1e3
# Agreement of a sensor with a pose: chi^2 below this, of one or two degrees of freedom.
AGREES: Final = 20.0


@dataclass(frozen=True, eq=False)
class Sensors:
    """What attitude and depth of both nodes say, in the terms that a pose can be tried against.

    down_a, down_b: (3,) in each camera's frame. tilt_variance: of both together, rad^2. R_a_b: (3, 3) by the
    attitudes, None where one is missing. heading_variance: of its heading. depth_m: of B's port below A's, None
    where unknown.
    """

    down_a: Floats
    down_b: Floats
    tilt_variance: float
    R_a_b: Floats | None
    heading_variance: float
    depth_m: float | None
    depth_variance: float


@dataclass(frozen=True, eq=False)
class Weighed:
    """Log likelihood ratios (K,) of hypotheses, and chi^2 (K,) of tilt and depth by themselves."""

    log_ratio: Floats
    tilt_chi2: Floats
    depth_chi2: Floats


@dataclass(frozen=True, eq=False)
class Evidence:
    """What speaks for and against the hypotheses of one trigger. candidates: how many each picture has."""

    rigs: tuple[Rig, Rig]
    candidates: tuple[int, int]
    sensors: Sensors
    prediction: Prediction | None
    settings: Settings

    def weigh(
        self, R_a_b: Floats, t_a_b_m: Floats, u: Floats, chi2: Floats, variance: Floats, log_weight: Floats
    ) -> Weighed:
        """Weigh K poses R_a_b (3, 3, K), t_a_b_m (3, K) along the lines of sight u (3, K).

        chi2: (K,) of the gaps, whose variance (of ln range and of twist) is (K,). log_weight: (K,) of the four
        candidates without a pose.
        """
        checks = self.settings.checks
        limits_m = self.settings.range_min_m, self.settings.range_max_m
        views_sr = self.rigs[0].camera.solid_angle_sr, self.rigs[1].camera.solid_angle_sr
        pairings = math.prod(n * (n - 1) for n in self.candidates)
        constant = math.log(views_sr[0] * views_sr[1] / (pairings * math.log(limits_m[1] / limits_m[0])))
        gaps = len(checks & {"range", "twist"})
        # A gap that nobody looks at says what chance says: about one turn, or an e-fold of range.
        constant -= (2 - gaps) * math.log(2.0 * math.pi)
        log_ratio = constant + log_weight + log_gaps(chi2, variance, gaps)
        sensed = weigh_sensors(R_a_b, t_a_b_m, u, variance, self.sensors, self.rigs, checks)
        log_ratio = log_ratio + sensed.log_ratio
        if self.prediction is not None:
            log_ratio = log_ratio + log_prior(R_a_b, t_a_b_m, variance, self.prediction, limits_m, views_sr)
        return Weighed(log_ratio, sensed.tilt_chi2, sensed.depth_chi2)


@dataclass(frozen=True, eq=False)
class Prediction:
    """Where earlier poses put this one: t_a_b_m (3,), R_a_b (3, 3), covariance (6, 6) like a pose's."""

    t_a_b_m: Floats
    R_a_b: Floats
    covariance: Floats


def combine(
    rigs: tuple[Rig, Rig],
    attitudes: tuple[Floats | None, Floats | None],
    sigmas_rad: tuple[Floats | None, Floats | None],
    depth_m: float | None,
    depth_variance: float,
) -> Sensors:
    """Put both nodes' attitudes (body to NED) and the difference of their depths together."""
    down, tilt, heading, R_ned_camera = [], 0.0, 0.0, []
    for rig, q_ned_body, sigma_rad in zip(rigs, attitudes, sigmas_rad, strict=True):
        if q_ned_body is None:
            down.append(np.array([0.0, 1.0, 0.0]))
            tilt += _UPRIGHT_SIGMA_RAD**2
            continue
        sigma = _DEFAULT_SIGMA_RAD if sigma_rad is None else sigma_rad
        # What a heading has been corrected by is taken back: both then count from magnetic north.
        magnetic = rotation_exp(np.array([0.0, 0.0, -rig.declination_rad]))
        R_ned_body = magnetic @ matrix_of(q_ned_body)
        R_ned_camera.append(R_ned_body @ rig.R_body_camera)
        down.append(R_ned_camera[-1][2])
        # Roll turns about the body's x axis, pitch about the horizontal across it, yaw about the vertical.
        steep2 = float(R_ned_body[2, 0]) ** 2
        roll2, pitch2, yaw2 = (float(x) ** 2 for x in sigma)
        tilt += 0.5 * (pitch2 + roll2 * (1.0 - steep2)) + _MOUNT_SIGMA_RAD**2
        heading += yaw2 + roll2 * steep2 + _HEADING_SIGMA_RAD**2
    both = len(R_ned_camera) == 2
    return Sensors(
        down_a=down[0],
        down_b=down[1],
        tilt_variance=tilt,
        R_a_b=R_ned_camera[0].T @ R_ned_camera[1] if both else None,
        heading_variance=heading,
        depth_m=depth_m if R_ned_camera else None,
        depth_variance=depth_variance + _DEPTH_SIGMA_M**2,
    )


def log_gaps(chi2: Floats, variance: Floats, gaps: int) -> Floats:
    """Give the log density of the gaps: Gaussian, with a share of gross errors."""
    usual = (1.0 - GROSS_PROBABILITY) * np.exp(-0.5 * chi2)
    gross = GROSS_PROBABILITY * GROSS_SCALE**-gaps * np.exp(-0.5 * chi2 / GROSS_SCALE**2)
    density: Floats = np.log(usual + gross) - 0.5 * gaps * np.log(2.0 * math.pi * variance)
    return density


def log_intruder(chi2: float, freedom: Floats, candidates: int, variance_px2: Floats, area_px2: float) -> Floats:
    """Give the log odds that one of four is a false candidate where a light is missing, not that light.

    chi2: of the pose. freedom: of that light's sighting. candidates, variance_px2, area_px2: of its picture.
    The other three foretell where it stands; a false one falls there by chance.
    """
    foretold = log_gaps(np.array(chi2), 1.0 / np.sqrt(np.maximum(freedom, 1e-12)), 2)
    odds: Floats = np.log(_MISSING_ODDS * candidates * variance_px2 / area_px2) - foretold
    return odds


def weigh_sensors(
    R_a_b: Floats,
    t_a_b_m: Floats,
    u: Floats,
    variance: Floats,
    sensors: Sensors,
    rigs: tuple[Rig, Rig],
    uses: frozenset[str],
) -> Weighed:
    """Weigh K poses, R_a_b (3, 3, K), t_a_b_m (3, K), against attitude and depth.

    u: (3, K) their lines of sight in A's frame. variance: (K,) of ln range and twist gaps.
    """
    log_ratio = np.zeros(t_a_b_m.shape[1])
    down_a = sensors.down_a[:, None]
    down_b = (R_a_b * sensors.down_b[None, :, None]).sum(1)
    # The rotation that brings B's down onto A's, as a vector across it.
    ax, ay, az = sensors.down_a
    bx, by, bz = down_b
    tilt = np.stack((by * az - bz * ay, bz * ax - bx * az, bx * ay - by * ax))
    sine = np.sqrt((tilt * tilt).sum(0))
    angle = np.arctan2(sine, sensors.down_a @ down_b)
    tilt = tilt * (angle / np.maximum(sine, 1e-12))
    # The picture's own noise turns B about the line of sight by half the twist gap's.
    s2, about = sensors.tilt_variance, 0.25 * variance
    across = about * (1.0 - (sensors.down_a @ u) ** 2)
    chi2 = (angle * angle - about * (tilt * u).sum(0) ** 2 / (s2 + across)) / s2
    area = 2.0 * math.pi * np.sqrt(s2 * (s2 + across))
    if "attitude" not in uses:
        # Nothing is known of the twist, and the reading is upright.
        log_ratio -= math.log(math.pi)
        chi2 = np.zeros_like(chi2)
    else:
        density = (1.0 - _TILT_BROKEN) * np.exp(-0.5 * chi2) / area + _TILT_BROKEN / (4.0 * math.pi)
        log_ratio += np.log(density * _PITCH_SPREAD)
        if sensors.R_a_b is not None:
            log_ratio += _log_heading(R_a_b, sensors.R_a_b, sensors, about)
    depth_chi2 = np.zeros_like(chi2)
    if sensors.depth_m is not None and "depth" in uses:
        down = down_a + down_b
        down = down / np.sqrt((down * down).sum(0))
        below = t_a_b_m - rigs[0].depth_port_m[:, None]
        if rigs[1].depth_port_m.any():
            below = below + (R_a_b * rigs[1].depth_port_m[None, :, None]).sum(1)
        fall = (down * below).sum(0)
        level2 = (below * below).sum(0) - fall * fall
        spread2 = sensors.depth_variance + 0.25 * s2 * level2 + 0.25 * variance * fall * fall
        depth_chi2 = (fall - sensors.depth_m) ** 2 / spread2
        density = (1.0 - _DEPTH_BROKEN) * np.exp(-0.5 * depth_chi2) / np.sqrt(2.0 * math.pi * spread2)
        log_ratio += np.log(density * _DEPTH_SPREAD_M + _DEPTH_BROKEN)
    return Weighed(log_ratio, chi2, depth_chi2)


def _log_heading(R_a_b: Floats, predicted: Floats, sensors: Sensors, about: Floats) -> Floats:
    """Weigh the turn about the vertical between poses and attitudes, loosely."""
    flat = R_a_b.reshape(9, -1)
    across = np.cross(sensors.down_a, predicted.T).T
    turn = 2.0 * np.arctan2(across.reshape(9) @ flat, 1.0 + predicted.reshape(9) @ flat)
    spread2 = sensors.heading_variance + about
    density = (1.0 - _HEADING_BROKEN) * np.exp(-0.5 * turn * turn / spread2) / np.sqrt(2.0 * math.pi * spread2)
    log_ratio: Floats = np.log((density + _HEADING_BROKEN / (2.0 * math.pi)) * _HEADING_SPREAD)
    return log_ratio


def log_prior(
    R_a_b: Floats,
    t_a_b_m: Floats,
    variance: Floats,
    prediction: Prediction,
    range_limits_m: tuple[float, float],
    views_sr: tuple[float, float],
) -> Floats:
    """Weigh K poses against a prediction from earlier ones: a bounded gain, and never more than half lost.

    variance: (K,) of ln range and twist, by which the poses themselves scatter along and about the line of sight.
    """
    away = t_a_b_m - prediction.t_a_b_m[:, None]
    turned = (R_a_b[:, None] * prediction.R_a_b[None, :, :, None]).sum(2)
    vector = 0.5 * np.stack((turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]))
    range2 = (t_a_b_m * t_a_b_m).sum(0)
    u = t_a_b_m / np.sqrt(range2)
    # Along the line of sight a pose scatters with its range, about it with its twist: on top of the prediction.
    own = np.zeros((len(range2), 6, 6))
    sight = u.T[:, :, None] * u.T[:, None, :]
    own[:, :3, :3] = sight * (0.25 * variance * range2)[:, None, None]
    own[:, 3:, 3:] = sight * (0.25 * variance)[:, None, None]
    total = own + prediction.covariance
    e = np.concatenate((away, vector)).T[:, :, None]
    chi2 = (e * np.linalg.solve(total, e)).sum((1, 2))
    density = np.exp(-0.5 * chi2) / np.sqrt((2.0 * math.pi) ** 6 * np.linalg.det(total))
    # Half a turn away the vector is short again.
    density = np.where(turned[0, 0] + turned[1, 1] + turned[2, 2] > 1.0, density, 0.0)
    spread = math.log(range_limits_m[1] / range_limits_m[0])
    chance = 1.0 / (spread * views_sr[0] * views_sr[1] * 2.0 * math.pi * range2 * np.sqrt(range2))
    gain: Floats = np.log(0.5 + 0.5 * np.minimum(np.nan_to_num(density / chance), _MAX_PRIOR_GAIN))
    return gain
