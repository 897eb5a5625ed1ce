"""A gesture: three blinks of a node's lamps, as the other node sees them, are a mark."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from itertools import groupby
from typing import Final

from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import Candidates, Mark, RelativePose

BLINKS: Final = 3
NOTE: Final = "by three blinks"
# How long lamps are dark, and lit between; a diver's blinks are alike within this ratio. Lamps are steady around them.
SHORTEST_NS: Final = 220 * MS_NS
LONGEST_NS: Final = 1200 * MS_NS
ALIKE: Final = 2.5
STEADY_NS: Final = S_NS
# A shorter change is a picture in which a light was missed, or another one taken for it.
FLEETING_NS: Final = 150 * MS_NS
# Pictures further apart do not show blinks. A pose older than this does not tell where the lamps are.
GAP_NS: Final = 210 * MS_NS
KNOWN_NS: Final = 6 * S_NS
# A lamp is seen where a candidate is so near to where it was (share of the picture's width).
NEAR: Final = 0.04


def find_blinks(seen: Iterable[Candidates], poses: Mapping[int, RelativePose]) -> list[Mark]:
    """Return a mark of the other node, of kind `point`, for each three blinks.

    seen: one node's candidates; poses: of a pair that it is in, by trigger.
    """
    marks = []
    length = 2 * BLINKS + 1
    for other, lit in _stretches(seen, poses):
        runs = _runs(lit)
        for k in range(len(runs) - length + 1):
            part = runs[k : k + length]
            times = [end_ns - start_ns for start_ns, end_ns, _ in part]
            if not part[0][2] or min(times[0], times[-1]) < STEADY_NS:
                continue
            between = times[1:-1]
            if min(between) < SHORTEST_NS or max(between) > LONGEST_NS:
                continue
            if all(max(one) <= ALIKE * min(one) for one in (between[::2], between[1::2])):
                marks.append(Mark(node=other, stamp_ns=part[1][0], kind="point", note=NOTE))
    return marks


def new_blinks(found: Iterable[Mark], known: Iterable[Mark]) -> list[Mark]:
    """Return those that are not known: three blinks that are found again may begin a picture later."""
    noted = [mark for mark in known if mark.note == NOTE]
    return [
        mark
        for mark in found
        if not any(one.node == mark.node and abs(one.stamp_ns - mark.stamp_ns) < STEADY_NS for one in noted)
    ]


def _stretches(
    seen: Iterable[Candidates], poses: Mapping[int, RelativePose]
) -> list[tuple[str, list[tuple[int, bool]]]]:
    """Return stretches of pictures without gaps: the other node, and by stamp whether its lamps are lit."""
    stretches: list[tuple[str, list[tuple[int, bool]]]] = []
    places: list[tuple[float, float]] = []
    known_ns = last_ns = 0
    for one in sorted(seen, key=lambda message: message.stamp_ns):
        if one.stamp_ns - last_ns > GAP_NS or one.stamp_ns - known_ns > KNOWN_NS:
            places = []
        pose = poses.get(one.trigger)
        if pose is not None:
            by_a = pose.node_a == one.node
            if not places:
                stretches.append((pose.node_b if by_a else pose.node_a, []))
            chosen = pose.blobs_a if by_a else pose.blobs_b
            places = [(one.blobs[i].u_px, one.blobs[i].v_px) for i in chosen if 0 <= i < len(one.blobs)]
            known_ns = one.stamp_ns
        last_ns = one.stamp_ns
        if places:
            reach_px = NEAR * one.width_px
            lit = any(math.hypot(blob.u_px - u, blob.v_px - v) < reach_px for blob in one.blobs for u, v in places)
            stretches[-1][1].append((one.stamp_ns, lit))
    return stretches


def _runs(lit: list[tuple[int, bool]]) -> list[tuple[int, int, bool]]:
    """Return runs of lit and dark: begin, begin of the next, and which; fleeting ones are part of their neighbours."""
    runs: list[tuple[int, int, bool]] = []
    for value, group in groupby(lit, key=lambda one: one[1]):
        stamps = [stamp_ns for stamp_ns, _ in group]
        if runs:
            runs[-1] = (runs[-1][0], stamps[0], runs[-1][2])
        runs.append((stamps[0], stamps[-1], value))
    merged: list[tuple[int, int, bool]] = []
    for start_ns, end_ns, value in runs:
        if merged and (merged[-1][2] == value or end_ns - start_ns < FLEETING_NS):
            merged[-1] = (merged[-1][0], end_ns, merged[-1][2])
        else:
            merged.append((start_ns, end_ns, value))
    return merged
