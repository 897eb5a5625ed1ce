"""What is probably wrong, named by its cause: each suspicion is tried, and the one that explains most is taken first.

An observation is suspected by its residual over the residual's own sd (data snooping, Baarda 1968). A station's name is
suspected by what remains if one visit to it were to another place.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from statistics import NormalDist
from typing import Final

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.survey.assembly import WANDER
from buddyline.tools.survey.connected import Change, Survey
from buddyline.tools.survey.observations import ANGLES, CHECKED, DISTANCE, Solution

MOST_BLUNDERS: Final = 10
# Chance that a sound survey is said to have a blunder, over all hypotheses that are tried.
FALSE_ALARM: Final = 0.01
# A station's name has three unknowns; an explanation by one is taken before it unless this much better.
NAME_COST: Final = 8.0
# Of the variance factor: a median of n squares is as certain as a mean of this share of them; the stated sds count as a
# mean of so many.
MEDIAN_SHARE: Final = 0.37
STATED_WORTH: Final = 20.0
# An instrument's error is suspected only where the survey, not its prior, tells at least this share of it.
TOLD_SHARE: Final = 0.1
# An explanation is listed with the best one if it explains this share as much.
AS_GOOD: Final = 0.8
MOST_OTHERS: Final = 4
# Suspicions whose first step explains this share of what the best one's does are tried, so many at most; what leaves
# chi^2 within this is the same.
LIKELY_SHARE: Final = 0.6
TRIED: Final = 8
TIED: Final = 6.0
# Chi^2 of 3 degrees of freedom that one sound identity in a thousand exceeds; and places looked at for it.
SAME_CHI2: Final = 16.27
PLACES_TRIED: Final = 3
NEAR_SIGMAS: Final = 4.0
LEAST_REACH_M: Final = 0.2
# The largest errors of an optical distance, and of a camera's focal length, as shares of them.
MOST_SHARE: Final = 0.5
MOST_SCALE: Final = 0.1
# A compass error within this of half a turn is one.
HALF_TURN_DEG: Final = 155.0
VISITS_TRIED: Final = 60


@dataclass(frozen=True)
class Blunder:
    """What is probably wrong. cause: in words; legs: that it is in, the likeliest first; others: causes as good.

    off: its size; unit: "m", "deg", "" for a share. chi2: of what it explains.
    """

    cause: str
    legs: tuple[str, ...]
    off: float
    unit: str
    chi2: float
    others: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The cause and its size; what would explain it as well."""
        size = f"{self.off:.1%}" if not self.unit else f"{self.off:.2f} {self.unit}" if self.unit == "m" else ""
        size = size or f"{self.off:.1f} {self.unit}"
        backwards = "compass" in self.cause and self.off > HALF_TURN_DEG
        wrong = "turned by 180 deg" if backwards else f"off by {size}"
        said = self.cause if self.cause.startswith("station name") else f"{self.cause} is {wrong}"
        return f"{said}, chi2 {self.chi2:.0f}" + (f" (or {'; '.join(self.others)})" if self.others else "")


@dataclass(frozen=True)
class _Suspect:
    cause: str
    legs: tuple[str, ...]
    change: Change
    score: float
    row: int = -1
    visit: tuple[tuple[int, int], ...] = ()


def variance_factor(solution: Solution) -> tuple[float, float]:
    """Return how much larger than stated residuals are, squared, at least 1, and its degrees of freedom.

    It is the weighted mean of what their median says, which few blunders move, and of 1, which the stated sds say.
    """
    shown = (solution.redundancies > CHECKED) & (solution.model.leg >= 0)
    freedom = MEDIAN_SHARE * max(solution.freedom - 1, 0)
    # The median of chi^2 with one degree of freedom.
    factor = float(np.median(solution.suspicion[shown])) / 0.455 if shown.any() else 1.0
    return max((STATED_WORTH + freedom * factor) / (STATED_WORTH + freedom), 1.0), STATED_WORTH + freedom


def critical_chi2(hypotheses: int, freedom: float) -> float:
    """Return the chi^2, over the variance factor, that one unknown must explain to be suspected.

    FALSE_ALARM is the chance that any hypothesis on a sound survey exceeds it. freedom: of the variance factor, which
    makes it a matter of Student's distribution (Wallace 1959).
    """
    z = NormalDist().inv_cdf(1 - FALSE_ALARM / (2 * max(hypotheses, 1))) * (8 * freedom + 3) / (8 * freedom + 1)
    return freedom * math.expm1(z**2 / freedom)


