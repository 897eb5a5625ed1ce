"""The survey as a network: weighted least squares with full covariances, loops, and who is to blame."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.geodesy import Grid, grid_of
from buddyline.tools.survey.lines import Line, line_of
from buddyline.tools.survey.project import Leg, Project
from msgspec import UNSET

# Chi^2 of three degrees of freedom that one leg in a thousand exceeds.
BLUNDER_CHI2: Final = 16.27
# Legs that explain a misclosure nearly as well as the best one are named with it.
AS_GOOD: Final = 0.8
EXACT_M: Final = 1e-4


@dataclass(frozen=True, eq=False)
class Position:
    """A station or point: east, north, up (m) of the grid; covariance (3, 3), the compasses' common error included."""

    name: str
    position_m: Floats
    covariance: Floats

    @property
    def ellipse(self) -> tuple[float, float, float]:
        """Semi-axes (m, 1 sd) of the horizontal ellipse, the larger first, and its azimuth (rad)."""
        values, vectors = np.linalg.eigh(self.covariance[:2, :2])
        major, minor = math.sqrt(max(float(values[1]), 0.0)), math.sqrt(max(float(values[0]), 0.0))
        return major, minor, math.atan2(float(vectors[0, 1]), float(vectors[1, 1])) % math.pi

    @property
    def up_sigma_m(self) -> float:
        """Standard deviation of the altitude."""
        return math.sqrt(max(float(self.covariance[2, 2]), 0.0))


@dataclass(frozen=True)
class Loop:
    """A closed round of legs, or a way between two fixed points. H, V: misclosure over its expected rms."""

    stations: tuple[str, ...]
    length_m: float
    misclosure_m: tuple[float, float, float]
    horizontal_ratio: float
    vertical_ratio: float

    @property
    def error_m(self) -> float:
        """How far it is from closing."""
        return math.hypot(*self.misclosure_m)


@dataclass(frozen=True)
class Residual:
    """What adjustment did to a leg. chi2: of what it moved against what it was free to; None: nothing checks it."""

    leg: Leg
    moved_m: tuple[float, float, float]
    chi2: float | None


@dataclass(frozen=True)
class Blunder:
    """Legs of which one is wrong, the likeliest first, and how far off that would be."""

    legs: tuple[str, ...]
    off_m: float
    chi2: float


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A survey adjusted. left_out: legs without a place in it, with the reason."""

    grid: Grid
    positions: dict[str, Position]
    lines: list[Line]
    residuals: list[Residual]
    loops: list[Loop]
    blunders: list[Blunder]
    points: list[Position]
    left_out: list[tuple[Leg, str]] = field(default_factory=list)

    @property
    def length_m(self) -> float:
        """Length of all legs that took part, repeats once."""
        once = {frozenset((line.leg.from_, line.leg.to)): line.leg.distance_m for line in self.lines}
        return sum(once.values())


def held_depths(project: Project) -> dict[str, float]:
    """Return the stations held at their gauges' mean depth, and it; none where each leg keeps its readings."""
    if project.adjust.depth != "absolute":
        return {}
    return {s.name: s.depth_m for s in project.station if s.depth_m is not UNSET}


def water_level_m(project: Project) -> float:
    """Return the surface's altitude: stated, or from a fixed point's altitude and depth, or 0."""
    if project.place.water_level_m is not UNSET:
        return project.place.water_level_m
    depths = {s.name: s.depth_m for s in project.station}
    for fix in project.fix:
        depth_m = depths.get(fix.station, UNSET)
        if fix.altitude_m is not UNSET and depth_m is not UNSET:
            return fix.altitude_m + depth_m
    return 0.0


def fixed_points(project: Project, grid: Grid) -> dict[str, tuple[Floats, float]]:
    """Return the fixed stations' positions (3,) and sigmas; without any, the first leg's start at east 0, north 0."""
    depths = {s.name: s.depth_m for s in project.station if s.depth_m is not UNSET}
    level_m = water_level_m(project)
    fixed: dict[str, tuple[Floats, float]] = {}
    for fix in project.fix:
        altitude_m = fix.altitude_m
        if altitude_m is UNSET or project.adjust.depth == "absolute":
            # Depths are absolute: an altitude of its own would contradict them.
            altitude_m = level_m - depths.get(fix.station, 0.0)
        fixed[fix.station] = np.array([*grid.position_m(fix), altitude_m]), fix.sigma_m
    if not fixed:
        if not project.leg:
            raise BuddylineError("the project has no legs; run `buddyline survey legs` first")
        start = project.leg[0].from_
        fixed[start] = np.array([0.0, 0.0, level_m - depths.get(start, 0.0)]), 0.0
    return fixed


