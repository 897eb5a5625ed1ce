"""Pairs whose nodes look apart are not solved at every trigger, and wake as soon as there is a pose."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Attitude, Candidates, Depth, Message, NodeInfo, Rejected, RelativePose
from buddyline.solver_service.config import SolveConfig
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.fix import NoFix
from buddyline.solver_service.geometry.observation import Sensed
from buddyline.solver_service.resting import CROWD, LOOK_APART, LOOKS, NOT_IN_VIEW, REST_NS, Resting, look_apart
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
    core = SolverCore(SolveConfig().settings("test"))
    found: list[Message] = []
    for start in range(0, len(messages), together):
        found += core.handle_many(messages[start : start + together])
    found += core.flush()
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
