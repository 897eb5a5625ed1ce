"""The survey as a network: adjusted positions, loops, residuals, and the legs that are probably wrong."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.gauges import adjust_gauges
from buddyline.tools.survey.geodesy import Grid, grid_of, leg_date
from buddyline.tools.survey.lines import Line, line_of
from buddyline.tools.survey.project import Leg, Project
from buddyline.tools.survey.proposals import Proposal, proposals
from msgspec import UNSET

# Chi^2 of three degrees of freedom that one leg in a thousand exceeds.
BLUNDER_CHI2: Final = 16.27
MOST_BLUNDERS: Final = 10
# Legs that explain a misclosure nearly as well as the best one are listed with it.
AS_GOOD: Final = 0.8
EXACT_M: Final = 1e-4

# Position (3,) and its standard deviations (3,): east, north, up, m.
Fixed: TypeAlias = dict[str, tuple[Floats, Floats]]
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
    """A closed round of legs, or a way between two fixed points. The ratios: misclosure over its expected rms."""

    stations: tuple[str, ...]
    length_m: float
    misclosure_m: Triple
    horizontal_ratio: float
    vertical_ratio: float

    @property
    def error_m(self) -> float:
        """Length of the misclosure, m."""
        return math.hypot(*self.misclosure_m)


@dataclass(frozen=True)
class Residual:
    """A leg's residual. chi2: of the residual, by its own covariance; None if no loop checks the leg."""

    leg: Leg
    moved_m: Triple
    chi2: float | None


@dataclass(frozen=True)
class Blunder:
    """Legs of which one is wrong, the likeliest first, and the error that it would have."""

    legs: tuple[str, ...]
    off_m: float
    chi2: float


@dataclass(frozen=True, eq=False)
class Adjusted:
    """An adjusted survey. proposals: stations that may be one place. left_out: legs without a place in it, and why."""

    grid: Grid
    positions: dict[str, Position]
    lines: list[Line]
    residuals: list[Residual]
    loops: list[Loop]
    blunders: list[Blunder]
    points: list[Position]
    proposals: list[Proposal] = field(default_factory=list)
    left_out: list[tuple[Leg, str]] = field(default_factory=list)

    @property
    def length_m(self) -> float:
        """Length of all legs that took part, repeats once."""
        return sum({frozenset((line.leg.from_, line.leg.to)): line.leg.distance_m for line in self.lines}.values())


def station_depths(project: Project) -> dict[str, float]:
    """Return the mean depth of every station whose gauges were read."""
    return {station.name: station.depth_m for station in project.station if station.depth_m is not UNSET}


def held_depths(project: Project) -> dict[str, float]:
    """Return the held stations and their gauges' mean depth; none if each leg keeps its readings."""
    return station_depths(project) if project.adjust.depth == "absolute" else {}


def water_level_m(project: Project) -> float:
    """Return the surface's altitude: stated, or from a fixed point's altitude and depth, or 0."""
    if project.place.water_level_m is not UNSET:
        return project.place.water_level_m
    depths = station_depths(project)
    known = (f.altitude_m + depths[f.station] for f in project.fix if f.altitude_m is not UNSET and f.station in depths)
    return next(known, 0.0)


def fixed_points(project: Project, grid: Grid) -> Fixed:
    """Return the fixed stations' positions and sigmas; without any, the first leg's start at east 0, north 0."""
    depths, level_m = station_depths(project), water_level_m(project)
    fixed: Fixed = {}
    for fix in project.fix:
        altitude_m, altitude_sigma_m = fix.altitude_m, fix.altitude_sigma_m
        if altitude_m is UNSET or project.adjust.depth == "absolute":
            # Depths are absolute: a fixed altitude would contradict them.
            altitude_m, altitude_sigma_m = level_m - depths.get(fix.station, 0.0), 0.0
        sigmas_m = np.array([fix.sigma_m, fix.sigma_m, altitude_sigma_m])
        fixed[fix.station] = np.array([*grid.position_m(fix), altitude_m]), sigmas_m
    if not fixed:
        if not project.leg:
            raise BuddylineError("the project has no legs; run `buddyline survey legs` first")
        start = project.leg[0].from_
        fixed[start] = np.array([0.0, 0.0, level_m - depths.get(start, 0.0)]), np.zeros(3)
    return fixed


