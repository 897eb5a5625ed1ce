"""Questions to the surveyor: stations without a common mark that may be the same place."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.observations import Solution

# Chi^2 of two degrees of freedom that three sd of each allow; and of one.
NEAR_CHI2: Final = 11.83
NEAR_SIGMAS: Final = 3.0
# So many pairs, the nearest first, are looked at.
MOST_PAIRS: Final = 30
# 1 sd between two nodes that two divers hold at the same tie-off on two days.
HELD_M: Final = 0.05
# Two different stations are seldom closer to each other than this share of the legs around them.
LEG_SHARE: Final = 0.5


@dataclass(frozen=True)
class Proposal:
    """Two stations that may be one. apart_m: in space; sigmas: on the map. ratio: H of the loop that it would close."""

    station: str
    other: str
    apart_m: float
    sigmas: float
    ratio: float

    @property
    def question(self) -> str:
        """The question alone."""
        return f"station {self.station} may be {self.other}: {self.apart_m:.2f} m away, {self.sigmas:.1f} sd"

    @property
    def text(self) -> str:
        """The question, and what to do if the answer is yes."""
        return (
            f"{self.question}; the loop would close with H {self.ratio:.1f}. If it is: "
            f'[[equate]] stations = ["{self.other}", "{self.station}"]'
        )


def proposals(solution: Solution, lines: Sequence[tuple[str, str]]) -> list[Proposal]:
    """Return pairs of stations that may be one place, the likeliest first. lines: ends of the legs between stations."""
    at = solution.observations.at
    names = sorted({name for ends in lines for name in ends}, key=lambda name: at[name])
    number = np.array([at[name] for name in names], dtype=np.int64)
    P, covariances = solution.position_m[number], solution.station_covariances[number]
    place = {name: i for i, name in enumerate(names)}
    ends = np.array([(place[start], place[end]) for start, end in lines], dtype=np.int64).reshape(-1, 2)
    shortest_m = np.full(len(names), np.inf)
    length_m = np.linalg.norm(P[ends[:, 1]] - P[ends[:, 0]], axis=1)
    for side in ends.T:
        np.minimum.at(shortest_m, side, length_m)
    beside: list[set[int]] = [{i} for i in range(len(names))]
    for start, end in ends.tolist():
        beside[start].add(end)
        beside[end].add(start)
    up_sd, places = np.sqrt(covariances[:, 2, 2] + HELD_M**2).tolist(), P.tolist()
    found = []
    # Their common error is not taken off here, so this is a wide gate for the heights.
    pairs = [
        (math.dist(places[i], places[j]), i, j)
        for i, j in _near(P, LEG_SHARE * shortest_m)
        if abs(places[i][2] - places[j][2]) < NEAR_SIGMAS * math.hypot(up_sd[i], up_sd[j])
        and not any(beside[one] & beside[j] for one in beside[i])
    ]
    pairs = sorted(pairs)[:MOST_PAIRS]
    near = np.array([(i, j) for _, i, j in pairs], dtype=np.int64).reshape(-1, 2)
    unknowns = 3 * number[near].reshape(-1, 2, 1) + np.arange(3)
    Z = solution.normal.inverse(unknowns.ravel()).reshape(len(pairs), 2, 3, len(pairs), 2, 3)
    for k, (_, i, j) in enumerate(pairs):
        own, shared = Z[k, :, :, k], Z[k, 0, :, k, 1]
        C = own[0, :, 0] + own[1, :, 1] - shared - shared.T
        d = P[i] - P[j]
        flat = C[:2, :2] + 2 * HELD_M**2 * np.eye(2)
        chi2 = float(d[:2] @ np.linalg.solve(flat, d[:2]))
        if chi2 < NEAR_CHI2 and abs(float(d[2])) < NEAR_SIGMAS * math.sqrt(float(C[2, 2]) + 2 * HELD_M**2):
            ratio = float(np.hypot(d[0], d[1])) / math.sqrt(float(np.trace(flat)))
            found.append(Proposal(names[i], names[j], float(np.linalg.norm(d)), math.sqrt(chi2), ratio))
    return sorted(found, key=lambda one: one.sigmas)


def _near(P: Floats, reach_m: Floats) -> Iterator[tuple[int, int]]:
    """Yield pairs i > j of places that are nearer to each other on the map than the lesser of their reaches."""
    cell_m = max(float(reach_m.max()), 1e-3) if len(reach_m) else 1.0
    places, reaches_m = P[:, :2].tolist(), reach_m.tolist()
    cells: dict[tuple[int, int], list[int]] = {}
    for i, (x, y) in enumerate(np.floor(P[:, :2] / cell_m).astype(int).tolist()):
        for other in ((x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)):
            for j in cells.get(other, ()):
                if math.dist(places[i], places[j]) < min(reaches_m[i], reaches_m[j]):
                    yield i, j
        cells.setdefault((x, y), []).append(i)
