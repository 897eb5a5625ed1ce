"""What two nodes recorded in a dive, and how a filter is brought through it."""

from __future__ import annotations

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias, TypeVar

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.gyros import TurningTold, faulty_spans, gyro_faults
from buddyline.solver_service.track.inputs import (
    Attitudes,
    AttitudeSeen,
    DepthSeen,
    FixSeen,
    FrameSeen,
    Stamps,
    TrackNode,
)
from buddyline.solver_service.track.intake import TrackIntake
from buddyline.solver_service.track.samples import false_ones, sound_ones
from buddyline.solver_service.track.stepping import TrackSteps
from buddyline.solver_service.track.units import clipped, stuck_runs, stuck_words
from buddyline.solver_service.track.vibration import fast_part, sudden_turn

# A dive is fed in pieces of this length, each further than the filter is brought: samples are needed ahead of it.
PIECE_NS: Final = 10 * S_NS
MARGIN_NS: Final = S_NS
BEGINNING_NS, END_NS = -(2**62), 2**62
Stamped = TypeVar("Stamped", AttitudeSeen, DepthSeen, FixSeen, FrameSeen)
Records: TypeAlias = tuple["NodeRecord", "NodeRecord"]


@dataclass(frozen=True, eq=False)
class NodeRecord:
    """What one node recorded, in order of stamps.

    Inertial columns: stamps (N,), accel and gyro (N, 3), body frame; fast (N, 7): the fast part of both and the
    camera's sudden turn, where known. faults: from when to when, by the node's stamps, the unit is stuck or its gyro
    turns otherwise, by all of the dive, and that in words; None where it is to be judged on the way.
    """

    node: TrackNode
    frames: Sequence[FrameSeen]
    imu_stamps_ns: Stamps = field(default_factory=lambda: np.zeros(0, np.int64))
    accel_mps2: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    gyro_radps: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    attitudes: Sequence[AttitudeSeen] = ()
    depths: Sequence[DepthSeen] = ()
    fast: Floats | None = None
    faults: Sequence[tuple[int, int, str]] | None = None

    def between(self, start_ns: int, end_ns: int) -> NodeRecord:
        """Give what was recorded from start_ns on and before end_ns."""
        first, last = np.searchsorted(self.imu_stamps_ns, (start_ns, end_ns))
        return replace(
            self,
            frames=between(self.frames, start_ns, end_ns),
            imu_stamps_ns=self.imu_stamps_ns[first:last],
            accel_mps2=self.accel_mps2[first:last],
            gyro_radps=self.gyro_radps[first:last],
            attitudes=between(self.attitudes, start_ns, end_ns),
            depths=between(self.depths, start_ns, end_ns),
            fast=None if self.fast is None else self.fast[first:last],
        )


def between(items: Sequence[Stamped], start_ns: int, end_ns: int) -> Sequence[Stamped]:
    """Give the items, in order of stamps, from start_ns on and before end_ns."""
    first, last = (bisect.bisect_left(items, stamp_ns, key=stamp_of) for stamp_ns in (start_ns, end_ns))
    return items[first:last]


def stamp_of(item: AttitudeSeen | DepthSeen | FixSeen | FrameSeen) -> int:
    """Give the stamp that items are in order of."""
    return item.stamp_ns


def joined(pieces: Sequence[NodeRecord]) -> NodeRecord:
    """Give the record of which these, at least one, are the pieces in order of time."""
    return replace(
        pieces[-1],
        frames=[frame for piece in pieces for frame in piece.frames],
        imu_stamps_ns=np.concatenate([piece.imu_stamps_ns for piece in pieces]),
        accel_mps2=np.concatenate([piece.accel_mps2 for piece in pieces]),
        gyro_radps=np.concatenate([piece.gyro_radps for piece in pieces]),
        attitudes=Attitudes.joined([piece.attitudes for piece in pieces]),
        depths=[each for piece in pieces for each in piece.depths],
    )


def in_order(record: NodeRecord) -> NodeRecord:
    """Give a record by its stamps."""
    order = np.argsort(record.imu_stamps_ns, kind="stable")
    return replace(
        record,
        frames=sorted(record.frames, key=stamp_of),
        imu_stamps_ns=record.imu_stamps_ns[order],
        accel_mps2=record.accel_mps2[order],
        gyro_radps=record.gyro_radps[order],
        attitudes=Attitudes.joined([record.attitudes]),
        depths=sorted(record.depths, key=stamp_of),
    )


def until_one_ended(records: Records) -> Records:
    """Give what was recorded until the first of the two nodes ended: its lamps alone show no track after that."""
    end_ns = min(map(_end_ns, records))
    a, b = (record.between(BEGINNING_NS, end_ns + 1) for record in records)
    return a, b


def _end_ns(record: NodeRecord) -> int:
    """Give the last stamp of a record in order."""
    told = [items[-1].stamp_ns for items in (record.frames, record.attitudes, record.depths) if items]
    return max([*told, *record.imu_stamps_ns[-1:].tolist()], default=END_NS)


