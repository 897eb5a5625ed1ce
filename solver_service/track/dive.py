"""A whole dive's track: filter, smooth, decide again what was open, smooth again."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.track.estimate import Estimate, Guide, Step
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import AttitudeSeen, DepthSeen, FixSeen, FrameSeen, Stamps, TrackNode
from buddyline.solver_service.track.lights import COLUMNS
from buddyline.solver_service.track.output import TrackRow
from buddyline.solver_service.track.smoother import rows_between, smoothed
from buddyline.solver_service.track.start import CLOCK_S, constants_of
from buddyline.solver_service.track.state import CLOCK, PHI, R_, State

_BLOCK: Final = np.ix_(COLUMNS, COLUMNS)
# How far a clock may be off that nobody told of, and by how much the first pass may err beside its own sigma, 1 sd.
UNTOLD_CLOCK_S: Final = 0.1
CLOCK_LEFT_S: Final = 0.003
CLOCK_WITHOUT_S: Final = 0.003
FAR_CLOCK_S: Final = 0.06
CLOCK_ROUNDS: Final = 3
# Further off, and a node without an inertial unit gets no track: the offset it seems to have is itself off by a tenth.
FAR_WITHOUT_S: Final = 0.05
# A later pass starts as if nothing were known but roughly where: its lights tell the rest.
BROAD_R_M: Final = 0.5
BROAD_TURN_RAD: Final = 0.15


@dataclass(frozen=True, eq=False)
class NodeRecord:
    """All that one node recorded on a dive. Inertial columns: stamps (N,), accel and gyro (N, 3), body frame."""

    node: TrackNode
    frames: Sequence[FrameSeen]
    imu_stamps_ns: Stamps = field(default_factory=lambda: np.zeros(0, np.int64))
    accel_mps2: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    gyro_radps: Floats = field(default_factory=lambda: np.zeros((0, 3)))
    attitudes: Sequence[AttitudeSeen] = ()
    depths: Sequence[DepthSeen] = ()


@dataclass(frozen=True, eq=False)
class Smoothed:
    """A dive's track.

    constants: the last state, which holds what was learned of the units and clocks. dark: lamps that were dark at the
    end: node, light, for how long (s).
    """

    rows: list[TrackRow]
    constants: State | None
    clock_offset_s: float
    clock_sigma_s: float
    problems: list[str]
    dark: list[tuple[int, int, float]] = field(default_factory=list)


def filter_of(
    records: tuple[NodeRecord, NodeRecord],
    fixes: Sequence[FixSeen],
    clock_ns: int = 0,
    clock_sigma_s: float = CLOCK_S,
) -> TrackFilter:
    """Make a filter that keeps its steps and holds a whole dive."""
    track = TrackFilter(records[0].node, records[1].node, keep_s=math.inf, clock_sigma_s=clock_sigma_s)
    track.clock_ns = clock_ns
    for node, record in enumerate(records):
        track.add_imu(node, record.imu_stamps_ns, record.accel_mps2, record.gyro_radps)
        for attitude in record.attitudes:
            track.add_attitude(node, attitude)
        for depth in record.depths:
            track.add_depth(node, depth)
        for frame in record.frames:
            track.add_frame(node, frame)
    for fix in fixes:
        track.add_fix(fix)
    return track


def smooth(
    records: tuple[NodeRecord, NodeRecord], fixes: Sequence[FixSeen], outputs_ns: Sequence[int], clock_ns: int = 0
) -> Smoothed:
    """Give the whole dive's track at outputs_ns."""
    end_ns, told_ns = last_ns(records), clock_ns
    for _ in range(CLOCK_ROUNDS):
        first = filter_of(records, fixes, clock_ns, UNTOLD_CLOCK_S)
        first.advance(end_ns)
        parts = parts_of(first)
        if not parts:
            return Smoothed([], None, clock_ns * 1e-9, math.inf, first.problems)
        if abs(parts[-1].state.clock_s) < FAR_CLOCK_S:
            break
        # So far off, the pass was not linear: once more, from there.
        clock_ns += round(parts[-1].state.clock_s * 1e9)
    without = any(any(part.without) for part in parts)
    off_s = (clock_ns - told_ns) * 1e-9
    if abs(parts[-1].state.clock_s) >= FAR_CLOCK_S or (without and abs(off_s) > FAR_WITHOUT_S):
        said = f"{first.both}: their clocks seem some {off_s:.2f} s apart, which cannot be told well enough: no track"
        return Smoothed([], None, clock_ns * 1e-9, math.inf, [*first.problems, said])
    if without:
        # Without a gyro the clocks' offset cannot be told from the turning, nor lights be decided by it again.
        only = filter_of(records, fixes, told_ns, CLOCK_WITHOUT_S)
        only.advance(end_ns)
        return rows_of(only, parts_of(only), outputs_ns)
    # B's stamps are moved by what the first pass found, so that the second is linear in what is left.
    learned = parts[-1]
    shift_s = learned.state.clock_s
    clock_sigma_s = CLOCK_LEFT_S + 3.0 * math.sqrt(learned.covariance[CLOCK, CLOCK])
    second = filter_of(records, (), clock_ns + round(shift_s * 1e9), clock_sigma_s)
    second.restarts = False
    told = sum(part.told for part in parts)
    if told > 100:
        second.unrest = min(max(math.sqrt(sum(part.surprise for part in parts) / told), 0.3), 2.0)
    # A track that has just begun has not yet learned how much its units shake.
    strain = max(part.strain for part in parts)
    for part in parts:
        results = smoothed(part.steps)
        guide_by(second, part.steps, results)
        state = replace(results[0][0], clock_s=0.0)
        second.begin(part.steps[0].t_s - 0.01, part.end_s, *broad_start(second, state), strain)
    # Every step of the first pass holds a covariance: both passes at once take twice the memory.
    del first, parts, part, learned, results
    second.advance(end_ns)
    return rows_of(second, parts_of(second), outputs_ns)