def adjust(project: Project) -> Adjusted:
    """Adjust the whole network; raise BuddylineError where there is nothing to adjust."""
    grid = grid_of(project)
    depths = held_depths(project)
    fixed = fixed_points(project, grid)
    stations = {name for leg in project.leg for name in (leg.from_, leg.to)}
    for name in fixed:
        if name not in stations:
            raise BuddylineError(f"fix of {name!r}: no leg has this station; known: {', '.join(sorted(stations))}")
    lines: list[Line] = []
    left_out: list[tuple[Leg, str]] = []
    for leg in project.leg:
        if leg not in project.used([leg]):
            edit = project.edit_of(leg)
            left_out.append((leg, f"taken out{': ' + edit.note if edit and edit.note else ''}"))
            continue
        line = line_of(leg, project, grid.to_grid_rad, depths)
        if line is None or leg.from_ == leg.to:
            left_out.append((leg, "no bearing, or no slope that its distance allows"))
        else:
            lines.append(line)
    reached = _reached(lines, fixed)
    left_out += [(line.leg, "not connected to a fixed point") for line in lines if line.leg.from_ not in reached]
    lines = [line for line in lines if line.leg.from_ in reached]
    solution = _Solution(lines, fixed)
    positions = solution.positions(math.radians(project.settings.compass_common_deg))
    for held in project.station:
        # An altitude is as good as the gauge: what that errs slowly is in no leg's noise.
        if held.name in positions and held.depth_sigma_m is not UNSET:
            positions[held.name].covariance[2, 2] += held.depth_sigma_m**2
    points = []
    for leg in project.used(project.point):
        line = line_of(leg, project, grid.to_grid_rad, {}, alone=True)
        station = positions.get(leg.from_)
        if line is None or station is None:
            left_out.append((leg, "no bearing or no slope" if line is None else f"station {leg.from_} has no position"))
            continue
        points.append(Position(leg.to, station.position_m + line.vector_m, station.covariance + line.covariance))
    return Adjusted(
        grid=grid,
        positions=positions,
        lines=lines,
        residuals=solution.residuals(),
        loops=loops(lines, fixed),
        blunders=_blunders(lines, fixed),
        points=points,
        left_out=left_out,
    )


class _Solution:
    """Weighted least squares of lines between fixed points; x: (3 n,), east, north, up of each station."""

    def __init__(self, lines: list[Line], fixed: dict[str, tuple[Floats, float]]) -> None:
        self.lines, self.fixed = lines, fixed
        names = [name for line in lines for name in (line.leg.from_, line.leg.to)]
        self.names = list(dict.fromkeys([name for name in fixed if name in set(names)] + names)) or list(fixed)
        self.at = {name: 3 * i for i, name in enumerate(self.names)}
        size = 3 * len(self.names)
        self.normal = np.zeros((size, size))
        right = np.zeros(size)
        self.weights = [np.linalg.inv(line.covariance) for line in lines]
        for line, weight in zip(lines, self.weights, strict=True):
            start, end = self._slices(line)
            for rows, sign in ((start, -1.0), (end, 1.0)):
                self.normal[rows, start] -= sign * weight
                self.normal[rows, end] += sign * weight
                right[rows] += sign * (weight @ line.vector_m)
        origin = next((position for position, _ in fixed.values()), np.zeros(3))
        for name, (position, sigma_m) in fixed.items():
            if name in self.at:
                rows = slice(self.at[name], self.at[name] + 3)
                weight = np.eye(3) / max(sigma_m, EXACT_M) ** 2
                self.normal[rows, rows] += weight
                right[rows] += weight @ (position - origin)
        self.covariance = np.linalg.inv(self.normal)
        self.x = self.covariance @ right + np.tile(origin, len(self.names))

    def _slices(self, line: Line) -> tuple[slice, slice]:
        i, j = self.at[line.leg.from_], self.at[line.leg.to]
        return slice(i, i + 3), slice(j, j + 3)

    def positions(self, common_rad: float) -> dict[str, Position]:
        """Return all stations; common_rad: 1 sd of an error that turns every leg alike, in no single one's sigma."""
        push = np.zeros(len(self.x))
        for line, weight in zip(self.lines, self.weights, strict=True):
            start, end = self._slices(line)
            pushed = weight @ line.turn_m
            push[start] -= pushed
            push[end] += pushed
        turn = common_rad * (self.covariance @ push)
        result = {}
        for name, i in self.at.items():
            part = slice(i, i + 3)
            covariance = self.covariance[part, part] + np.outer(turn[part], turn[part])
            result[name] = Position(name, self.x[part], covariance)
        return result

    def residual(self, line: Line) -> Floats:
        """Return what adjustment added to a line."""
        start, end = self._slices(line)
        moved: Floats = self.x[end] - self.x[start] - line.vector_m
        return moved

    def chi2(self, line: Line) -> float | None:
        """Return the residual's chi^2 by its own covariance (data snooping, Baarda 1968); None: nothing checks it."""
        start, end = self._slices(line)
        S = self.covariance
        adjusted = S[start, start] + S[end, end] - S[start, end] - S[end, start]
        free = line.covariance - adjusted
        values, vectors = np.linalg.eigh(free / np.trace(line.covariance))
        seen = values > 1e-6
        if not seen.any():
            return None
        moved = vectors.T @ self.residual(line)
        return float((moved[seen] ** 2 / (values[seen] * np.trace(line.covariance))).sum())

    def residuals(self) -> list[Residual]:
        """Return every line's residual."""
        return [Residual(line.leg, _triple(self.residual(line)), self.chi2(line)) for line in self.lines]


