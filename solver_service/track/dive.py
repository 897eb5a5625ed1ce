"""A whole dive's track: filter, smooth, pass over it again about its own path, smooth again."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import chain
from typing import Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.track.between import rows_between
from buddyline.solver_service.track.earlier import EARLIER_S, EarlierFilter
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.guessing import GuessedMotion
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.output import CONTRADICTS, TrackRow, fix_chi2
from buddyline.solver_service.track.parts import (
    MOST_LEFT_S,
    NEAR_CLOCK_S,
    TOLD_SIGMAS,
    clock_left_ns,
    clock_off_by,
    goes_on,
    in_pieces,
    lasted_s,
    mostly_without,
    of_one_clock,
    parts_of,
)
from buddyline.solver_service.track.records import (
    END_NS,
    PIECE_NS,
    Records,
    feed,
    in_order,
    judged,
    parted,
    pass_over,
    stamp_of,
    until_one_ended,
)
from buddyline.solver_service.track.relax import PassedOver, PathPass
from buddyline.solver_service.track.scale import ScaleGap, gap_words, scaled
from buddyline.solver_service.track.settling import clock_sigma_s, settled
from buddyline.solver_service.track.smoother import Path, smoothed
from buddyline.solver_service.track.start import CLOCK_S
from buddyline.solver_service.track.trail import Trail
from buddyline.solver_service.track.vibration import Shares
from buddyline.solver_service.track.walking import Walking, joint

# The clocks' offset, 1 sd, where a node has no inertial unit, so that no pass estimates it.
CLOCK_WITHOUT_S: Final = 0.003
# A pass that finds the clocks' offset off (`clock_left_ns`) is repeated with it, in CLOCK_ROUNDS passes at most, and
# where the best of those that were tried has some left then, in as many more.
CLOCK_ROUNDS: Final = 4
# Where a track began with one lamp of each node, a lamp that is found in a smaller share of its pictures is dark.
NEVER_FOUND: Final = 0.1
# A track that began without a fix, and is carried back by more than this, is passed over until that settles.
LATE_S: Final = 2.0
# Then one in so many of its steps is compared with those of the same track that was not carried back.
COMPARED: Final = 5
# A track whose start is so near to the dive's is left as it is.
LEAST_EARLIER_S: Final = 0.15
# Offsets that are tried where a first pass gives more than one track, and none goes on (`goes_on`); a pass finds one up
# to 0.3 s from each. There is no result if the best pass is in pieces (`in_pieces`).
CLOCK_TRIES_S: Final = (0.4, -0.4, 0.8, -0.8)
HEAD_NS: Final = 90 * S_NS
# Further off, there is no track where a node has no inertial unit: the offset that is found is itself off by a tenth.
FAR_WITHOUT_S: Final = 0.05
# First passes over a dive whose bars do not fit each other, the last included; a gap of so many sigmas may be left.
GAP_ROUNDS: Final = 5
GAP_LEFT_SIGMAS: Final = 2.0


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

    @classmethod
    def none(cls, clock_ns: int, problems: list[str]) -> Smoothed:
        """Give no track. clock_ns: how far B's clock was believed ahead."""
        return cls([], clock_ns * 1e-9, math.inf, problems)


def smooth(records: Records, fixes: Sequence[FixSeen], outputs_ns: Sequence[int], told_ns: int = 0) -> Smoothed:
    """Give the whole dive's track at outputs_ns. told_ns: how far B's clock was told to be ahead; fixes count it.

    Where the pictures of both nodes tell different distances, their bars are taken for longer and shorter by half of
    that each, and the sigmas hold that one of them alone may be wrong.
    """
    a, b = until_one_ended((in_order(records[0]), in_order(records[1])))
    records, fixes, gap = (judged(parted(a)), judged(parted(b))), sorted(fixes, key=stamp_of), 0.0
    first = _first_pass(records, fixes, told_ns)
    for _ in range(GAP_ROUNDS - 1):
        more = first.gap_beyond(gap)
        if not more:
            break
        # Its steps only take memory now.
        del first
        gap += more
        a, b = (
            replace(record, node=replace(record.node, rig=scaled(record.node.rig, share)))
            for record, share in zip(records, (-0.5 * more, 0.5 * more), strict=True)
        )
        records = a, b
        first = _first_pass(records, fixes, told_ns)
    found = _of_first_pass(first, records, fixes, outputs_ns, told_ns, gap, again=True)
    names = [record.node.name for record in records]
    return replace(found, problems=[*found.problems, gap_words(gap, names)]) if gap else found


