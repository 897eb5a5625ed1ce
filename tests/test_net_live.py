"""Nodes that are not as they say, live: moved, of another release, two of one id, in another frame of one name."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import numpy as np
import pytest
from buddyline.node.sim import dive as simulation
from buddyline.node.sim import rotation
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.trajectory import Placement
from buddyline.node.sim.world import World
from buddyline.protocol.bus import Received
from buddyline.protocol.messages import Candidates, Message, NodeInfo, NodePose, SolverStatus
from buddyline.protocol.topics import SOLVER_STATUS
from buddyline.protocol.zenoh_bus import connect
from msgspec.structs import replace

from tests.processes import Process, free_endpoint, until
from tests.soak.shared import START_NS, LiveDive

MOVES_S, SECONDS, RATE_HZ = 6.0, 30.0, 10.0


def simulated(moved: str = "", aside_m: float = 0.0, turned_deg: float = 0.0) -> list[Message]:
    """Return what four nodes tell, of which a and c are said to be fixed where they begin; one moves after MOVES_S."""
    world = World(Scenario(seed=31, start_ns=START_NS, more_nodes=("c", "d"), fixed_nodes=("a", "c")))
    stands = world._scene.motion._placement

    def placement(index: int, t_s: float) -> Placement:
        where = stands(index, t_s)
        if "abcd"[index] != moved or t_s < MOVES_S:
            return where
        R = rotation.from_euler(0.0, 0.0, np.radians(turned_deg)) @ where.R_ned_body
        return Placement(R, where.position_ned_m + R @ np.array((0.0, aside_m, 0.0)))

    world._scene.motion.placement = placement
    told = [one for _, _, one in simulation.messages(world, DivePlan(seconds=SECONDS, rate_hz=RATE_HZ, imu=True))]
    kept = [one for one in told if hasattr(one, "node") and not isinstance(one, NodePose)]
    first = {one.node: one for one in reversed(kept) if isinstance(one, NodeInfo)}
    kept = [replace(one, fixed=first[one.node].fixed) if isinstance(one, NodeInfo) else one for one in kept]
    return sorted(kept, key=lambda one: one.stamp_ns)


def problems_of(messages: list[Message], named: str, within_s: float) -> tuple[float, set[str]]:
    """Play nodes to a hub and a solver; give when a status named it, s, inf if none did, and all problems."""
    endpoint, stop = free_endpoint(), threading.Event()
    said: dict[str, float] = {}
    with Process("hub", "--listen", endpoint) as hub:
        hub.wait_for("listens")
        with Process("solver", "--connect", endpoint) as solver:
            solver.wait_for("connected")
            bus = connect(endpoint, stop=stop, on_wait=lambda _: None)
            assert bus is not None

            def take(received: Received) -> None:
                status = received.open().message
                assert isinstance(status, SolverStatus)
                for one in status.problem.split("; "):
                    said.setdefault(one, time.monotonic())

            with bus:
                bus.subscribe((SOLVER_STATUS.key_any(),), take)
                began_s = time.monotonic()
                with LiveDive(bus, messages, RATE_HZ):
                    ends_s = began_s + within_s
                    until(lambda: any(named in one for one in list(said)) or time.monotonic() > ends_s, 0.05)
    return min([at_s - began_s for one, at_s in said.items() if named in one], default=np.inf), set(said)


@pytest.fixture(scope="module")
def still() -> list[Message]:
    return simulated()


@pytest.mark.slow
@pytest.mark.parametrize(("aside_m", "turned_deg"), [(0.5, 0.0), (0.0, 10.0)])
def test_a_fixed_node_that_moves_is_named_within_seconds(aside_m: float, turned_deg: float) -> None:
    """By the poses of others: it moves aside, or turns by less than its own compass may err."""
    named = "has fixed node c moved"
    after_s, _ = problems_of(simulated("c", aside_m, turned_deg), named, SECONDS - 2.0)
    assert MOVES_S < after_s < SECONDS - 2.0


@pytest.mark.slow
def test_of_fixed_nodes_that_stand_still_none_is_named(still: list[Message]) -> None:
    _, said = problems_of(still, "moved", 15.0)
    assert not any("moved" in one or "contradict" in one for one in said)


def of_another_release(one: Message) -> list[Message]:
    return [replace(one, software="buddyline 9.7.0") if isinstance(one, NodeInfo) and one.node == "b" else one]


def of_another_net(one: Message) -> list[Message]:
    is_c = isinstance(one, NodeInfo) and one.node == "c"
    return [replace(one, fixed=replace(one.fixed, net="pool")) if is_c else one]


def of_another_frame(one: Message) -> list[Message]:
    """Node c has its place in a frame of the same name, which is another one."""
    is_c = isinstance(one, NodeInfo) and one.node == "c"
    return [replace(one, fixed=replace(one.fixed, p_m=(40.0, -25.0, 3.0))) if is_c else one]


def twice(one: Message) -> list[Message]:
    is_d = isinstance(one, Candidates) and one.node == "d"
    return [one, replace(one, node="b", boot="another", seq=one.seq + 7)] if is_d else [one]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "named"),
    [
        (of_another_release, "node b runs Buddyline 9.7"),
        (of_another_net, "fixed nodes name the nets main and pool: all are taken for one frame"),
        (of_another_frame, "has fixed node c moved"),
        (twice, "two nodes have the id b: give each its own"),
    ],
)
def test_a_node_that_is_not_as_the_others_take_it_for_is_named(
    still: list[Message], change: Callable[[Message], list[Message]], named: str
) -> None:
    after_s, said = problems_of([each for one in still for each in change(one)], named, SECONDS)
    assert after_s < SECONDS, said
