"""Everything that was observed, as one list: what each observation should read, given stations and instruments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Final, Literal, TypeAlias, get_args

import numpy as np
from buddyline.tools.survey.averages import Floats, Ints
from buddyline.tools.survey.normal import Normal, Tree

# distance, azimuth, inclination: of the line from start to end. east, north, up: of station `start`. rise: of end over
# start. angle, number: of the instruments' unknowns alone.
Kind: TypeAlias = Literal["distance", "azimuth", "inclination", "rise", "east", "north", "up", "angle", "number"]
KINDS: Final[dict[Kind, int]] = {kind: number for number, kind in enumerate(get_args(Kind))}
DISTANCE, _AZIMUTH, _INCLINATION, _RISE, _EAST, _NORTH, _UP, _ANGLE, _NUMBER = range(len(KINDS))
ANGLES: Final = (_AZIMUTH, _INCLINATION, _ANGLE)
# An iteration that moves nothing by more than this (m, rad) is the last.
SETTLED: Final = 1e-3
MOST_ITERATIONS: Final = 20
# After a step that moves nothing by more than this (m, rad) the same equations do for the next ones.
NEAR_M: Final = 0.05
MOST_HALVINGS: Final = 6
# What is left of a variance known beforehand, where the observations know better.
KNOWN_SHARE: Final = 0.5
# A step after which the observations fit worse than this is too long.
WORSE: Final = 1.05
# A compass this many sd off counts a quarter (Geman and McClure 1987): some are disturbed, by any angle.
FAR_SIGMAS: Final = 2.5
# An error is checked where at least this share of it shows.
CHECKED: Final = 1e-5
# A leg that ends this share of its length away from where it reads is taken as it reads.
GROSS_SHARE: Final = 0.3
LEAST_RUN_M: Final = 1e-3

Terms: TypeAlias = Sequence[tuple[int, float]]


@dataclass(eq=False)
class Observations:
    """Observations of `stations` (their unknowns are 3 s, 3 s + 1, 3 s + 2: east, north, up, m) and of instruments.

    Each reads: what its kind gives of the stations, plus the sum of coefficient times unknown over its terms; of a
    distance the terms are shares of it. leg: the number of the leg it is part of, or -1. what: its name in words.
    robust: its errors have long tails. vectors_m: (l, 3), each leg's vector as read, NaN where it has none.
    loosen: rows of what is known beforehand, with their unknown: where the other observations know it better, they
    alone count, and the row has this sigma. rows: by leg's number and reading, where there is one alone of its kind.
    tree: of their normal equations, once they have been adjusted.
    """

    stations: list[str]
    names: list[str] = field(default_factory=list)
    start_values: list[float] = field(default_factory=list)
    kind: list[int] = field(default_factory=list)
    start: list[int] = field(default_factory=list)
    end: list[int] = field(default_factory=list)
    value: list[float] = field(default_factory=list)
    sigma: list[float] = field(default_factory=list)
    leg: list[int] = field(default_factory=list)
    what: list[str] = field(default_factory=list)
    robust: list[bool] = field(default_factory=list)
    rows: dict[tuple[int, str], int] = field(default_factory=dict)
    loosen: dict[int, tuple[int, float]] = field(default_factory=dict)
    vectors_m: Floats = field(default_factory=lambda: np.empty((0, 3)))
    tree: Tree | None = None
    _term_row: list[int] = field(default_factory=list)
    _term_column: list[int] = field(default_factory=list)
    _term_value: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.at = {name: number for number, name in enumerate(self.stations)}
        self._unknown: dict[str, int] = {}

    @property
    def count(self) -> int:
        """Number of unknowns."""
        return 3 * len(self.stations) + len(self.names)

    def unknown(self, name: str, sigma: float | None = None, value: float = 0.0) -> int:
        """Return the number of an instrument's unknown, made at its first use.

        sigma: 1 sd of what is known of it beforehand, itself an observation; None: nothing. value: where the search
        begins.
        """
        if name not in self._unknown:
            self._unknown[name] = column = self.count
            self.names.append(name)
            self.start_values.append(value)
            if sigma is not None:
                self.add("number", -1, -1, value, sigma, [(column, 1.0)], what=name)
        return self._unknown[name]

    def has(self, name: str) -> int | None:
        """Return the number of an unknown, if there is one of this name."""
        return self._unknown.get(name)

    def add(
        self,
        kind: Kind,
        start: int,
        end: int,
        value: float,
        sigma: float,
        terms: Terms = (),
        *,
        leg: int = -1,
        what: str,
        robust: bool = False,
    ) -> int:
        """Add an observation; return its row."""
        row = len(self.value)
        self.kind.append(KINDS[kind])
        self.start.append(start)
        self.end.append(end)
        self.value.append(value)
        self.sigma.append(sigma)
        self.leg.append(leg)
        self.what.append(what)
        self.robust.append(robust)
        for column, coefficient in terms:
            self._term_row.append(row)
            self._term_column.append(column)
            self._term_value.append(coefficient)
        return row

    def adjust(self, stations_m: Floats, *, linear: bool = False) -> Solution:
        """Return the least squares solution, searched from stations_m (s, 3); raise BuddylineError if there is none.

        linear: with the derivatives at each leg's readings, where blunders of any size cannot lead astray; lines that
        are read without a direction have them at their places.
        """
        model = Model(self)
        x = np.concatenate([stations_m.ravel(), self.start_values])
        normal = None
        misfit, at, values = model.linear(x)
        moved = math.inf
        for number in range(MOST_ITERATIONS):
            weights = model.weights(misfit) if number and not linear else model.sigma**-2
            fresh = number < 2 or moved > NEAR_M or bool(model.robust.any())
            if normal is None or fresh:
                normal = Normal(at, values, weights, model.blocks, self.tree)
                self.tree = normal.tree
            step = normal.solve(np.bincount(at[1], values * (weights * misfit)[at[0]], len(x)).astype(float))
            chi2 = float(weights @ misfit**2)
            for _ in range(MOST_HALVINGS):
                misfit, at, values = model.linear(x + step)
                if float(weights @ misfit**2) <= WORSE * chi2 + 1.0:
                    break
                step = step / 2
            x, moved = x + step, float(np.abs(step).max())
            if number and moved < SETTLED:
                break
            if not number:
                freed = [
                    row for row, (column, _) in self.loosen.items() if self._is_told(normal, column, model.sigma[row])
                ]
                for row in freed:
                    model.sigma[row] = self.loosen[row][1]
                if linear and model.by_reading.all() and not freed:
                    break
                if not linear:
                    model.turn_to(x)
                    misfit, at, values = model.linear(x)
        # Residuals are judged by the weights that they come from: a linear step counts robust observations in full.
        weights = model.sigma**-2 if linear else model.weights(misfit)
        # Equations that have served for several steps are made again, and robust weights may have changed.
        if normal is None or not fresh or (model.robust.any() and not linear):
            normal = Normal(at, values, weights, model.blocks, self.tree)
        return Solution(self, model, x, misfit, at, values, weights, normal)

    def _is_told(self, normal: Normal, column: int, sigma: float) -> bool:
        """Tell whether the other observations know an unknown better than its sd beforehand."""
        unit = np.zeros(self.count)
        unit[column] = 1.0
        return bool(normal.solve(unit)[column] < KNOWN_SHARE * sigma**2)


class Model:
    """Observations as arrays, (m,) and (t,) for terms."""

    def __init__(self, of: Observations) -> None:
        self.count, self.stations = of.count, len(of.stations)
        self.kind, self.start, self.end = (np.array(one, dtype=np.int64) for one in (of.kind, of.start, of.end))
        self.value, self.sigma = np.array(of.value, dtype=float), np.array(of.sigma, dtype=float)
        self.leg, self.robust = np.array(of.leg, dtype=np.int64), np.array(of.robust, dtype=bool)
        self.term_row = np.array(of._term_row, dtype=np.int64)
        self.term_column = np.array(of._term_column, dtype=np.int64)
        self.term_value = np.array(of._term_value, dtype=float)
        # A station's three coordinates are eliminated together.
        self.blocks = np.arange(self.count) - 2 * self.stations
        self.blocks[: 3 * self.stations] = np.arange(3 * self.stations) // 3
        self.is_angle = np.isin(self.kind, ANGLES)
        self.lines = np.flatnonzero(self.kind <= _RISE)
        self.base_m = np.full((len(self.lines), 3), np.nan)
        if len(of.vectors_m):
            known = self.leg[self.lines] >= 0
            self.base_m[known] = of.vectors_m[self.leg[self.lines][known]]
        self.by_reading = ~np.isnan(self.base_m[:, 0])
        self.heights = np.flatnonzero((self.kind >= _EAST) & (self.kind <= _UP))
        # The rows that hold the prior of an unknown of robust observations. These have long tails, which pull at the
        # prior as well, so it is not suspected.
        tailed = np.zeros(self.count, dtype=bool)
        tailed[self.term_column[self.robust[self.term_row]]] = True
        self.told_by_robust = np.zeros(len(self.value), dtype=bool)
        alone = self.kind[self.term_row] == _NUMBER
        self.told_by_robust[self.term_row[alone]] = tailed[self.term_column[alone]]

    def turn_to(self, x: Floats) -> None:
        """Take derivatives from now on at the places x, but at the readings where a leg is far from what it reads.

        There a blunder is likely, and a derivative at a wrong place would lead astray.
        """
        P = x[: 3 * self.stations].reshape(-1, 3)
        off_m = np.linalg.norm(P[self.end[self.lines]] - P[self.start[self.lines]] - self.base_m, axis=1)
        self.by_reading &= off_m > GROSS_SHARE * np.linalg.norm(self.base_m, axis=1)

    def terms(self, x: Floats) -> Floats:
        """Return each row's sum over its terms."""
        return np.bincount(self.term_row, self.term_value * x[self.term_column], len(self.value)).astype(float)

    def linear(self, x: Floats) -> tuple[Floats, tuple[Ints, Ints], Floats]:
        """Return observed minus computed (m,), and the derivatives of the computed: rows and columns, and values."""
        P, terms = x[: 3 * self.stations].reshape(-1, 3), self.terms(x)
        computed = terms.copy()
        lines, kind = self.lines, self.kind[self.lines]
        i, j = self.start[lines], self.end[lines]
        moved = P[j] - P[i]
        away = np.where(self.by_reading[:, None], self.base_m, moved)
        range_m = np.maximum(np.linalg.norm(away, axis=1), LEAST_RUN_M)
        run_m = np.maximum(np.hypot(away[:, 0], away[:, 1]), LEAST_RUN_M)
        # Where derivatives are at the readings, all is linear.
        longer = np.where(self.by_reading, 1.0, 1 + terms[lines])
        reads = np.select(
            [kind == DISTANCE, kind == _AZIMUTH, kind == _INCLINATION],
            [range_m * (1 + terms[lines]), np.arctan2(away[:, 0], away[:, 1]), np.arctan2(away[:, 2], run_m)],
            away[:, 2],
        )
        by = np.zeros((len(lines), 3))
        one = kind == DISTANCE
        by[one] = away[one] * (longer / range_m)[one, None]
        one = kind == _AZIMUTH
        by[one, 0], by[one, 1] = (away[:, 1] / run_m**2)[one], (-away[:, 0] / run_m**2)[one]
        one = kind == _INCLINATION
        by[one, :2] = (-away[:, 2] / (run_m * range_m**2))[one, None] * away[one, :2]
        by[one, 2] = (run_m / range_m**2)[one]
        by[kind == _RISE, 2] = 1.0
        computed[lines] = np.where(kind == DISTANCE, reads, reads + terms[lines])
        axis = self.kind[self.heights] - _EAST
        computed[self.heights] += P[self.start[self.heights], axis]
        misfit = self.value - computed
        misfit[self.is_angle] = (misfit[self.is_angle] + math.pi) % (2 * math.pi) - math.pi
        misfit[lines] -= (by * (moved - away)).sum(axis=1)
        # Terms of a distance are shares of it.
        full = np.ones(len(self.value))
        full[lines[kind == DISTANCE]] = range_m[kind == DISTANCE]
        rows = np.concatenate([np.repeat(lines, 6), self.heights, self.term_row])
        columns = np.concatenate(
            [
                np.stack([3 * i, 3 * i + 1, 3 * i + 2, 3 * j, 3 * j + 1, 3 * j + 2], axis=1).ravel(),
                3 * self.start[self.heights] + axis,
                self.term_column,
            ]
        )
        values = np.concatenate(
            [np.hstack([-by, by]).ravel(), np.ones(len(axis)), self.term_value * full[self.term_row]]
        )
        kept = values != 0.0
        return misfit, (rows[kept], columns[kept]), values[kept]

    def weights(self, misfit: Floats) -> Floats:
        """Return the weights: 1 / sigma^2, of robust ones less where they are far off."""
        near = 1 + (misfit / (FAR_SIGMAS * self.sigma)) ** 2
        return np.asarray(np.where(self.robust, near**-2, 1.0) * self.sigma**-2)


