"""Lists of different lengths, one after the other in one array: which item belongs to which list, and in what place."""

from __future__ import annotations

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, Indices


def starts_of(counts: Indices) -> Indices:
    """Give where each list begins, and where the last one ends: one more than there are lists."""
    return np.concatenate(([0], counts.cumsum()))


def places(counts: Indices) -> tuple[Indices, Indices]:
    """Give the list of each item and its place in it; counts: the lengths of the lists."""
    owner = np.arange(len(counts)).repeat(counts)
    return owner, np.arange(len(owner)) - (counts.cumsum() - counts)[owner]


def rank(owner: Indices, cost: Floats, lists: int) -> tuple[Indices, Indices]:
    """Sort items by list, then by cost, the lowest first; give their order and each one's place in its list."""
    order = np.lexsort((cost, owner))
    return order, places(np.bincount(owner, minlength=lists))[1]


def largest(owner: Indices, values: Floats, lists: int, least: float) -> Floats:
    """Give the largest value of each list, `least` for an empty one."""
    found = np.full(lists, least)
    np.maximum.at(found, owner, values)
    return found
