"""`buddyline net init`: find where nodes on tripods stand, from a short dive; lines for their configurations."""

from __future__ import annotations

import argparse
import json
import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError

if TYPE_CHECKING:
    import numpy as np
    from buddyline.protocol.messages import FixedPlace, NodePose
    from numpy.typing import NDArray

log = logging.getLogger(__name__)

# A node whose place scatters by more than this, RMS, does not stand still.
STILL_M: Final = 0.05
STILL_RAD: Final = 0.03
# The same of the origin's tilt, of which its own attitudes alone tell: they err by a degree and a half.
STILL_TILT_RAD: Final = 0.06
# Whether a node stands still is not to be seen in less; half a minute is advised.
LEAST_S: Final = 1.0
# Errors of the network's poses are correlated over about a second.
INDEPENDENT_S: Final = 1.0
RATE_HZ: Final = 10.0
# No place is stated better than this, 1 sd.
LEAST_M: Final = 0.002
LEAST_RAD: Final = 0.001


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("action", choices=("init",), help="init: find where fixed nodes stand")
    parser.add_argument("dives", nargs="+", metavar="DIVE.mcap", help="a dive, or each node's log")
    parser.add_argument(
        "--still",
        action="append",
        required=True,
        metavar="NODE",
        help="a node that stood still, repeatable; the first is the origin, and its compass says where north is",
    )
    parser.add_argument("--net", default="main", help="the frame's name; default: main")
    parser.add_argument("-o", "--output", type=Path, metavar="DIR", help="write NODE.toml files there; must be empty")
    parser.add_argument("--json", action="store_true", help="print the places as JSON")


@dataclass(frozen=True, eq=False)
class Stand:
    """Where a node stood. rows: how many poses the place is the mean of."""

    place: FixedPlace
    rows: int


def run(args: argparse.Namespace) -> int:
    """Find the places and print them; return 0."""
    from buddyline.tools.newfile import new_folder, write_new
    from msgspec import to_builtins

    if args.output is not None:
        new_folder(args.output)
    stands = find(args.dives, args.still, args.net)
    texts = {node: _toml(node, stand) for node, stand in stands.items()}
    if args.output is not None:
        for node, text in texts.items():
            write_new(args.output / f"{node}.toml", text)
            log.info("%s: append it to the configuration of node %s", args.output / f"{node}.toml", node)
    if args.json:
        print(json.dumps({node: to_builtins(one.place) for node, one in stands.items()}))
    elif args.output is None:
        print("\n".join(texts.values()), end="")
    return 0


def find(paths: Sequence[str], still: Sequence[str], net: str) -> dict[str, Stand]:
    """Return where nodes stood; the first of `still` is at zero, at its own depth. Raise BuddylineError."""
    import numpy as np
    from buddyline.protocol.messages import Attitude, Depth, FixedPlace, NodeInfo, NodePose
    from buddyline.solver_service.config import SolveConfig, track_settings
    from buddyline.solver_service.core import SolverCore
    from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix
    from buddyline.tools.dives import Dive
    from buddyline.tools.solve import solved
    from msgspec import UNSET
    from msgspec.structs import replace

    origin = still[0]
    if len(set(still)) < len(still):
        raise BuddylineError(f"--still: a node is named twice: {', '.join(still)}")
    with Dive(paths) as dive:
        infos = dive.infos()
        for node in still:
            if node not in infos:
                raise BuddylineError(f"{dive.name}: no NodeInfo of node {node}; nodes: {', '.join(sorted(infos))}")
        attitudes, headings_rad, depths, stamps_ns = [], [], [], []
        for envelope in dive.messages("attitude", "depth"):
            if isinstance(envelope.message, Attitude) and envelope.message.node == origin:
                attitudes.append(quat_to_matrix(np.array(envelope.message.q_ned_body_xyzw)))
                headings_rad.append(envelope.message.sigma_rad[2])
                stamps_ns.append(envelope.message.stamp_ns)
            elif isinstance(envelope.message, Depth) and envelope.message.node == origin:
                depths.append(envelope.message.depth_m)
        if not attitudes:
            raise BuddylineError(f"{dive.name}: no attitude of node {origin}: its compass must say where north is")
        if (told_s := (max(stamps_ns) - min(stamps_ns)) / S_NS) < LEAST_S:
            raise BuddylineError(
                f"{dive.name}: attitudes of node {origin} over {told_s:.1f} s only; record half a minute"
            )
        _check_still(origin, np.array(attitudes), float(np.median(headings_rad)))
        R_body_camera = quat_to_matrix(np.array(infos[origin].q_body_camera_xyzw))
        R = _mean_rotation(np.array(attitudes)) @ R_body_camera
        port_m = float((R @ np.array(infos[origin].depth_port_m))[2])
        down_m = float(np.median(depths)) - port_m if depths else 0.0
        at_origin = FixedPlace(
            net=net, p_m=(0.0, 0.0, down_m), q_xyzw=_quaternion(matrix_to_quat(R)), sigma_m=LEAST_M, sigma_rad=LEAST_RAD
        )
        exact = replace(at_origin, sigma_m=1e-4, sigma_rad=1e-4)
        full = sorted(node for node, info in infos.items() if info.has_camera and info.has_lights)
        core = SolverCore(
            SolveConfig().settings("net init"),
            list(combinations(full, 2)),
            track=track_settings("filter", RATE_HZ),
            lone=sorted(infos.keys() - set(full)),
        )
        found: dict[str, list[NodePose]] = {node: [] for node in still}
        messages = (envelope.message for envelope in dive.messages("info", "candidates", "imu", "attitude", "depth"))
        placed = (
            replace(one, fixed=exact if one.node == origin else UNSET) if isinstance(one, NodeInfo) else one
            for one in messages
        )
        for one in solved(core, placed):
            if isinstance(one, NodePose) and one.node in found:
                found[one.node].append(one)
    stands = {origin: Stand(at_origin, len(found[origin]))}
    for node in still[1:]:
        stands[node] = _stand(node, found[node], net)
    return stands