@dataclass(frozen=True, eq=False)
class _FirstPass:
    """A filter that has passed over a dive, its tracks, and how far B's clock was believed ahead."""

    track: TrackFilter
    parts: list[Estimate]
    clock_ns: int

    def gap_beyond(self, gap: float) -> float:
        """Give by how much more the bars do not fit each other than the gap by which they were changed, 0 for not."""
        found = reduce(ScaleGap.plus, [part.scale for part in self.parts], ScaleGap())
        # A clock that jumps is no bar.
        more = not in_pieces(self.parts) and (found.found or (gap and found.sigmas > GAP_LEFT_SIGMAS))
        return found.share if more else 0.0


def _first_pass(records: Records, fixes: Sequence[FixSeen], clock_ns: int) -> _FirstPass:
    """Pass a filter over a whole dive. clock_ns: how far B's clock is believed ahead."""
    long = bool(fixes) and fixes[-1].stamp_ns - fixes[0].stamp_ns > 2 * HEAD_NS
    head_ns = (fixes[0].stamp_ns + HEAD_NS) // PIECE_NS * PIECE_NS if long else END_NS
    first = _tries(records, fixes, clock_ns, head_ns)
    if long and not any(map(mostly_without, first.parts)):
        # The dive's beginning has given the clocks' offset: what is left of the dive mostly needs no other round.
        pass_over(first.track, records, fixes, head_ns)
        first = replace(first, parts=parts_of(first.track))
        left_ns = clock_left_ns(first.parts)
        if left_ns:
            first = _rounds(records, fixes, first.clock_ns + left_ns)
    return first


def _of_first_pass(
    passed: _FirstPass,
    records: Records,
    fixes: Sequence[FixSeen],
    outputs_ns: Sequence[int],
    told_ns: int,
    gap: float,
    *,
    again: bool,
) -> Smoothed:
    """Give the track of a dive that a filter has passed over.

    told_ns: how far B's clock was told to be ahead. gap: what the bars have been changed by. again: whether to begin
    once more where the later passes contradict the first one: with their offset, which is nearer than the first one's.
    """
    first, parts, clock_ns = passed.track, passed.parts, passed.clock_ns
    if not parts:
        return Smoothed.none(clock_ns, first.problems)
    parts = of_one_clock(parts)
    without = any(map(mostly_without, parts))
    off_s = (clock_ns - told_ns) * 1e-9
    far = in_pieces(parts) or clock_off_by(parts[-1], MOST_LEFT_S)
    if far or (without and abs(off_s) > FAR_WITHOUT_S):
        said = f"{first.both}: {why_none(off_s)}: no track"
        return Smoothed.none(clock_ns, [*first.problems, said])
    if without:
        # Without a gyro the offset cannot be told from the turning, and is taken as it was told. The first pass has
        # shown that it is small. Its steps only take memory now.
        for part in passed.parts:
            part.steps = Trail()
        only = _empty_filter(records, told_ns, CLOCK_WITHOUT_S)
        pass_over(only, records, fixes)
        return replace(_of_guessed_motion(records, only, fixes, outputs_ns, gap), clock_sigma_s=math.inf)
    shares = reduce(Shares.plus, [part.shares for part in parts]).best()
    known = PassedOver(records, first.epoch_ns or 0, clock_ns, shares, Walking())
    if all(part.lone for part in parts):
        return _of_one_lamp_each(known, max(parts, key=lasted_s), outputs_ns, gap)
    # Beside a track of any other start these are not linear enough for the passes below.
    parts = [part for part in parts if not part.lone]
    learned = replace(known, walking=joint([part.walking for part in parts]).cautious(), unrest=_unrest(parts))
    found: list[tuple[PathPass, Path]] = []
    lost: list[str] = []
    since_s, contradicting_ns = -math.inf, None
    for part in parts:
        one, other_ns = _settled_part(part, known, learned, since_s, only=len(parts) == 1)
        since_s = part.end_s
        if one is not None:
            found.append(one)
        else:
            span = f"no track for {lasted_s(part):.0f} s"
            lost.append(f"{first.both}: passes over the dive contradict the first one or do not settle: {span}")
            contradicting_ns = contradicting_ns if other_ns is None else other_ns
    if not found and again and contradicting_ns is not None:
        passed = _first_pass(records, fixes, contradicting_ns)
        other = _of_first_pass(passed, records, fixes, outputs_ns, contradicting_ns, gap, again=False)
        return other if math.isfinite(other.clock_sigma_s) else replace(other, problems=[*other.problems, *lost])
    if not found:
        return Smoothed.none(clock_ns, [*first.problems, *lost])
    whole = _rows_of(found, outputs_ns, gap)
    return replace(whole, problems=[*whole.problems, *lost])


