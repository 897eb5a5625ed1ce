"""The demo's dives of many seeds and waters, without hub, processes or waiting: is any pose or track wrong?

    .venv/bin/python -m tests.demo_seeds 100                     # each seed in one of the five waters
    .venv/bin/python -m tests.demo_seeds 100 --waters 5          # each seed in all of them
    .venv/bin/python -m tests.demo_seeds 1 --first 17 --seconds 60

Pictures are rendered as the demo's nodes render them, and go through the product's detector, guide, exposure loop and
solver, in the order of their stamps. Poses and tracks, the smoothed one too, are judged as `demo` and `evaluate` judge
them. A line a dive, one for all at the end; status 1 where anything is wrong. A dive of 10 s takes about 10 s of CPU.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from heapq import merge

import cv2
import numpy as np
from buddyline.node.capture.loop import ExposureLoop
from buddyline.node.config import ExposureConfig
from buddyline.node.detect import make_detector
from buddyline.node.devices import Frame
from buddyline.node.guide import Guide
from buddyline.node.pipeline import Pipeline
from buddyline.node.sim.devices import ATTITUDE_HZ, DEPTH_HZ, IMU_HZ
from buddyline.node.sim.scenario import ENVIRONMENTS, Environment, Scenario
from buddyline.node.sim.sensor import DelayedControls
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, Expect, Message, Rejected, RelativePose, Track
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.tracking import TrackSettings
from buddyline.tools.evaluation.poses import pose_errors
from buddyline.tools.evaluation.result import Accuracy
from buddyline.tools.evaluation.tracks import TrackFigures, tracks_figures
from buddyline.tools.evaluation.truth import TruthTrack

NODES = ("a", "b")
START_NS = 1_764_000_000 * S_NS
PERIOD_NS = S_NS // 10
BOOT = "demo"


class DemoNode:
    """One node of the demo: what its camera sees, and what it makes of it."""

    def __init__(self, world: World, node: str) -> None:
        self.guide = Guide(node)
        self._world, self._node = world, node
        self._controls = DelayedControls()
        self._loop = ExposureLoop(ExposureConfig(), self._controls.range)
        self._pipeline = Pipeline(node, BOOT, PERIOD_NS, make_detector(), self.guide)
        self.guide.saw_process("solver/a_b", True)

    def frame(self, trigger: int) -> Candidates:
        """Render a trigger's picture, detect lights in it, and set the next exposure."""
        stamp_ns = trigger * PERIOD_NS
        exposure, context = self._controls.take(trigger)
        picture = self._world.render(self._node, stamp_ns, exposure)
        frame = Frame(picture, stamp_ns, exposure=exposure, context=context)
        candidates = self._pipeline.candidates(frame)
        assert candidates is not None
        self._controls.follow(self._loop.update(frame, candidates, self._pipeline.expected))
        return candidates


@dataclass(frozen=True)
class DemoDive:
    """A dive's outcomes. scattered: poses outside their 95 % ellipsoid. nees: of each pose, 6 on average if honest.

    tracks: the figures of each mode.
    """

    poses: int
    rejected: Counter[str]
    wrong_poses: int
    scattered: int
    nees: float
    tracks: dict[str, TrackFigures]

    @property
    def wrong(self) -> int:
        """Number of wrong poses and samples."""
        return self.wrong_poses + sum(figures.wrong for figures in self.tracks.values())

    def __str__(self) -> str:
        tracks = "  ".join(f"{mode} {told_track([figures])}" for mode, figures in self.tracks.items())
        rejected = " ".join(f"{reason} {n}" for reason, n in sorted(self.rejected.items())) or "none"
        told = f"wrong: poses {self.wrong_poses} of {self.poses}  {tracks}"
        honest = f"NEES/6 {self.nees / 6:.2f}, {self.scattered} outside" if self.poses else "-"
        return f"{told}  ({honest}; no pose: {rejected})"


def told_track(found: Sequence[TrackFigures]) -> str:
    """Say how many samples of one mode's tracks are wrong, how much the least of them covers, and NEES/6 of all."""
    samples = sum(figures.samples for figures in found)
    nees = sum((figures.nees6.mean or 0.0) * figures.nees6.count for figures in found)
    count = sum(figures.nees6.count for figures in found)
    covered = min((figures.covered or 0.0 for figures in found), default=0.0)
    wrong = sum(figures.wrong for figures in found)
    return f"{wrong} of {samples} (covered {covered:.1%}, NEES/6 {nees / 6 / max(count, 1):.2f})"


