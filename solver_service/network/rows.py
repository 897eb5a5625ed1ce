"""Where the members are at coming times, for what is told of them: noted where the filter stands, worked out together.

What is told changes nothing in the estimate. So what a row is made of is noted when its turn comes, and the rows of
several times are worked out in one set of arrays. Of a row only each member's own block of the covariance is needed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from buddyline.solver_service.geometry.rotation import Floats, Indices, inner, skew
from buddyline.solver_service.network.motion import moved_members
from buddyline.solver_service.network.state import BLOCK, P_, PHI, POSED, V_, NetState, block
from buddyline.solver_service.network.trail import Present
from buddyline.solver_service.track.moving import Excerpt, integrated
from buddyline.solver_service.track.strapdown import Noise

# A node's pose is given while its position is better than TOLD_M, 1 sd, or than a share of its distance from the
# frame's zero.
TOLD_M: Final = 0.5
TOLD_SHARE: Final = 0.1
# So many rows are worked out at once at most, and so many members' ways at least: few rotations are worked out
# otherwise (geometry/rotation.py), and a row is to be the same whichever others are made with it.
TOGETHER: Final = 64
LEAST: Final = 5
Each = TypeVar("Each")
_DOWN: Final = np.array((0.0, 0.0, 1.0))


@dataclass(frozen=True, eq=False)
class NetRow:
    """One node's pose in the net's frame at one time, as the message NodePose has it."""

    node: int
    stamp_ns: int
    p_m: Floats
    R: Floats
    v_mps: Floats
    covariance: Floats
    age_s: float


@dataclass(frozen=True, eq=False)
class NetWay:
    """What leads to a row from the state of span_s before: of the members `moving`, their samples, noises, and the
    variances (M, 2) of their shaking."""

    span_s: float
    moving: Sequence[int]
    samples: Sequence[Excerpt]
    noises: Sequence[Noise]
    shaking: Floats


@dataclass(frozen=True, eq=False)
class DueNetRow:
    """A row that is to be told: the members, their state and covariance (N, N), and the way from there, None where the
    state is that of the row's time. anchor: the member that the frame moves with, None where it is fixed. north_doubt:
    as of the belief."""

    stamp_ns: int
    members: Sequence[Present]
    state: NetState
    covariance: Floats
    way: NetWay | None
    anchor: int | None
    north_doubt: float


def make_rows(due: Sequence[DueNetRow]) -> list[NetRow]:
    """Make rows, in their order: one of each member that is known well enough."""
    rows: list[NetRow] = []
    for start in range(0, len(due), TOGETHER):
        some = due[start : start + TOGETHER]
        # The members of all rows, one behind another: where those of each row begin.
        begin = np.cumsum([0, *(len(of.state) for of in some)])
        state, F, Q = _moved(some, begin)
        P = np.array([of.covariance[block(i), block(i)] for of in some for i in range(len(of.state))])
        own = F @ P @ F.swapaxes(1, 2) + Q
        if some[0].anchor is not None:
            state, own = _beside_anchors(some, begin, state, F, own)
        stamps_ns = [of.stamp_ns for of in some for _ in of.members]
        doubts = np.array([of.north_doubt for of in some for _ in of.members])
        rows += rows_of(stamps_ns, [one for of in some for one in of.members], state, own, doubts)
    return rows


def _moved(due: Sequence[DueNetRow], begin: Indices) -> tuple[NetState, Floats, Floats]:
    """Give all rows' members (K) at their times, and the F (K, POSED, BLOCK) and Q (K, POSED, POSED) of what a pose is
    made of; the frame has not followed its anchor."""
    state = NetState.behind([of.state for of in due])
    F, Q = np.tile(np.eye(POSED, BLOCK), (len(state), 1, 1)), np.zeros((len(state), POSED, POSED))
    ways = [(of.way, int(first)) for of, first in zip(due, begin, strict=False) if of.way is not None]
    moving = [first + i for way, first in ways for i in way.moving]
    if not moving:
        return state, F, Q
    more = [-1] * (LEAST - len(moving))

    def of_each(values: Iterable[Each]) -> list[Each]:
        every = list(values)
        return every + [every[i] for i in more]

    start = state.chosen(of_each(moving))
    parts = integrated(start, of_each(one for way, _ in ways for one in way.samples))
    noises = of_each(noise for way, _ in ways for noise in way.noises)
    shaking = np.array(of_each(variances for way, _ in ways for variances in way.shaking))
    span_s = np.array(of_each(way.span_s for way, _ in ways for _ in way.moving))
    after, *step, _ = moved_members(start, parts, noises, shaking, span_s)
    count = len(moving)
    F[moving], Q[moving] = step[0][:count, :POSED], step[1][:count, :POSED, :POSED]
    return state.replaced(moving, after.chosen(list(range(count)))), F, Q


def _beside_anchors(
    due: Sequence[DueNetRow], begin: Indices, state: NetState, F: Floats, own: Floats
) -> tuple[NetState, Floats]:
    """Give members and the covariances of their errors in a frame that has followed each row's anchor.

    p' = p - p_ref and v' likewise in errors (Move.onward): x' = J x - G x_ref, J as `plain_of_posed` of the anchor, G
    the same without the rows of phi. So P' = J P J^T - J C G^T - G C^T J^T + G P_ref G^T, C the covariance of x and
    x_ref.
    """
    counts = [len(of.state) for of in due]
    ref = np.repeat([int(first) + (of.anchor or 0) for of, first in zip(due, begin, strict=False)], counts)
    with_ref = np.array([of.covariance[block(i), block(of.anchor or 0)] for of in due for i in range(len(of.state))])
    C = F @ with_ref @ F[ref].swapaxes(1, 2)
    C[np.unique(ref)] = own[np.unique(ref)]
    p, v = state.p_m[ref], state.v_mps[ref]
    J = plain_of_posed(p, v)
    G = J.copy()
    G[:, PHI] = 0.0
    J_back, G_back = J.swapaxes(1, 2), G.swapaxes(1, 2)
    across = J @ C @ G_back
    own = J @ own @ J_back - across - across.swapaxes(1, 2) + G @ own[ref] @ G_back
    return replace(state, p_m=state.p_m - p, v_mps=state.v_mps - v), own


def rows_of(
    stamps_ns: Sequence[int], members: Sequence[Present], state: NetState, own: Floats, north_doubts: Floats
) -> list[NetRow]:
    """Give the confirmed ones of members (K) whose places are known well.

    own (K, POSED, POSED): covariances in the errors of `NetState.plus`. north_doubts (K,): variances of what turns all
    about the vertical besides. Whether a place is known well is asked without it.
    """
    J = plain_of_posed(state.p_m, state.v_mps)
    plain = J @ own @ J.swapaxes(1, 2)
    sigma_m = np.sqrt(np.maximum(np.trace(plain[:, P_, P_], axis1=1, axis2=2), 0.0))
    known = sigma_m < np.maximum(TOLD_M, TOLD_SHARE * np.sqrt(inner(state.p_m, state.p_m)))
    pose = np.r_[P_, PHI]
    covariances = plain[:, pose[:, None], pose]
    doubtful = np.flatnonzero(north_doubts)
    covariances[doubtful] += turned_by_north(state.p_m[doubtful], covariances[doubtful, -1, -1], north_doubts[doubtful])
    return [
        NetRow(
            node=member.node,
            stamp_ns=stamp_ns,
            p_m=state.p_m[k],
            R=state.R[k],
            v_mps=state.v_mps[k],
            covariance=covariances[k],
            age_s=member.age_s,
        )
        for k, (stamp_ns, member, well) in enumerate(zip(stamps_ns, members, known.tolist(), strict=True))
        if member.confirmed and member.asked and well
    ]


def turned_by_north(p_m: Floats, variances: Floats, more: Floats) -> Floats:
    """Give what covariances (K, 6, 6) of places and attitudes gain where north's variance (K,) does.

    Turned far, a place stays on its arc, by E t sin t, E sin^2 t and E (1 - cos t)^2 of a normal turn t. Of a radian or
    more nothing is told of north.
    """

    def of_turn(v: Floats) -> Floats:
        double = 0.5 * np.exp(-2.0 * v)
        return np.array((0.5 - double, 1.5 - 2.0 * np.exp(-0.5 * v) + double, v * np.exp(-0.5 * v), v))

    before = np.minimum(variances, 1.0)
    along, bent, both, turn = of_turn(np.minimum(before + more, 1.0)) - of_turn(before)
    across, level = np.cross(_DOWN, p_m), p_m * (1.0, 1.0, 0.0)
    out = np.zeros((len(p_m), 6, 6))
    out[:, :3, :3] = along[:, None, None] * (across[:, :, None] * across[:, None])
    out[:, :3, :3] += bent[:, None, None] * (level[:, :, None] * level[:, None])
    out[:, :3, 5] = out[:, 5, :3] = both[:, None] * across
    out[:, 5, 5] = turn
    return out


def plain_of_posed(p_m: Floats, v_mps: Floats) -> Floats:
    """Give (..., POSED, POSED): plain errors of place, velocity and attitude by nodes' own."""
    J = np.zeros((*p_m.shape[:-1], POSED, POSED))
    J[...] = np.eye(POSED)
    J[..., P_, PHI], J[..., V_, PHI] = -skew(np.array((p_m, v_mps)))
    return J
