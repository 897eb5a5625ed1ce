"""One light short: six coordinates for six unknowns, and attitude and depth to tell whether they belong together.

Why the track does not replace it: with a lamp dark for the whole dive, the track has no other fix to start from. In the
dives of prior.py, poses of three lights are 1,876 of 9,364.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.batch import Batch
from buddyline.solver_service.geometry.evidence import (
    DEPTH_SPREAD_M,
    GROSS_PROBABILITY,
    GROSS_PX,
    GROSS_SCALE,
    GROSS_SHARE,
    HEADING_SPREAD,
    MISSING_ODDS,
    PITCH_SPREAD,
    weigh_heading,
)
from buddyline.solver_service.geometry.guesses import Guesses, guess
from buddyline.solver_service.geometry.ragged import places, starts_of
from buddyline.solver_service.geometry.readings import Poses, Read, Readings
from buddyline.solver_service.geometry.refinement import Refined, Solved, light_rows, refine
from buddyline.solver_service.geometry.rotation import Floats, Index, Indices, inner, skew
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.sensors import off_rad, turn_of
from numpy.typing import NDArray

# chi^2 of tilt and depth, three degrees of freedom, after the refinement.
_FITS_CHI2: Final = 16.0
_STEPS: Final = 4
# Of which side each of four lights is.
_SIDES: Final = np.array((0, 1, 0, 1))
# No gap tells a gross error of the pair: the covariance has its share of them.
UNCHECKED: Final = 1.0 + GROSS_PROBABILITY * (GROSS_SCALE**2 - 1.0)


def three_lights_tell(batch: Batch) -> NDArray[np.bool_]:
    """Tell in which triggers (T,) three lights can give a pose: where attitudes and depths are known and may speak."""
    sensors, settings = batch.sensors, batch.settings
    if settings.method != "refined" or not settings.checks >= {"attitude", "depth"}:
        return np.zeros(batch.triggers, dtype=bool)
    told: NDArray[np.bool_] = sensors.both & np.isfinite(sensors.depth_m)
    return told


def read_three_lights(batch: Batch, wanted: NDArray[np.bool_]) -> Read:
    """Give the best readings of three lights of the triggers wanted (T,), of those in which three lights can tell."""
    guesses = guess(batch, wanted)
    seen, settings = batch.candidates, batch.settings
    trigger, lights = guesses.trigger, guesses.lights
    across = _across(batch.sensors.R_ned_camera[trigger, 0, 2])
    refined = _refined(batch, guesses, across)
    T_a_b = refined.T_a_b.retract(refined.solved.step)
    range2 = inner(T_a_b.t_m, T_a_b.t_m)
    sound = refined.sound & (refined.solved.chi2 < _FITS_CHI2)
    sound &= (range2 > settings.range_min_m**2) & (range2 < settings.range_max_m**2)
    log_ratio, turn, log_heading, turn_variance, lone_odds, lone_density = _log_ratio(
        batch, guesses, across, T_a_b, refined
    )
    sound &= np.isfinite(refined.solved.covariance.sum((1, 2)) + log_ratio)
    none, range_m = np.zeros(len(trigger)), np.sqrt(range2)
    starts = starts_of(np.bincount(trigger, minlength=batch.triggers))
    return Read(
        pose_starts=starts,
        poses=Poses(
            T_a_b=T_a_b,
            log_ratio=np.where(sound, log_ratio + log_fit(refined.solved), -np.inf),
            turn=turn,
            log_heading=log_heading,
            turn_variance=turn_variance,
        ),
        starts=starts,
        pose=np.arange(len(trigger)),
        readings=Readings(
            lights=np.where(lights < 0, -1, seen.index[lights]),
            refined=replace(refined, sound=sound),
            dt_s=np.column_stack(((seen.dt_s[lights] * (lights >= 0)).repeat(2, 1), none, none, none)),
            log_ratio=log_ratio,
            tilt_chi2=none,
            depth_chi2=none,
            gap_chi2=none,
            range_m=np.stack((range_m, range_m), axis=1),
            twist_gap_rad=none,
            clutter=none,
            lone_odds=lone_odds,
            lone_density=lone_density,
        ),
    )


def log_fit(solved: Solved) -> Floats:
    """Give the residuals' part (K,) of the log likelihood ratio, by Laplace's approximation about the pose."""
    fit: Floats = 0.5 * np.log(np.linalg.det(solved.covariance)) - 0.5 * solved.chi2 - solved.log_noise
    return fit


def _refined(batch: Batch, guesses: Guesses, across: Floats) -> Refined:
    """Fit the three lights with tilt and depth; across: as `_sensor_rows` takes it."""
    seen, rigs = batch.candidates, batch.rigs
    lights, T_a_b = guesses.lights, rigs.between_cameras(guesses.T_a_b)
    absent = lights < 0
    # The missing light has no weight; its bearing only keeps the arithmetic finite.
    lights_m = rigs.lights_in_camera_m
    in_a = lights_m[1] @ T_a_b.R.swapaxes(1, 2) + T_a_b.t_m[:, None]
    in_b = (lights_m[0] - T_a_b.t_m[:, None]) @ T_a_b.R
    q = np.concatenate((in_a, in_b), axis=1)
    frames = seen.frames[lights]
    frames[absent] = 0.0
    frames[absent, 0] = (q / np.sqrt(inner(q, q))[..., None])[absent]

    def rows_at(T_a_b: SE3, chosen: Index) -> tuple[Floats, Floats]:
        of_lights, depth = light_rows(T_a_b, frames[chosen], lights_m)
        of_sensors, _ = _sensor_rows(batch, guesses.trigger[chosen], across[chosen], T_a_b)
        return np.concatenate((of_lights, of_sensors), axis=1), depth

    return refine(T_a_b, rows_at, _STEPS)


def _sensor_rows(batch: Batch, trigger: Indices, across: Floats, T_a_b: SE3) -> tuple[Floats, Floats]:
    """Give rows (K, 3, 7) of tilt and depth as in `Refined`, and the product of their sds (K,).

    across: (K, 2, 3) unit vectors across A's down.
    """
    sensors, (port_a, port_b) = batch.sensors, batch.rigs.port_in_camera_m
    down_a, of_b = sensors.R_ned_camera[trigger, :, 2].swapaxes(0, 1)
    down_b, port_b = (T_a_b.R @ of_b[:, :, None])[:, :, 0], T_a_b.R @ port_b
    below = T_a_b.t_m - port_a + port_b
    down = down_a + down_b
    down /= np.sqrt(inner(down, down))[:, None]
    fall = inner(down, below)
    tilt_variance = sensors.tilts_variance[trigger]
    sigma_m = np.sqrt(sensors.depth_variance[trigger] + 0.25 * tilt_variance * (inner(below, below) - fall * fall))
    across = across / np.sqrt(tilt_variance)[:, None, None]
    down /= sigma_m[:, None]
    rows = np.zeros((len(trigger), 3, 7))
    rows[:, :2, 3:6] = -across @ skew(down_b)
    rows[:, :2, 6] = (across @ down_b[:, :, None])[:, :, 0]
    rows[:, 2, :3] = down
    rows[:, 2, 3:6] = -(down[:, None] @ skew(port_b))[:, 0]
    rows[:, 2, 6] = (fall - sensors.depth_m[trigger]) / sigma_m
    return rows, tilt_variance * sigma_m


def _across(down: Floats) -> Floats:
    """Give two unit vectors (K, 2, 3) across each of K."""
    x, y, z = down.T
    none = np.zeros(len(down))
    first = np.where(np.abs(x) < 0.9, (none, -z, y), (y, -x, none)).T
    first = first / np.sqrt(inner(first, first))[:, None]
    return np.stack((first, (skew(down) @ first[:, :, None])[:, :, 0]), axis=1)


def _log_ratio(
    batch: Batch, guesses: Guesses, across: Floats, T_a_b: SE3, refined: Refined
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Give the log likelihood ratio against chance (K,), without the fit.

    After it turn, log_heading and turn_variance as in Poses, and lone_odds and lone_density as in Readings. across: as
    `_sensor_rows` takes it.
    """
    settings, seen, rigs, sensors = batch.settings, batch.candidates, batch.rigs, batch.sensors
    trigger, lights = guesses.trigger, guesses.lights
    range_m = np.sqrt(inner(T_a_b.t_m, T_a_b.t_m))
    # The prior of a pose, per m^3 and rad^3; its turn about the line of sight stands with the tilt.
    prior = -3.0 * np.log(range_m) - math.log(rigs.views_sr2 * math.log(settings.range_max_m / settings.range_min_m))
    # Chance puts candidates evenly on the pictures, per px^2.
    counts = seen.in_whole[trigger]
    both_seen = (lights.reshape(-1, 2, 2) >= 0).all(2)
    chance = np.log(counts / rigs.area_px2) + np.where(
        both_seen, np.log(np.maximum(counts - 1, 1) / rigs.area_px2), 0.0
    )
    sigma_px = np.where(lights < 0, 1.0, seen.sigma_px[lights])
    _, sigma = _sensor_rows(batch, trigger, across, refined.T_a_b)
    total = prior - chance.sum(1) - 2.0 * np.log(sigma_px).sum(1) - np.log(sigma)
    # Nine residuals and six unknowns leave three factors of a normal density.
    total += math.log(PITCH_SPREAD * DEPTH_SPREAD_M * MISSING_ODDS) - 1.5 * math.log(2.0 * math.pi)
    total += np.where(lights < 0, 0.0, seen.log_score[lights]).sum(1)
    if seen.log_side is not None and seen.dark is not None:
        total += np.where(lights < 0, 0.0, seen.log_side[lights, _SIDES]).sum(1)
        # A lamp that is switched off is missing for certain.
        total -= math.log(MISSING_ODDS) * ((lights < 0) & seen.dark[trigger]).sum(1)
    total += np.log1p(_gross_odds(batch, guesses, T_a_b))
    R_ned_a, R_ned_b = sensors.R_ned_camera[trigger].swapaxes(0, 1)
    turn = turn_of(T_a_b.R, R_ned_a, R_ned_b)
    u = T_a_b.t_m / range_m[:, None]
    turn_variance = inner((refined.solved.covariance[:, 3:, 3:] @ u[:, :, None])[:, :, 0], u)
    heading = weigh_heading(off_rad(turn), sensors.heading_variance[trigger] + turn_variance)
    # The pair and the attitudes predict where the lone light stands: across by the tilts, along by the headings.
    rise = inner((T_a_b.R @ R_ned_b[:, 2, :, None])[:, :, 0] - R_ned_a[:, 2], u)
    tilt_variance = sensors.tilts_variance[trigger]
    density = np.exp(heading - 0.5 * rise * rise / tilt_variance)
    density /= HEADING_SPREAD * np.sqrt(2.0 * math.pi * tilt_variance)
    lone, others_per_sr = _others_per_sr(batch, guesses)
    lone_odds, lone_density = MISSING_ODDS * others_per_sr / density, density * seen.variance[lone]
    return total + heading, turn, heading, turn_variance, lone_odds, lone_density


