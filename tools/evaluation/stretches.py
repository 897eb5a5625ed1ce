"""Stretches of a dive without a pose: the one definition, for report, evaluate and the page.

A stretch reaches from a pose to the next one, or from the first trigger to the first pose, or from the last pose to the
last trigger, if at least one trigger's time lies between. Times are those of the triggers' stamps: logs of a dive that
was played or recorded anew have other receive times, and the same stretches.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np
from buddyline.protocol.clock import S_NS

# Two poses this many trigger periods apart have a trigger without a pose between them.
BROKEN_PERIODS: Final = 1.5


class Outcome(NamedTuple):
    """How a trigger ended. at_ns: its time in the log; reason: None for a pose."""

    stamp_ns: int
    at_ns: int
    reason: str | None


@dataclass(frozen=True)
class Stretch:
    """From begin_ns to end_ns (stamps) without a pose; begin_at_ns, end_at_ns: the same instants in the log's time."""

    begin_ns: int
    end_ns: int
    begin_at_ns: int
    end_at_ns: int
    reasons: Counter[str]

    @property
    def seconds(self) -> float:
        """Its length, s."""
        return (self.end_ns - self.begin_ns) / S_NS


def stretches(outcomes: Iterable[Outcome]) -> list[Stretch]:
    """Return a pair's stretches without a pose, in order of time. outcomes: one for each trigger, in any order."""
    ordered = sorted(outcomes, key=lambda outcome: outcome.stamp_ns)
    if len(ordered) < 2:
        return []
    steps_ns = np.diff([outcome.stamp_ns for outcome in ordered])
    period_ns = float(np.median(steps_ns[steps_ns > 0])) if (steps_ns > 0).any() else 0.0
    bounds = [0, *(k for k, outcome in enumerate(ordered) if outcome.reason is None), len(ordered) - 1]
    found = []
    for begin, end in pairwise(bounds):
        first, last = ordered[begin], ordered[end]
        is_long = last.stamp_ns - first.stamp_ns > BROKEN_PERIODS * period_ns
        is_edge = first.reason is not None or last.reason is not None
        if begin < end and (is_long or is_edge):
            reasons = Counter(each.reason for each in ordered[begin : end + 1] if each.reason is not None)
            found.append(Stretch(first.stamp_ns, last.stamp_ns, first.at_ns, last.at_ns, reasons))
    return found
