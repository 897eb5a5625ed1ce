"""Pairs whose nodes look apart are not solved at every trigger, and wake as soon as there is a pose."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.rotation import from_euler
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.team import TeamMotion
from buddyline.node.sim.trajectory import Placement
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Candidates, Depth, Message, NodeInfo, Rejected, RelativePose
from buddyline.solver_service import core
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.fix import NoFix
from buddyline.solver_service.geometry.observation import Sensed
from buddyline.solver_service.resting import CROWD, LOOK_APART, LOOKS, NOT_IN_VIEW, REST_NS, Resting, look_apart
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.track.inputs import FrameSeen
from buddyline.solver_service.tracking import TrackSettings
from msgspec.structs import replace

from tests.solver_service.scenes import IDEAL

START_NS = 1_764_000_000 * S_NS
SIGMA_RAD = np.full(3, 0.02)


def heading(deg: float, sigma_rad: np.ndarray | None = SIGMA_RAD) -> Sensed:
    half = np.radians(deg) / 2.0
    return Sensed(q_ned_body_xyzw=np.array((0.0, 0.0, np.sin(half), np.cos(half))), sigma_rad=sigma_rad)


@pytest.mark.parametrize(
    ("a", "b", "apart"), [(0.0, 180.0, False), (30.0, 170.0, False), (0.0, 0.0, True), (90.0, 100.0, True)]
)
def test_cameras_that_face_each_other_do_not_look_apart(a: float, b: float, apart: bool) -> None:
    assert look_apart((heading(a), heading(b)), (IDEAL, IDEAL)) is apart
    assert not look_apart((heading(a), Sensed()), (IDEAL, IDEAL))
    # A compass that may be anywhere tells nothing.
    assert not look_apart((heading(a), heading(b, np.array((0.02, 0.02, 1.0)))), (IDEAL, IDEAL))


def test_a_pair_rests_until_something_may_be_a_pose() -> None:
    resting = Resting()
    assert not resting.rests(START_NS)
    assert not resting.rests(START_NS + REST_NS)
    later_ns = START_NS + REST_NS + 1
    assert resting.rests(later_ns)
    resting.take(later_ns, NoFix("ambiguous", ""))
    assert resting.rests(later_ns)
    resting.take(later_ns, NoFix("heading", ""))
    assert not resting.rests(later_ns)


def outcomes(messages: list[Message], together: int) -> dict[tuple[str, str, int], str]:
    solver = SolverCore(SolveConfig().settings("test"))
    found: list[Message] = []
    for start in range(0, len(messages), together):
        found += solver.handle_many(messages[start : start + together])
    found += solver.flush()
    return {
        (one.node_a, one.node_b, one.trigger): one.detail if isinstance(one, Rejected) else "solved"
        for one in found
        if isinstance(one, RelativePose | Rejected)
    }


PLAN = DivePlan(seconds=8.0)


@pytest.fixture(scope="module")
def three() -> list[Message]:
    """Of nodes a and c, which look at b."""
    world = World(Scenario(seed=3, start_ns=START_NS, more_nodes=("c",), fixed_nodes=("a",), interruptions=False))
    return [
        message
        for _, _, message in simulation.messages(world, PLAN)
        if isinstance(message, NodeInfo | Candidates | Attitude | Depth)
    ]


def test_among_many_a_pair_without_poses_rests_wherever_it_looks(three: list[Message]) -> None:
    """Without attitudes, and one candidate in each picture; the others have not sent a picture yet."""
    info = next(message for message in three if isinstance(message, NodeInfo))
    others = [replace(info, node=f"x{k}") for k in range(CROWD - 2)]
    messages = others + [
        replace(one, blobs=one.blobs[:1]) if isinstance(one, Candidates) else one
        for one in three
        if not isinstance(one, Attitude) and one.node in ("a", "c")
    ]
    told = outcomes(messages, 40)
    assert told == outcomes(messages, 5000)
    resting = [trigger for (a, b, trigger), why in told.items() if (a, b) == ("a", "c") and why == NOT_IN_VIEW]
    assert 16 <= len(resting) <= 24
    assert all(trigger % LOOKS for trigger in resting)
    assert NOT_IN_VIEW not in outcomes(messages[1:], 5000).values()


def test_a_team_solves_pairs_that_look_apart_once_in_five_triggers(three: list[Message]) -> None:
    messages = three
    told = outcomes(messages, 40)
    assert told == outcomes(messages, 5000)
    counts = {
        pair: Counter(why for (a, b, _), why in told.items() if (a, b) == pair) for pair in (("a", "b"), ("a", "c"))
    }
    assert counts["a", "b"]["solved"] > 60
    assert counts["a", "b"][LOOK_APART] == 0
    assert 16 <= counts["a", "c"][LOOK_APART] <= 24
    resting = [trigger for (a, b, trigger), why in told.items() if (a, b) == ("a", "c") and why == LOOK_APART]
    assert all(trigger % LOOKS for trigger in resting)
    assert min(resting) * PLAN.period_ns > START_NS + REST_NS


def test_pictures_of_nodes_that_look_apart_start_no_track(
    three: list[Message], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the other node's picture of a trigger is lost."""
    lost = [one for one in three if isinstance(one, Candidates) and one.node == "c" and one.trigger % LOOKS == 1]
    fed: list[tuple[str, int]] = []

    def noted(self: TrackFilter, _: int, frames: Sequence[FrameSeen]) -> None:
        fed.extend((self.both, frame.stamp_ns) for frame in frames)

    monkeypatch.setattr(TrackFilter, "add_frames", noted)
    solver = SolverCore(SolveConfig().settings("test"), track=TrackSettings(frozenset({"filter"})))
    solver.handle_many([one for one in three if one not in lost])
    solver.flush()
    resting_ns = START_NS + REST_NS + S_NS
    assert sum(both == "nodes a and b" and stamp_ns > resting_ns for both, stamp_ns in fed) > 30
    assert [stamp_ns for both, stamp_ns in fed if both == "nodes a and c" and stamp_ns > resting_ns] == []


