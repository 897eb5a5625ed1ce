"""Nodes whose clocks differ: the network finds out by how much, and tells nothing wrong before."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buddyline.node.sim.world import World
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.messages import NodePose
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import Floats
from buddyline.solver_service.network.belief import KnownPlace
from buddyline.solver_service.network.clocks import is_off
from buddyline.solver_service.network.estimate import NetEstimate
from buddyline.solver_service.network.filter import ROW, NetFilter
from buddyline.solver_service.network.sights import WIDTH, by_clocks_px2, columns, light_positions
from buddyline.solver_service.network.state import BLOCK, CLOCK, COMMON, block
from buddyline.solver_service.track.inputs import AttitudeSeen, DepthSeen, FrameSeen, TrackNode
from buddyline.solver_service.track.lights import residuals
from buddyline.solver_service.tracking import Coming, PairTracker

from tests.solver_service.network.test_jacobians import LIGHTS_M, PINHOLE, a_state, an_estimate
from tests.solver_service.network.test_network import START_NS, dive, errors, solved


@pytest.fixture(autouse=True)
def no_tracks_of_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, told in (("follow", Coming()), ("tell", []), ("finish", [])):
        monkeypatch.setattr(PairTracker, name, lambda *_, told=told: told)


def judged(world: World, poses: list[NodePose]) -> tuple[float, int]:
    """Return the mean of the squared errors over the covariance / 6 of nodes that move, and how many are wrong."""
    origins = {pose.node for pose in poses if not any(pose.p_m)} - {pose.node for pose in poses if pose.fixed}
    assert len(origins) < 2
    origin = next(iter(origins), None)
    fixed = {pose.node for pose in poses if pose.fixed or pose.node == origin}
    found = errors(world, poses, origin)
    rows = np.concatenate([of for node, of in found.items() if node not in fixed])
    wrong = ((rows[:, 0] > 0.3) | (rows[:, 1] > 0.1)) & (rows[:, 2] > 1.5)
    return float(rows[:, 2].mean()), int(wrong.sum())


def network_of(core: SolverCore) -> NetFilter:
    assert core.network is not None
    assert core.network._filter is not None
    return core.network._filter


def off_sigmas(core: SolverCore, offset_s: float) -> list[float]:
    """Return by how many sigmas the network is wrong about how far the clocks of all but a are ahead of a's."""
    net = network_of(core)
    members = {net.nodes[one.node].name: k for k, one in enumerate(net.main.members)}
    found = []
    for k in (k for node, k in members.items() if node != "a"):
        (of_a_s, _), (left_s, sigma_s) = net.main.clock(members["a"]), net.main.clock(k)
        put_right_s = 1e-9 * (net.off_ns[net.main.members[k].node] - net.off_ns[net.main.members[members["a"]].node])
        found.append((put_right_s + left_s - of_a_s - offset_s) / math.hypot(sigma_s, 1e-3))
    return found


@pytest.mark.parametrize("offset_ms", [-30, pytest.param(100, marks=pytest.mark.slow), 300])
def test_a_live_network_finds_its_nodes_clocks(offset_ms: int) -> None:
    world, messages = dive(3, 8.0, clock_offset_ns=offset_ms * MS_NS)
    poses, core = solved(messages)
    assert np.abs(off_sigmas(core, 1e-3 * offset_ms)).max() < 4.0
    nees, wrong = judged(world, poses)
    assert wrong == 0
    assert 0.4 < nees < 1.5
    # Nearly all rows are told once the clocks are known.
    for node in "bcd":
        late = [one for one in poses if one.node == node and one.stamp_ns > START_NS + 5 * S_NS + offset_ms * MS_NS]
        assert len(late) > 18
    assert any(" ms from that of a: the network counts with it" in problem for problem in network_of(core).problems)


