"""A whole dive's track: filter, smooth, decide again what was open, smooth again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import chain
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.earlier import EARLIER_S, EarlierFilter
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.moving import KNOWN_CLOCK_S
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.parts import (
    MOST_LEFT_S,
    NEAR_CLOCK_S,
    clock_left_ns,
    clock_off_by,
    goes_on,
    in_pieces,
    lasted_s,
    of_one_clock,
    parts_of,
)
from buddyline.solver_service.track.records import (
    END_NS,
    PIECE_NS,
    Records,
    feed,
    in_order,
    parted,
    pass_over,
    stamp_of,
)
from buddyline.solver_service.track.relax import settled
from buddyline.solver_service.track.smoother import Path, rows_between, smoothed
from buddyline.solver_service.track.start import CLOCK_S, broad_start
from buddyline.solver_service.track.state import CLOCK, NAV
from buddyline.solver_service.track.trail import Trail
from buddyline.solver_service.track.vibration import Shares
from buddyline.solver_service.track.walking import joint

# The clocks' offset in the last pass, 1 sd: what the first pass has left beside its own sigma; and where a node has no
# inertial unit, so that no pass estimates it.
CLOCK_LEFT_S: Final = 0.003
CLOCK_WITHOUT_S: Final = 0.003
# A pass that finds the clocks' offset off (`clock_left_ns`) is repeated with it, CLOCK_ROUNDS passes at most.
CLOCK_ROUNDS: Final = 4
# A track that began without a fix, and is carried back by more than this, is passed over until that settles.
LATE_S: Final = 2.0
# A track whose start is so near to the dive's is left as it is.
LEAST_EARLIER_S: Final = 0.15
# Offsets that are tried where a first pass gives more than one track, and none goes on (`goes_on`); a pass finds one up
# to 0.3 s from each. There is no result if the best pass is in pieces (`in_pieces`).
CLOCK_TRIES_S: Final = (0.4, -0.4, 0.8, -0.8)
HEAD_NS: Final = 90 * S_NS
# Further off, there is no track where a node has no inertial unit: the offset that is found is itself off by a tenth.
FAR_WITHOUT_S: Final = 0.05


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A dive's track.

    rows: made as they are read, once. clock_sigma_s: inf where the offset is not estimated, but assumed. dark: the
    lamps that were dark at the end: node, light, for how long (s).
    """

    rows: Iterable[TrackRow]
    clock_offset_s: float
    clock_sigma_s: float
    problems: list[str]
    dark: list[tuple[int, int, float]] = field(default_factory=list)


