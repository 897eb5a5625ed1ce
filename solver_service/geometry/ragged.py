"""Lists of different lengths, one after the other in one array: which item belongs to which list, and in what place."""

from __future__ import annotations

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, Indices


def starts_of(counts: Indices) -> Indices:
    """Give where each list begins, and where the last one ends: one more than there are lists."""
    starts = np.zeros(len(counts) + 1, dtype=np.intp)
    np.add.accumulate(counts, out=starts[1:])
    return starts


def places(counts: Indices) -> tuple[Indices, Indices]:
    """Give the list of each item and its place in it; counts: the lengths of the lists."""
    owner = np.arange(len(counts)).repeat(counts)
    return owner, np.arange(len(owner)) - starts_of(counts)[owner]


def rank(owner: Indices, cost: Floats, lists: int) -> tuple[Indices, Indices]:
    """Sort items by list, then by cost, the lowest first; give their order and each one's place in its list."""
    order = np.lexsort((cost, owner))
    starts = starts_of(np.bincount(owner, minlength=lists))
    return order, np.arange(len(order)) - starts[owner[order]]


def largest(owner: Indices, values: Floats, lists: int, least: float) -> Floats:
    """Give the largest value of each list, `least` for an empty one."""
    found = np.full(lists, least)
    np.maximum.at(found, owner, values)
    return found
