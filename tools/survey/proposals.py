"""Questions to the surveyor: stations without a common mark that may be the same place."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from buddyline.tools.survey.averages import Bools, Floats, Ints

# Stations fewer legs apart than this are neighbours, which may be close to each other.
LEAST_LEGS_APART: Final = 3
# Chi^2 of two degrees of freedom that three sd of each allow; and of one.
NEAR_CHI2: Final = 11.83
NEAR_SIGMAS: Final = 3.0
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
    def text(self) -> str:
        """The question, and what to do if the answer is yes."""
        return (
            f"station {self.station} may be {self.other}: {self.apart_m:.2f} m away, {self.sigmas:.1f} sd; the loop "
            f'would close with H {self.ratio:.1f}. If it is: [[equate]] stations = ["{self.other}", "{self.station}"]'
        )


def proposals(
    names: list[str],
    position_m: Floats,
    covariance: Floats,
    up_sigma_m: Floats,
    ends: tuple[Ints, Ints],
    length_m: Floats,
) -> list[Proposal]:
    """Return pairs of stations that may be one place, the likeliest first.

    position_m: (n, 3), east, north, up. covariance: (n, n, 3, 3), of each with each. up_sigma_m: (n,), what gauges add
    to it. ends: of each leg, (m,) numbers of stations; length_m: (m,).
    """
    count = len(names)
    apart = ~_near(count, ends)
    shortest_m = np.full(count, np.inf)
    for side in ends:
        np.minimum.at(shortest_m, side, length_m)
    found = []
    for i in range(1, count):
        d = position_m[i] - position_m[:i]
        C = covariance[i, i] + covariance[np.arange(i), np.arange(i)] - covariance[i, :i] - covariance[:i, i]
        flat = C[:, :2, :2] + 2 * HELD_M**2 * np.eye(2)
        chi2 = np.einsum("ni,nij,nj->n", d[:, :2], np.linalg.inv(flat), d[:, :2])
        up_sd = np.sqrt(np.maximum(C[:, 2, 2], 0.0) + up_sigma_m[i] ** 2 + up_sigma_m[:i] ** 2 + 2 * HELD_M**2)
        across_m = np.hypot(d[:, 0], d[:, 1])
        near = apart[i, :i] & (chi2 < NEAR_CHI2) & (np.abs(d[:, 2]) < NEAR_SIGMAS * up_sd)
        near &= across_m < LEG_SHARE * np.minimum(shortest_m[i], shortest_m[:i])
        for j in np.flatnonzero(near).tolist():
            ratio = float(across_m[j] / math.sqrt(float(np.trace(flat[j]))))
            away_m = float(np.linalg.norm(d[j]))
            found.append(Proposal(names[i], names[j], away_m, math.sqrt(float(chi2[j])), ratio))
    return sorted(found, key=lambda one: one.sigmas)


def _near(count: int, ends: tuple[Ints, Ints]) -> Bools:
    """Return which stations (n, n) are fewer than LEAST_LEGS_APART legs apart."""
    beside = np.eye(count, dtype=bool)
    beside[ends] = beside[ends[::-1]] = True
    reached = beside
    for _ in range(LEAST_LEGS_APART - 2):
        reached = reached @ beside
    return reached