def smooth(records: Records, fixes: Sequence[FixSeen], outputs_ns: Sequence[int], clock_ns: int = 0) -> Smoothed:
    """Give the whole dive's track at outputs_ns."""
    records, fixes = (parted(in_order(records[0])), parted(in_order(records[1]))), sorted(fixes, key=stamp_of)
    told_ns = clock_ns
    long = bool(fixes) and fixes[-1].stamp_ns - fixes[0].stamp_ns > 2 * HEAD_NS
    head_ns = (fixes[0].stamp_ns + HEAD_NS) // PIECE_NS * PIECE_NS if long else END_NS
    first, parts, clock_ns = _first_pass(records, fixes, clock_ns, head_ns)
    if long:
        # The dive's beginning has given the clocks' offset: what is left of the dive mostly needs no other round.
        pass_over(first, records, fixes, head_ns)
        parts = parts_of(first)
        left_ns = clock_left_ns(parts)
        if left_ns:
            first, parts, clock_ns = _rounds(records, fixes, clock_ns + left_ns)
    if not parts:
        return Smoothed([], clock_ns * 1e-9, math.inf, first.problems)
    parts = of_one_clock(parts)
    without = any(any(part.without) for part in parts)
    off_s = (clock_ns - told_ns) * 1e-9
    far = in_pieces(parts) or clock_off_by(parts[-1], MOST_LEFT_S)
    if far or (without and abs(off_s) > FAR_WITHOUT_S):
        said = f"{first.both}: their clocks seem some {off_s:.2f} s apart, which cannot be told well enough: no track"
        return Smoothed([], clock_ns * 1e-9, math.inf, [*first.problems, said])
    if without:
        # Without a gyro the offset cannot be told from the turning: no second pass from what this one has learned.
        only = _empty_filter(records, told_ns, CLOCK_WITHOUT_S)
        pass_over(only, records, fixes)
        return replace(_smoothed(only, parts_of(only), outputs_ns), clock_sigma_s=math.inf)
    # B's stamps are moved by the offset that the first pass found: for what is left the second is linear.
    learned = parts[-1]
    shift_s = learned.state.clock_s if learned.covariance[CLOCK, CLOCK] < KNOWN_CLOCK_S**2 else 0.0
    clock_sigma_s = CLOCK_LEFT_S + 3.0 * math.sqrt(learned.covariance[CLOCK, CLOCK])
    shares = reduce(Shares.plus, [part.shares for part in parts]).best()
    if all(part.lone for part in parts):
        return _of_one_lamp_each(records, clock_ns, max(parts, key=lasted_s), shares, outputs_ns)
    # Beside a track of any other start these are not linear enough for the pass below.
    parts = [part for part in parts if not part.lone]
    walking = joint([part.walking for part in parts])
    told = sum(part.told for part in parts)
    unrest = min(max(math.sqrt(sum(part.surprise for part in parts) / told), 0.3), 2.0) if told > 100 else None
    paths = [(smoothed(part.steps), part.end_s, part.shaking.less(shares)) for part in parts]
    if len(parts) == 1 and parts[0].searched and not parts[0].agreed:
        [(path, _, shaking)] = paths
        earlier = _path_before(records, clock_ns, path, -math.inf, shares)
        # So far from the start, a path that is carried back is too far off for the one pass below to be linear.
        if earlier is not None and path.t_s[0] - earlier.t_s[0] > LATE_S:
            parts[0].steps = Trail()
            about = (path.after(earlier), parts[0].detection, sum(parts[0].told_by))
            found = settled(*about, records, clock_ns, shaking, shares)
            if found is not None:
                return _rows_of(found[0], [found[1]], outputs_ns)
    # Every step of the first pass holds a covariance: both passes at once take twice the memory.
    del first, parts, learned
    # Where the dive's beginning, before the first start, leads the second pass astray, it is left out.
    for to_beginning in (True, False):
        second = _empty_filter(records, clock_ns + round(shift_s * 1e9), clock_sigma_s)
        second.restarts = False
        second.take_off(shares)
        if unrest is not None:
            second.unrest = unrest
        since_s = -math.inf
        for path, end_s, shaking in paths:
            second.guide_by(path)
            earlier = _path_before(records, clock_ns, path, since_s, shares) if to_beginning else None
            if earlier is not None:
                second.guide_by(earlier)
            whole = earlier or path
            state = replace(whole.state(0), clock_s=0.0)
            begun = broad_start(second.nodes, state, clock_sigma_s, whole.oldest, shaking)
            second.begin(float(whole.t_s[0]) - 0.01, end_s, *begun, shaking, walking)
            since_s = end_s
        pass_over(second, records, ())
        parts = parts_of(second)
        # Led astray by what was carried back, it finds other clocks than the first pass.
        if not any(clock_off_by(part, NEAR_CLOCK_S if to_beginning else MOST_LEFT_S) for part in parts):
            return _smoothed(second, parts, outputs_ns)
    said = f"{second.both}: the second pass contradicts the first on the clocks, so it has diverged: no track"
    return Smoothed([], clock_ns * 1e-9, math.inf, [*second.problems, said])


def _of_one_lamp_each(
    records: Records, clock_ns: int, part: Estimate, shares: Floats, outputs_ns: Sequence[int]
) -> Smoothed:
    """Give the track that began with one lamp of each node, the dive's beginning with it if that settles, too."""
    path, told, about = smoothed(part.steps), sum(part.told_by), (records, clock_ns, part.shaking.less(shares), shares)
    part.steps = Trail()
    found = settled(path, part.detection, told, *about)
    if found is None:
        said = f"nodes {records[0].node.name} and {records[1].node.name}: one lamp of each does not tell a track"
        return Smoothed([], clock_ns * 1e-9, math.inf, [said])
    track, path = found
    earlier = _path_before(records, clock_ns, path, -math.inf, shares)
    if earlier is not None:
        track, path = settled(path.after(earlier), track.passed.detection, told, *about) or found
    return _rows_of(track, [path], outputs_ns)