def parted(record: NodeRecord) -> NodeRecord:
    """Give a record with the fast part of its inertial samples, and its camera's sudden turns."""
    stamps_ns, values = record.imu_stamps_ns, np.hstack((record.accel_mps2, record.gyro_radps))
    sound = sound_ones(values)
    sound[sound] = ~false_ones(np.asarray(stamps_ns[sound], np.float64) * 1e-9, values[sound])
    if sound.any() and not sound.all():
        # One that is to be left out must not spoil those about it.
        for column in values.T:
            column[~sound] = np.interp(stamps_ns[~sound], stamps_ns[sound], column[sound])
    of_each = [fast_part(stamps_ns, of_sensor) for of_sensor in (values[:, :3], values[:, 3:])]
    return replace(record, fast=np.column_stack((*of_each, sudden_turn(stamps_ns, values[:, 3:]))))


def judged(record: NodeRecord) -> NodeRecord:
    """Give a record in order with its unit's faults, by all of it."""
    faults = _stuck(record)
    stamps_ns, attitudes = record.imu_stamps_ns, Attitudes.joined([record.attitudes])
    if not len(stamps_ns) or not len(attitudes):
        return replace(record, faults=faults)
    epoch_ns = int(stamps_ns[0])
    with np.errstate(invalid="ignore"):
        values = np.hstack((record.accel_mps2, record.gyro_radps))
        sound = sound_ones(values) & ~clipped(record.gyro_radps)
    sound[1:] &= np.diff(stamps_ns) > 0
    sound[sound] = ~false_ones(np.asarray(stamps_ns[sound] - epoch_ns, np.float64) * 1e-9, values[sound])
    told = TurningTold(
        np.asarray(attitudes.stamps_ns - epoch_ns, np.float64) * 1e-9,
        attitudes.R_ned_body,
        attitudes.sigma_rad,
        np.asarray(stamps_ns[sound] - epoch_ns, np.float64) * 1e-9,
        record.gyro_radps[sound],
    )
    faults += [
        (
            epoch_ns if math.isinf(start_s) else epoch_ns + round(start_s * 1e9),
            END_NS if math.isinf(end_s) else epoch_ns + round(end_s * 1e9),
            fault.of(record.node.name),
        )
        for start_s, end_s, fault in faulty_spans(list(gyro_faults(told)))
    ]
    return replace(record, faults=faults)


def _stuck(record: NodeRecord) -> list[tuple[int, int, str]]:
    """Give from when to when, by stamps, force or rate do not change for a second, and that in words."""
    found = []
    for values, of_rate in ((record.accel_mps2, False), (record.gyro_radps, True)):
        for first, last in stuck_runs(values):
            start_ns, end_ns = record.imu_stamps_ns[[first, last]].tolist()
            if end_ns - start_ns > S_NS:
                found.append((start_ns, end_ns, stuck_words(record.node.name, not of_rate, of_rate)))
    return found


def last_ns(records: Records) -> int:
    """Give a stamp well after all that was recorded."""
    stamps = [0]
    for record in records:
        stamps += [frame.stamp_ns for frame in record.frames[-1:]]
    return max(stamps) + 1_000_000_000


def feed(track: TrackIntake, node: int, record: NodeRecord) -> None:
    """Give a filter what a node recorded."""
    if record.faults is not None:
        track.know_faults(node, record.faults)
    track.add_imu(node, record.imu_stamps_ns, record.accel_mps2, record.gyro_radps, record.fast)
    for attitude in record.attitudes:
        track.add_attitude(node, attitude)
    for depth in record.depths:
        track.add_depth(node, depth)
    track.add_frames(node, record.frames)


def pass_over(
    track: TrackSteps,
    records: Records,
    fixes: Sequence[FixSeen],
    start_ns: int = BEGINNING_NS,
    stop_ns: int = END_NS,
) -> None:
    """Bring a filter through a dive, fed piece by piece, so that it holds a minute of samples at a time.

    start_ns, stop_ns: of the part of the dive to take in, in whole pieces; a later call goes on from there.
    """
    track.passes = True
    frames_ns = np.array([frame.stamp_ns for record in records for frame in record.frames], dtype=np.int64)
    ends_ns = (np.unique(frames_ns // PIECE_NS) + 1) * PIECE_NS
    for end_ns in [*ends_ns[(ends_ns > start_ns) & (ends_ns < stop_ns)].tolist(), stop_ns]:
        for node, record in enumerate(records):
            shift_ns = track.clock_ns if node else 0
            feed(track, node, record.between(start_ns + shift_ns, end_ns + shift_ns))
        for fix in between(fixes, start_ns, end_ns):
            track.add_fix(fix)
        track.advance(end_ns - MARGIN_NS if end_ns < END_NS else last_ns(records))
        start_ns = end_ns
