"""A whole dive's track: filter, smooth, decide again what was open, smooth again."""

from __future__ import annotations

import bisect
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from itertools import chain, combinations
from typing import Final, TypeAlias, TypeVar

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.earlier import EARLIER_S, EarlierFilter
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import AttitudeSeen, DepthSeen, FixSeen, FrameSeen, Stamps, TrackNode
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.relax import PathFilter
from buddyline.solver_service.track.search import FURTHEST_M
from buddyline.solver_service.track.shaking import Shaking
from buddyline.solver_service.track.smoother import Path, rows_between, smoothed
from buddyline.solver_service.track.start import CLOCK_S, broad_start
from buddyline.solver_service.track.state import CLOCK, NAV, R_
from buddyline.solver_service.track.stepping import KNOWN_CLOCK_S
from buddyline.solver_service.track.trail import Trail
from buddyline.solver_service.track.vibration import Shares, fast_part, sudden_turn
from buddyline.solver_service.track.walking import joint

# The clocks' offset in the last pass, 1 sd: what the first pass has left beside its own sigma; and where a node has no
# inertial unit, so that no pass estimates it.
CLOCK_LEFT_S: Final = 0.003
CLOCK_WITHOUT_S: Final = 0.003
# A pass that finds the offset off by as much is repeated with it, CLOCK_ROUNDS passes at most; where a node has no
# inertial unit, only from MOST_LEFT_S on. Where the last pass still finds MOST_LEFT_S there is no track.
NEAR_CLOCK_S: Final = 0.005
MOST_LEFT_S: Final = 0.06
CLOCK_ROUNDS: Final = 4
# A track that began without a fix, and is carried back by more than this, is passed over until that settles.
LATE_S: Final = 2.0
# A track whose start is so near to the dive's is left as it is.
LEAST_EARLIER_S: Final = 0.15
# An offset differs from the assumed one where it is so many sigmas off.
TOLD_SIGMAS: Final = 6.0
# Offsets that are tried where a first pass gives more than one track, and none goes on for NEARLY_ALL of the time; a
# pass finds one up to 0.3 s from each. There is no result if the best pass is in pieces: tracks whose offsets differ by
# more than so many s, and so many sigmas.
CLOCK_TRIES_S: Final = (0.4, -0.4, 0.8, -0.8)
NEARLY_ALL: Final = 0.9
PIECES_S: Final = 0.1
PIECES_SIGMAS: Final = 4.0
# A track that began with single lamps, or so late, is passed over so often at most, until a pass moves no pose by so
# many sigmas. It is one where chi^2 of each residual is below UNFIT, on average, and it takes LEAST_TOLD of the lights
# of the first.
LONE_PASSES: Final = 12
STAYS_SIGMAS: Final = 0.3
LOOKED_AT: Final = 10
UNFIT: Final = 1.5
LEAST_TOLD: Final = 0.5
# Two quartz clocks drift apart by less, s a second.
MOST_DRIFT: Final = 100e-6
HEAD_NS: Final = 90 * S_NS
# Further off, there is no track where a node has no inertial unit: the offset that is found is itself off by a tenth.
FAR_WITHOUT_S: Final = 0.05
# A dive is fed in pieces of this length, each further than the filter is brought: samples are needed ahead of it.
PIECE_NS: Final = 10 * S_NS
MARGIN_NS: Final = S_NS
_BEGINNING_NS, _END_NS = -(2**62), 2**62
Stamped = TypeVar("Stamped", AttitudeSeen, DepthSeen, FixSeen, FrameSeen)
Records: TypeAlias = tuple["NodeRecord", "NodeRecord"]