def find_blunders(survey: Survey) -> list[Blunder]:
    """Return probable blunders, the first found first; each is taken out before the next is looked for."""
    found: list[Blunder] = []
    taken = Change()
    solution = survey.adjust(linear=True)
    while len(found) < MOST_BLUNDERS:
        suspects = sorted(_suspects(survey, solution, taken), key=lambda one: -one.score)
        best_score = suspects[0].score if suspects else 0.0
        # The scores are of a first step; which suspicion explains most is seen in the adjustment without it.
        likely = [one for one in suspects if one.score >= LIKELY_SHARE * best_score][:TRIED]
        trials = [trial for one in likely if (trial := _tried(survey, taken, one)) is not None]
        if not trials:
            break
        noise = max(min(one.after.chi2 / max(one.after.freedom, 1) for one in trials), 1.0)
        costs = [one.after.chi2 / noise + NAME_COST * bool(one.suspect.visit) for one in trials]
        named = trials[int(np.argmin(costs))]
        if named.suspect.visit:
            tied = [one for one, cost in zip(trials, costs, strict=True) if cost <= min(costs) + TIED]
            # Which of a name's two stays is the wrong one shows where the other place has a name; else the later one.
            judged = [_identified(survey, taken, one) for one in tied if one.suspect.visit]
            by_time = sorted(judged, key=lambda one: -survey.legs[one.suspect.visit[0][0]].start_ns)
            named = next((one for one in judged if one.same), by_time[0])
        best, after = named.suspect, named.after
        # Another name explains what a single reading does, and more: it is no alternative to it.
        as_good = [
            one
            for one in suspects
            if one.cause != best.cause and one.score >= AS_GOOD * best_score and (best.visit or not one.visit)
        ]
        legs = dict.fromkeys(name for one in (best, *as_good) for name in one.legs)
        others = tuple(dict.fromkeys(one.cause for one in as_good))[:MOST_OTHERS]
        off, unit = _size(solution, after, best)
        found.append(Blunder(named.cause, tuple(legs), off, unit, solution.chi2 - after.chi2, others))
        taken, solution = taken.with_(named.change), after
    return found


def _suspects(survey: Survey, solution: Solution, taken: Change) -> Iterator[_Suspect]:
    """Yield what may be wrong by the adjustment as it is, linearly."""
    model, of, r = solution.model, solution.observations, solution.redundancies
    scale, known = variance_factor(solution)
    w2 = solution.suspicion / scale
    told = np.where(model.leg >= 0, CHECKED, TOLD_SHARE)
    tried = (r > told) & ~model.robust & ~model.told_by_robust
    every = list(_visits(survey, taken))
    critical = critical_chi2(int(tried.sum()) + len(every), known)
    # A disturbed compass pulls at gyroscopes here, but not in the adjustment, where its weight falls.
    disturbed = w2[model.robust].max(initial=0.0)
    for row in np.flatnonzero(tried & (w2 > critical)).tolist():
        leg, what = int(model.leg[row]), of.what[row]
        gyroscope = what.startswith("gyroscope")
        if (leg, what) in taken.drops or what.startswith(WANDER) or (gyroscope and w2[row] < disturbed):
            continue
        off = abs(float(solution.misfit[row] / r[row]))
        if model.kind[row] == DISTANCE and leg >= 0 and survey.legs[leg].from_node:
            # The lights of a node cannot be taken for others so far away: rather, the leg ends elsewhere.
            if off > MOST_SHARE * survey.legs[leg].distance_m + LEAST_REACH_M:
                continue
        elif what.startswith("scale") and off > MOST_SCALE:
            continue
        name = survey.legs[leg].name if leg >= 0 else ""
        cause = f"leg {name}: {what}" if name else what
        drop = Change(drops=frozenset([(leg, what)]))
        yield _Suspect(cause, (name,) if name else (), drop, float(w2[row]), row)
    of_leg = model.leg >= 0
    shown = np.bincount(model.leg[of_leg], w2[of_leg], len(survey.legs)).tolist()
    worst = np.zeros(len(survey.legs))
    np.maximum.at(worst, model.leg[of_leg], w2[of_leg])
    # Where no reading is suspected, what a stay's other place explains shows in the sum of its legs' residuals.
    least = critical if worst.max(initial=0.0) <= critical else 0.0
    suspected = [visit for visit in every if sum(shown[leg] for leg, _ in visit) > least]
    visits = sorted(suspected, key=lambda visit: -max(worst[leg] for leg, _ in visit))[:VISITS_TRIED]
    if not visits:
        return
    rows_of: dict[int, list[int]] = {}
    for row, leg in enumerate(model.leg.tolist()):
        rows_of.setdefault(leg, []).append(row)
    unknowns, derivatives = solution.design
    errors = []
    for visit in visits:
        at = of.at[survey.name_at(*visit[0], taken)]
        rows = np.array([row for leg, _ in visit for row in rows_of[leg]])
        moved = np.stack(
            [(derivatives[rows] * (unknowns[rows] == 3 * at + axis)).sum(axis=1) for axis in range(3)], axis=1
        )
        errors.append((rows, moved))
    for visit, effect in zip(visits, solution.effect(errors), strict=True):
        chi2 = effect / scale
        if chi2 > critical + NAME_COST:
            name = survey.name_at(*visit[0], taken)
            legs = tuple(survey.legs[leg].name for leg, _ in visit)
            change = Change(names=dict.fromkeys(visit, f"{name}'"))
            yield _Suspect(f"station name: {name} of {' and '.join(legs)}", legs, change, chi2 - NAME_COST, visit=visit)


