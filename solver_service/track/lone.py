"""Starts from single lamps: some seconds of both nodes' pictures and samples at once, by least squares.

One lamp of each node tells no range in a picture. Over seconds it does: a lamp moves by known metres as its bar rolls,
and as the depth gauges and the units say. Which lamp is which is told alike (docs/track.md, "One lamp each").
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.courses import lamp_courses
from buddyline.solver_service.track.start import (
    broad_covariance,
    constants_of,
)
from buddyline.solver_service.track.state import NAV, SIZE, State, invariant_of_plain
from buddyline.solver_service.track.window import R_, Fit, Seen, Window
from numpy.typing import NDArray

# Ranges to begin with; rounds with the depths held, then free, until a round gains less than LEAST_GAIN.
RANGES_M: Final = (1.5, 2.7, 5.0, 9.0)
HELD_ROUNDS: Final = 3
ROUNDS: Final = 6
LEAST_GAIN: Final = 0.2
# Courses of a node that are tried, the longest; nodes face each other; pictures of each to begin with; fits to go on
# with.
COURSES: Final = 2
FACING: Final = -0.5
FEW: Final = 30
MOST_FITS: Final = 4
# A fit is refuted by so much of twice the log odds; and is none where its lights cost more than UNFIT each.
REFUTED_BY: Final = 60.0
UNFIT: Final = 5.0


def _fitted(window: Window, seen: Seen, start: Fit) -> Fit:
    """Improve a start by Gauss-Newton, the lights' depths held first."""
    x, ahead = start, start.r / np.linalg.norm(start.r)
    for _ in range(HELD_ROUNDS):
        N, g, _ = window.sums(seen, x, start.near_m)
        N[R_, R_] += np.outer(ahead, ahead) / (0.1 * start.near_m) ** 2
        x = x.plus(np.asarray(np.linalg.solve(N, g), np.float64))
    return _polished(window, seen, x)


def _polished(window: Window, seen: Seen, x: Fit) -> Fit:
    """Improve a fit by Gauss-Newton, with shorter steps where a whole one makes it worse."""
    N, g, cost = window.sums(seen, x)
    for _ in range(ROUNDS):
        step, gained = np.asarray(np.linalg.solve(N, g), np.float64), 0.0
        for share in (1.0, 0.5, 0.2, 0.05):
            trial = x.plus(share * step)
            after = window.sums(seen, trial)
            if after[2] < cost:
                gained = cost - after[2]
                x, (N, g, cost) = trial, after
                break
        if gained < LEAST_GAIN:
            break
    return replace(x, cost=cost, information=N, seen=seen)


def _some(seen: NDArray[np.intp]) -> NDArray[np.intp]:
    return seen[:: max(len(seen) // FEW, 1)]


def fits(window: Window) -> list[Fit]:
    """Give what the window's courses of single lamps allow, the likeliest first, but what is refuted.

    Of each pair of courses, either lamp may be the left or the right one.
    """
    lamps = [lamp_courses(window.sights[n], window.courses[n].D[window.at[n]])[:COURSES] for n in (0, 1)]
    R0 = np.stack([window.anchors.R[n][0] for n in (0, 1)])
    unbiased = np.zeros((2, 15))
    found = []
    for of_a, of_b in product(*lamps):
        ahead, back = (
            R0[n] @ window.courses[n].D[window.at[n][at]] @ window.sights[n][at].bearings[k]
            for n, (at, k) in ((0, of_a[len(of_a) // 2]), (1, of_b[len(of_b) // 2]))
        )
        if float(ahead @ back) > FACING:
            continue
        for light_a, light_b in product((0, 1), (0, 1)):
            seen = (np.insert(np.array(of_a), 2, light_b, axis=1), np.insert(np.array(of_b), 2, light_a, axis=1))
            some = (_some(seen[0]), _some(seen[1]))
            coarse = [
                _fitted(window, some, Fit(range_m * ahead, np.zeros(3), R0, unbiased, near_m=range_m))
                for range_m in RANGES_M
            ]
            best = min(coarse, key=lambda one: one.cost)
            found.append(replace(best, seen=seen, cost=best.cost * len(seen[0]) / len(some[0])))
    kept: list[Fit] = []
    for fit in sorted(found, key=lambda one: one.odds)[:MOST_FITS]:
        full = _polished(window, fit.seen, fit)
        kept.append(_polished(window.by(full.own), full.seen, full))
    kept.sort(key=lambda one: one.odds)
    return [one for one in kept if one.odds < kept[0].odds + REFUTED_BY and one.cost < UNFIT * one.lights]


def state_of(window: Window, fit: Fit, clock_sigma_s: float) -> tuple[State, Floats]:
    """Give the state at a window's start, and a covariance of several of the fit's sigmas."""
    window = window.by(fit.own)
    r_m, v_mps = fit.r.copy(), fit.v.copy()
    for n, sign in ((0, -1.0), (1, 1.0)):
        r_m += sign * fit.R[n] @ window.courses[n].a[0]
        v_mps += sign * fit.R[n] @ window.courses[n].b[0]
    untold, _ = constants_of(window.nodes, fit.R, r_m, clock_sigma_s)
    state = untold.with_parts(
        v_mps=v_mps,
        gyro_bias_radps=fit.own[:, 0:3],
        accel_bias_mps2=fit.own[:, 3:6],
        mount_rad=fit.own[:, 12:15],
        clock_s=fit.clock_s,
        depth_offset_m=fit.depth_m,
    )
    known = np.zeros((SIZE, SIZE))
    T = invariant_of_plain(state)[:NAV, :NAV]
    known[:NAV, :NAV] = T @ np.linalg.inv(fit.information)[:NAV, :NAV] @ T.T
    return state, broad_covariance(window.nodes, state, clock_sigma_s, known)