@dataclass(frozen=True, eq=False)
class NodeRecord:
    """What one node recorded, in order of stamps.

    Inertial columns: stamps (N,), accel and gyro (N, 3), body frame; fast (N, 7): the fast part of both and the
    camera's sudden turn, where known.
    """

    node: TrackNode
    frames: Sequence[FrameSeen]
    imu_stamps_ns: Stamps = field(default_factory=lambda: np.zeros(0, np.int64))
    accel_mps2: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    gyro_radps: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    attitudes: Sequence[AttitudeSeen] = ()
    depths: Sequence[DepthSeen] = ()
    fast: Floats | None = None

    def between(self, start_ns: int, end_ns: int) -> NodeRecord:
        """Give what was recorded from start_ns on and before end_ns."""
        first, last = np.searchsorted(self.imu_stamps_ns, (start_ns, end_ns))
        return replace(
            self,
            frames=_between(self.frames, start_ns, end_ns),
            imu_stamps_ns=self.imu_stamps_ns[first:last],
            accel_mps2=self.accel_mps2[first:last],
            gyro_radps=self.gyro_radps[first:last],
            attitudes=_between(self.attitudes, start_ns, end_ns),
            depths=_between(self.depths, start_ns, end_ns),
            fast=None if self.fast is None else self.fast[first:last],
        )


def _between(items: Sequence[Stamped], start_ns: int, end_ns: int) -> Sequence[Stamped]:
    first, last = (bisect.bisect_left(items, stamp_ns, key=_stamp_of) for stamp_ns in (start_ns, end_ns))
    return items[first:last]


def _stamp_of(item: AttitudeSeen | DepthSeen | FixSeen | FrameSeen) -> int:
    return item.stamp_ns


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


def joined(pieces: Sequence[NodeRecord]) -> NodeRecord:
    """Give the record of which these, at least one, are the pieces in order of time."""
    return replace(
        pieces[-1],
        frames=[frame for piece in pieces for frame in piece.frames],
        imu_stamps_ns=np.concatenate([piece.imu_stamps_ns for piece in pieces]),
        accel_mps2=np.concatenate([piece.accel_mps2 for piece in pieces]),
        gyro_radps=np.concatenate([piece.gyro_radps for piece in pieces]),
        attitudes=[each for piece in pieces for each in piece.attitudes],
        depths=[each for piece in pieces for each in piece.depths],
    )


def feed(track: TrackFilter, node: int, record: NodeRecord) -> None:
    """Give a filter what a node recorded."""
    track.add_imu(node, record.imu_stamps_ns, record.accel_mps2, record.gyro_radps, record.fast)
    for attitude in record.attitudes:
        track.add_attitude(node, attitude)
    for depth in record.depths:
        track.add_depth(node, depth)
    for frame in record.frames:
        track.add_frame(node, frame)


def _empty_filter(records: Records, clock_ns: int, clock_sigma_s: float) -> TrackFilter:
    track = TrackFilter(records[0].node, records[1].node, keep_s=math.inf, clock_sigma_s=clock_sigma_s)
    track.clock_ns = clock_ns
    return track