def swum(world: World, seconds: float) -> list[Message]:
    """Let both nodes and the solver run through a dive of the demo; return what the solver says."""
    end_ns = START_NS + round(seconds * S_NS)
    nodes = {node: DemoNode(world, node) for node in NODES}
    settings = TrackSettings(frozenset(("filter", "lag", "smooth")), expect=True)
    core = SolverCore(Settings(), [("a", "b")], track=settings)
    told = [one for node in NODES for one in core.handle(world.info(node, START_NS, PERIOD_NS))]
    for message in _in_order(world, nodes, end_ns):
        for one in core.handle(message):
            if isinstance(one, Expect):
                nodes[one.node].guide.expect(one)
            else:
                told.append(one)
    return told + core.flush()


def _in_order(world: World, nodes: dict[str, DemoNode], end_ns: int) -> Iterator[Message]:
    """Yield the messages of all nodes by time. A frame is made when it is asked for: the solver may guide it."""
    instants = []
    for node in NODES:
        for rank, (sample, hz) in enumerate(
            ((world.imu, IMU_HZ), (world.attitude, ATTITUDE_HZ), (world.depth, DEPTH_HZ))
        ):
            stamps_ns = range(START_NS, end_ns, S_NS // hz)
            instants.append([(stamp_ns, rank, node, sample) for stamp_ns in stamps_ns])
        instants.append([(stamp_ns, 3, node, None) for stamp_ns in range(START_NS + PERIOD_NS, end_ns, PERIOD_NS)])
    for stamp_ns, _, node, sample in merge(*instants, key=lambda instant: instant[:3]):
        yield nodes[node].frame(stamp_ns // PERIOD_NS) if sample is None else sample(node, stamp_ns)


def judged(world: World, outcomes: list[Message]) -> DemoDive:
    """Compare what the solver said with the truth of a world."""
    poses = [one for one in outcomes if isinstance(one, RelativePose)]
    tracks = [one for one in outcomes if isinstance(one, Track)]
    pose_truth = TruthTrack([world.truth(pose.stamp_ns, pose.trigger) for pose in poses])
    errors = pose_errors(poses, pose_truth, lambda _: None, None)
    accuracy = Accuracy.of(errors)
    figures = tracks_figures(tracks, poses, TruthTrack([world.truth(track.stamp_ns, 0) for track in tracks]))
    assert len(errors) == len(poses)
    return DemoDive(
        poses=len(poses),
        rejected=Counter(one.reason for one in outcomes if isinstance(one, Rejected)),
        wrong_poses=accuracy.wrong,
        scattered=round((1.0 - (accuracy.honest6 or 0.0)) * len(poses)),
        nees=float(np.mean(errors.nees6)) if poses else 0.0,
        tracks={one.mode: one for one in figures},
    )


def dives(first: int, seeds: int, waters: int) -> Iterator[tuple[int, Environment]]:
    """Yield each seed with its waters: first every seed in one, then every seed in the next."""
    for turn in range(waters):
        for seed in range(first, first + seeds):
            yield seed, ENVIRONMENTS[(seed + turn) % len(ENVIRONMENTS)]


def main() -> int:
    """Swim the dives; 1 where a pose or a track's sample is wrong."""
    parser = argparse.ArgumentParser(prog="python -m tests.demo_seeds", description=__doc__.split("\n")[0])
    parser.add_argument("seeds", type=int)
    parser.add_argument("--first", type=int, default=1, help="default: 1")
    parser.add_argument("--waters", type=int, default=1, help=f"of each seed, up to {len(ENVIRONMENTS)}; default: 1")
    parser.add_argument("--seconds", type=float, default=10.0, help="default: 10")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    found = []
    for seed, environment in dives(args.first, args.seeds, args.waters):
        world = World(Scenario(environment=environment, seed=seed, start_ns=START_NS))
        dive = judged(world, swum(world, args.seconds))
        found.append(dive)
        print(f"{environment:10} {seed:4}  {dive}", flush=True)
    poses = sum(dive.poses for dive in found)
    wrong_poses = sum(dive.wrong_poses for dive in found)
    nees = sum(dive.nees * dive.poses for dive in found) / max(poses, 1)
    outside = sum(dive.scattered for dive in found) / max(poses, 1)
    print(
        f"{len(found)} dives: {wrong_poses} of {poses} poses wrong; "
        f"NEES/6 {nees / 6:.2f}, {outside:.1%} of poses outside their 95 % ellipsoid; "
        f"{sum(not dive.poses for dive in found)} dives without a pose"
    )
    for mode in ("filter", "lag", "smooth"):
        print(f"{mode} samples wrong: {told_track([dive.tracks[mode] for dive in found if mode in dive.tracks])}")
    return 1 if any(dive.wrong for dive in found) else 0


if __name__ == "__main__":
    sys.exit(main())