def last_ns(records: tuple[NodeRecord, NodeRecord]) -> int:
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


def broad_start(track: TrackFilter, state: State) -> tuple[State, Floats]:
    """Give a state to start again from, with a covariance that holds nothing of the lights yet."""
    _, variances = constants_of(track.nodes, state.R, state.r_m, track.clock_sigma_s)
    P = np.diag(variances)
    P[R_, R_] = BROAD_R_M**2 * np.eye(3)
    level = 0.15**2 * np.eye(3)
    P[PHI[0], PHI[0]] = P[PHI[0], PHI[1]] = P[PHI[1], PHI[0]] = level
    P[PHI[1], PHI[1]] = level + BROAD_TURN_RAD**2 * np.eye(3)
    return state, P


def guide_by(track: TrackFilter, steps: Sequence[Step], results: Sequence[tuple[State, Floats]]) -> None:
    """Tell a filter what a pass knew at each picture."""
    for step, (state, P) in zip(steps, results, strict=True):
        for look in step.looks:
            key = look.sight.stamp_ns, look.sight.node
            track.guides[key] = Guide(look.sight.t_s - step.t_s, state, P[_BLOCK], step.rates_radps, look.chosen)


def rows_of(track: TrackFilter, parts: Sequence[Estimate], outputs_ns: Sequence[int]) -> Smoothed:
    """Smooth each part and give its rows at the asked stamps."""
    rows: list[TrackRow] = []
    last: tuple[State, Floats] | None = None
    stamps = sorted(outputs_ns)
    times = np.array([track.between(stamp) for stamp in stamps])
    for part in parts:
        results = smoothed(part.steps)
        last = results[-1]
        rows += rows_between(part.steps, results, times, stamps)
    if last is None:
        return Smoothed([], None, track.clock_ns * 1e-9, math.inf, track.problems)
    state, P = last
    clock_s = track.clock_ns * 1e-9 + state.clock_s
    return Smoothed(rows, state, clock_s, math.sqrt(P[CLOCK, CLOCK]), track.problems, track.lamps.dark())
