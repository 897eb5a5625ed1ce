"""Rows, which are worked out together and from blocks of the covariance, against the step of all members."""

import numpy as np
import pytest
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.messages import LightTruth, NodePose, Truth
from buddyline.solver_service.config import SolveConfig, track_settings
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.rotation import rotation_exp
from buddyline.solver_service.network.estimate import NetEstimate
from buddyline.solver_service.network.rows import make_rows, plain_of_posed, turned_by_north
from buddyline.solver_service.network.state import P_, PHI, POSED, block
from buddyline.solver_service.tracking import Coming, PairTracker

START_NS = 1_764_000_000_000_000_000


@pytest.fixture(params=[("a",), ()], ids=["a fixed frame", "a frame that moves with a node"])
def estimate(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> NetEstimate:
    monkeypatch.setattr(PairTracker, "follow", lambda *_: Coming())
    world = World(Scenario(seed=3, start_ns=START_NS, more_nodes=("c", "d"), fixed_nodes=request.param))
    core = SolverCore(SolveConfig().settings("test"), None, track=track_settings("filter", 10.0))
    told = [message for _, _, message in simulation.messages(world, DivePlan(seconds=3.0, imu=True))]
    core.handle_many(message for message in told if not isinstance(message, Truth | LightTruth | NodePose))
    assert core.network is not None
    assert core.network._filter is not None
    return core.network._filter.main


def test_rows_are_where_a_step_of_all_members_leads(estimate: NetEstimate) -> None:
    times_s = [estimate.t_s + ahead_s for ahead_s in (0.0, 0.03, 0.08)]
    due = [one for k, t_s in enumerate(times_s) if (one := estimate.due_row(t_s, k, range(4))) is not None]
    rows = {(row.stamp_ns, row.node): row for row in make_rows(due)}
    assert len(rows) == 3 * len(estimate.members) == 12
    alone = {(row.stamp_ns, row.node): row for one in due for row in make_rows([one])}
    for k, t_s in enumerate(times_s):
        assert estimate.state is not None
        state, P = estimate.state, estimate.covariance
        if k:
            state, move, *_ = estimate._moved(t_s)
            P = move.covariance(P)
        for i, member in enumerate(estimate.members):
            row = rows[k, member.node]
            J = plain_of_posed(state.p_m[i], state.v_mps[i])
            plain = J @ P[block(i), block(i)][:POSED, :POSED] @ J.T
            which = np.r_[P_, PHI]
            told = plain[np.ix_(which, which)]
            told += turned_by_north(state.p_m[[i]], told[-1:, -1], np.array((estimate.north_doubt,)))[0]
            assert row.p_m == pytest.approx(state.p_m[i], abs=1e-12)
            assert row.v_mps == pytest.approx(state.v_mps[i], abs=1e-12)
            assert np.abs(row.R - state.R[i]).max() < 1e-12
            assert row.covariance == pytest.approx(told, rel=1e-6, abs=1e-15)
            same = alone[k, member.node]
            assert (row.p_m == same.p_m).all()
            assert (row.covariance == same.covariance).all()


def test_a_place_that_north_turns_stays_on_its_arc() -> None:
    """Against turns that are drawn; what the covariance held before comes on top, as it was."""
    rng, place_m, before, more = np.random.default_rng(1), np.array((3.0, -4.0, 1.5)), 0.1**2, 0.4**2
    drawn = []
    for variance in (before, before + more):
        turns = np.sqrt(variance) * rng.standard_normal(200_000)
        R = rotation_exp(turns[:, None] * (0.0, 0.0, 1.0))
        errors = np.concatenate((R @ place_m - place_m, turns[:, None] * (0.0, 0.0, 1.0)), axis=1)
        drawn.append(errors.T @ errors / len(errors))
    gained = turned_by_north(place_m[None], np.array((before,)), np.array((more,)))[0]
    np.testing.assert_allclose(gained, drawn[1] - drawn[0], atol=0.02)
    # However little is known of north, it is a covariance.
    for variance in (0.0, 0.1, 1.0, 10.0):
        for doubt in (1e-4, 0.1, 10.0):
            gained = turned_by_north(place_m[None], np.array((variance,)), np.array((doubt,)))[0]
            assert np.linalg.eigvalsh(gained).min() > -1e-9