def _gross_odds(batch: Batch, guesses: Guesses, T_a_b: SE3) -> Floats:
    """Give the odds (K,) that the fourth light is among the candidates, off by a gross error, against that it is not.

    Where four lights do not fit for the sake of one, the other three would otherwise have to call it chance that a
    candidate stands beside its place, and would lose to three lights of another pose.
    """
    seen, rigs, lights = batch.candidates, batch.rigs, guesses.lights
    missing = lights.argmin(1)
    in_b = missing >> 1
    light_m = rigs.lights_in_camera_m[1 - in_b, missing & 1]
    back_again = T_a_b.inverse()
    R = np.where(in_b[:, None, None], back_again.R, T_a_b.R)
    t = np.where(in_b[:, None], back_again.t_m, T_a_b.t_m)
    foretold = (R @ light_m[:, :, None])[:, :, 0] + t
    picture = 2 * guesses.trigger + in_b
    owner, place = places(seen.counts.ravel()[picture])
    other = seen.starts[picture][owner] + place
    along, *across = np.moveaxis((seen.frames[other] @ foretold[owner, :, None])[:, :, 0], 1, 0)
    off = np.array(across) / along * seen.sigma_px[other]
    fits = np.exp(seen.log_score[other] - 0.5 * (off * off).sum(0) / GROSS_PX**2)
    if seen.log_side is not None:
        fits *= np.exp(seen.log_side[other, _SIDES[missing[owner]]])
    # The third light, in the same picture, is no second one; nor is a light that stands behind the camera.
    fits[(other == lights.max(1, where=np.arange(4) // 2 == in_b[:, None], initial=-1)[owner]) | (along <= 0.0)] = 0.0
    # The third light is not one of those that chance puts there.
    chance = np.maximum(seen.in_whole[guesses.trigger, in_b] - 1, 1) / rigs.area_px2[in_b]
    found = np.bincount(owner, fits, minlength=len(lights))
    odds: Floats = GROSS_SHARE / MISSING_ODDS * found / (2.0 * math.pi * GROSS_PX**2 * chance)
    return odds


def _others_per_sr(batch: Batch, guesses: Guesses) -> tuple[Indices, Floats]:
    """Give the lone lights (K,), and how many candidates per sr of their pictures look as much like a light.

    Each counts as one.
    """
    seen = batch.candidates
    seen_in = guesses.lights.reshape(-1, 2, 2)
    node = (seen_in >= 0).all(2).argmin(1)
    lone = seen_in[np.arange(len(node)), node].max(1)
    owner, place = places(seen.counts[guesses.trigger, node])
    other = seen.starts[seen.image[lone]][owner] + place
    alike = np.minimum(np.exp(2.0 * (seen.log_score[other] - seen.log_score[lone[owner]])), 1.0)
    return lone, np.bincount(owner, alike, minlength=len(node)) / batch.rigs.solid_angle_sr[node]