def adjust(project: Project) -> Adjusted:
    """Adjust the whole network; raise BuddylineError if there is nothing to adjust.

    Declination and convergence are each leg's own, so on a map grid a first adjustment gives the places of the legs.
    """
    grid = grid_of(project)
    fixed = fixed_points(project, grid)
    stations = {name for leg in project.leg for name in (leg.from_, leg.to)}
    for name in fixed:
        if name not in stations:
            raise BuddylineError(f"fix of {name!r}: no leg has this station; known: {', '.join(sorted(stations))}")
    read_m = adjust_gauges(project.leg).corrected_m
    at: dict[str, Floats] = {}
    lines, left_out = _lines(project, grid, fixed, read_m, at)
    if grid.projection is not None or (grid.declination is not None and grid.declination.stated_rad is None):
        first = _Solution(lines, fixed)
        at = {name: first.x[i] for name, i in first.at.items()}
        lines, left_out = _lines(project, grid, fixed, read_m, at)
    solution = _Solution(lines, fixed)
    common_rad = math.radians(project.settings.compass_common_deg)
    positions = solution.positions(common_rad)
    for held in project.station:
        # An altitude is only as good as the gauge, whose slow error is not in any leg's noise.
        if held.name in positions and held.depth_sigma_m is not UNSET:
            positions[held.name].covariance[2, 2] += held.depth_sigma_m**2
    points = []
    for leg in project.used(project.point):
        turn_rad = grid.turn_rad(leg_date(project, leg), at.get(leg.from_))
        line = line_of(leg, project, turn_rad, {}, alone=True)
        station = positions.get(leg.from_)
        if line is None or station is None:
            left_out.append((leg, "no bearing or no slope" if line is None else f"station {leg.from_} has no position"))
            continue
        points.append(Position(leg.to, station.position_m + line.vector_m, station.covariance + line.covariance))
    residuals = [
        Residual(line.leg, _triple(moved_m), chi2)
        for line, moved_m, chi2 in zip(lines, solution.moved_m, solution.chi2(), strict=True)
    ]
    gauge_sigma_m = {one.name: one.depth_sigma_m for one in project.station if one.depth_sigma_m is not UNSET}
    return Adjusted(
        grid,
        positions,
        lines,
        residuals,
        loops(lines, fixed),
        _blunders(lines, fixed),
        points,
        solution.proposals(common_rad, gauge_sigma_m),
        left_out,
    )


def _lines(
    project: Project, grid: Grid, fixed: Fixed, read_m: dict[int, tuple[float, float]], at: dict[str, Floats]
) -> tuple[list[Line], list[tuple[Leg, str]]]:
    """Return the legs that are connected to a fixed point, as lines, and the others, each with the reason.

    read_m: both depths of a leg by its number, as `Gauges.corrected_m`. at: where stations are, as far as known.
    """
    depths = held_depths(project)
    lines: list[Line] = []
    left_out: list[tuple[Leg, str]] = []
    for number, leg in enumerate(project.leg):
        edit = project.edit_of(leg)
        turn_rad = grid.turn_rad(leg_date(project, leg), at.get(leg.from_))
        line = line_of(leg, project, turn_rad, depths, read_m=read_m.get(number))
        if edit is not None and not edit.use:
            left_out.append((leg, f"taken out{': ' + edit.note if edit.note else ''}"))
        elif line is None or leg.from_ == leg.to:
            left_out.append((leg, "no bearing, or no slope that its distance allows"))
        else:
            lines.append(line)
    reached = _tree(lines, fixed)
    left_out += [(line.leg, "not connected to a fixed point") for line in lines if line.leg.from_ not in reached]
    return [line for line in lines if line.leg.from_ in reached], left_out


