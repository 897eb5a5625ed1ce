"""How well an adjustment fits: the global test, the instruments' errors, and what no residual would show."""

from __future__ import annotations

import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Final

import numpy as np
from buddyline.tools.survey.assembly import SIGHT, WANDER
from buddyline.tools.survey.averages import Floats
from buddyline.tools.survey.observations import CHECKED, Solution

# Chance that a sound survey fails the global test.
FAILS: Final = 0.01
# Baarda's non-centrality: an error of this many sd is found with 80 %, at a chance of 0.1 % of a false alarm.
DETECTABLE: Final = 4.13


@dataclass(frozen=True)
class SurveyFit:
    """chi2 of all observations, and how many they are more than unknowns; chance: of a larger one if all is right.

    instruments: by name, value, 1 sd and unit.
    """

    chi2: float
    freedom: int
    chance: float
    instruments: dict[str, tuple[float, float, str]]

    @property
    def factor(self) -> float:
        """The variance factor: chi2 over its expectation; 1 where nothing is checked."""
        return self.chi2 / self.freedom if self.freedom else 1.0

    @property
    def verdict(self) -> str:
        """The global test in words."""
        if not self.freedom:
            return "no observation more than needed, so nothing is checked"
        words = "agree as well as their sds say"
        if self.chance < FAILS:
            words = "contradict each other by more than their sds explain"
        elif self.chance > 1 - FAILS:
            words = "agree better than their sds say"
        more = "1 observation" if self.freedom == 1 else f"{self.freedom} observations"
        return f"{more} more than needed; all {words} (chi2 {self.chi2:.1f}, variance factor {self.factor:.2f})"


def chance_of(chi2: float, freedom: int) -> float:
    """Return the chance of a larger chi^2 (Wilson and Hilferty 1931)."""
    if freedom <= 0:
        return 1.0
    spread = 2 / (9 * freedom)
    return 1 - NormalDist().cdf(((chi2 / freedom) ** (1 / 3) - 1 + spread) / math.sqrt(spread))


def fit_of(solution: Solution) -> SurveyFit:
    """Return the tests of an adjustment. Unknowns with a prior are observed by it as well."""
    of = solution.observations
    names = [name for name in of.names if not name.startswith((SIGHT, WANDER))]
    columns = np.array([of.unknown(name) for name in names], dtype=np.int64)
    sigmas = np.sqrt(solution.variances(columns)) if names else np.empty(0)
    instruments = {}
    for name, column, sigma in zip(names, columns.tolist(), sigmas.tolist(), strict=True):
        scale, unit = _unit(name)
        instruments[name] = scale * float(solution.x[column]), scale * sigma, unit
    freedom = solution.freedom
    return SurveyFit(solution.chi2, freedom, chance_of(solution.chi2, freedom), instruments)


def _unit(name: str) -> tuple[float, str]:
    if name.startswith("scale") or name.endswith(": scale"):
        return 100.0, "%"
    if name.startswith("gyroscope"):
        return math.degrees(1), "deg/s"
    if name.startswith("tide"):
        return 3600.0, "m an hour"
    return (math.degrees(1), "deg") if name == "north" or name.startswith("compass") else (1.0, "m")


def detectable(solution: Solution) -> Floats:
    """Return the least error of each observation that its residual would show, (m,), in its unit; inf: none."""
    r = solution.redundancies
    shown = r > CHECKED
    return np.where(shown, DETECTABLE * solution.weights**-0.5 / np.sqrt(np.where(shown, r, 1.0)), np.inf)