def _settled_part(
    part: Estimate, known: PassedOver, learned: PassedOver, since_s: float, *, only: bool
) -> tuple[tuple[PathPass, Path] | None, int | None]:
    """Pass over a track of the first pass until it settles; give the last pass, and its path.

    The dive's beginning before the track's start, from since_s on, is passed over with it; where that leads the passes
    astray, it is left out. learned: known, with what the first pass has learned of walks. only: whether the dive has no
    other track. Where later passes find another offset of the clocks, there is none, but the offset, ns.
    """
    path, shaking = smoothed(part.steps, uses_up=True), part.shaking.less(known.shares)
    earlier = _path_before(known, path, since_s)
    tries = [path] if earlier is None else [path.after(earlier), path]
    late = only and part.searched and not part.agreed and path.t_s[0] - tries[0].t_s[0] > LATE_S
    believed = part.detection, shaking, known if late else learned, sum(part.lit_pictures)
    alone = settled(path, *believed, doubtful=True) if late else None
    other_ns = None
    for about in tries:
        one = alone if late and about is path else settled(about, *believed, doubtful=late)
        limit_s = MOST_LEFT_S if about is path else NEAR_CLOCK_S
        if one is None or (alone is not None and _contradict(one[1], alone[1])):
            continue
        passed_s, first_s = _clock_s(*one), known.clock_ns * 1e-9 + part.state.clock_s
        # What a late start tells of the clocks is little, and less than it believes.
        if late or abs(passed_s - first_s) < max(limit_s, TOLD_SIGMAS * clock_sigma_s(one[1])):
            return one, None
        other_ns = round(passed_s * 1e9)
    return None, other_ns


def _contradict(path: Path, alone: Path) -> bool:
    """Whether a path that was carried back is elsewhere, at a step of the one that was not, than that one bears."""
    for k in range(0, len(alone), COMPARED):
        there = path.state(int(np.abs(path.t_s - alone.t_s[k]).argmin()))
        pose = FixSeen(0, there.R[0].T @ there.r_m, there.R[0].T @ there.R[1], np.zeros((6, 6)))
        if fix_chi2(alone.state(k), alone.covariance(k), alone.rates_radps[k], pose) > CONTRADICTS:
            return True
    return False


def why_none(off_s: float) -> str:
    """Say why a first pass that is in pieces, or finds the clocks far off, gives no track. off_s: what it found."""
    if abs(off_s) > FAR_WITHOUT_S:
        return f"their clocks seem some {off_s:.2f} s apart, which cannot be told well enough"
    return (
        "the parts of the dive contradict each other: an inertial unit is mounted otherwise than stated, rig or camera "
        "are not as calibrated, or a clock jumped"
    )


def _unrest(parts: Sequence[Estimate]) -> float:
    """Give how much of the guessed motion's noise a dive's chi^2 asks for, 1 where it does not tell.

    Of lights whose errors last it does not: these do not show against a track that has the same errors.
    """
    told = sum(part.chi2_dof for part in parts)
    if told <= 100 or _lasting(parts):
        return 1.0
    return min(max(math.sqrt(sum(part.chi2 for part in parts) / told), 0.3), 2.0)


def _lasting(parts: Sequence[Estimate]) -> bool:
    """Whether the errors of most lights that were used last from picture to picture."""
    return sum(part.lasting_dof for part in parts) > 0.5 * sum(part.chi2_dof for part in parts)


def _clock_s(track: TrackFilter | PathPass, path: Path) -> float:
    """Give how far B's clock is ahead, by a pass and its path."""
    return track.clock_ns * 1e-9 + path.state(-1).clock_s


def _of_one_lamp_each(known: PassedOver, part: Estimate, outputs_ns: Sequence[int], gap: float) -> Smoothed:
    """Give the track that began with one lamp of each node, the dive's beginning with it if that settles, too."""
    path = smoothed(part.steps, uses_up=True)
    believed = part.shaking.less(known.shares), known, sum(part.lit_pictures)
    # A reflection beside the lit lamp would pass for the dark one, and tell a range.
    lit = np.where(part.detection < NEVER_FOUND, 0.0, part.detection)
    found = settled(path, lit, *believed, doubtful=True)
    if found is None:
        names = " and ".join(record.node.name for record in known.records)
        said = f"nodes {names}: one lamp of each does not tell a track"
        return Smoothed.none(known.clock_ns, [said])
    track, path = found
    earlier = _path_before(known, path, -math.inf)
    if earlier is not None:
        track, path = settled(path.after(earlier), track.passed.detection, *believed, doubtful=True) or found
    return _rows_of([(track, path)], outputs_ns, gap)