class _Solution:
    """Weighted least squares of lines between fixed points.

    x: (n, 3), east, north, up of each station. covariance: (n, n, 3, 3), of each station with each. moved_m: (m, 3),
    what the adjustment added to each line.
    """

    def __init__(self, lines: list[Line], fixed: Fixed) -> None:
        ends = dict.fromkeys(name for line in lines for name in (line.leg.from_, line.leg.to))
        # Fixed points first; a survey without lines consists of its fixed points.
        names = list(dict.fromkeys([*(name for name in fixed if name in ends or not lines), *ends]))
        self.at = {name: i for i, name in enumerate(names)}
        self.start = np.array([self.at[line.leg.from_] for line in lines], dtype=int)
        self.end = np.array([self.at[line.leg.to] for line in lines], dtype=int)
        n = len(names)
        vectors = np.array([line.vector_m for line in lines]).reshape(-1, 3)
        self._turns = np.array([line.turn_m for line in lines]).reshape(-1, 3, 1)
        self._stated = np.array([line.covariance for line in lines]).reshape(-1, 3, 3)
        self._weights = np.linalg.inv(self._stated)
        normal = np.zeros((n, n, 3, 3))
        for rows, columns, sign in (
            (self.start, self.start, 1.0),
            (self.end, self.end, 1.0),
            (self.start, self.end, -1.0),
            (self.end, self.start, -1.0),
        ):
            np.add.at(normal, (rows, columns), sign * self._weights)
        right = self._pushed(vectors[..., None])
        # Coordinates are relative to the first fixed point, because UTM's millions would cost digits.
        origin = next((position for position, _ in fixed.values()), np.zeros(3))
        for name, (position, sigma_m) in fixed.items():
            if name in self.at:
                weight = np.maximum(sigma_m, EXACT_M) ** -2
                normal[self.at[name], self.at[name]] += np.diag(weight)
                right[self.at[name]] += weight * (position - origin)
        flat = np.linalg.inv(normal.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n))
        self.covariance = flat.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)
        self.x = (flat @ right.ravel()).reshape(n, 3) + origin
        self.moved_m = self.x[self.end] - self.x[self.start] - vectors
        self._flat = flat

    def _pushed(self, vectors: Floats) -> Floats:
        """Return the normal equations' right side (n, 3) of a vector (m, 3, 1) for each line."""
        right = np.zeros((len(self.at), 3))
        pushed = (self._weights @ vectors)[..., 0]
        np.add.at(right, self.end, pushed)
        np.add.at(right, self.start, -pushed)
        return right

    def positions(self, common_rad: float) -> dict[str, Position]:
        """Return all stations; common_rad: 1 sd of an error that turns all legs alike, not in any leg's sigma."""
        turn = common_rad * self._turned()
        return {
            name: Position(name, self.x[i], self.covariance[i, i] + np.outer(turn[i], turn[i]))
            for name, i in self.at.items()
        }

    def _turned(self) -> Floats:
        """Return how far each station moves, (n, 3), per radian that turns every leg alike."""
        return (self._flat @ self._pushed(self._turns).ravel()).reshape(-1, 3)

    def proposals(self, common_rad: float, gauge_sigma_m: dict[str, float]) -> list[Proposal]:
        """Return stations that may be one place; gauge_sigma_m: by station, of its depth."""
        turn = common_rad * self._turned()
        common = turn[:, None, :, None] * turn[None, :, None, :]
        up_sigma_m = np.array([gauge_sigma_m.get(name, 0.0) for name in self.at])
        length_m = np.linalg.norm(self.x[self.end] - self.x[self.start], axis=1)
        return proposals(list(self.at), self.x, self.covariance + common, up_sigma_m, (self.start, self.end), length_m)

    def chi2(self) -> list[float | None]:
        """Return each residual's chi^2 by its own covariance (data snooping, Baarda 1968); None: nothing checks it."""
        S, i, j = self.covariance, self.start, self.end
        scale = np.trace(self._stated, axis1=1, axis2=2)[:, None]
        free = self._stated - (S[i, i] + S[j, j] - S[i, j] - S[j, i])
        values, axes = np.linalg.eigh(free / scale[..., None])
        seen = np.asarray(values > 1e-6)
        along = (axes.transpose(0, 2, 1) @ self.moved_m[..., None])[..., 0]
        chi2 = np.where(seen, along**2 / np.where(seen, values * scale, 1.0), 0.0).sum(axis=1)
        checked = np.atleast_1d(seen.any(axis=1)).tolist()
        return [one if any_seen else None for one, any_seen in zip(chi2.tolist(), checked, strict=True)]


def _triple(vector: Floats) -> Triple:
    return float(vector[0]), float(vector[1]), float(vector[2])


