"""One trigger: what two nodes saw, and the one pose that explains it, or why there is none.

A pure function: the same input gives the same output, bit for bit, whatever was solved before.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.closed_form import closed_form
from buddyline.solver_service.geometry.evidence import AGREES, CHANCE_ODDS, intruder_odds
from buddyline.solver_service.geometry.four_lights import read_four_lights
from buddyline.solver_service.geometry.hypotheses import find_pairs
from buddyline.solver_service.geometry.observation import Heading, Prior, Reason, Sensed, Settings, View
from buddyline.solver_service.geometry.readings import Readings
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats, quaternion_of, rotation_log
from buddyline.solver_service.geometry.terms import Terms
from buddyline.solver_service.geometry.three_lights import read_three_lights
from numpy.typing import NDArray

__all__ = ["Camera", "Fix", "NoFix", "Prior", "Reason", "Rig", "Sensed", "Settings", "View", "solve_trigger"]


@dataclass(frozen=True, eq=False)
class Fix:
    """A pose. T_a_b maps B's camera frame into A's.

    covariance: (6, 6), position in A's camera frame, then the small rotation w with R_true = exp(w) R_a_b, in
    A's camera frame. pair_a: indices into view A of B's (left, right) light, -1 where it was not seen; pair_b
    likewise. chi2: of the picture coordinates, two degrees of freedom. probability: against chance and others.
    """

    t_a_b_m: Floats
    q_a_b_xyzw: Floats
    covariance: Floats
    range_a_m: float
    range_b_m: float
    range_gap_m: float
    twist_gap_rad: float
    chi2: float
    hypotheses: int
    pair_a: tuple[int, int]
    pair_b: tuple[int, int]
    method: str
    checks: tuple[str, ...]
    probability: float


@dataclass(frozen=True)
class NoFix:
    """Why there is no pose: detail is for a person."""

    reason: Reason
    detail: str


# Poses nearer than this, relative to the range, and turned by less than 0.1 rad (their trace) are one pose.
_SAME_POSITION: Final = 0.04
_SAME_TRACE: Final = 1.0 + 2.0 * math.cos(0.1)
_ALONE: Final = np.ones(1, dtype=bool)
# Three lights have no gap to check them: they must be likelier than four, and likelier still where the last poses
# speak for them, which know nothing of how a diver turns aside, or against them, as for another diver's lamps.
_THREE_PROBABILITY: Final = 0.98
_FOLLOWED_PROBABILITY: Final = 0.999
# chi^2 of two degrees of freedom from which on a gross error is likelier than the noise.
_GROSS_CHI2: Final = 11.3
# A position that is known to this share of the range (1 sd) is no wrong one.
_SURE_POSITION: Final = 0.02
# Odds of a false candidate among four lights from which on three are tried.
_POOR_FIT: Final = 2e-3
# What is this much less likely widens no covariance.
_NEGLIGIBLE: Final = 1e-6
# A rival within this log ratio is named.
_RIVAL: Final = 6.0


def solve_trigger(
    view_a: View,
    view_b: View,
    rig_a: Rig,
    rig_b: Rig,
    sensed_a: Sensed,
    sensed_b: Sensed,
    settings: Settings,
    prior: Prior | None = None,
    heading: Heading | None = None,
) -> Fix | NoFix:
    """Find the four lights among both nodes' candidates, and T_a_b from them, or say why there is none.

    prior, heading: what earlier poses tell of this one, and of the headings.
    """
    for name, rig in (("A", rig_a), ("B", rig_b)):
        if not rig.usable:
            return NoFix("degenerate", f"the lights of {name} are less than 1 mm apart")
    with np.errstate(all="ignore"):
        terms = Terms.of((view_a, view_b), (rig_a, rig_b), (sensed_a, sensed_b), settings, prior, heading)
        return _solve(terms)


def _solve(terms: Terms) -> Fix | NoFix:
    pairs = find_pairs(terms.candidates, terms.rigs, (terms.sensors.down_a, terms.sensors.down_b), terms.settings)
    four = read_four_lights(terms, pairs)
    found = NoFix(*four.why) if four.readings is None else _decide(terms, four.readings, four.others)
    if terms.settings.method != "refined" or not _doubtful(found, four.readings):
        return found
    three = read_three_lights(terms, pairs)
    if three is None:
        return found
    return _decide(terms, three if four.readings is None else four.readings.joined(three), four.others)


def _doubtful(found: Fix | NoFix, readings: Readings | None) -> bool:
    """Whether three of the lights may tell more than four: no pose, a poor fit, or one that nobody expected."""
    if readings is None or isinstance(found, NoFix):
        return True
    k = int(readings.log_ratio.argmax())
    poor = intruder_odds(float(readings.chi2[k]), float(readings.clutter[k])) > _POOR_FIT
    return bool(poor or readings.log_prior[k] < 0.0)


def _decide(terms: Terms, readings: Readings, others: float) -> Fix | NoFix:
    """Publish the likeliest reading where it stands alone; others: the likelihood ratios of all that is not here."""
    settings = terms.settings
    k = int(readings.log_ratio.argmax())
    if readings.log_ratio[k] == -np.inf:
        return NoFix("degenerate", "the directions do not determine a pose")
    t, R = readings.t_a_b_m, readings.R_a_b
    range_m = math.hypot(*t[k].tolist())
    if not settings.range_min_m <= range_m <= settings.range_max_m:
        return NoFix("out_of_range", f"what agrees, at {range_m:.3g} m, is not {terms.range_limits}")
    same = _ALONE
    ratio = agreeing = math.exp(readings.log_ratio[k])
    if len(readings) > 1:
        same = np.add.reduce((t - t[k]) ** 2, 1) < (_SAME_POSITION * range_m) ** 2
        same &= R.reshape(-1, 9) @ R[k].ravel() > _SAME_TRACE
        ratios = np.exp(readings.log_ratio)
        agreeing = float(np.add.reduce(ratios[same]))
        others += float(np.add.reduce(ratios[~same]))
    short = min(readings.lights[k].tolist()) < 0
    chi2 = float(readings.chi2[k])
    # One of four lights may be off by more than its noise; which one, two residuals cannot tell.
    widened = 0.5 * chi2 if chi2 > _GROSS_CHI2 and not short else 1.0
    sigma_m = math.sqrt(widened * sum(readings.covariance[k].diagonal()[:3].tolist()))
    if short and sigma_m > _SURE_POSITION * range_m:
        return NoFix("ambiguous", f"three lights give {range_m:.3g} m to {sigma_m:.2g} m only")
    # A false candidate in a light's place is off by as much as the covariance has been widened for.
    intruder = ratio * float(readings.lone_odds[k])
    if not short and sigma_m > _SURE_POSITION * range_m:
        intruder = ratio * intruder_odds(chi2, float(readings.clutter[k]))
    probability = agreeing / (CHANCE_ODDS + agreeing + others + intruder)
    required = settings.min_probability
    if short:
        required = max(required, _FOLLOWED_PROBABILITY if readings.log_prior[k] != 0.0 else _THREE_PROBABILITY)
    if probability >= required:
        covariance = widened * _spread(readings, k, same)
        return _fix(terms, readings, k, covariance, probability)
    tilt_chi2, depth_chi2 = float(readings.tilt_chi2[k]), float(readings.depth_chi2[k])
    what = f"the best of the hypotheses, at {range_m:.3g} m,"
    if tilt_chi2 > AGREES:
        return NoFix("attitude", f"{what} is {math.sqrt(tilt_chi2):.1f} sigma off the attitudes")
    if depth_chi2 > AGREES:
        return NoFix("depth", f"{what} is {math.sqrt(depth_chi2):.1f} sigma off the depths")
    why = "one light may be a false candidate" if intruder > CHANCE_ODDS else "chance may give it"
    rivals = np.where(same, -np.inf, readings.log_ratio)
    rival = int(rivals.argmax())
    if rivals[rival] > readings.log_ratio[k] - _RIVAL:
        why = f"another stands at {math.sqrt(float(t[rival] @ t[rival])):.3g} m"
    return NoFix("ambiguous", f"{what} is {probability:.0%} likely: {why} (chi2 {chi2:.1f})")


def _checks(terms: Terms, readings: Readings, k: int) -> tuple[str, ...]:
    """Name what speaks for the pose."""
    settings, sensors = terms.settings, terms.sensors
    checks: list[str] = []
    if min(readings.lights[k].tolist()) >= 0:
        checks += [name for name in ("range", "twist") if name in settings.checks]
    if not sensors.both or "attitude" not in settings.checks:
        checks.append("upright_assumed")
    elif readings.tilt_chi2[k] <= AGREES:
        checks.append("attitude")
    if sensors.depth_m is not None and "depth" in settings.checks and readings.depth_chi2[k] <= AGREES:
        checks.append("depth")
    return tuple(checks)


def _fix(terms: Terms, readings: Readings, k: int, covariance: Floats, probability: float) -> Fix:
    """Publish reading k, between the cameras' frames."""
    method, (rig_a, rig_b) = terms.settings.method, terms.rigs.rigs
    lights, found = readings.lights[k], readings.lights[k].tolist()
    range_a_m, range_b_m = readings.range_m[k].tolist()
    twist_gap_rad = float(readings.twist_gap_rad[k])
    in_a, in_b = terms.candidates.counts
    t = rig_a.R_level_camera.T @ readings.t_a_b_m[k]
    R = rig_a.R_level_camera.T @ readings.R_a_b[k] @ rig_b.R_level_camera
    if method != "refined":
        views = terms.candidates.bearings.T[lights].reshape(2, 2, 3)
        views = views @ np.array((rig_a.R_level_camera, rig_b.R_level_camera))
        solved = closed_form(views[:, 0, :, None], views[:, 1, :, None], rig_a, rig_b, method)
        t, R = solved.t_a_b_m[:, 0], solved.R_a_b[:, :, 0]
        range_a_m, range_b_m = solved.range_m[:, 0].tolist()
        twist_gap_rad = float(solved.twist_gap_rad[0])
    covariance = rig_a.both_level_camera.T @ covariance @ rig_a.both_level_camera
    places = terms.candidates.index.tolist()
    index = [places[light] if light >= 0 else -1 for light in found]
    return Fix(
        t_a_b_m=t,
        q_a_b_xyzw=quaternion_of(R),
        covariance=0.5 * (covariance + covariance.T),
        range_a_m=range_a_m,
        range_b_m=range_b_m,
        range_gap_m=range_a_m - range_b_m,
        twist_gap_rad=twist_gap_rad,
        chi2=float(readings.chi2[k]),
        hypotheses=in_a * (in_a - 1) * in_b * (in_b - 1),
        pair_a=(index[0], index[1]),
        pair_b=(index[2], index[3]),
        method=method if min(found) >= 0 else "three_lights",
        checks=_checks(terms, readings, k),
        probability=probability,
    )


def _spread(readings: Readings, k: int, same: NDArray[np.bool_]) -> Floats:
    """Give the covariance of pose k, which may as well be one of its near neighbours; same: (K,) whether one is."""
    covariance: Floats = readings.covariance[k]
    if len(readings) == 1 or np.count_nonzero(same) < 2:
        return covariance
    # What the last poses said of near neighbours was read from pictures like this one: it does not count again.
    weights = np.where(same, np.exp(readings.log_ratio - readings.log_prior), 0.0)
    near = (weights > _NEGLIGIBLE * weights[k]).nonzero()[0]
    for i in near[near != k]:
        away = np.concatenate(
            (readings.t_a_b_m[i] - readings.t_a_b_m[k], rotation_log(readings.R_a_b[i] @ readings.R_a_b[k].T))
        )
        share = weights[i] / np.add.reduce(weights[near])
        covariance = covariance + share * away[:, None] * away
    return covariance