def _visits(survey: Survey, taken: Change) -> Iterator[tuple[tuple[int, int], ...]]:
    """Yield the legs and ends of each stay of a node at a station that has other stays as well."""
    stays: dict[str, list[list[tuple[int, int]]]] = {}
    last: dict[tuple[int, str], tuple[str, list[tuple[int, int]]]] = {}
    order = sorted(range(len(survey.legs)), key=lambda number: survey.legs[number].start_ns)
    for number in order:
        leg = survey.legs[number]
        for end, node in ((0, leg.from_node), (1, leg.to_node)):
            name = survey.name_at(number, end, taken)
            if " " in name:
                continue
            before = last.get((leg.dive, node)) if node else None
            if before is not None and before[0] == name:
                before[1].append((number, end))
            else:
                stay = [(number, end)]
                stays.setdefault(name, []).append(stay)
                last[leg.dive, node] = name, stay
    for name, of_station in stays.items():
        for number, stay in enumerate(of_station):
            # A fixed point is where its first stay was.
            if len(of_station) > 1 and (number or name not in survey.fixed):
                yield tuple(stay)
            if len(stay) > 1:
                yield from ((one,) for one in stay)


def _size(solution: Solution, after: Solution, suspect: _Suspect) -> tuple[float, str]:
    if suspect.row < 0:
        return math.nan, "m"
    kind, name = solution.model.kind[suspect.row], solution.observations.what[suspect.row]
    # The same observation, whose misfit is the whole error once it counts no more.
    off = float(after.misfit[suspect.row]) if len(after.misfit) == len(solution.misfit) else math.nan
    if kind in ANGLES or "compass" in name:
        return math.degrees(abs(off)), "deg"
    return abs(off), "" if name.startswith("scale") else "m"


@dataclass(frozen=True)
class _Trial:
    """A suspicion and the adjustment after it. same: the other place of a misnamed station has a name."""

    suspect: _Suspect
    change: Change
    cause: str
    after: Solution
    same: bool = False


def _tried(survey: Survey, taken: Change, suspect: _Suspect) -> _Trial | None:
    """Try a suspicion; None where it leaves stations that nothing else holds: then it explains anything."""
    try:
        after = survey.adjust(taken.with_(suspect.change), linear=True)
    except BuddylineError:
        return None
    return _Trial(suspect, suspect.change, suspect.cause, after)


def _identified(survey: Survey, taken: Change, trial: _Trial) -> _Trial:
    """Return the station that the place of a stay at a misnamed one is, if it has a name already."""
    suspect, after = trial.suspect, trial.after
    new = next(iter(suspect.change.names.values()))
    i, names = after.observations.at[new], after.observations.stations
    away_m = np.linalg.norm(after.position_m - after.position_m[i], axis=1)
    reach_m = NEAR_SIGMAS * (math.sqrt(float(np.trace(after.station_covariances[i]))) + LEAST_REACH_M)
    beside = {survey.name_at(leg, 1 - end, taken) for leg, end in suspect.visit} | {new}
    near = [names[k] for k in np.argsort(away_m).tolist() if away_m[k] < reach_m]
    for name in [one for one in near if one not in beside and " " not in one][:PLACES_TRIED]:
        change = Change(names=dict.fromkeys(suspect.visit, name))
        joined = survey.adjust(taken.with_(change), linear=True)
        if joined.chi2 - after.chi2 < SAME_CHI2:
            return _Trial(suspect, change, f"{suspect.cause}: it is {name}", joined, same=True)
    return replace(trial, cause=f"{suspect.cause}: it is another place")
