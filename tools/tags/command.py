"""`buddyline artag`: poses from AR tags in a dive's pictures, to compare the lights with."""

from __future__ import annotations

import argparse
import json
import logging
import math
from dataclasses import dataclass, field

import cv2
import numpy as np
from buddyline.node.drivers.stored import PictureError, decode_picture
from buddyline.protocol.clock import trigger_index
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Attitude, CompressedImage, NodeInfo, RelativePose
from buddyline.protocol.topics import ARTAG
from buddyline.tools import losses
from buddyline.tools.dives import Dive
from buddyline.tools.evaluation.rotation import Floats, multiply, normalized, rotate
from buddyline.tools.evaluation.truth import PoseHistory
from buddyline.tools.newfile import new_dive_log
from buddyline.tools.option_values import node_files
from buddyline.tools.solve import COPIED, pair_of
from buddyline.tools.tags.detection import TagFinder
from buddyline.tools.tags.layout import Layout, layout_of, load_layout
from buddyline.tools.tags.pose import TagPose, readings_of, tag_pose
from msgspec import UNSET

log = logging.getLogger(__name__)


@dataclass
class TagSolver:
    """Finds tags picture by picture; `poses` then gives the poses of all triggers."""

    node_a: str
    node_b: str
    infos: dict[str, NodeInfo]
    layouts: dict[str, Layout]
    pictures: int = 0
    with_tags: int = 0
    left_out: int = 0
    _seen: dict[int, dict[str, tuple[int, dict[int, list[Floats]]]]] = field(default_factory=dict)
    _finders: dict[str, TagFinder] = field(default_factory=dict)

    def take(self, node: str, image: CompressedImage) -> None:
        """Take one picture; raise PictureError if it cannot be used."""
        info = self.infos[node]
        picture = decode_picture(image.data, f"picture of node {node} at {image.stamp_ns}")
        if picture.shape[:2] != (info.height_px, info.width_px):
            raise PictureError(
                f"picture of node {node} at {image.stamp_ns}: {picture.shape[1]}x{picture.shape[0]} px, its NodeInfo "
                f"says {info.width_px}x{info.height_px}"
            )
        other = self.node_b if node == self.node_a else self.node_a
        if node not in self._finders:
            self._finders[node] = TagFinder(self.layouts[other])
        found = self._finders[node].find(picture)
        self.pictures += 1
        self.with_tags += bool(found)
        trigger = trigger_index(image.stamp_ns, info.trigger_period_ns)
        self._seen.setdefault(trigger, {})[node] = (image.stamp_ns, found)

    def poses(self, attitudes_a: PoseHistory) -> list[RelativePose]:
        """Return the poses of all triggers whose tags determine one, in order of time."""
        poses = []
        for trigger, views in sorted(self._seen.items()):
            readings = [
                reading
                for node, (_, found) in views.items()
                for reading in readings_of(
                    found,
                    self.layouts[self.node_b if node == self.node_a else self.node_a],
                    self.infos[node].camera,
                    by_a=node == self.node_a,
                )
            ]
            solved = tag_pose(readings)
            if solved is not None:
                self.left_out += solved.left_out
                poses.append(
                    self._message(trigger, {node: view[0] for node, view in views.items()}, solved, attitudes_a)
                )
        return poses

    def _message(
        self, trigger: int, stamps_ns: dict[str, int], solved: TagPose, attitudes_a: PoseHistory
    ) -> RelativePose:
        # If one node's picture is missing, the other's stamp is used for both.
        stamp_a_ns = stamps_ns.get(self.node_a, stamps_ns.get(self.node_b, 0))
        stamp_b_ns = stamps_ns.get(self.node_b, stamp_a_ns)
        t_ned_m = None
        attitude = attitudes_a.at(stamp_a_ns)
        if attitude is not None:
            q_body_camera = normalized(np.array(self.infos[self.node_a].q_body_camera_xyzw))
            t_ned_m = rotate(multiply(attitude[1], q_body_camera), solved.t_a_b_m).tolist()
        return RelativePose(
            node_a=self.node_a,
            node_b=self.node_b,
            stamp_ns=(stamp_a_ns + stamp_b_ns) // 2,
            trigger=trigger,
            t_a_b_m=tuple(solved.t_a_b_m.tolist()),
            q_a_b_xyzw=tuple(solved.q_a_b_xyzw.tolist()),
            covariance=solved.covariance.ravel().tolist(),
            range_m=float(np.linalg.norm(solved.t_a_b_m)),
            range_a_m=solved.range_a_m,
            range_b_m=solved.range_b_m,
            range_gap_m=solved.range_a_m - solved.range_b_m,
            twist_gap_rad=solved.twist_gap_rad,
            chi2=solved.chi2,
            hypotheses=solved.readings + solved.left_out,
            blobs_a=(-1, -1),
            blobs_b=(-1, -1),
            method="artag",
            checks=[],
            skew_ns=stamp_a_ns - stamp_b_ns,
            t_ned_m=UNSET if t_ned_m is None else tuple(t_ned_m),
            azimuth_rad=UNSET if t_ned_m is None else math.atan2(t_ned_m[1], t_ned_m[0]) % (2 * math.pi),
            inclination_rad=UNSET if t_ned_m is None else -math.atan2(t_ned_m[2], math.hypot(t_ned_m[0], t_ned_m[1])),
        )


