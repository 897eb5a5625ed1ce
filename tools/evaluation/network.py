"""Compare the poses of all nodes in one frame with truth: errors, whether the covariances are true, coverage."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import NodePose
from buddyline.protocol.topics import NET_POSE, NET_TRUTH, POSE, REJECTED
from buddyline.tools.clock_curves import noted_curves
from buddyline.tools.dives import first_with_net, open_each
from buddyline.tools.evaluation.logs import simulated_clocks
from buddyline.tools.evaluation.rotation import conjugate, multiply, normalized, rotation_vector
from buddyline.tools.evaluation.statistics import Stats
from buddyline.tools.evaluation.truth import PoseHistory
from buddyline.tools.measure.tables import number, text_table
from buddyline.tools.progress import counted
from msgspec.structs import replace

# A node's pose is wrong where it is off by more than this, and by more than WRONG_SIGMAS.
WRONG_M: Final = 0.3
WRONG_SIGMAS: Final = 3.0
Ahead: TypeAlias = Callable[[str, int], int]


@dataclass(frozen=True)
class NodeFigures:
    """The figures of one node. samples: number with truth. sigma_m: RMS of the stated sigma of the place, all axes.

    covered: share of the net's samples at which the node has a pose. nees6: mean 6 if the covariance is true. wrong: of
    the samples, see WRONG_M.
    """

    net: str
    node: str
    fixed: bool
    samples: int
    covered: float
    position_m: Stats
    worst_m: float
    sigma_m: float
    rotation_rad: Stats
    nees6: Stats
    wrong: int


def network_figures(
    poses: Sequence[NodePose], truths: Sequence[NodePose], ahead_ns: Ahead = lambda *_: 0
) -> list[NodeFigures]:
    """Return the figures of each net's nodes that have truth, by net and node.

    Where one node is the origin, which moves with it, places count from its true place at the same instant; without its
    truth they do not count. ahead_ns: a node's clock minus the first node's, at a stamp.
    """
    of_truth: dict[tuple[str, str], list[NodePose]] = defaultdict(list)
    for truth in truths:
        of_truth[truth.net, truth.node].append(truth)
    # The truth of a simulated dive has one net; the estimate may have another name.
    by_node = {node: PoseHistory.of_node(found) for (_, node), found in of_truth.items()}
    own: dict[tuple[str, str], list[NodePose]] = defaultdict(list)
    stamps: dict[str, set[int]] = defaultdict(set)
    origins: dict[tuple[str, int], str] = {}
    for pose in poses:
        own[pose.net, pose.node].append(pose)
        stamps[pose.net].add(pose.stamp_ns)
        if not any(pose.covariance[i] for i in (0, 7, 14)) and not pose.fixed:
            origins[pose.net, pose.stamp_ns] = pose.node
    return [
        _figures(net, node, found, by_node, len(stamps[net]), origins, ahead_ns)
        for (net, node), found in sorted(own.items())
        if node in by_node
    ]


def _figures(
    net: str,
    node: str,
    poses: Sequence[NodePose],
    truth: dict[str, PoseHistory],
    count: int,
    origins: dict[tuple[str, int], str],
    ahead_ns: Ahead,
) -> NodeFigures:
    rows = []
    for pose in counted(poses, f"evaluate {node}"):
        true = truth[node].at(pose.stamp_ns)
        zero_m = np.zeros(3)
        if (origin := origins.get((net, pose.stamp_ns))) is not None:
            by_origin_ns = pose.stamp_ns + ahead_ns(origin, pose.stamp_ns) - ahead_ns(node, pose.stamp_ns)
            true_origin = truth[origin].at(by_origin_ns) if origin in truth else None
            if true_origin is None:
                continue
            zero_m = true_origin[0]
        if true is None:
            continue
        off_m = true[0] - zero_m - pose.p_m
        q = multiply(true[1], conjugate(normalized(np.array(pose.q_xyzw))))
        off = np.concatenate((off_m, rotation_vector(q)))
        P = np.array(pose.covariance).reshape(6, 6)
        # For the rounding of the truth; and the origin's own covariance is zero.
        nees = off @ np.linalg.solve(P + 1e-10 * np.eye(6), off)
        rows.append((np.linalg.norm(off[:3]), np.linalg.norm(off[3:]), nees, np.sqrt(max(np.trace(P[:3, :3]), 0.0))))
    e = np.array(rows).reshape(-1, 4)
    wrong = (e[:, 0] > WRONG_M) & (e[:, 0] > WRONG_SIGMAS * e[:, 3])
    return NodeFigures(
        net=net,
        node=node,
        fixed=poses[0].fixed,
        samples=len(e),
        covered=len(poses) / count,
        position_m=Stats.of(e[:, 0]),
        worst_m=float(e[:, 0].max(initial=0.0)),
        sigma_m=float(np.sqrt(np.mean(e[:, 3] ** 2))) if len(e) else 0.0,
        rotation_rad=Stats.of(e[:, 1]),
        nees6=Stats.of(e[:, 2]),
        wrong=int(wrong.sum()),
    )


def load_network(paths: Sequence[str], truth_paths: Sequence[str]) -> tuple[list[NodePose], list[NodePose], Ahead]:
    """Read the poses of all nodes, of the first log that has any, and their truth; raise BuddylineError for none.

    Each node's poses and truth are by its own clock; the truth is moved by the curves that the dive was solved with.
    The last is how far a simulated dive's clocks are still apart then.
    """
    with ExitStack() as stack:
        logs, truth_logs = open_each(paths, stack), open_each(truth_paths, stack)
        solved = first_with_net(logs)
        poses = list(solved.all_of(NET_POSE, NodePose, doing=f"read {solved.name}"))
        curves = noted_curves(solved.metadata(), solved.name)
        clocks = simulated_clocks([*logs, *truth_logs])
        truths: list[NodePose] = []
        for log in [*truth_logs, *logs]:
            truths += log.all_of(NET_TRUTH, NodePose, doing=f"read {log.name}")
    if not truths:
        named = ", ".join([*paths, *truth_paths])
        raise BuddylineError(f"{named}: no truth of the net's nodes; name its log with --truth T.mcap")

    def known_ns(node: str, stamp_ns: int) -> int:
        return curves[node].offset_ns(stamp_ns) if node in curves else 0

    moved = [replace(one, stamp_ns=max(one.stamp_ns - known_ns(one.node, one.stamp_ns), 0)) for one in truths]
    return poses, moved, lambda node, stamp_ns: clocks.ahead_ns(node, stamp_ns) - known_ns(node, stamp_ns)


def shows_network(paths: Sequence[str]) -> bool:
    """Return whether logs have poses of a net, and results of more than one pair."""
    with ExitStack() as stack:
        logs = open_each(paths, stack)
        pairs = {ids for log in logs for ids in log.ids(POSE.name, REJECTED.name)}
        return len(pairs) > 1 and any(log.ids(NET_POSE.name) for log in logs)


def network_text(figures: Sequence[NodeFigures]) -> str:
    """Return a table of all nodes."""
    head = ("node", "rows", "told", "place, mm: median", "RMS", "worst", "stated", "turn, mrad", "NEES / 6", "wrong")
    body = [
        (
            f"{one.node} (fixed)" if one.fixed else one.node,
            str(one.samples),
            f"{one.covered:.0%}",
            _scaled(one.position_m.median, 1e3),
            _scaled(one.position_m.rmse, 1e3),
            _scaled(one.worst_m, 1e3),
            _scaled(one.sigma_m, 1e3),
            _scaled(one.rotation_rad.median, 1e3),
            "-" if one.fixed or one.nees6.mean is None else number(one.nees6.mean / 6.0, 2),
            str(one.wrong),
        )
        for one in figures
    ]
    nets = ", ".join(dict.fromkeys(one.net for one in figures))
    return f"all nodes in the frame of the net {nets}; --pair A/B evaluates a pair's poses\n" + text_table(
        [head, *body]
    )


def _scaled(value: float | None, factor: float) -> str:
    return "-" if value is None else number(value * factor, 1)