@dataclass(frozen=True)
class _Edge:
    """One line of the tree of shortest ways: from `back`, nearer to a fixed point, along line `index`."""

    back: str
    index: int
    sign: float


def _tree(lines: list[Line], fixed: Fixed) -> dict[str, _Edge | None]:
    """Return the last step of the shortest way from a fixed point to each station; None at the fixed points."""
    touching: dict[str, list[tuple[str, _Edge]]] = {}
    for i, line in enumerate(lines):
        touching.setdefault(line.leg.from_, []).append((line.leg.to, _Edge(line.leg.from_, i, 1.0)))
        touching.setdefault(line.leg.to, []).append((line.leg.from_, _Edge(line.leg.to, i, -1.0)))
    tree: dict[str, _Edge | None] = dict.fromkeys(fixed)
    queue = deque(fixed)
    while queue:
        for other, step in touching.get(queue.popleft(), []):
            if other not in tree:
                tree[other] = step
                queue.append(other)
    return tree


def loops(lines: list[Line], fixed: Fixed) -> list[Loop]:
    """Return independent loops: each line that is not in the tree of shortest ways closes one.

    Fixed points count as joined, so that a way between two of them is a loop.
    """
    tree = _tree(lines, fixed)
    in_tree = {step.index for step in tree.values() if step is not None}

    def way(name: str) -> tuple[list[str], list[_Edge]]:
        """Return the stations from `name` back to a fixed point, and the steps between them."""
        names, steps = [name], []
        while (step := tree[names[-1]]) is not None:
            steps.append(step)
            names.append(step.back)
        return names, steps

    found = []
    for i, line in enumerate(lines):
        if i in in_tree or line.leg.from_ not in tree:
            continue
        (out, out_steps), (back, back_steps) = way(line.leg.from_), way(line.leg.to)
        while len(out) > 1 and len(back) > 1 and out[-2] == back[-2]:
            for common in (out, out_steps, back, back_steps):
                common.pop()
        signed = [(line, 1.0), *((lines[s.index], s.sign) for s in out_steps)]
        signed += [(lines[s.index], -s.sign) for s in back_steps]
        vector = sum((sign * one.vector_m for one, sign in signed), np.zeros(3))
        covariance = sum((one.covariance for one, _ in signed), np.zeros((3, 3)))
        if out[-1] != back[-1]:
            for end, sign in ((out[-1], 1.0), (back[-1], -1.0)):
                vector = vector + sign * fixed[end][0]
                covariance = covariance + np.diag(fixed[end][1] ** 2)
        # Held depths close by construction, so V is computed from each leg's own readings.
        read_m = sum(sign * (one.read_rise_m - one.rise_m) for one, sign in signed)
        read_var = sum(one.read_rise_sigma_m**2 - one.rise_sigma_m**2 for one, _ in signed)
        vector = vector + np.array([0.0, 0.0, read_m])
        found.append(
            Loop(
                (*reversed(out), *back),
                sum(one.length_m for one, _ in signed),
                _triple(vector),
                math.hypot(vector[0], vector[1]) / math.sqrt(covariance[0, 0] + covariance[1, 1]),
                abs(float(vector[2])) / math.sqrt(max(covariance[2, 2] + read_var, EXACT_M**2)),
            )
        )
    return found


def _blunders(lines: list[Line], fixed: Fixed) -> list[Blunder]:
    """Find the worst leg, with those that would explain the misclosure as well; leave it out, and search again."""
    left = list(lines)
    found: list[Blunder] = []
    while len(left) > 1 and len(found) < MOST_BLUNDERS:
        chi2 = np.array([one or 0.0 for one in _Solution(left, fixed).chi2()])
        worst = int(chi2.argmax())
        if chi2[worst] <= BLUNDER_CHI2:
            break
        order = np.argsort(-chi2, kind="stable").tolist()
        named = tuple(left[i].leg.name for i in order if chi2[i] >= AS_GOOD * chi2[worst])
        line = left.pop(worst)
        without = _Solution(left, fixed)
        off_m = math.nan
        if line.leg.from_ in without.at and line.leg.to in without.at:
            way_m = without.x[without.at[line.leg.to]] - without.x[without.at[line.leg.from_]]
            off_m = float(np.linalg.norm(way_m - line.vector_m))
        found.append(Blunder(named, off_m, float(chi2[worst])))
    return found
