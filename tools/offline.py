"""The whole pipeline in memory: a dive's messages in, poses, rejections and track out, no file written."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from buddyline.node.choices import DETECTORS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Candidates, Message, NodeInfo, Rejected, RelativePose, Track
from buddyline.solver_service.choices import CHECKS
from buddyline.solver_service.clock_curve import ClockCurve
from buddyline.solver_service.config import SolveConfig, track_settings
from buddyline.solver_service.core import SolverCore
from buddyline.tools.clock_curves import chosen_curves
from buddyline.tools.columns import (
    Pair,
    PoseColumns,
    RejectionColumns,
    TrackColumns,
    columns_of,
    in_order,
    pose_columns,
    track_columns,
)
from buddyline.tools.dives import Dive
from buddyline.tools.solve import clocks_apart, is_replaced, messages_of, solved


@dataclass(frozen=True, eq=False)
class SolvedDive:
    """The poses, rejections and track of a dive, as columns by time. pair: a and b of T_a_b.

    track has no rows with track="none", and where no track was found.
    """

    pair: Pair
    poses: PoseColumns
    rejections: RejectionColumns
    track: TrackColumns


def solve_messages(
    messages: Iterable[Message],
    *,
    pair: Pair | None = None,
    method: str = "refined",
    checks: Sequence[str] = CHECKS,
    clock_offset_s: float | None = None,
    track: str = "smooth",
    track_hz: float = 50.0,
    clocks: Mapping[str, ClockCurve] | None = None,
) -> SolvedDive:
    """Solve a pair's messages (NodeInfo, Candidates, Imu, Attitude, Depth), in the order in which they were received.

    pair: may be left out where two nodes have candidates. clock_offset_s: B's clock minus A's. track: "smooth", "lag",
    "filter" or "none". clocks: each node's clock over time, in place of clock_offset_s. The results are those of
    `buddyline solve`. Raises BuddylineError if the pair or its calibration is missing.
    """
    taken = list(messages)
    chosen = _pair(sorted({message.node for message in taken if isinstance(message, Candidates)}), pair)
    known = {message.node for message in taken if isinstance(message, NodeInfo)}
    for node in chosen:
        if node not in known:
            raise BuddylineError(f"no NodeInfo of node {node}")
    settings = SolveConfig(method=method, checks=list(checks)).settings("solve_messages")
    if clocks is None:
        clocks = {chosen[1]: ClockCurve.constant(clock_offset_s or 0.0)}

    def outcomes_of(apart_s: Mapping[Pair, float]) -> tuple[SolverCore, list[Message]]:
        core = SolverCore(settings, [chosen], clocks, apart_s=apart_s, track=track_settings(track, track_hz))
        return core, list(solved(core, taken))

    core, outcomes = outcomes_of({})
    if apart_s := clocks_apart(core):
        # What the first pass has made only takes memory now.
        del core, outcomes
        _, outcomes = outcomes_of(apart_s)
    rejected = sorted((one for one in outcomes if isinstance(one, Rejected)), key=lambda one: one.stamp_ns)
    return SolvedDive(
        chosen,
        pose_columns(in_order(one for one in outcomes if isinstance(one, RelativePose))),
        columns_of(RejectionColumns, rejected),
        track_columns(in_order(one for one in outcomes if isinstance(one, Track))),
    )


def solve_logs(
    logs: Sequence[str | Path],
    *,
    pair: Pair | None = None,
    method: str = "refined",
    checks: Sequence[str] = CHECKS,
    clock_offset_s: float | None = None,
    environment: str = "auto",
    infos: Mapping[str, NodeInfo] | None = None,
    track: str = "smooth",
    track_hz: float = 50.0,
) -> SolvedDive:
    """Solve a stored dive; the pictures of a node without candidates are detected first.

    infos: calibrations in place of the logs' own. environment: changes nothing for the default
    detector. clock_offset_s: None for what the nodes' beacons tell. The others as in solve_messages.
    """
    with Dive([Path(log) for log in logs]) as dive:
        given = dict(infos or {})
        envelopes = messages_of(
            dive,
            dive.infos() | given,
            *dive.nodes(),
            detector=DETECTORS[0],
            environment=environment,
            doing="",
        )
        found = [*given.values(), *(one.message for one in envelopes if not is_replaced(one.message, given))]
        chosen = _pair(sorted({message.node for message in found if isinstance(message, Candidates)}), pair)
        return solve_messages(
            found,
            pair=chosen,
            clocks=chosen_curves(dive, chosen, clock_offset_s, None),
            method=method,
            checks=checks,
            track=track,
            track_hz=track_hz,
        )


def _pair(present: list[str], wanted: Pair | None) -> Pair:
    if wanted is not None:
        missing = [node for node in wanted if node not in present]
        if missing:
            raise BuddylineError(f"no candidates of node {missing[0]}; nodes: {', '.join(present) or 'none'}")
        return wanted
    if len(present) != 2:
        raise BuddylineError(f"candidates of nodes {', '.join(present) or 'none'}: choose a pair")
    return present[0], present[1]