def in_ring(node: int, t_s: float) -> Placement:
    """Six that look across a ring of 7 m, which turns."""
    at = node * math.pi / 3.0 + 0.1 * t_s
    outwards = np.array((math.cos(at), math.sin(at), 0.0))
    return Placement(from_euler(0.0, 0.05 * math.sin(t_s), at + math.pi), 3.5 * outwards + (0.0, 0.0, 10.0))


def in_line(node: int, t_s: float) -> Placement:
    """Eight in a line, by twos face to face; every second one turns round, to the one behind, and back."""
    turned = math.pi * (node % 2 == 0 and node > 0 and 3.0 < t_s < 6.0)
    yaw = (0.0, math.pi)[node % 2] + turned
    return Placement(from_euler(0.0, 0.0, yaw), np.array((3.0 * node, 0.15 * (-1) ** node * math.sin(t_s), 10.0)))


def face_each_other(one: Placement, other: Placement) -> bool:
    across_m = other.position_ned_m - one.position_ned_m
    looks = one.R_ned_body[:, 0] @ across_m, other.R_ned_body[:, 0] @ -across_m
    return min(looks) > math.cos(math.radians(22.0)) * float(np.linalg.norm(across_m))


@pytest.mark.parametrize(
    ("placed", "nodes"), [(in_ring, "abcdef"), pytest.param(in_line, "abcdefgh", marks=pytest.mark.slow)]
)
def test_in_a_crowd_of_another_shape_no_pair_in_view_is_lost(
    placed: Callable[[int, float], Placement], nodes: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(TeamMotion, "_placement", lambda _, node, t_s: placed(node, t_s))
    world = World(Scenario(seed=7, start_ns=START_NS, more_nodes=tuple(nodes[2:]), false_lights=1))
    plan = DivePlan(seconds=10.0, rate_hz=2.0)
    sent = (one for _, _, one in simulation.messages(world, plan))
    told = [one for one in sent if isinstance(one, NodeInfo | Candidates | Attitude | Depth)]
    rested = outcomes(told, 5000)
    monkeypatch.setattr(core, "CROWD", 99)
    awake = outcomes(told, 5000)

    def in_view(a: str, b: str, trigger: int) -> bool:
        t_s = (trigger * plan.period_ns - START_NS) / S_NS
        return face_each_other(placed(nodes.index(a), t_s), placed(nodes.index(b), t_s))

    posed = {which for which, why in awake.items() if why == "solved" and in_view(*which)}
    assert len(posed) > 20
    assert {which: rested[which] for which in posed if rested[which] != "solved"} == {}
    # In the ring the bars of others look like the one sought, so that no pair rests.
    assert (sum(why in (NOT_IN_VIEW, LOOK_APART) for why in rested.values()) > 10) is (placed is in_line)
