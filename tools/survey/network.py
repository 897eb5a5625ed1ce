"""The survey as a network: adjusted positions, loops, residuals, and what is probably wrong."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from functools import cache, cached_property, partial
from typing import TypeAlias

import numpy as np
from buddyline.tools.survey.assembly import EXACT_M, Fixed, depths_of
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.blunders import Blunder, find_blunders
from buddyline.tools.survey.connected import Survey, held_depths
from buddyline.tools.survey.fit import SurveyFit, fit_of
from buddyline.tools.survey.geodesy import Grid, grid_of
from buddyline.tools.survey.lines import Line, line_of, measures_of
from buddyline.tools.survey.observations import Solution
from buddyline.tools.survey.project import Leg, Project
from buddyline.tools.survey.proposals import Proposal, proposals
from buddyline.tools.survey.swims import SwumWay, paths_of
from msgspec import UNSET

Triple: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, eq=False)
class Position:
    """A station or point: east, north, up (m) of the grid; covariance (3, 3), the compasses' common error included."""

    name: str
    position_m: Floats
    covariance: Floats

    @property
    def ellipse(self) -> Triple:
        """Semi-axes (m, 1 sd) of the horizontal ellipse, the larger first, and its azimuth (rad)."""
        values, vectors = np.linalg.eigh(self.covariance[:2, :2])
        minor_m, major_m = np.sqrt(np.maximum(values, 0.0)).tolist()
        return major_m, minor_m, math.atan2(float(vectors[0, 1]), float(vectors[1, 1])) % math.pi

    @property
    def sigmas_m(self) -> Floats:
        """Standard deviations (3,) of east, north and up."""
        return np.asarray(np.sqrt(np.maximum(np.diag(self.covariance), 0.0)))


@dataclass(frozen=True)
class Loop:
    """A closed round of legs, or a way between two fixed points. The ratios: misclosure over its expected rms.

    legs: their numbers in the Survey.
    """

    stations: tuple[str, ...]
    length_m: float
    misclosure_m: Triple
    horizontal_ratio: float
    vertical_ratio: float
    legs: tuple[int, ...] = ()

    @property
    def error_m(self) -> float:
        """Length of the misclosure, m."""
        return math.hypot(*self.misclosure_m)


@dataclass(frozen=True)
class Residual:
    """A leg's residual. chi2: the largest of its observations', by their own sds; None if no loop checks the leg."""

    leg: Leg
    moved_m: Triple
    chi2: float | None


@dataclass(frozen=True, eq=False)
class Adjusted:
    """An adjusted survey. proposals: stations that may be one place. left_out: legs without a place in it, and why.

    lines: legs with what the instruments add taken off, so that whoever adjusts them gets these positions. survey,
    solution: what was adjusted, and the least squares of it.
    """

    grid: Grid
    positions: dict[str, Position]
    loops: list[Loop]
    points: list[Position]
    survey: Survey
    solution: Solution
    proposals: list[Proposal] = field(default_factory=list)
    left_out: list[tuple[Leg, str]] = field(default_factory=list)

    @cached_property
    def lines(self) -> list[Line]:
        """Every leg that took part and has a direction, as corrected by what the adjustment found."""
        return self.survey.corrected(self.solution)

    @cached_property
    def residuals(self) -> list[Residual]:
        """Every line's residual, in the order of lines."""
        return residuals_of(self.survey, self.solution, self.lines, self.loops)

    @cached_property
    def paths(self) -> list[SwumWay]:
        """The ways that were swum between stations."""
        return paths_of(self.survey.project, self.solution, self.survey.origin_m)

    @cached_property
    def blunders(self) -> list[Blunder]:
        """What is probably wrong, the first found first."""
        return find_blunders(self.survey)

    @cached_property
    def fit(self) -> SurveyFit:
        """The global test and the instruments."""
        return fit_of(self.solution)

    @property
    def length_m(self) -> float:
        """Length of all legs that took part, repeats once."""
        return sum({frozenset(ends): leg.distance_m for leg, ends in self.survey.stations_legs}.values())