def _path_before(known: PassedOver, path: Path, since_s: float) -> Path | None:
    """Give the path before another's start, from since_s or the dive's first picture on; None where there is none."""
    records, clock_ns = known.records, known.clock_ns
    track = EarlierFilter(records[0].node, records[1].node, keep_s=math.inf, clock_sigma_s=CLOCK_S)
    track.epoch_ns, track.clock_ns = known.epoch_ns, clock_ns
    track.take_off(known.shares)
    first_ns = min(frame.stamp_ns for record in records for frame in record.frames[:1])
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


def _tries(records: Records, fixes: Sequence[FixSeen], clock_ns: int, stop_ns: int) -> _FirstPass:
    """Pass over a dive up to stop_ns.

    Where that gives tracks in pieces other offsets are tried, and the one that explains most is taken. With units off
    their mounts each pass finds only a part of the offset, so the best is repeated while some is left.
    """
    best = _rounds(records, fixes, clock_ns, stop_ns)
    for try_s in CLOCK_TRIES_S:
        if goes_on(best.parts):
            break
        other = _rounds(records, fixes, clock_ns + round(try_s * 1e9), stop_ns)
        best = max(best, other, key=lambda found: sum(part.evidence for part in found.parts))
    left_ns = clock_left_ns(best.parts)
    return _rounds(records, fixes, best.clock_ns + left_ns, stop_ns) if left_ns else best


def _rounds(records: Records, fixes: Sequence[FixSeen], clock_ns: int, stop_ns: int = END_NS) -> _FirstPass:
    """Pass over a dive until the offset is settled: a pass whose clocks are off finds too small an offset."""
    for left in reversed(range(CLOCK_ROUNDS)):
        first = _empty_filter(records, clock_ns, CLOCK_S)
        pass_over(first, records, fixes, stop_ns=stop_ns)
        parts = parts_of(first)
        left_ns = clock_left_ns(parts)
        if not left or not left_ns:
            break
        clock_ns += left_ns
    return _FirstPass(first, parts, clock_ns)


def _empty_filter(records: Records, clock_ns: int, clock_sigma_s: float) -> TrackFilter:
    track = TrackFilter(records[0].node, records[1].node, keep_s=math.inf, clock_sigma_s=clock_sigma_s)
    track.clock_ns = clock_ns
    return track


def _of_guessed_motion(
    records: Records, first: TrackFilter, fixes: Sequence[FixSeen], outputs_ns: Sequence[int], gap: float
) -> Smoothed:
    """Give the tracks of a first pass over nodes without inertial units.

    Each is passed over again. Where that does not settle, the first pass's path stands.
    """
    found: list[tuple[TrackFilter | PathPass, Path]] = []
    for part in parts_of(first):
        path, guessed = smoothed(part.steps, auxiliary=True, uses_up=True), GuessedMotion.of(part.walking)
        known = PassedOver(
            records,
            first.epoch_ns or 0,
            first.clock_ns,
            np.zeros((2, 2)),
            part.walking,
            guessed=guessed,
            clock_sigma_s=CLOCK_WITHOUT_S,
            fixes=[(first.pair_seconds(fix.stamp_ns), fix) for fix in fixes],
            lasting=_lasting([part]),
        )
        again = settled(path, part.detection, part.shaking, known, sum(part.lit_pictures), doubtful=False)
        found.append(again or (first, path))
    if not found:
        return Smoothed.none(first.clock_ns, first.problems)
    whole = _rows_of(found, outputs_ns, gap)
    problems = list(dict.fromkeys([*first.problems, *whole.problems]))
    return replace(whole, problems=problems, dark=first.lamps.dark())


def _rows_of(passed: Sequence[tuple[TrackFilter | PathPass, Path]], outputs_ns: Sequence[int], gap: float) -> Smoothed:
    """Give the rows of last passes' paths."""
    problems = list(dict.fromkeys(said for track, _ in passed for said in track.problems))
    stamps = sorted(outputs_ns)
    rows = chain.from_iterable(
        rows_between(path, np.array([track.pair_seconds(stamp) for stamp in stamps]), stamps, gap)
        for track, path in passed
    )
    last, path = passed[-1]
    return Smoothed(rows, _clock_s(last, path), clock_sigma_s(path), problems, last.lamps.dark())