def run(args: argparse.Namespace) -> int:
    """Find the tags of a dive's pictures; return 0, or 1 if no picture shows one."""
    cv2.setNumThreads(1)
    with Dive(args.dives) as dive:
        nodes = pair_of(dive, args.nodes)
        infos = dive.infos()
        solver = TagSolver(*nodes, infos, layouts(dive.name, infos, nodes, args.tags))
        attitudes: list[Attitude] = []
        skipped = 0
        topics = [topic for topic in COPIED if topic != "candidates"]
        with new_dive_log(args.output, dive.metadata() | {"command": "artag", "method": "artag"}) as writer:
            for envelope in dive.messages(*topics, "image", doing="artag"):
                message = envelope.message
                if not set(envelope.ids) <= set(nodes):
                    continue
                if isinstance(message, CompressedImage):
                    try:
                        solver.take(envelope.node, message)
                    except PictureError as error:
                        skipped += 1
                        losses.report([str(error)])
                else:
                    writer.write(envelope.key, envelope.payload, envelope.time_ns)
                if isinstance(message, Attitude) and message.node == nodes[0]:
                    attitudes.append(message)
            poses = solver.poses(PoseHistory.of_attitudes(attitudes))
            for pose in poses:
                writer.write_message(pose, key=ARTAG.key(*nodes))
    summary = {
        "output": args.output,
        "poses": len(poses),
        "pictures": solver.pictures,
        "with_tags": solver.with_tags,
        "left_out": solver.left_out,
        "skipped": skipped,
    }
    if args.json:
        print(json.dumps(summary))
    else:
        print(
            f"{args.output}: {len(poses)} poses from tags; {solver.with_tags} of {solver.pictures} pictures show any, "
            f"{solver.left_out} readings did not fit the layout"
        )
    return 0 if poses else 1


def layouts(name: str, infos: dict[str, NodeInfo], nodes: tuple[str, str], given: list[str]) -> dict[str, Layout]:
    """Return the tags of both nodes: of `--tags NODE=FILE`, else of NodeInfo; raise if there are none."""
    chosen: dict[str, Layout] = {}
    for node, path in node_files("--tags", given):
        if node not in nodes:
            raise BuddylineError(f"--tags {node}={path}: is of neither {' nor '.join(nodes)}")
        chosen[node] = load_layout(path)
    for node in nodes:
        info = infos.get(node)
        if info is None:
            raise BuddylineError(f"{name}: no NodeInfo of node {node}")
        if node not in chosen:
            if info.tags is UNSET:
                raise BuddylineError(f"{name}: NodeInfo of node {node} names no tags; give them: --tags {node}=FILE")
            chosen[node] = layout_of(info.tags, f"{name}: tags of node {node}")
    families = {layout.family for layout in chosen.values()}
    if len(families) > 1:
        raise BuddylineError(f"tags of nodes {' and '.join(nodes)}: families {', '.join(sorted(families))}; use one")
    return chosen
