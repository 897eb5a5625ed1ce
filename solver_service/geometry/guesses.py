"""Poses out of three lights: a pair in one picture, a single light in the other, and gravity.

The full observer sees both lights of the partial observer, which sees one of the full observer's. The pair gives the
line of sight, and the range once the partial observer's bar is oriented; gravity orients it about the line of sight;
the single light turns the full observer to where it sees it. Tilt (twice) and depth are then left over as checks.

Arrays hold the full observer's value first; vectors (3, M).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.batch import Batch
from buddyline.solver_service.geometry.closed_form import cross, dot, eq1_range_m
from buddyline.solver_service.geometry.ragged import places, rank
from buddyline.solver_service.geometry.rotation import Floats, Indices
from buddyline.solver_service.geometry.se3 import SE3
from numpy.typing import NDArray

# More combinations than this are not tried: among so many, three lights are never certain.
_MAX_COMBINATIONS: Final = 4000
# The single light is first taken for the middle of its bar, then for where it is.
_ROUNDS: Final = 2
# chi^2 of tilt and depth, three degrees of freedom, before the refinement.
_GATE_CHI2: Final = 40.0
# So many of a trigger's guesses are refined.
_KEPT: Final = 12
# How far a bar may rise more than its attitude says, and the middle stand off the bisector: shares of alpha.
_BAR_RISE: Final = 0.15
_SPLIT_SHARE: Final = 0.1
_X: Final = np.array(((1.0,), (0.0,), (0.0,)))


@dataclass(eq=False, slots=True)
class Guesses:
    """M poses between the bar frames by trigger, the best first; lights: (M, 4) candidates, -1: not seen."""

    trigger: Indices
    lights: Indices
    T_a_b: SE3


@dataclass(eq=False, slots=True)
class _Combinations:
    """Pair (M,) in the full observer's picture, single light (M,) in the other's, read as left (0) or right (1)."""

    pair: Indices
    single: Indices
    side: Indices
    trigger: Indices
    full: Indices


def guess(batch: Batch, wanted: NDArray[np.bool_]) -> Guesses:
    """Try all pairs of either picture with all candidates of the other; wanted: (T,) in which triggers."""
    seen, pairs, rigs, sensors = batch.candidates, batch.pairs, batch.rigs, batch.sensors
    tried = _combinations(batch, wanted)
    nodes = np.array((tried.full, 1 - tried.full))
    down = sensors.down[tried.trigger, nodes].swapaxes(1, 2)
    middle = rigs.middle_m[nodes].swapaxes(1, 2)
    port = rigs.port_m[nodes].swapaxes(1, 2)
    arm = rigs.lights_m[tried.full, tried.side].T - middle[0]
    c, w, chord = pairs.c[:, tried.pair], pairs.w[:, tried.pair], pairs.chord[tried.pair]
    bearing = seen.bearing[:, tried.single]
    cos_alpha, sin_alpha = 1.0 - 0.5 * chord * chord, chord * np.sqrt(1.0 - 0.25 * chord * chord)
    # Both lines of sight point from the full to the partial observer.
    sight = np.array((c, -bearing))
    axes = _axes(sight, down)
    # Gravity tells which end of the pair is the right light: the partial observer's x axis, turned over.
    swapped = dot(w, _turned(axes[1], axes[0], _X)) < 0.0
    w = np.where(swapped, -w, w)
    range_m = np.zeros(len(tried.pair))
    for step in range(_ROUNDS):
        if step > 0:
            light = _turned(axes[0], axes[1], arm - sight[0] * range_m) + middle[1]
            back = bearing - sight[1] - light / np.sqrt(dot(light, light))
            sight[1] = -back / np.sqrt(dot(back, back))
        sin_beta = -sight[1, 0]
        half = 0.5 * (np.arcsin(sin_beta) - np.arcsin(sin_beta * cos_alpha))
        sight[0] = c * np.cos(half) - w * np.sin(half)
        range_m = eq1_range_m(cos_alpha, sin_alpha, sin_beta, rigs.length_m[nodes[1]])
        axes = _axes(sight, down)
    R = np.einsum("rak,rbk->abk", *axes)
    t = middle[0] + sight[0] * range_m - dot(R, middle[1])
    # Both components of the tilt that remain: along the line of sight, and about it.
    rise = np.arcsin(dot(down[0], sight[0])) - np.arcsin(dot(down[1], sight[1]))
    bar = R[:, 0] - sight[0] * dot(sight[0], R[:, 0])
    about = dot(sight[0], cross(bar, w)) / np.sqrt(dot(bar, bar))
    fall = dot(down[0], t - port[0] + dot(R, port[1]))
    variance, tilt_variance = pairs.variance[tried.pair], sensors.tilts_variance[tried.trigger]
    depth_variance = sensors.depth_variance[tried.trigger] + 0.5 * tilt_variance * (dot(t, t) - fall * fall)
    depth_variance += variance * fall * fall
    off_m = np.where(tried.full == 0, fall, -fall) - sensors.depth_m[tried.trigger]
    chi2 = (rise * rise + about * about) / (tilt_variance + variance) + off_m * off_m / depth_variance
    settings = batch.settings
    keep = np.flatnonzero((range_m > settings.range_min_m) & (range_m < settings.range_max_m) & (chi2 < _GATE_CHI2))
    # Chance puts two candidates near each other the more rarely, the nearer.
    order, place = rank(tried.trigger[keep], (chi2 + 4.0 * np.log(chord))[keep], batch.triggers)
    best = keep[order[place < _KEPT]]
    T_full_partial = SE3(R[:, :, best].transpose(2, 0, 1), t[:, best].T)
    back_again = T_full_partial.inverse()
    of_a = tried.full[best] == 0
    return Guesses(
        trigger=tried.trigger[best],
        lights=_lights(batch, tried, swapped, best),
        T_a_b=SE3(
            np.where(of_a[:, None, None], T_full_partial.R, back_again.R),
            np.where(of_a[:, None], T_full_partial.t_m, back_again.t_m),
        ),
    )


def _lights(batch: Batch, tried: _Combinations, swapped: NDArray[np.bool_], best: Indices) -> Indices:
    """Give the candidates (M, 4) of the chosen combinations."""
    first, second = batch.pairs.ends[:, tried.pair[best]]
    full, rows = tried.full[best], np.arange(len(best))
    lights = np.full((len(best), 4), -1)
    lights[rows, 2 * full] = np.where(swapped[best], second, first)
    lights[rows, 2 * full + 1] = np.where(swapped[best], first, second)
    lights[rows, 2 - 2 * full + tried.side[best]] = tried.single[best]
    return lights


def _combinations(batch: Batch, wanted: NDArray[np.bool_]) -> _Combinations:
    """Give pairs and single lights that lie in opposite elevations."""
    seen, pairs, rigs, sensors = batch.candidates, batch.pairs, batch.rigs, batch.sensors
    counts = pairs.counts * seen.counts[:, ::-1]
    wanted = wanted & (2 * counts.sum(1) <= _MAX_COMBINATIONS)
    chosen = np.flatnonzero(wanted[pairs.trigger] & pairs.usable)
    opposite = pairs.image[chosen] ^ 1
    owner, place = places(seen.counts.ravel()[opposite])
    pair, single = chosen[owner], seen.starts[opposite][owner] + place
    down = sensors.down.reshape(-1, 3)
    rise = np.arcsin(dot(down[pairs.image].T, pairs.c))
    fall = np.arcsin(-dot(down[seen.image].T, seen.bearing))
    # The single light stands off the middle by half its bar: so much at the range that the pair has at least.
    node = pairs.image & 1
    ratio = rigs.length_m[node] / rigs.length_m[1 - node]
    share = 0.75 * ratio * (np.abs(down[pairs.image, 0]) + _BAR_RISE) + _SPLIT_SHARE
    slack = share * pairs.chord + np.sqrt(_GATE_CHI2 * sensors.tilts_variance)[pairs.trigger]
    near = np.abs(rise[pair] - fall[single]) < slack[pair]
    pair, single = pair[near].repeat(2), single[near].repeat(2)
    side = np.arange(len(pair)) & 1
    return _Combinations(pair, single, side, pairs.trigger[pair], pairs.image[pair] & 1)


def _axes(sight: Floats, down: Floats) -> Floats:
    """Give the axes (2, 3, 3, M) along each line of sight (2, 3, M), down across it, and across both."""
    across = down - sight * dot(down, sight)[:, None]
    across /= np.sqrt(dot(across, across))[:, None]
    return np.array((sight, across, cross(sight, across))).swapaxes(0, 1)


def _turned(of: Floats, to: Floats, v: Floats) -> Floats:
    """Turn vectors (3, M) from the rig that has the axes `of` (3, 3, M) to the rig that has the axes `to`."""
    turned: Floats = np.einsum("rck,rk->ck", to, dot(of, v))
    return turned
