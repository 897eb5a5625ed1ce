"""All nodes in one frame, in a dive's report: how well each is known, where all were, and what each pair gave."""

from __future__ import annotations

from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import NodePose, RelativePose
from buddyline.protocol.topics import NET_POSE, NET_TRUTH, POSE, REJECTED
from buddyline.tools.dives import Dive
from buddyline.tools.draw.figures import inline_svg
from buddyline.tools.draw.net import NodePath, draw_net
from buddyline.tools.draw.page import section, table
from buddyline.tools.evaluation.network import network_figures
from buddyline.tools.health.words import duration_words
from buddyline.tools.monitor.panel import length_words


@dataclass(frozen=True)
class DiveNet:
    """The net of a dive: poses by node, in order of time; truth; outcomes and poses of each pair."""

    poses: dict[str, list[NodePose]]
    truths: list[NodePose]
    outcomes: Counter[str]
    solved: Counter[str]

    @property
    def origin(self) -> str | None:
        """The node that is the frame's zero and moves with it, the last where it was not always the same."""
        if any(one.fixed for found in self.poses.values() for one in found):
            return None
        zero = [one for found in self.poses.values() for one in found if not any(one.covariance[i] for i in (0, 7, 14))]
        return max(zero, key=lambda one: one.stamp_ns).node if zero else None


def net_of(dive: Dive) -> DiveNet | None:
    """Read the net of a dive; None where it has none. Smoothed poses are preferred to live ones."""
    every = list(dive.all_of(NET_POSE, NodePose, doing="read the net"))
    if not every:
        return None
    poses: dict[str, list[NodePose]] = defaultdict(list)
    smooth = any(one.mode == "smooth" for one in every)
    for one in sorted(every, key=lambda one: one.stamp_ns):
        if not smooth or one.mode == "smooth":
            poses[one.node].append(one)
    outcomes, solved = Counter[str](), Counter[str]()
    for envelope in dive.messages(POSE.name, REJECTED.name, doing="read outcomes"):
        outcomes["/".join(envelope.ids)] += 1
        solved["/".join(envelope.ids)] += isinstance(envelope.message, RelativePose)
    return DiveNet(dict(poses), list(dive.all_of(NET_TRUTH, NodePose, doing="read the truth")), outcomes, solved)


def net_numbers(net: DiveNet | None) -> dict[str, Any] | None:
    """Return the numbers of each node and pair."""
    if net is None:
        return None
    stamps = np.unique([one.stamp_ns for found in net.poses.values() for one in found])
    figures = {one.node: one for one in network_figures([p for of in net.poses.values() for p in of], net.truths)}
    nodes = {}
    for node, found in sorted(net.poses.items()):
        variances_m2 = [one.covariance[0] + one.covariance[7] + one.covariance[14] for one in found]
        own = np.array([stamps[0], *(one.stamp_ns for one in found), stamps[-1]])
        true = figures.get(node)
        nodes[node] = {
            "fixed": found[0].fixed,
            "rows": len(found),
            "covered": len(found) / len(stamps),
            "sigma_median_m": float(np.median(np.sqrt(np.maximum(variances_m2, 0.0)))),
            "longest_without_row_s": float(np.diff(own).max()) / S_NS,
            "longest_without_light_s": max(one.age_s for one in found),
            "against_truth": None if true is None or not true.samples else {
                "median_m": true.position_m.median,
                "worst_m": true.worst_m,
                "wrong": true.wrong,
                "samples": true.samples,
            },
        }  # fmt: skip
    pairs = {pair: {"total": count, "with_pose": net.solved[pair]} for pair, count in sorted(net.outcomes.items())}
    return {"origin": net.origin, "nodes": nodes, "pairs": pairs}


def net_sections(dive: Dive, net: DiveNet | None, numbers: dict[str, Any] | None) -> list[str]:
    """Return the section of the net, none where the dive has no net."""
    if net is None or numbers is None:
        return []
    truth = any(one["against_truth"] for one in numbers["nodes"].values())
    head = ["node", "told", "longest gap", "1 sd of its place, median"]
    head += ["off the truth, median", "worst", "wrong"] if truth else []
    rows = []
    for node, one in numbers["nodes"].items():
        row = [
            f"{node} (fixed)" if one["fixed"] else f"{node} (the origin)" if node == net.origin else node,
            f"{one['covered']:.0%}",
            duration_words(one["longest_without_row_s"]),
            length_words(one["sigma_median_m"]),
        ]
        true = one["against_truth"]
        if true:
            wrong = f"{true['wrong']} of {true['samples']}"
            row += [length_words(true["median_m"]), length_words(true["worst_m"]), wrong]
        rows.append(row)
    pairs = [
        (pair, f"{one['with_pose']} of {one['total']}", f"{one['with_pose'] / one['total']:.0%}")
        for pair, one in numbers["pairs"].items()
    ]
    paths = {
        node: NodePath(
            np.array([(one.stamp_ns - dive.start_ns) / S_NS for one in found]),
            np.array([one.p_m for one in found]),
            found[0].fixed,
        )
        for node, found in net.poses.items()
    }
    frame = "Places are in the frame of the fixed nodes." if net.origin is None else (
        f"Places count from {net.origin}, which moves; north is by the compasses."
    )  # fmt: skip
    return [
        section(
            "All nodes in one frame",
            table(rows, head),
            inline_svg(draw_net(paths, net.origin), "all nodes from above, and their depths"),
            f'<p class="dim">{frame}</p>',
            table(pairs, ("pair", "triggers with a pose", "")),
        )
    ]