@pytest.mark.slow
@pytest.mark.parametrize(("offset_ms", "fixed"), [(100, ()), (300, ()), (300, ("a",))])
def test_a_smoothed_network_finds_its_nodes_clocks(offset_ms: int, fixed: tuple[str, ...]) -> None:
    world, messages = dive(5, 10.0, clock_offset_ns=offset_ms * MS_NS, fixed_nodes=fixed)
    poses, core = solved(messages, mode="smooth")
    assert np.abs(off_sigmas(core, 1e-3 * offset_ms)).max() < 4.0
    nees, wrong = judged(world, poses)
    assert wrong == 0
    assert 0.3 < nees < 1.5
    assert len([one for one in poses if one.node == "b"]) > 80


@pytest.mark.slow
def test_a_network_follows_clocks_that_drift() -> None:
    world, messages = dive(7, 20.0, clock_drift=5e-4)
    poses, core = solved(messages)
    assert np.abs(off_sigmas(core, 0.01)).max() < 4.0
    assert len(poses) > 4 * 185
    nees, wrong = judged(world, poses)
    assert wrong == 0
    assert 0.4 < nees < 1.4


def test_a_clock_has_proved_to_be_off_once_that_is_sure() -> None:
    assert is_off(-0.02, 0.002)
    assert not is_off(-0.02, 0.006)
    assert not is_off(0.3, 0.05)
    assert not is_off(0.004, 1e-4)


def three(anchored: bool) -> tuple[NetFilter, NetEstimate]:
    """Give three members, of which c's clock seems 80 ms ahead."""
    net = NetFilter()
    for name in "abc":
        net.add_node(TrackNode(name, Rig(PINHOLE, LIGHTS_M)))
    net.main = estimate = an_estimate(a_state(2))
    estimate.intake = net
    if not anchored:
        estimate.places[0] = KnownPlace(np.zeros(3), np.eye(3), 0.01, 0.01)
    assert estimate.state is not None
    estimate.state.clock_s[:] = 0.0, 0.001, 0.08
    for index in range(3):
        estimate.covariance[block(index).start + CLOCK, block(index).start + CLOCK] = 0.005**2
    return net, estimate


@pytest.mark.parametrize(("anchored", "told"), [(False, [0, 1]), (True, [])])
def test_a_node_whose_clock_seems_far_off_is_named_and_not_told(anchored: bool, told: list[int]) -> None:
    """In a frame that moves with a node, the places of all count by its motion at wrong times."""
    net, estimate = three(anchored)
    assert [one.node for one in estimate._present(5.0, (0, 1, 2)) if one.confirmed] == told
    net._check_clocks(5.0)
    assert net.problems == ["c: its clock is +80 ms from that of a: the network does not tell its places"]


def test_without_an_inertial_unit_a_clock_that_was_far_off_is_not_known_well_enough() -> None:
    net, estimate = three(anchored=False)
    assert estimate.state is not None
    estimate.state.clock_s[2], net.off_ns[2] = 0.0, 80 * MS_NS
    assert estimate.is_timed(2)
    estimate.members[2].without = True
    assert not estimate.is_timed(2)


def test_what_a_node_has_told_is_moved_by_what_its_clock_is_ahead() -> None:
    net = NetFilter()
    for name in "ab":
        net.add_node(TrackNode(name, Rig(PINHOLE, LIGHTS_M)))
    stamps_ns = START_NS + np.arange(3) * 10 * MS_NS
    for node in (0, 1):
        net.add_imu(node, stamps_ns, np.zeros((3, 3)), np.zeros((3, 3)))
        net.add_attitude(node, AttitudeSeen(START_NS, np.eye(3), np.full(3, 0.02)))
        net.add_depth(node, DepthSeen(START_NS, 3.0, 0.01))
        frame = FrameSeen(START_NS, np.array(((300.0, 200.0),)), np.ones(1))
        net.add_frames(node, [frame])
    net.ask_rows(START_NS, (0, 1), ROW)
    at_s = net.since_epoch(START_NS)
    net.put_right({1: 0.2})
    waiting = {(rank, what if isinstance(what, tuple) else 0): t_s for t_s, rank, _, what in net._events}
    assert waiting == pytest.approx(
        {(1, 0): at_s, (2, 0): at_s - 0.2, (ROW, (START_NS, 0)): at_s, (ROW, (START_NS, 1)): at_s - 0.2}, abs=1e-6
    )
    for node, ahead_s in enumerate((0.0, 0.2)):
        assert net.seconds(node, START_NS) == pytest.approx(at_s - ahead_s, abs=1e-6)
        assert net.samples[node].times_s == pytest.approx(at_s - ahead_s + np.arange(3) * 0.01, abs=1e-6)
        assert net.attitudes[node][0][0] == net.depths[node][0][0] == pytest.approx(at_s - ahead_s, abs=1e-6)


