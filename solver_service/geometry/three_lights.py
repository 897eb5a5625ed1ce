"""One light short: six coordinates for six unknowns, and attitude and depth to tell whether they belong together.

One node, the seer, sees both lights of the other, which sees one of the seer's. The pair gives the line of sight,
and the range once the other's bar is oriented; gravity orients it about the line of sight; the single light turns
the other to where it sees it. Tilt (twice) and depth are then left over as checks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.closed_form import dot, eq1_range_m
from buddyline.solver_service.geometry.evidence import (
    DEPTH_SPREAD_M,
    GROSS_PROBABILITY,
    GROSS_SCALE,
    HEADING_SPREAD,
    MISSING_ODDS,
    PITCH_SPREAD,
    Sensors,
    weigh_heading,
    weigh_prediction,
)
from buddyline.solver_service.geometry.hypotheses import Pairs
from buddyline.solver_service.geometry.readings import Readings
from buddyline.solver_service.geometry.refinement import (
    Sightings,
    is_large,
    linearize,
    moved,
    shifts_of,
    solve_normal,
    weight_of,
)
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats, skew
from buddyline.solver_service.geometry.terms import Terms
from numpy.typing import NDArray

# More combinations than this are not tried: among so many, three lights are never certain.
_MAX_COMBINATIONS: Final = 4000
_ROUNDS: Final = 2
# chi^2 of tilt and depth, three degrees of freedom, before and after the refinement.
_GATE_CHI2: Final = 40.0
_FITS_CHI2: Final = 16.0
# No gap tells a gross error of the pair: the covariance has its share of them.
_UNCHECKED: Final = 1.0 + GROSS_PROBABILITY * (GROSS_SCALE**2 - 1.0)
# So many guesses are weighed against the prediction, so many of them refined.
_KEPT: Final = 64
_REFINED: Final = 6
_STEPS: Final = 4
# How far a bar may rise more than its attitude says, and the middle stand off the bisector: shares of alpha.
_BAR_RISE: Final = 0.15
_SPLIT_SHARE: Final = 0.1
_YZX: Final = np.array((1, 2, 0))
_ZXY: Final = np.array((2, 0, 1))
_X: Final = np.array(((1.0,), (0.0,), (0.0,)))


@dataclass(eq=False, slots=True)
class _Guesses:
    """M poses T_a_b between the level frames: lights (M, 4), t (M, 3), R (M, 3, 3), score (M,), the less the better."""

    lights: NDArray[np.intp]
    t_a_b_m: Floats
    R_a_b: Floats
    score: Floats


def read_three_lights(terms: Terms, pairs: Pairs) -> Readings | None:
    """Give the best readings of three lights; None where there are none, or the sensors do not support any."""
    sensors, checks = terms.sensors, terms.settings.checks
    supported = sensors.both and sensors.depth_m is not None and checks >= {"attitude", "depth"}
    in_a, in_b = terms.candidates.counts
    if not supported or 2 * (pairs.counts[0] * in_b + pairs.counts[1] * in_a) > _MAX_COMBINATIONS:
        return None
    guesses = _guess(terms, pairs)
    score = guesses.score
    if terms.prediction is not None and len(score):
        score = score - 2.0 * weigh_prediction(guesses.R_a_b.transpose(1, 2, 0), guesses.t_a_b_m.T, terms.prediction)
    best = score.argsort(kind="stable")[:_REFINED]
    best = best[np.isfinite(score[best])]
    return _refined(terms, guesses.lights[best], guesses.t_a_b_m[best], guesses.R_a_b[best]) if len(best) else None


def _guess(terms: Terms, pairs: Pairs) -> _Guesses:
    """Try all pairs of either picture with all candidates of the other, each as left and as right light."""
    candidates, sensors, settings = terms.candidates, terms.sensors, terms.settings
    pair, single = (np.concatenate(parts) for parts in zip(*(_opposite(terms, pairs, k) for k in (0, 1)), strict=True))
    pair, single, side = pair.repeat(2), single.repeat(2), np.tile((0, 1), len(pair))
    # Who sees the pair: 0 is A. From here on the seer's own comes first, then the other's.
    seer = (pair >= pairs.split).astype(np.intp)
    own_other = np.array((seer, 1 - seer))
    levels = terms.rigs.levels

    def each(of_a: Floats, of_b: Floats) -> Floats:
        """Give both vectors (2, 3, M), the seer's own first."""
        return np.array((of_a, of_b)).T.take(own_other, axis=1).swapaxes(0, 1)

    down = each(sensors.down_a, sensors.down_b)
    middle = each(levels[0].middle_m, levels[1].middle_m)
    length_m = terms.rigs.length_m.take(own_other[1])
    arm = np.array((levels[0].lights_m, levels[1].lights_m))[seer, side].T - middle[0]
    c, w, chord = pairs.c.take(pair, 1), pairs.w.take(pair, 1), pairs.chord[pair]
    seen = candidates.bearings.take(single, 1)
    cos_alpha, sin_alpha = 1.0 - 0.5 * chord * chord, chord * np.sqrt(1.0 - 0.25 * chord * chord)
    # Both lines of sight point from the seer to the other.
    sight = np.array((c, -seen))
    own, other = _frames(sight, down)
    # Gravity tells which end of the pair is the right light.
    w = np.where(dot(w, _turned(other, own, _X)) < 0.0, -w, w)
    range_m = np.zeros(len(pair))
    for step in range(_ROUNDS):
        if step > 0:
            q = _turned(own, other, arm - sight[0] * range_m) + middle[1]
            back = seen - sight[1] - q / np.sqrt(dot(q, q))
            sight[1] = back / -np.sqrt(dot(back, back))
        sin_beta = -sight[1, 0]
        half = 0.5 * (np.arcsin(sin_beta) - np.arcsin(sin_beta * cos_alpha))
        sight[0] = c * np.cos(half) - w * np.sin(half)
        range_m = eq1_range_m(cos_alpha, sin_alpha, sin_beta, length_m)
        own, other = _frames(sight, down)
    R_own_other = np.add.reduce(own[:, :, None] * other[:, None])
    u = sight[0]
    t = middle[0] + u * range_m - np.add.reduce(R_own_other * middle[1], 1)
    # Both components of the tilt that remain: along the line of sight, and about it.
    rise_own, rise_other = np.arcsin(dot(down, sight))
    rise = rise_own - rise_other
    bar = R_own_other[:, 0]
    across = bar - u * dot(u, bar)
    about = dot(u, _cross(across, w)) / np.sqrt(dot(across, across))
    port = each(levels[0].depth_port_m, levels[1].depth_port_m)
    fall = dot(down[0], t - port[0] + np.add.reduce(R_own_other * port[1], 1))
    level2 = dot(t, t) - fall * fall
    variance = pairs.variance[pair]
    spread2 = sensors.depth_variance + 0.5 * sensors.tilt_variance * level2 + variance * fall * fall
    chi2 = (rise * rise + about * about) / (sensors.tilt_variance + variance)
    chi2 = chi2 + ((1 - 2 * seer) * fall - (sensors.depth_m or 0.0)) ** 2 / spread2
    keep = (range_m > settings.range_min_m) & (range_m < settings.range_max_m) & (chi2 < _GATE_CHI2)
    # Chance puts two candidates near each other the more rarely, the nearer.
    score = chi2 + 4.0 * np.log(chord)
    keep = keep.nonzero()[0]
    keep = keep[score[keep].argsort(kind="stable")[:_KEPT]]
    pair, single, side, seer = pair[keep], single[keep], side[keep], seer[keep]
    swapped = dot(w.take(keep, 1), pairs.w.take(pair, 1)) < 0.0
    first, second = pairs.ends.take(pair, 1)
    lights, rows = np.full((len(keep), 4), -1), np.arange(len(keep))
    lights[rows, 2 * seer] = np.where(swapped, second, first)
    lights[rows, 2 * seer + 1] = np.where(swapped, first, second)
    lights[rows, 2 - 2 * seer + side] = single
    R = R_own_other.take(keep, 2).transpose(2, 0, 1).copy()
    t = t.take(keep, 1).T
    turned = seer == 1
    R[turned] = R[turned].swapaxes(1, 2)
    t[turned] = -(R[turned] @ t[turned][:, :, None])[:, :, 0]
    return _Guesses(lights, t, R, score[keep])