def pass_over(
    track: TrackFilter,
    records: Records,
    fixes: Sequence[FixSeen],
    start_ns: int = _BEGINNING_NS,
    stop_ns: int = _END_NS,
) -> None:
    """Bring a filter through a dive, fed piece by piece, so that it holds a minute of samples at a time.

    start_ns, stop_ns: of the part of the dive to take in, in whole pieces; a later call goes on from there.
    """
    frames_ns = np.array([frame.stamp_ns for record in records for frame in record.frames], dtype=np.int64)
    ends_ns = (np.unique(frames_ns // PIECE_NS) + 1) * PIECE_NS
    for end_ns in [*ends_ns[(ends_ns > start_ns) & (ends_ns < stop_ns)].tolist(), stop_ns]:
        for node, record in enumerate(records):
            shift_ns = track.clock_ns if node else 0
            feed(track, node, record.between(start_ns + shift_ns, end_ns + shift_ns))
        for fix in _between(fixes, start_ns, end_ns):
            track.add_fix(fix)
        track.advance(end_ns - MARGIN_NS if end_ns < _END_NS else last_ns(records))
        start_ns = end_ns


def smooth(records: Records, fixes: Sequence[FixSeen], outputs_ns: Sequence[int], clock_ns: int = 0) -> Smoothed:
    """Give the whole dive's track at outputs_ns."""
    records, fixes = (parted(in_order(records[0])), parted(in_order(records[1]))), sorted(fixes, key=_stamp_of)
    told_ns = clock_ns
    long = bool(fixes) and fixes[-1].stamp_ns - fixes[0].stamp_ns > 2 * HEAD_NS
    head_ns = (fixes[0].stamp_ns + HEAD_NS) // PIECE_NS * PIECE_NS if long else _END_NS
    first, parts, clock_ns = _first_pass(records, fixes, clock_ns, head_ns)
    if long:
        # The dive's beginning has given the clocks' offset: what is left of the dive mostly needs no other round.
        pass_over(first, records, fixes, head_ns)
        parts = parts_of(first)
        left_ns = _clock_left_ns(parts)
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
        return _of_one_lamp_each(records, clock_ns, max(parts, key=_lasted_s), shares, outputs_ns)
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
            settled = _settled(*about, records, clock_ns, shaking, shares)
            if settled is not None:
                return _rows_of(settled[0], [settled[1]], outputs_ns)
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
        found = parts_of(second)
        if not any(clock_off_by(one, MOST_LEFT_S) for one in found):
            return _smoothed(second, found, outputs_ns)
    said = f"{second.both}: the second pass contradicts the first on the clocks, so it has diverged: no track"
    return Smoothed([], clock_ns * 1e-9, math.inf, [*second.problems, said])


def _of_one_lamp_each(
    records: Records, clock_ns: int, part: Estimate, shares: Floats, outputs_ns: Sequence[int]
) -> Smoothed:
    """Give the track that began with one lamp of each node, the dive's beginning with it if that settles, too."""
    path, told, about = smoothed(part.steps), sum(part.told_by), (records, clock_ns, part.shaking.less(shares), shares)
    part.steps = Trail()
    found = _settled(path, part.detection, told, *about)
    if found is None:
        said = f"nodes {records[0].node.name} and {records[1].node.name}: one lamp of each does not tell a track"
        return Smoothed([], clock_ns * 1e-9, math.inf, [said])
    track, path = found
    earlier = _path_before(records, clock_ns, path, -math.inf, shares)
    if earlier is not None:
        track, path = _settled(path.after(earlier), track.passed.detection, told, *about) or found
    return _rows_of(track, [path], outputs_ns)


def _settled(
    path: Path, detection: Floats, told: int, records: Records, clock_ns: int, shaking: Shaking, shares: Floats
) -> tuple[PathFilter, Path] | None:
    """Pass over a dive about the last pass's path until that does not move. told: the pictures that the first used."""
    for _ in range(LONE_PASSES):
        track = PathFilter((records[0].node, records[1].node), path, detection, shaking)
        track.clock_ns = clock_ns
        track.take_off(shares)
        pass_over(track, records, ())
        found = track.passed
        old, path, detection = path, smoothed(found.steps, path), found.detection
        if not bool(np.isfinite(path.states).all()):
            return None
        if _stays(old, path):
            fits = found.surprise < UNFIT * found.told and sum(found.told_by) > LEAST_TOLD * told
            near = np.linalg.norm(path.states[:, R_], axis=1).max() < FURTHEST_M
            return (track, path) if fits and near else None
    return None


def _stays(old: Path, new: Path) -> bool:
    """Whether a pass over a dive has left each pose where the pass before had it, by its covariance."""
    for k in range(0, len(new), LOOKED_AT):
        moved = new.state(k).minus(old.state(k))[:NAV]
        if not moved @ np.linalg.solve(new.covariance(k)[:NAV, :NAV], moved) < NAV * STAYS_SIGMAS**2:
            return False
    return True


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


def goes_on(parts: Sequence[Estimate]) -> bool:
    """Whether one of a dive's tracks is nearly all of it, with the clocks' offset settled: the others are false starts.

    With a wrong offset tracks are replaced after seconds, or go on but ask for another offset in each pass.
    """
    if len(parts) < 2:
        return True
    longest = max(parts, key=_lasted_s)
    whole_s = max(part.t_s for part in parts) - min(part.start_s for part in parts)
    return _lasted_s(longest) > NEARLY_ALL * whole_s and not _clock_left_ns([longest])


def _lasted_s(part: Estimate) -> float:
    return min(part.t_s, part.end_s) - part.start_s


def in_pieces(parts: Sequence[Estimate]) -> bool:
    """Whether a dive's tracks disagree on the clocks' offset: it is further off than was tried."""
    return any(disagree(one, other, PIECES_S) for one, other in combinations(parts, 2))


def disagree(one: Estimate, other: Estimate, limit_s: float) -> bool:
    """Whether two tracks' clock offsets differ by more than limit_s beside drift, and more than PIECES_SIGMAS."""
    limit_s += MOST_DRIFT * abs(one.t_s - other.t_s)
    variance = float(one.covariance[CLOCK, CLOCK] + other.covariance[CLOCK, CLOCK])
    return abs(one.state.clock_s - other.state.clock_s) > max(limit_s, PIECES_SIGMAS * math.sqrt(variance))


def of_one_clock(parts: Sequence[Estimate]) -> list[Estimate]:
    """Leave out tracks that diverged: between one and the next the clocks' offset cannot have jumped.

    Of two that disagree on it, the one that explains more is kept. Further apart than PIECES_S it is the offset that
    is not known.
    """
    sound: list[Estimate] = []
    for part in parts:
        while sound and disagree(sound[-1], part, NEAR_CLOCK_S) and not disagree(sound[-1], part, PIECES_S):
            if sound[-1].evidence > part.evidence:
                break
            sound.pop()
        else:
            sound.append(part)
    return sound


def _rounds(
    records: Records, fixes: Sequence[FixSeen], clock_ns: int, stop_ns: int = _END_NS
) -> tuple[TrackFilter, list[Estimate], int]:
    """Pass over a dive until the offset is settled: a pass whose clocks are off finds too small an offset."""
    for left in reversed(range(CLOCK_ROUNDS)):
        first = _empty_filter(records, clock_ns, CLOCK_S)
        pass_over(first, records, fixes, stop_ns=stop_ns)
        parts = parts_of(first)
        left_ns = _clock_left_ns(parts)
        if not left or not left_ns:
            break
        clock_ns += left_ns
    return first, parts, clock_ns


def _clock_left_ns(parts: Sequence[Estimate]) -> int:
    """Give by how much B's clock proves to be off what a pass assumed; 0 where that is near enough."""
    if not parts:
        return 0
    without = any(any(part.without) for part in parts)
    off = clock_off_by(parts[-1], MOST_LEFT_S if without else NEAR_CLOCK_S)
    return round(parts[-1].state.clock_s * 1e9) if off else 0


def clock_off_by(part: Estimate, limit_s: float) -> bool:
    """Whether a track's clocks are limit_s and TOLD_SIGMAS off: at rest, its sigma is too small for fewer."""
    sigma_s = math.sqrt(part.covariance[CLOCK, CLOCK])
    return abs(part.state.clock_s) >= max(limit_s, TOLD_SIGMAS * sigma_s)


def in_order(record: NodeRecord) -> NodeRecord:
    """Give a record by its stamps."""
    order = np.argsort(record.imu_stamps_ns, kind="stable")
    return replace(
        record,
        frames=sorted(record.frames, key=_stamp_of),
        imu_stamps_ns=record.imu_stamps_ns[order],
        accel_mps2=record.accel_mps2[order],
        gyro_radps=record.gyro_radps[order],
        attitudes=sorted(record.attitudes, key=_stamp_of),
        depths=sorted(record.depths, key=_stamp_of),
    )


def parted(record: NodeRecord) -> NodeRecord:
    """Give a record with the fast part of its inertial samples, and its camera's sudden turns."""
    stamps_ns = record.imu_stamps_ns
    of_each = [fast_part(stamps_ns, values) for values in (record.accel_mps2, record.gyro_radps)]
    return replace(record, fast=np.column_stack((*of_each, sudden_turn(stamps_ns, record.gyro_radps))))


def last_ns(records: Records) -> int:
    """Give a stamp well after all that was recorded."""
    stamps = [0]
    for record in records:
        stamps += [frame.stamp_ns for frame in record.frames[-1:]]
    return max(stamps) + 1_000_000_000


def parts_of(track: TrackFilter) -> list[Estimate]:
    """Give the confirmed tracks of a filter, one after the other in time."""
    parts = [part for part in track.finished if part.steps]
    if track.main is not None and track.main.confirmed and track.main.steps:
        parts.append(track.main)
    return parts


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