@dataclass(eq=False)
class Solution:
    """An adjustment: x (n,), what is left of each observation (m,), and the design and weights it was solved with."""

    observations: Observations
    model: Model
    x: Floats
    misfit: Floats
    at: tuple[Ints, Ints]
    values: Floats
    weights: Floats
    normal: Normal

    @property
    def position_m(self) -> Floats:
        """East, north, up of each station, (s, 3)."""
        return self.x[: 3 * self.model.stations].reshape(-1, 3)

    @cached_property
    def terms(self) -> Floats:
        """What the instruments add to each observation, (m,); a share of a distance."""
        return self.model.terms(self.x)

    def correction(self, leg: int, reading: str) -> float:
        """Return what the instruments add to a leg's reading (a share of a distance, m, rad); 0 if there is none."""
        row = self.observations.rows.get((leg, reading))
        return 0.0 if row is None else float(self.terms[row])

    @property
    def chi2(self) -> float:
        """Weighted sum of squares of what is left."""
        return float(self.weights @ self.misfit**2)

    @property
    def freedom(self) -> int:
        """Observations more than unknowns."""
        return len(self.misfit) - len(self.x)

    def unknown(self, name: str) -> tuple[float, float]:
        """Return an instrument's unknown and its 1 sd."""
        column = self.observations.unknown(name)
        unit = np.zeros(len(self.x))
        unit[column] = 1.0
        return float(self.x[column]), math.sqrt(float(self.normal.solve(unit)[column]))

    @cached_property
    def design(self) -> tuple[Ints, Floats]:
        """Each row's unknowns, -1 for none, in order, and its derivatives by them, both (m, k)."""
        rows, columns = self.at
        order = np.lexsort((columns, rows))
        rows, columns, values = rows[order], columns[order], self.values[order]
        # A row may name an unknown twice.
        fresh = np.ones(len(rows), dtype=bool)
        fresh[1:] = (rows[1:] != rows[:-1]) | (columns[1:] != columns[:-1])
        values = np.add.reduceat(values, np.flatnonzero(fresh)) if len(rows) else values
        rows, columns = rows[fresh], columns[fresh]
        counts = np.bincount(rows, minlength=len(self.misfit))
        place = np.arange(len(rows)) - (np.cumsum(counts) - counts)[rows]
        unknowns = np.full((len(counts), int(counts.max(initial=1))), -1)
        derivatives = np.zeros(unknowns.shape)
        unknowns[rows, place], derivatives[rows, place] = columns, values
        return unknowns, derivatives

    @cached_property
    def _inverses(self) -> tuple[Floats, Floats]:
        """Each station's covariance, (s, 3, 3), and each row's variance as the solution predicts it, (m,)."""
        stations = np.arange(3 * self.model.stations).reshape(-1, 3)
        return self.normal.blocks(stations, *self.design)

    @property
    def station_covariances(self) -> Floats:
        """Covariance of each station, (s, 3, 3)."""
        return self._inverses[0]

    @cached_property
    def redundancies(self) -> Floats:
        """Each observation's redundancy number, (m,): the share of its error that shows in its residual."""
        return np.asarray(np.clip(1 - self.weights * self._inverses[1], 0.0, 1.0))

    def variances(self, columns: Ints) -> Floats:
        """Return the variances of unknowns, (c,)."""
        nothing = np.empty((0, 1), dtype=np.int64)
        return self.normal.blocks(columns[:, None], nothing, np.empty((0, 1)))[0][:, 0, 0]

    @cached_property
    def suspicion(self) -> Floats:
        """Chi^2 of each residual by its own variance, (m,): data snooping (Baarda 1968); 0 where nothing checks it."""
        r = self.redundancies
        return np.asarray(np.where(r > CHECKED, self.weights * self.misfit**2 / np.where(r > CHECKED, r, 1.0), 0.0))

    def effect(self, errors: Sequence[tuple[Ints, Floats]]) -> list[float]:
        """Return the chi^2 that each error explains: of at most q degrees of freedom if there is no such error.

        An error: a list of rows, and the (r, q) changes of their readings by its q unknowns; all have the same q.
        The part of an error that no residual shows is left out.
        """
        q = errors[0][1].shape[1]
        unknowns, derivatives = self.design
        push = np.zeros((len(self.x), q * len(errors)))
        information, right = np.zeros((len(errors), q, q)), np.zeros((len(errors), q))
        for number, (rows, change) in enumerate(errors):
            weighed = self.weights[rows, None] * change
            information[number] = change.T @ weighed
            right[number] = weighed.T @ self.misfit[rows]
            where = unknowns[rows]
            known = where >= 0
            part = np.einsum("rk,rq->rkq", derivatives[rows], weighed)[known]
            np.add.at(push, (where[known][:, None], np.arange(q) + q * number), part)
        moved = self.normal.solve(push)
        explained = []
        for number in range(len(errors)):
            part = slice(q * number, q * number + q)
            # Along axes of unit information, what is left of it is a redundancy number.
            known_by, axes = np.linalg.eigh(information[number])
            seen = known_by > CHECKED**2 * known_by[-1]
            unit = axes[:, seen] / np.sqrt(known_by[seen])
            shares, turned = np.linalg.eigh(np.eye(seen.sum()) - unit.T @ push[:, part].T @ moved[:, part] @ unit)
            off = turned.T @ unit.T @ right[number]
            explained.append(float((off[shares > CHECKED] ** 2 / shares[shares > CHECKED]).sum()))
        return explained