def _opposite(terms: Terms, pairs: Pairs, seer: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Give the pairs of the seer and the candidates of the other that lie in opposite elevations."""
    candidates, sensors = terms.candidates, terms.sensors
    start_pair, end_pair = ((0, pairs.split), (pairs.split, len(pairs.key)))[seer]
    in_a = candidates.counts[0]
    start_single, end_single = ((in_a, len(candidates.index)), (0, in_a))[seer]
    down_own, down_other = (sensors.down_a, sensors.down_b)[:: 1 - 2 * seer]
    rise = np.arcsin(down_own @ pairs.c[:, start_pair:end_pair])
    fall = np.arcsin(-(down_other @ candidates.bearings[:, start_single:end_single]))
    # The single light stands off the middle by half its bar: so much at the range that the pair has at least.
    ratio = float(terms.rigs.length_m[seer] / terms.rigs.length_m[1 - seer])
    share = 0.75 * ratio * (abs(float(down_own[0])) + _BAR_RISE) + _SPLIT_SHARE
    slack = share * pairs.chord[start_pair:end_pair] + math.sqrt(_GATE_CHI2 * sensors.tilt_variance)
    pair, single = (np.abs(rise[:, None] - fall) < slack[:, None]).nonzero()
    return pair + start_pair, single + start_single


def _cross(a: Floats, b: Floats) -> Floats:
    """Give the cross products of vectors (..., 3, M)."""
    product: Floats = a.take(_YZX, -2) * b.take(_ZXY, -2) - a.take(_ZXY, -2) * b.take(_YZX, -2)
    return product


def _frames(sight: Floats, down: Floats) -> Floats:
    """Give the axes (2, 3, 3, M) along each line of sight (2, 3, M), down across it, and across both."""
    level = down - sight * dot(down, sight)[:, None]
    level /= np.sqrt(dot(level, level))[:, None]
    return np.array((sight, level, _cross(sight, level))).swapaxes(0, 1)


def _turned(of: Floats, to: Floats, v: Floats) -> Floats:
    """Turn vectors (3, M) from the rig that has the axes `of` (3, 3, M) to the rig that has the axes `to`."""
    turned: Floats = np.add.reduce(to * np.add.reduce(of * v, 1)[:, None])
    return turned


def _refined(terms: Terms, lights: NDArray[np.intp], t: Floats, R: Floats) -> Readings | None:
    """Fit the three lights with tilt and depth, and weigh what comes of it."""
    candidates, sensors, levels = terms.candidates, terms.sensors, terms.rigs.levels
    absent = lights < 0
    # The missing light has no weight; its bearing only keeps the arithmetic finite.
    frames = candidates.frames.take(lights, 0)
    q = np.concatenate(
        (levels[1].lights_m @ R.swapaxes(1, 2) + t[:, None], (levels[0].lights_m - t[:, None]) @ R), axis=1
    )
    frames[absent] = 0.0
    frames[absent, 0] = (q / np.sqrt((q * q).sum(2, keepdims=True)))[absent]
    seen = Sightings(frames, candidates.dt_s[lights] * ~absent)
    shifts = shifts_of(seen.dt_s, terms.motion.rates)
    bodies = levels[0].lights_m, levels[1].lights_m
    across = _basis(sensors.down_a)
    weight = np.eye(8)
    for step in range(_STEPS):
        J, along = linearize(t, R, seen, bodies, shifts)
        J_s, sigma = _sensor_rows(sensors, across, levels, t, R)
        if step == 0:
            weight = weight_of(J[:, :, :6], seen.dt_s, terms.motion)
        normal = J.swapaxes(1, 2) @ weight @ J + J_s.swapaxes(1, 2) @ J_s
        covariance, _, move, chi2 = solve_normal(normal)
        t, R = moved(t, R, move)
        if not is_large(move, t, normal[:, 6, 6], chi2):
            break
    range2 = np.add.reduce(t * t, 1)
    settings = terms.settings
    sound = (chi2 < _FITS_CHI2) & (np.minimum.reduce(along, 1) > 0.0)
    sound &= (range2 > settings.range_min_m**2) & (range2 < settings.range_max_m**2)
    sound &= np.isfinite(np.add.reduce(covariance, (1, 2)) + chi2)
    if not np.count_nonzero(sound):
        return None
    log_ratio, log_prior, lone_odds = _log_ratio(terms, lights, t, R, covariance, chi2, sigma)
    range_m = np.sqrt(range2)
    none = np.zeros(len(chi2))
    return Readings(
        lights=lights,
        t_a_b_m=t,
        R_a_b=R,
        covariance=_UNCHECKED * covariance,
        chi2=chi2,
        log_ratio=np.where(sound & np.isfinite(log_ratio), log_ratio, -np.inf),
        tilt_chi2=none,
        depth_chi2=none,
        range_m=np.stack((range_m, range_m), axis=1),
        twist_gap_rad=none,
        clutter=none,
        log_prior=log_prior,
        lone_odds=lone_odds,
    )


def _sensor_rows(
    sensors: Sensors, across: Floats, levels: tuple[Rig, Rig], t: Floats, R: Floats
) -> tuple[Floats, Floats]:
    """Give the derivatives of tilt and depth by the pose, whitened, the residuals as a seventh column (K, 3, 7).

    And the product of their sds.
    """
    down_a = sensors.down_a
    down_b = R @ sensors.down_b
    port_b = R @ levels[1].depth_port_m
    below = t - levels[0].depth_port_m + port_b
    down = down_a + down_b
    down /= np.sqrt(np.add.reduce(down * down, 1, keepdims=True))
    fall = np.add.reduce(down * below, 1)
    level2 = np.add.reduce(below * below, 1) - fall * fall
    sigma_m = np.sqrt(sensors.depth_variance + (0.25 * sensors.tilt_variance) * level2)
    sigma_rad = math.sqrt(sensors.tilt_variance)
    J = np.zeros((len(t), 3, 7))
    across = across / sigma_rad
    np.matmul(down_b, across.T, out=J[:, :2, 6])
    np.matmul(-across, skew(down_b), out=J[:, :2, 3:6])
    down /= sigma_m[:, None]
    J[:, 2, 6] = (fall - (sensors.depth_m or 0.0)) / sigma_m
    J[:, 2, :3] = down
    J[:, 2, 3:6] = -(down[:, None] @ skew(port_b))[:, 0]
    return J, sigma_rad**2 * sigma_m


def _basis(down: Floats) -> Floats:
    """Give two unit vectors (2, 3) across a third."""
    first = np.array((0.0, -down[2], down[1])) if abs(down[0]) < 0.9 else np.array((down[1], -down[0], 0.0))
    first = first / math.sqrt(float(first @ first))
    return np.array((first, skew(down) @ first))


def _log_ratio(
    terms: Terms, lights: NDArray[np.intp], t: Floats, R: Floats, covariance: Floats, chi2: Floats, sigma: Floats
) -> tuple[Floats, Floats, Floats]:
    """Give the log likelihood ratio against chance, by Laplace's approximation about the pose, and the prior's part.

    And the odds that the lone light is another lamp.
    """
    settings, candidates = terms.settings, terms.candidates
    range_m = np.sqrt(np.add.reduce(t * t, 1))
    # The prior of a pose, per m^3 and rad^3; its turn about the line of sight stands with the tilt.
    prior = -3.0 * np.log(range_m)
    prior -= math.log(terms.rigs.views_sr * math.log(settings.range_max_m / settings.range_min_m))
    # Chance puts candidates evenly on the pictures, per px^2.
    chance = np.zeros(len(t))
    for node in (0, 1):
        count, area_px2 = candidates.counts[node], float(terms.rigs.area_px2[2 * node])
        seen = (lights[:, 2 * node : 2 * node + 2] >= 0).sum(1)
        chance += math.log(count / area_px2) + np.where(seen == 2, math.log(max(count - 1, 1) / area_px2), 0.0)
    sigma2_px = np.where(lights < 0, 1.0, candidates.sigma_px[lights] ** 2).prod(1)
    fit = 0.5 * np.log(np.linalg.det(covariance)) - 0.5 * chi2 - np.log(sigma2_px)
    # Nine residuals and six unknowns leave three factors of a normal density.
    fit -= np.log(sigma) + 1.5 * math.log(2.0 * math.pi)
    total = prior + fit - chance + math.log(PITCH_SPREAD * DEPTH_SPREAD_M * MISSING_ODDS)
    R_last, u = R.transpose(1, 2, 0), (t / range_m[:, None]).T
    turn_variance = np.add.reduce(u * (covariance[:, 3:, 3:] @ u.T[:, :, None])[:, :, 0].T)
    _, cosine, sine = terms.sensors.turns @ R.reshape(-1, 9).T
    heading = weigh_heading(sine, cosine, terms.sensors.heading_variance + turn_variance)
    total += heading
    log_prior = np.zeros(len(t))
    if terms.prediction is not None:
        log_prior = weigh_prediction(R_last, t.T, terms.prediction)
    if candidates.log_score is not None:
        total += np.where(lights < 0, 0.0, candidates.log_score[lights]).sum(1)
    # The pair and the attitudes foretell where the lone light stands: across by the tilts, along by the headings.
    rise = ((R @ terms.sensors.down_b - terms.sensors.down_a) * u.T).sum(1)
    density = np.exp(heading - 0.5 * rise * rise / terms.sensors.tilt_variance + log_prior)
    density /= HEADING_SPREAD * math.sqrt(2.0 * math.pi * terms.sensors.tilt_variance)
    return total + log_prior, log_prior, MISSING_ODDS * _others_per_sr(terms, lights) / density


def _others_per_sr(terms: Terms, lights: NDArray[np.intp]) -> Floats:
    """Give how dense candidates that look as much like a light as the lone one stand in its picture, itself counted."""
    candidates, (in_a, in_b) = terms.candidates, terms.candidates.counts
    seer = (lights[:, 0] < 0) | (lights[:, 1] < 0)
    lone = np.where(seer, lights[:, :2].max(1), lights[:, 2:].max(1))
    log_odds = np.zeros(in_a + in_b) if candidates.log_score is None else 2.0 * candidates.log_score
    alike = np.minimum(np.exp(log_odds - log_odds[lone][:, None]), 1.0)
    of_a, of_b = (rig.camera.solid_angle_sr for rig in terms.rigs.rigs)
    density: Floats = np.where(seer, alike[:, :in_a].sum(1) / of_a, alike[:, in_a:].sum(1) / of_b)
    return density
