"""Poses of pictures that were taken at two instants, because the nodes' clocks differ."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import LightTruth, Message, NodePose, Rejected, RelativePose, Truth
from buddyline.solver_service.clock_curve import ClockCurve, trigger_moved
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings

START_NS = 1_764_000_000 * S_NS
PAIR = "a", "b"


@dataclass(frozen=True, eq=False)
class ApartDive:
    """A dive of which B's clock is ahead, and its messages."""

    world: World
    messages: list[Message]

    def solved(self, apart_s: float = 0.0, told_s: float = 0.0) -> list[Message]:
        """Solve it without a track. apart_s: counted by the poses; told_s: taken off B's stamps."""
        clocks = {"b": ClockCurve.constant(told_s)}
        core = SolverCore(Settings(), [PAIR], clocks, apart_s={PAIR: apart_s})
        return [*core.handle_many(self.messages), *core.flush()]

    def judged(self, apart_s: float = 0.0) -> tuple[int, int, float]:
        """Return the number of poses, of wrong ones, and the mean NEES / 3 of places."""
        poses = [one for one in self.solved(apart_s) if isinstance(one, RelativePose)]
        squares, wrong = [], 0
        for pose in poses:
            off_m = np.array(pose.t_a_b_m) - self.world.truth(pose.stamp_ns, 0).t_a_b_m
            wrong += bool(np.linalg.norm(off_m) > 0.1 * pose.range_m)
            squares.append(off_m @ np.linalg.solve(np.array(pose.covariance).reshape(6, 6)[:3, :3], off_m) / 3.0)
        return len(poses), wrong, float(np.mean(squares))


def apart(milliseconds: int, seed: int = 9700) -> ApartDive:
    scenario = Scenario(seed=seed, start_ns=START_NS, inertial="poor", clock_offset_ns=milliseconds * MS_NS)
    world = World(scenario)
    unseen = Truth, LightTruth, NodePose
    told = [one for _, _, one in simulation.messages(world, DivePlan(seconds=20.0, rate_hz=10.0))]
    return ApartDive(world, [one for one in told if not isinstance(one, unseen)])


@pytest.mark.parametrize(("milliseconds", "more"), [(60, 0.95), (300, 1.5)])
def test_poses_count_what_is_known_of_the_clocks(milliseconds: int, more: float) -> None:
    """Before, they were off by what the nodes moved meanwhile, and many were rejected by the gaps that this made."""
    dive = apart(milliseconds)
    poses, _, nees = dive.judged()
    counted, wrong, counted_nees = dive.judged(1e-3 * milliseconds)
    assert counted > more * poses
    assert wrong == 0
    assert nees > 3.0
    assert counted_nees < 1.3


def test_pictures_far_apart_need_poses_of_just_before() -> None:
    """Without them nothing tells how the nodes move."""
    found = apart(300).solved(0.3)
    first = next(one for one in found if isinstance(one, RelativePose))
    without = [one for one in found if isinstance(one, Rejected) and "0.30 s apart" in one.detail]
    assert min(one.stamp_ns for one in without) < first.stamp_ns
    assert {one.reason for one in without} == {"ambiguous"}


def test_an_offset_of_half_a_period_takes_all_triggers_the_same_way() -> None:
    """By each stamp's own rounding 95 of B's 192 pictures moved by one, and 97 did not."""
    found = apart(50).solved(told_s=0.05)
    rejected = [one for one in found if isinstance(one, Rejected)]
    assert not [one for one in rejected if one.reason == "duplicate"]
    assert sum(one.reason == "unmatched" for one in rejected) < 20


@pytest.mark.parametrize(
    ("trigger", "offset_ms", "moved"), [(100, 49, 100), (100, 151, 98), (100, -151, 102), (1, 500, 0)]
)
def test_a_trigger_moves_by_whole_periods(trigger: int, offset_ms: int, moved: int) -> None:
    assert trigger_moved(trigger, offset_ms * MS_NS, 100 * MS_NS) == moved