def test_a_clock_put_right_moves_no_light() -> None:
    """What one node shows, and what it sees, is the same by its old clock and by the one that is put right."""
    more_s, rates = 0.004, np.random.default_rng(4).normal(0.0, 0.3, (3, 3))
    estimate = an_estimate(a_state(3))
    before = estimate.state
    estimate.rates_radps = rates
    estimate.nudge(1, more_s)
    after = estimate.state
    assert before is not None
    assert after is not None
    assert after.clock_s[1] == pytest.approx(before.clock_s[1] - more_s)
    for (observer, other), late_s in (((0, 1), 0.0), ((1, 0), more_s)):

        def seen(state, at_s, pair=(observer, other)):
            lights = LIGHTS_M[None]
            return light_positions(state, [pair[0]], [pair[1]], lights, rates, np.array([[at_s]]))[0]

        # Its own pictures' stamps go back with its clock.
        assert seen(after, 0.002 - late_s) == pytest.approx(seen(before, 0.002), abs=2e-5)


def test_lights_count_what_two_unknowns_of_the_clock_move_together() -> None:
    """The clock's error times the velocity's is in no Jacobian: it is as large as random errors of both make it."""
    estimate, rng = an_estimate(a_state(3)), np.random.default_rng(5)
    assert estimate.state is not None
    still, rates = replace(estimate.state, v_mps=np.zeros((3, 3))), np.zeros((3, 3))
    which = columns([0], [1])[0]
    P = np.zeros((WIDTH, WIDTH))
    mixed = rng.normal(0.0, 1.0, (4, 4)) * np.array((0.1, 0.1, 0.1, 0.02))[:, None]
    own = np.r_[WIDTH // 2 + 3 : WIDTH // 2 + 6, WIDTH - 1]
    P[np.ix_(own, own)] = mixed @ mixed.T

    def pixels_off(error: Floats) -> Floats:
        at, D = light_positions(still.plus(error), [0], [1], LIGHTS_M[None], rates, np.zeros((1, 1)))
        return residuals(bearings, tangents, at, D)[0][0, 0, 0]

    X, D = light_positions(still, [0], [1], LIGHTS_M[None], rates, np.zeros((1, 1)))
    u_px = PINHOLE.fx_px * X[0, 0, :1, :2] / X[0, 0, :1, 2:] + (PINHOLE.cx_px, PINHOLE.cy_px)
    bearings, tangents = (of[None] for of in PINHOLE.rays(u_px))
    H = residuals(bearings, tangents, X, D)[1]
    left = []
    for draw in rng.multivariate_normal(np.zeros(4), P[np.ix_(own, own)], 4000):
        error = np.zeros(COMMON + 3 * BLOCK)
        error[which[own]] = draw
        left.append(-pixels_off(error) - H[0, 0, 0, :, :-1][:, own] @ draw)
    [found] = by_clocks_px2(H[..., :-1], P[None])
    assert found == pytest.approx(0.5 * float(np.var(left, axis=0).sum()), rel=0.1)
    known = P.copy()
    known[WIDTH - 1], known[:, WIDTH - 1] = 0.0, 0.0
    assert by_clocks_px2(H[..., :-1], known[None]) == pytest.approx([0.0])
