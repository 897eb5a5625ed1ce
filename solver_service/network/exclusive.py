"""Which candidate of a picture is which lamp of which node: each candidate is one lamp's at most.

Each bar's assignments are weighed by themselves (track/association.py). Where several bars want one candidate, all
their assignments together are weighed, and those that use a candidate twice are left out: what one node explains is no
evidence for another.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import Final, NamedTuple

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.association import SURE, Case, variance_of

# Assignments of a bar whose odds are lower than its best's by so much are not combined with those of others.
WEIGHED: Final = 18.0
MOST_CASES: Final = 48
MOST_TOGETHER: Final = 600

Joint = tuple[float, tuple[int, ...], frozenset[int]]
"""Log odds, the place of each bar's case so far, and the candidates that they use."""


class _Choice(NamedTuple):
    """One bar's case, the log of its odds, and the candidates that it uses."""

    case: Case
    log: float
    used: frozenset[int]

    @classmethod
    def of(cls, case: Case, log: float) -> _Choice:
        return cls(case, log, frozenset(picked[0] for picked in case if picked is not None))


@dataclass(frozen=True, eq=False)
class Shared:
    """What one picture says of several bars.

    chosen: (candidate, bar, light, variance in px^2) of the lights that are sure. seen (B, 2): the probability that
    each light is among the candidates. evidence (B,): log of the odds that each bar adds to those of all others.
    total: log of the odds of all.
    """

    chosen: tuple[tuple[int, int, int, float], ...]
    seen: Floats
    evidence: Floats
    total: float


def share(bars: Sequence[tuple[list[Case], Floats]], sigma_px: Floats) -> Shared:
    """Weigh the assignments of all bars, each given as `association.Odds.weighed` gives it, together."""
    kept = [_likely(cases, logs) for cases, logs in bars]
    chosen: list[tuple[int, int, int, float]] = []
    seen, evidence, total = np.zeros((len(bars), 2)), np.zeros(len(bars)), 0.0
    for group in _groups([frozenset().union(*(one.used for one in some)) for some in kept]):
        joint = _joint([kept[bar] for bar in group])
        logs = np.array([log for log, _, _ in joint])
        top = float(logs.max())
        weights = np.exp(logs - top)
        whole = top + math.log(float(weights.sum()))
        total += whole
        weights /= weights.sum()
        marginal: dict[tuple[int, int, int], list[float]] = {}
        for weight, (_, places, _) in zip(weights.tolist(), joint, strict=True):
            for place, bar in zip(places, group, strict=True):
                for light, picked in enumerate(kept[bar][place].case):
                    if picked is not None:
                        seen[bar, light] += weight
                        marginal.setdefault((picked[0], bar, light), [0.0, 0.0])[picked[1]] += weight
        for (k, bar, light), (common, gross) in sorted(marginal.items()):
            if common + gross > SURE:
                chosen.append((k, bar, light, variance_of(float(sigma_px[k]), common, gross)))
        for bar in group:
            others = [kept[other] for other in group if other != bar]
            rest = _total(_joint(others)) if others else 0.0
            evidence[bar] = whole - rest
    return Shared(tuple(chosen), seen, evidence, total)


def _likely(cases: list[Case], logs: Floats) -> list[_Choice]:
    order = np.argsort(-logs, kind="stable")[:MOST_CASES].tolist()
    every = logs.tolist()
    kept = [i for i in order if every[i] > every[order[0]] - WEIGHED]
    # That a bar is not seen at all is possible whatever else is.
    missing = cases.index((None, None))
    return [_Choice.of(cases[i], every[i]) for i in (kept if missing in kept else [*kept, missing])]


def _groups(wants: Sequence[frozenset[int]]) -> list[list[int]]:
    """Give the bars in groups that want no candidate of another group."""
    groups: list[tuple[list[int], frozenset[int]]] = []
    for bar, wanted in enumerate(wants):
        touching = [group for group in groups if group[1] & wanted]
        members = [one for group in touching for one in group[0]] + [bar]
        together = frozenset(wanted).union(*(group[1] for group in touching))
        groups = [group for group in groups if not group[1] & wanted] + [(sorted(members), together)]
    return [members for members, _ in groups]


def _joint(bars: Sequence[list[_Choice]]) -> list[Joint]:
    """Give the likeliest choices of a case for each bar in which no candidate is used twice."""
    found: list[Joint] = [(0.0, (), frozenset())]
    for choices in bars:
        found = [
            (log + choice.log, (*places, place), used | choice.used)
            for log, places, used in found
            for place, choice in enumerate(choices)
            if used.isdisjoint(choice.used)
        ]
        found.sort(key=itemgetter(0), reverse=True)
        del found[MOST_TOGETHER:]
    return found


def _total(joint: Sequence[Joint]) -> float:
    logs = np.array([log for log, _, _ in joint])
    top = float(logs.max())
    return top + math.log(float(np.exp(logs - top).sum()))