def _triple(vector: Floats) -> tuple[float, float, float]:
    return float(vector[0]), float(vector[1]), float(vector[2])


def _reached(lines: list[Line], fixed: dict[str, tuple[Floats, float]]) -> set[str]:
    neighbours: dict[str, set[str]] = {}
    for line in lines:
        neighbours.setdefault(line.leg.from_, set()).add(line.leg.to)
        neighbours.setdefault(line.leg.to, set()).add(line.leg.from_)
    reached = set(fixed)
    queue = deque(reached)
    while queue:
        for name in neighbours.get(queue.popleft(), set()) - reached:
            reached.add(name)
            queue.append(name)
    return reached


def loops(lines: list[Line], fixed: dict[str, tuple[Floats, float]]) -> list[Loop]:
    """Return independent loops: each line that is not in the tree of shortest ways closes one.

    Fixed points count as joined, so that a way between two of them is a loop.
    """
    parent: dict[str, tuple[str, int, float] | None] = {name: None for name in fixed}
    queue = deque(fixed)
    in_tree: set[int] = set()
    touching: dict[str, list[tuple[int, str, float]]] = {}
    for i, line in enumerate(lines):
        touching.setdefault(line.leg.from_, []).append((i, line.leg.to, 1.0))
        touching.setdefault(line.leg.to, []).append((i, line.leg.from_, -1.0))
    while queue:
        name = queue.popleft()
        for i, other, sign in touching.get(name, []):
            if other not in parent:
                parent[other] = (name, i, sign)
                in_tree.add(i)
                queue.append(other)

    def way(name: str) -> list[tuple[str, int, float]]:
        steps = []
        while (step := parent.get(name)) is not None:
            steps.append((name, step[1], step[2]))
            name = step[0]
        return [*steps, (name, -1, 0.0)]

    found = []
    for i, line in enumerate(lines):
        if i in in_tree or line.leg.from_ not in parent:
            continue
        out, back = way(line.leg.from_), way(line.leg.to)
        while len(out) > 1 and len(back) > 1 and out[-2][0] == back[-2][0]:
            out.pop()
            back.pop()
        vector = line.vector_m.copy()
        covariance = line.covariance.copy()
        length_m = line.length_m
        for steps, sense in ((out[:-1], 1.0), (back[:-1], -1.0)):
            for _, k, sign in steps:
                vector += sense * sign * lines[k].vector_m
                covariance = covariance + lines[k].covariance
                length_m += lines[k].length_m
        if out[-1][0] != back[-1][0]:
            for (end, _, _), sign in ((out[-1], 1.0), (back[-1], -1.0)):
                vector += sign * fixed[end][0]
                covariance = covariance + fixed[end][1] ** 2 * np.eye(3)
        names = [step[0] for step in reversed(out)] + [step[0] for step in back]
        found.append(
            Loop(
                tuple(names),
                length_m,
                _triple(vector),
                math.hypot(vector[0], vector[1]) / math.sqrt(covariance[0, 0] + covariance[1, 1]),
                abs(float(vector[2])) / math.sqrt(covariance[2, 2]),
            )
        )
    return found


def _blunders(lines: list[Line], fixed: dict[str, tuple[Floats, float]]) -> list[Blunder]:
    """Name the worst leg, take it out, and look again; with it those that would explain it as well."""
    left = list(lines)
    found: list[Blunder] = []
    while len(left) > 1 and len(found) < 10:
        solution = _Solution(left, fixed)
        chi2 = [solution.chi2(line) or 0.0 for line in left]
        worst = int(np.argmax(chi2))
        if chi2[worst] <= BLUNDER_CHI2:
            break
        order = sorted(range(len(left)), key=lambda i: -chi2[i])
        named = tuple(left[i].leg.name for i in order if chi2[i] >= AS_GOOD * chi2[worst])
        line = left.pop(worst)
        without = _Solution(left, fixed)
        off_m = math.nan
        if line.leg.from_ in without.at and line.leg.to in without.at:
            off_m = float(np.linalg.norm(without.residual(line)))
        found.append(Blunder(named, off_m, chi2[worst]))
    return found