def residuals_of(survey: Survey, solution: Solution, lines: list[Line], loops: list[Loop]) -> list[Residual]:
    """Return what the adjustment added to each line, and how far beyond its sds."""
    looped = {number for loop in loops for number in loop.legs}
    worst = np.zeros(len(survey.legs))
    of_leg = solution.model.leg >= 0
    np.maximum.at(worst, solution.model.leg[of_leg], solution.suspicion[of_leg])
    at, position_m = solution.observations.at, solution.position_m
    numbers = {id(leg): number for number, leg in enumerate(survey.legs)}
    found = []
    for line in lines:
        number = numbers[id(line.leg)]
        start, end = (at[name] for name in survey.ends[number])
        moved_m = position_m[end] - position_m[start] - line.vector_m
        found.append(Residual(line.leg, _triple(moved_m), float(worst[number]) if number in looped else None))
    return found


def adjust(project: Project) -> Adjusted:
    """Adjust the whole network; raise BuddylineError if there is nothing to adjust."""
    grid = grid_of(project)
    survey = Survey(project, grid)
    solution = survey.adjust()
    covariances = solution.station_covariances
    if project.adjust.datum == "free" and not project.fix:
        covariances = free_covariances(solution, turned=survey.north_along is not None)
    position_m = solution.position_m + survey.origin_m
    at = solution.observations.at
    of_points = {ends[1]: leg.to for leg, ends in zip(survey.legs, survey.ends, strict=True) if " " in ends[1]}
    every = {
        name: Position(of_points.get(name, name), position_m[number], covariances[number])
        for name, number in at.items()
    }
    return Adjusted(
        grid,
        {name: one for name, one in every.items() if name not in of_points},
        find_loops(survey, solution),
        [every[name] for name in of_points],
        survey,
        solution,
        proposals(solution, [ends for _, ends in survey.stations_legs]),
        survey.left_out,
    )


def free_covariances(solution: Solution, *, turned: bool = False) -> Floats:
    """Return the stations' covariances (s, 3, 3) relative to all stations' mean (inner constraints; Baarda 1973).

    S = I - H (H^T H)^-1 H^T takes off what a shift of the whole map, H, explains; heights keep their water level.
    turned: and what a turn about the mean explains, where nothing tells a direction.
    """
    count = solution.model.stations
    H = np.zeros((len(solution.x), 3 if turned else 2))
    H[0 : 3 * count : 3, 0] = H[1 : 3 * count : 3, 1] = 1 / math.sqrt(count)
    if turned:
        away_m = solution.position_m[:, :2] - solution.position_m[:, :2].mean(axis=0)
        H[0 : 3 * count : 3, 2], H[1 : 3 * count : 3, 2] = away_m[:, 1], -away_m[:, 0]
        H[:, 2] /= np.linalg.norm(H[:, 2])
    ZH = solution.normal.solve(H)
    block = (H.T @ ZH)[None]
    h = H[: 3 * count].reshape(count, 3, H.shape[1])
    across = h @ ZH[: 3 * count].reshape(count, 3, H.shape[1]).transpose(0, 2, 1)
    return np.asarray(
        solution.station_covariances - across - across.transpose(0, 2, 1) + h @ block @ h.transpose(0, 2, 1)
    )


def _triple(vector: Floats) -> Triple:
    return float(vector[0]), float(vector[1]), float(vector[2])


