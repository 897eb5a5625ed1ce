"""Read the measurements of a calibration from dive logs and pictures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np
from buddyline.node.drivers.stored import decode_picture, picture_files, read_picture
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Candidates, CompressedImage, Imu, NodeInfo, RelativePose
from buddyline.protocol.topics import IMU
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.calibration.leastsquares import Floats
from buddyline.tools.calibration.lights import TapedPlace
from buddyline.tools.dives import Dive
from msgspec import UNSET
from numpy.typing import NDArray

REST_PX: Final = 2.0
LEAST_FIXES: Final = 5


def pictures(paths: list[str], node: str | None) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    """Yield (name, picture) from pictures, folders and dive logs; raise BuddylineError for anything else."""
    for text in paths:
        path = Path(text)
        if path.suffix == ".mcap":
            yield from _dive_pictures(path, node)
            continue
        for file in picture_files(path):
            yield str(file), read_picture(file)


def _dive_pictures(path: Path, node: str | None) -> Iterator[tuple[str, NDArray[np.uint8]]]:
    with Dive([path]) as dive:
        wanted = _one_node(dive, node, "image")
        for envelope in dive.messages("image"):
            if isinstance(envelope.message, CompressedImage) and envelope.node == wanted:
                name = f"{path} at {(envelope.time_ns - dive.start_ns) / S_NS:.1f} s"
                yield name, decode_picture(envelope.message.data, name)


def inertial(paths: list[str], node: str | None) -> tuple[str, Floats, Floats]:
    """Return the node's id, its magnetometer's readings (n, 3), T, and its accelerometer's (n, 3), m/s^2."""
    wanted, samples = inertial_samples(paths, node)
    readings = [(one.mag_t, one.accel_mps2) for one in samples if one.mag_t is not UNSET]
    if not readings:
        raise BuddylineError(f"{', '.join(paths)}: no magnetometer readings of node {wanted}")
    mags, accels = zip(*readings, strict=True)
    return wanted, np.array(mags), np.array(accels)


def inertial_samples(paths: list[str], node: str | None) -> tuple[str, list[Imu]]:
    """Return the node's id, and its inertial samples in order of time."""
    with Dive(paths) as dive:
        wanted = _one_node(dive, node, "imu")
        found = [one for one in dive.all_of(IMU, Imu, doing="calibrate") if one.node == wanted]
    return wanted, sorted(found, key=lambda one: one.stamp_ns)


def _one_node(dive: Dive, node: str | None, topic: str) -> str:
    present = dive.nodes(topic)
    if node is None and len(present) == 1:
        return present[0]
    if node in present:
        return str(node)
    if not present:
        what = {"image": "pictures", "imu": "inertial samples"}[topic]
        raise BuddylineError(f"{dive.name}: no {what} of any node; name a node's own log, which has them")
    raise BuddylineError(f"{dive.name}: {topic} of nodes {', '.join(present)}; choose one with --node")


def places(
    paths: list[str], tapes: list[tuple[float, float, float]], nodes: list[str] | None
) -> tuple[list[TapedPlace], tuple[NodeInfo, NodeInfo]]:
    """Return a place for each tape (begin s, end s, distance m) of a solved dive, and both nodes' calibrations.

    nodes: the pair; None if the dive has only one.
    """
    for begin_s, end_s, distance_m in tapes:
        if begin_s >= end_s or distance_m <= 0.0:
            raise BuddylineError(
                f"--tape {begin_s:g} {end_s:g} {distance_m:g}: give BEGIN_S END_S METRES: the begin before the end, in "
                "seconds of the dive, and a distance above 0"
            )
    with Dive(paths) as dive:
        infos = dive.infos()
        pairs = [ids for ids in dive.ids("pose") if nodes is None or set(ids) == set(nodes)]
        if len(pairs) != 1:
            known = ", ".join(" ".join(ids) for ids in dive.ids("pose"))
            if not known:
                raise BuddylineError(f"{dive.name}: holds no poses; solve it first: buddyline solve ... -o solved.mcap")
            raise BuddylineError(f"{dive.name}: poses of the pairs {known}; choose one with --nodes A B")
        pair = pairs[0]
        frames: dict[tuple[str, int], Candidates] = {}
        poses: list[tuple[float, RelativePose]] = []
        for envelope in dive.messages("candidates", "pose"):
            message = envelope.message
            if isinstance(message, Candidates):
                frames[message.node, message.trigger] = message
            elif isinstance(message, RelativePose) and envelope.ids == pair:
                poses.append(((message.stamp_ns - dive.start_ns) / S_NS, message))
    missing = [node for node in pair if node not in infos]
    if missing:
        raise BuddylineError(f"no calibration of node {missing[0]} in the log")
    found = []
    for begin, end, distance_m in tapes:
        name, resting = f"{begin:g}-{end:g} s", [pose for t, pose in poses if begin <= t <= end]
        if not resting:
            times_s = [t for t, _ in poses] or [0.0]
            raise BuddylineError(
                f"--tape {name}: no fix; those of {'/'.join(pair)} are from {min(times_s):.1f} to {max(times_s):.1f} s "
                "of the dive (`buddyline view` shows when): choose seconds in which both rested and saw each other"
            )
        found.append(_place(name, resting, frames, distance_m))
    return found, (infos[pair[0]], infos[pair[1]])


def _place(
    name: str, poses: list[RelativePose], frames: dict[tuple[str, int], Candidates], distance_m: float
) -> TapedPlace:
    seen = []
    for pose in poses:
        a, b = frames.get((pose.node_a, pose.trigger)), frames.get((pose.node_b, pose.trigger))
        if a is None or b is None or min(*pose.blobs_a, *pose.blobs_b) < 0:
            continue
        seen.append([[a.blobs[i].u_px, a.blobs[i].v_px] for i in pose.blobs_a])
        seen[-1] += [[b.blobs[i].u_px, b.blobs[i].v_px] for i in pose.blobs_b]
    if len(seen) < LEAST_FIXES:
        why = "longer, or other seconds, in which each saw both lights of the other"
        if not frames:
            why = "the logs have no candidates, so name the dive's own logs, too"
        raise BuddylineError(
            f"--tape {name}: {len(seen)} fixes with all four lights, of {len(poses)} fixes; {LEAST_FIXES} are needed: "
            f"{why}"
        )
    pixels = np.array(seen)
    moved_px = float(np.abs(pixels - np.median(pixels, axis=0)).mean())
    if moved_px > REST_PX:
        raise BuddylineError(
            f"--tape {name}: the lights moved by {moved_px:.1f} px; both nodes must be at rest: choose other seconds"
        )
    middle = np.median(pixels, axis=0)
    pose = poses[len(poses) // 2]
    return TapedPlace(
        name, middle[:2], middle[2:], np.array(pose.t_a_b_m), quat_to_matrix(np.array(pose.q_a_b_xyzw)), distance_m
    )