def _check_still(node: str, R_ned_body: NDArray[np.float64], heading_sigma_rad: float) -> None:
    """Raise BuddylineError where a node's own attitudes (N, 3, 3) say that it did not stand still.

    heading_sigma_rad: as they state it. A compass's own errors are that large over many dives, and vary less in one.
    """
    from buddyline.solver_service.geometry.rotation import rotation_log

    off_rad = rotation_log(R_ned_body @ _mean_rotation(R_ned_body).T)
    for what, turned_rad, most_rad in (
        ("tilt", off_rad[:, :2], STILL_TILT_RAD),
        ("heading", off_rad[:, 2:], heading_sigma_rad),
    ):
        scatter_rad = math.sqrt(float((turned_rad**2).sum(axis=1).mean()))
        if scatter_rad > most_rad:
            raise BuddylineError(
                f"node {node}: does not stand still: its {what} scatters by {math.degrees(scatter_rad):.1f} deg"
            )


def _stand(node: str, poses: Sequence[NodePose], net: str) -> Stand:
    """Return a node's mean place; raise BuddylineError where it is not known, or did not stand still."""
    import numpy as np
    from buddyline.protocol.messages import FixedPlace
    from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix, rotation_log

    if len(poses) < RATE_HZ * LEAST_S:
        raise BuddylineError(f"node {node}: the dive places it for {len(poses) / RATE_HZ:.1f} s only; is it seen?")
    p_m = np.array([pose.p_m for pose in poses])
    turns = quat_to_matrix(np.array([pose.q_xyzw for pose in poses]))
    weights = 1.0 / np.array([sum(pose.covariance[i] for i in (0, 7, 14)) + LEAST_M**2 for pose in poses])
    weights /= weights.sum()
    mean_m, R = weights @ p_m, _mean_rotation(turns, weights)
    off_m = math.sqrt(float(weights @ ((p_m - mean_m) ** 2).sum(1)))
    off_rad = math.sqrt(float(weights @ (rotation_log(turns @ R.T) ** 2).sum(1)))
    if off_m > STILL_M or off_rad > STILL_RAD:
        scatter = f"{off_m:.3f} m and {math.degrees(off_rad):.1f} deg"
        raise BuddylineError(f"node {node}: does not stand still: its place scatters by {scatter}")
    root = math.sqrt(max(len(poses) / RATE_HZ / INDEPENDENT_S, 1.0))
    x, y, z = mean_m.tolist()
    place = FixedPlace(
        net=net,
        p_m=(x, y, z),
        q_xyzw=_quaternion(matrix_to_quat(R)),
        sigma_m=max(off_m / root, LEAST_M),
        sigma_rad=max(off_rad / root, LEAST_RAD),
    )
    return Stand(place, len(poses))


def _mean_rotation(R: NDArray[np.float64], weights: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Return the rotation nearest to the mean of rotations (N, 3, 3)."""
    import numpy as np

    u, _, vt = np.linalg.svd(np.average(R, axis=0, weights=weights))
    nearest: NDArray[np.float64] = u @ np.diag((1.0, 1.0, float(np.linalg.det(u @ vt)))) @ vt
    return nearest


def _quaternion(q: NDArray[np.float64]) -> tuple[float, float, float, float]:
    x, y, z, w = q.tolist()
    return x, y, z, w


def _toml(node: str, stand: Stand) -> str:
    place = stand.place
    p = ", ".join(f"{value:.4f}" for value in place.p_m)
    q = ", ".join(f"{value:.6f}" for value in place.q_xyzw)
    return (
        f"# node {node}, from {stand.rows} poses\n[fixed]\nnet = {json.dumps(place.net)}\n"
        f"p_m = [{p}]\nq_xyzw = [{q}]\nsigma_m = {place.sigma_m:.4f}\nsigma_rad = {place.sigma_rad:.5f}\n"
    )