def find_loops(survey: Survey, solution: Solution) -> list[Loop]:
    """Return independent loops of the legs as read: each leg that is not in the tree of shortest ways closes one.

    Fixed points count as joined, so that a way between two of them is a loop. V is of the gauges' own readings, with
    zeros, drifts and levels taken off.
    """
    fixed = survey.fixed
    touching: dict[str, list[tuple[str, int, float]]] = {}
    for number, (start, end) in enumerate(survey.ends):
        if " " not in end:
            touching.setdefault(start, []).append((end, number, 1.0))
            touching.setdefault(end, []).append((start, number, -1.0))
    # The last step of the shortest way from a fixed point: back to where, by which leg, in which sense; its length.
    tree: dict[str, tuple[str, int, float] | None] = dict.fromkeys(name for name in fixed if name in touching)
    level = dict.fromkeys(tree, 0)
    queue = deque(tree)
    while queue:
        name = queue.popleft()
        for other, number, sign in touching[name]:
            if other not in tree:
                tree[other], level[other] = (name, number, sign), level[name] + 1
                queue.append(other)
    in_tree = {step[1] for step in tree.values() if step is not None}
    as_read = cache(partial(_as_read, survey, solution, held_depths(survey.project)))
    found = []
    for closing, (start, end) in enumerate(survey.ends):
        if closing in in_tree or start not in tree or end not in tree:
            continue
        ways: tuple[list[str], list[str]] = ([start], [end])
        steps = [(closing, 1.0)]
        while ways[0][-1] != ways[1][-1] and (tree[ways[0][-1]] is not None or tree[ways[1][-1]] is not None):
            side = 0 if level[ways[0][-1]] >= level[ways[1][-1]] else 1
            back, number, sign = tree[ways[side][-1]]  # type: ignore[misc]
            ways[side].append(back)
            steps.append((number, sign if side == 0 else -sign))
        numbers, signs = zip(*steps, strict=True)
        parts = np.array([as_read(number) for number in numbers])
        if not np.isnan(parts).any():
            found.append(_loop(fixed, ways, numbers, signs, parts))
    return found


def _as_read(survey: Survey, solution: Solution, depths_m: dict[str, float], number: int) -> Floats:
    """Return a leg as read, (7,): east, north, up by the gauges' own readings, their variances, and the length.

    All are NaN for a leg that has no vector. depths_m: the held depths.
    """
    leg, turn_rad = survey.legs[number], survey.turns_rad[number]
    line = line_of(leg, measures_of(leg, survey.project, turn_rad, depths_m), turn_rad)
    if line is None:
        return np.full(7, np.nan)
    vector_m, variances = line.vector_m.copy(), np.diag(line.covariance).copy()
    start, end = depths_of(leg)
    if start is not None and end is not None and not line.by_clino:
        # Held depths close by construction, so V is of each leg's own readings.
        vector_m[2] = start[0] - end[0] + solution.correction(number, "depth_from")
        vector_m[2] -= solution.correction(number, "depth_to") + solution.correction(number, "rise")
        noises = leg.depth_from_noise_m, leg.depth_to_noise_m
        sigmas = (leg.depth_from_sigma_m, leg.depth_to_sigma_m) if UNSET in noises else noises
        variances[2] += sum(sd**2 for sd in sigmas if sd is not UNSET) - line.rise_sigma_m**2
    return np.array([*vector_m, *variances, line.length_m])


def _loop(
    fixed: Fixed, ways: tuple[list[str], list[str]], numbers: tuple[int, ...], signs: tuple[float, ...], parts: Floats
) -> Loop:
    """Return the loop of two ways that meet, or end at two fixed points. parts: (legs, 7), see _as_read."""
    vector, variances, length_m = np.array(signs) @ parts[:, :3], parts[:, 3:6].sum(axis=0), parts[:, 6].sum()
    out, back = ways
    joined = out[-1] == back[-1]
    for name, sign in () if joined else ((out[-1], 1.0), (back[-1], -1.0)):
        position_m, sigmas_m = fixed[name]
        vector = vector + sign * np.nan_to_num(position_m)
        variances = variances + sigmas_m**2
    if not joined and any(math.isnan(fixed[name][0][2]) for name in (out[-1], back[-1])):
        vector[2] = 0.0
    return Loop(
        (*reversed(out), *(back[:-1] if joined else back)),
        float(length_m),
        _triple(vector),
        math.hypot(vector[0], vector[1]) / math.sqrt(variances[0] + variances[1]),
        abs(float(vector[2])) / math.sqrt(max(float(variances[2]), EXACT_M**2)),
        numbers,
    )