def _path_before(records: Records, clock_ns: int, path: Path, since_s: float, shares: Floats) -> Path | None:
    """Give the path before another's start, from since_s or the dive's first picture on; None where there is none."""
    track = EarlierFilter(records[0].node, records[1].node, keep_s=math.inf, clock_sigma_s=CLOCK_S)
    track.clock_ns = clock_ns
    track.take_off(shares)
    first_ns = min(frame.stamp_ns for record in records for frame in record.frames[:1])
    track.seconds(0, first_ns)
    start_s = float(path.t_s[0])
    begin_s = max(since_s, track.seconds(0, first_ns) + 0.1, start_s - EARLIER_S)
    if start_s - begin_s < LEAST_EARLIER_S:
        return None
    before_ns, after_ns = (round((start_s - at_s) * 1e9) for at_s in (begin_s - 1.0, start_s + 1.0))
    start_ns = track.stamp_ns(start_s)
    for node, record in enumerate(records):
        shift_ns = clock_ns if node else 0
        feed(track, node, record.between(start_ns - before_ns + shift_ns, start_ns - after_ns + shift_ns))
    return track.path_before(path, begin_s)


def _first_pass(
    records: Records, fixes: Sequence[FixSeen], clock_ns: int, stop_ns: int
) -> tuple[TrackFilter, list[Estimate], int]:
    """Give a filter that has passed over a dive up to stop_ns, its tracks, and how far B's clock was believed ahead.

    Where that gives tracks in pieces other offsets are tried, and the one that explains most is taken.
    """
    best = _rounds(records, fixes, clock_ns, stop_ns)
    for try_s in CLOCK_TRIES_S:
        if goes_on(best[1]):
            break
        other = _rounds(records, fixes, clock_ns + round(try_s * 1e9), stop_ns)
        best = max(best, other, key=lambda found: sum(part.evidence for part in found[1]))
    return best


def _rounds(
    records: Records, fixes: Sequence[FixSeen], clock_ns: int, stop_ns: int = END_NS
) -> tuple[TrackFilter, list[Estimate], int]:
    """Pass over a dive until the offset is settled: a pass whose clocks are off finds too small an offset."""
    for left in reversed(range(CLOCK_ROUNDS)):
        first = _empty_filter(records, clock_ns, CLOCK_S)
        pass_over(first, records, fixes, stop_ns=stop_ns)
        parts = parts_of(first)
        left_ns = clock_left_ns(parts)
        if not left or not left_ns:
            break
        clock_ns += left_ns
    return first, parts, clock_ns


def _empty_filter(records: Records, clock_ns: int, clock_sigma_s: float) -> TrackFilter:
    track = TrackFilter(records[0].node, records[1].node, keep_s=math.inf, clock_sigma_s=clock_sigma_s)
    track.clock_ns = clock_ns
    return track


def _smoothed(track: TrackFilter, parts: Sequence[Estimate], outputs_ns: Sequence[int]) -> Smoothed:
    """Smooth each part."""
    paths = []
    for part in parts:
        paths.append(smoothed(part.steps))
        part.steps = Trail()
    return _rows_of(track, paths, outputs_ns)


def _rows_of(track: TrackFilter, paths: Sequence[Path], outputs_ns: Sequence[int]) -> Smoothed:
    """Give the rows of a last pass's paths."""
    if not paths:
        return Smoothed([], track.clock_ns * 1e-9, math.inf, track.problems)
    stamps = sorted(outputs_ns)
    times_s = np.array([track.between(stamp) for stamp in stamps])
    clock_s = track.clock_ns * 1e-9 + paths[-1].state(-1).clock_s
    sigma_s = math.sqrt(paths[-1].covariance(-1)[NAV, NAV])
    rows = chain.from_iterable(rows_between(path, times_s, stamps) for path in paths)
    return Smoothed(rows, clock_s, sigma_s, track.problems, track.lamps.dark())
