"""Measure times on a machine whose speed changes: by turns, for ratios, or the fastest of several."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Work: TypeAlias = Callable[[], object]


def by_turns(
    works: Mapping[str, Work], rounds: int, clock_s: Callable[[], float] = time.thread_time
) -> dict[str, NDArray[np.float64]]:
    """Do each work once a round; return its seconds by round, (rounds,), after a first round to warm up.

    Within a round the machine's speed hardly changes: compare works by their ratios in each round.
    """
    times_s = {name: np.empty(rounds + 1) for name in works}
    for i in range(rounds + 1):
        for name, work in works.items():
            times_s[name][i] = seconds_of(work, clock_s)
    return {name: found[1:] for name, found in times_s.items()}


def fastest_s(work: Work, repeats: int, clock_s: Callable[[], float] = time.perf_counter) -> float:
    """Return the shortest of several times: the one that other processes disturbed least."""
    return min(seconds_of(work, clock_s) for _ in range(repeats))


def seconds_of(work: Work, clock_s: Callable[[], float] = time.perf_counter) -> float:
    """Return how long a work takes."""
    began_s = clock_s()
    work()
    return clock_s() - began_s
