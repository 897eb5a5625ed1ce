"""A node's clock that is set, or is far off: the others go on meanwhile, all goes on after, and no time is walked."""

import tracemalloc

import pytest
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Candidates, NodeInfo, NodePose, Rejected, RelativePose, Track
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.network.estimate import NetEstimate
from buddyline.solver_service.track.filter import TrackFilter
from buddyline.solver_service.tracking import TrackSettings
from msgspec.structs import replace

from tests.solver_service.conftest import PERIOD_NS, START_NS, dive_messages

LATE_NS = 30_000_000
DAY_S = 86_400


@pytest.fixture(scope="module")
def inertial():
    return dive_messages(seconds=9.0, imu=True)[0]


@pytest.fixture(scope="module")
def three():
    scenario = Scenario(
        seed=5, start_ns=START_NS, environment="basin", node_a="a", node_b="b", more_nodes=("c",), interruptions=False
    )
    told = [one for _, _, one in simulation.messages(World(scenario), DivePlan(seconds=6.0, imu=True))]
    kept = [one for one in told if hasattr(one, "node") and not isinstance(one, NodePose)]
    return sorted(kept, key=lambda one: (one.stamp_ns, isinstance(one, Candidates)))


def ahead(message, by_s):
    later = replace(message, stamp_ns=message.stamp_ns + by_s * S_NS)
    return replace(later, trigger=later.trigger + by_s * S_NS // PERIOD_NS) if isinstance(later, Candidates) else later


def live(messages, node, by_s, from_s=0.0, to_s=100.0):
    """Yield (receive time, result) and at last the core: of a live dive in which a node's clock is off for a while."""
    core = SolverCore(Settings(), None, track=TrackSettings(frozenset(("filter", "lag")), 20.0, expect=True))
    found = []
    for message in messages:
        at_s = (message.stamp_ns - START_NS) / S_NS
        is_off = message.node == node and from_s <= at_s < to_s and not isinstance(message, NodeInfo)
        now_ns = message.stamp_ns + LATE_NS
        results = core.handle(ahead(message, by_s) if is_off else message, now_ns)
        found += [((now_ns - START_NS) / S_NS, one) for one in results]
    return found, core


@pytest.mark.parametrize("by_s", [12, 60])
def test_poses_and_track_are_back_as_soon_as_a_clock_that_was_ahead_is_right_again(inertial, by_s):
    """Its triggers were answered without the other node's frames, and its samples were stamped in the future."""
    found, core = live(inertial, "b", by_s, 2.0, 5.0)
    poses = [at_s for at_s, one in found if isinstance(one, RelativePose) and at_s > 6.0]
    rows = [at_s for at_s, one in found if isinstance(one, Track) and one.mode == "filter" and at_s > 7.0]
    assert len(poses) > 20
    assert len(rows) > 30
    assert max(one.stamp_ns for _, one in found if isinstance(one, Track)) < START_NS + 10 * S_NS
    assert all("too late" not in status.problem for status in core.report(0, START_NS + 10 * S_NS, 0, []))


def test_a_trigger_that_a_clock_was_ahead_to_is_answered_when_both_nodes_reach_it(inertial):
    """The one with a clock that was right all the time is not late."""
    found, _ = live(inertial, "b", 6, 1.0, 2.0)
    first = START_NS // PERIOD_NS + 7 * S_NS // PERIOD_NS
    outcomes = [one for _, one in found if isinstance(one, RelativePose | Rejected)]
    again = {trigger: [one for one in outcomes if one.trigger == trigger] for trigger in range(first, first + 9)}
    assert all(sum(isinstance(one, RelativePose) for one in of_trigger) <= 1 for of_trigger in again.values())
    assert sum(isinstance(of_trigger[-1], RelativePose) for of_trigger in again.values() if of_trigger) > 5


def test_clocks_that_are_a_day_apart_cost_no_memory(inertial):
    """As where one of two Pis has no clock chip, and was last switched off yesterday."""
    tracemalloc.start()
    try:
        found, _ = live([one for one in inertial if one.stamp_ns < START_NS + 4 * S_NS], "b", -DAY_S)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert any(isinstance(one, Rejected) for _, one in found)
    assert peak < 50e6


class StepCount:
    """Counts the steps of a kind of estimate, and refuses more than two minutes of them."""

    def __init__(self, patch, owner, name):
        self.count, step = 0, getattr(owner, name)

        def counted(*args):
            self.count += 1
            assert self.count < 1500, "it walks through the gap"
            return step(*args)

        patch.setattr(owner, name, counted)


@pytest.mark.parametrize("mode", ["filter", "smooth"])
def test_a_track_does_not_walk_through_a_gap_of_an_hour(inertial, mode, monkeypatch):
    steps = StepCount(monkeypatch, TrackFilter, "_move")
    core = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset((mode,)), 20.0))
    gap_s = 3600
    messages = [one if one.stamp_ns < START_NS + 3 * S_NS else ahead(one, gap_s) for one in inertial]
    before = [one for one in messages if one.stamp_ns < START_NS + gap_s * S_NS]
    found = core.handle_many(before) + core.handle_many(messages[len(before) :]) + core.flush()
    rows_s = [(one.stamp_ns - START_NS) / S_NS for one in found if isinstance(one, Track)]
    assert steps.count > 30
    assert sum(at_s < 4 for at_s in rows_s) > 30
    # Of what comes at once after the gap, none is left out.
    assert sum(gap_s + 4.0 < at_s < gap_s + 8.5 for at_s in rows_s) > 80


@pytest.mark.parametrize("by_s", [4, 60, DAY_S])
def test_a_network_goes_on_while_one_nodes_clock_is_ahead(three, by_s, monkeypatch):
    """Rows of its time would be of the future, and the other nodes' data would come too late for them."""
    StepCount(monkeypatch, NetEstimate, "_go")
    found, _ = live(three, "c", by_s, 2.0)
    rows = [(at_s, one) for at_s, one in found if isinstance(one, NodePose)]
    assert all(one.stamp_ns < START_NS + at_s * S_NS for at_s, one in rows)
    for node in "ab":
        assert sum(one.node == node and at_s > 4.0 for at_s, one in rows) > 25


def test_a_network_does_not_walk_through_a_gap_of_an_hour(three, monkeypatch):
    steps = StepCount(monkeypatch, NetEstimate, "_go")
    core = SolverCore(Settings(), None, track=TrackSettings(frozenset(("filter",)), 20.0))
    gap_s = 3600
    messages = [one if one.stamp_ns < START_NS + 3 * S_NS else ahead(one, gap_s) for one in three]
    found = [result for one in messages for result in core.handle(one)] + core.flush()
    rows = [one for one in found if isinstance(one, NodePose)]
    assert steps.count > 10
    for node in "abc":
        of_node_s = [(one.stamp_ns - START_NS) / S_NS for one in rows if one.node == node]
        assert sum(at_s < 4 for at_s in of_node_s) > 20
        assert sum(at_s > gap_s for at_s in of_node_s) > 20
