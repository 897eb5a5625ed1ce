"""A simulated dive as messages in time order: what the nodes would log, and the truth."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable, Iterator
from itertools import combinations
from typing import Final, TypeAlias

import cv2
import numpy as np
from buddyline.node.capture.loop import ExposureLoop
from buddyline.node.config import ExposureConfig
from buddyline.node.detect import make_detector
from buddyline.node.devices import Frame
from buddyline.node.pipeline import Pipeline
from buddyline.node.sim.randomness import generator
from buddyline.node.sim.scenario import DivePlan
from buddyline.node.sim.sensor import DelayedControls
from buddyline.node.sim.world import World
from buddyline.protocol import topics
from buddyline.protocol.clock import MS_NS, S_NS, trigger_index
from buddyline.protocol.messages import CompressedImage, FoxgloveTime, Message
from msgspec.structs import replace
from numpy.typing import NDArray

BOOT: Final = "simulated"
NET: Final = "main"
ATTITUDE_NS: Final = S_NS // 50
DEPTH_NS: Final = S_NS // 10
IMU_NS: Final = S_NS // 100
JPEG_QUALITY: Final = 92

Entry: TypeAlias = tuple[int, str, Message]
"""Stamp, key, message."""


def messages(world: World, plan: DivePlan) -> Iterator[Entry]:
    """Yield all messages of a dive in order of time; the same world and plan give the same dive."""
    start_ns = world.scenario.start_ns
    end_ns = start_ns + math.ceil(plan.seconds * S_NS)
    nodes = world.scenario.nodes
    for node in nodes:
        yield start_ns, topics.INFO.key(node), world.info(node, start_ns, plan.period_ns)
    streams: list[Iterator[Entry]] = [_truth(world, plan, end_ns)]
    for node in nodes:
        attitude, depth, imu = (topic.key(node) for topic in (topics.ATTITUDE, topics.DEPTH, topics.IMU))
        streams.append(_samples(world.attitude, node, attitude, range(start_ns, end_ns, ATTITUDE_NS)))
        streams.append(_samples(world.depth, node, depth, range(start_ns + 7 * MS_NS, end_ns, DEPTH_NS)))
        if plan.imu:
            streams.append(_samples(world.imu, node, imu, range(start_ns + 3 * MS_NS, end_ns, IMU_NS)))
        streams.append(_frames(world, plan, node, end_ns))
    yield from heapq.merge(*streams, key=lambda entry: entry[0])


def _samples(sample: Callable[[str, int], Message], node: str, key: str, stamps_ns: range) -> Iterator[Entry]:
    for stamp_ns in stamps_ns:
        yield stamp_ns, key, sample(node, stamp_ns)


def _triggers(world: World, plan: DivePlan, end_ns: int) -> Iterator[int]:
    """Yield the trigger numbers of a dive, from the first whose exposure cannot be before the dive's start."""
    lead_ns = 5 * (plan.exposure_sigma_ns + world.scenario.stamp_sigma_ns) + MS_NS
    yield from range(-(-(world.scenario.start_ns + lead_ns) // plan.period_ns), -(-end_ns // plan.period_ns))


def _truth(world: World, plan: DivePlan, end_ns: int) -> Iterator[Entry]:
    """Yield the truth at the stamp of every trigger's nominal instant, also where its frames are lost."""
    nodes = world.scenario.nodes
    pairs = list(combinations(nodes, 2))
    for trigger in _triggers(world, plan, end_ns):
        stamp_ns = trigger * plan.period_ns
        for pair in pairs:
            yield stamp_ns, topics.TRUTH.key(*pair), world.truth(stamp_ns, trigger, pair)
        for node in nodes:
            yield stamp_ns, topics.NET_TRUTH.key(NET, node), world.node_truth(node, stamp_ns, NET)


def _frames(world: World, plan: DivePlan, node: str, end_ns: int) -> Iterator[Entry]:
    """Yield each frame that is not lost, as a picture or as candidates, and its LightTruth."""
    index, seq = world.scenario.index(node), 0
    eye = _Eye(world, node, plan.period_ns) if plan.images and plan.exposure == "auto" else None
    light_truth = topics.LIGHT_TRUTH.key(node)
    for instant in _triggers(world, plan, end_ns):
        rng = generator(world.scenario.seed, "exposures", index, instant)
        stray = max(-5.0, min(5.0, float(rng.standard_normal())))
        lost = float(rng.random()) < plan.lost_share
        if lost:
            continue
        taken_ns = instant * plan.period_ns + round(stray * plan.exposure_sigma_ns)
        stamp_ns = taken_ns + world.stamp_error_ns(node, instant)
        trigger = trigger_index(stamp_ns, plan.period_ns)
        if plan.images:
            picture = world.render(node, taken_ns) if eye is None else eye.take(taken_ns, trigger)
            yield stamp_ns, topics.IMAGE.key(node), _message(picture, node, stamp_ns)
        else:
            found = world.candidates(node, taken_ns, trigger, seq, BOOT)
            yield stamp_ns, topics.CANDIDATES.key(node), replace(found, stamp_ns=stamp_ns)
        seq += 1
        yield stamp_ns, light_truth, replace(world.light_truth(node, taken_ns, trigger), stamp_ns=stamp_ns)


class _Eye:
    """A node's camera with its exposure loop, which needs the detector."""

    def __init__(self, world: World, node: str, period_ns: int) -> None:
        self._world, self._node = world, node
        self._controls = DelayedControls()
        self._loop = ExposureLoop(ExposureConfig(), self._controls.range)
        self._pipeline = Pipeline(node, BOOT, period_ns, make_detector())

    def take(self, stamp_ns: int, trigger: int) -> NDArray[np.uint8]:
        """Return the picture of a trigger."""
        exposure, context = self._controls.take(trigger)
        picture = self._world.render(self._node, stamp_ns, exposure)
        frame = Frame(picture, stamp_ns, exposure=exposure, context=context)
        candidates = self._pipeline.candidates(frame)
        if candidates is not None:
            self._controls.follow(self._loop.update(frame, candidates))
        return picture


def _message(picture: NDArray[np.uint8], node: str, stamp_ns: int) -> CompressedImage:
    """Return the picture as JPEG."""
    _, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    seconds, rest_ns = divmod(stamp_ns, S_NS)
    return CompressedImage(
        timestamp=FoxgloveTime(sec=seconds, nsec=rest_ns),
        frame_id=f"{node}_camera",
        data=data.tobytes(),
        format="jpeg",
    )
