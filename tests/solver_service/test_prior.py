"""The prediction from earlier fixes: honest, lost after a while, never stubborn."""

import numpy as np
import pytest
from buddyline.node.sim import dive as simulation
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import RelativePose, Truth
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.observation import Settings
from buddyline.solver_service.geometry.past import Past
from buddyline.solver_service.geometry.rig import pair_of
from buddyline.solver_service.geometry.rotation import rotation_exp
from buddyline.solver_service.geometry.se3 import SE3
from buddyline.solver_service.geometry.trigger import Fix
from buddyline.solver_service.prior import LIFETIME_NS, PosePrior

from tests.solver_service.scenes import IDEAL

STEP_NS = 100_000_000
START_NS = 1_764_000_000 * S_NS


def fix(t_a_b_m, R_a_b, covariance):
    return Fix(
        T_a_b=SE3(R_a_b, np.asarray(t_a_b_m, float)),
        covariance=covariance,
        range_a_m=3.0,
        range_b_m=3.0,
        range_gap_m=0.0,
        twist_gap_rad=0.0,
        chi2=0.0,
        hypotheses=1,
        pair_a=(0, 1),
        pair_b=(0, 1),
        method="refined",
        checks=(),
        probability=1.0,
    )


def moving(seconds, rng, noise=1.0):
    """A pair in a swell: (stamp, t, R, fix) ten times a second."""
    covariance = np.diag([0.002, 0.002, 0.01, 0.004, 0.004, 0.002]) ** 2
    for k in range(int(seconds * 10)):
        s = k * 0.1
        t = np.array([0.3 * np.sin(0.7 * s), 0.2 * np.cos(0.5 * s), 4 + 0.1 * s])
        R = rotation_exp(np.array([0.1 * np.sin(0.9 * s), 0.2 * np.cos(0.6 * s), 0.1 * np.sin(s)]))
        off = noise * rng.normal(size=6) * np.sqrt(np.diag(covariance))
        yield k * STEP_NS, t, R, fix(t + off[:3], rotation_exp(off[3:]) @ R, covariance)


def test_predictions_cover_what_comes():
    rng = np.random.default_rng(1)
    prior, errors = PosePrior(), []
    for stamp_ns, t, R, seen in moving(60, rng):
        predicted = prior.predict(stamp_ns)
        if predicted is not None and stamp_ns > 20 * STEP_NS:
            off = SE3(R, t).minus(predicted.T_a_b)
            errors.append(off @ np.linalg.solve(predicted.covariance, off))
        prior.update(stamp_ns, seen)
    # Wider than the truth needs is allowed, too narrow is not: six degrees of freedom.
    assert np.mean(errors) < 6.0
    assert np.quantile(errors, 0.99) < 16.8


@pytest.mark.parametrize("pictures", [1, 5, 10])
def test_predictions_cover_the_turns_of_a_diver_who_looks_at_another_far_away(pictures):
    """B stands still; in A's frame it swings, the further away the faster. Not seen for so many pictures of 50."""
    covariance, back = np.diag([0.002, 0.002, 0.01, 0.004, 0.004, 0.002]) ** 2, rotation_exp(np.array([0.0, 3.1, 0.0]))
    for range_m in (2.0, 6.0, 12.0):
        rng, prior, errors = np.random.default_rng(6), PosePrior(), []
        for k in range(1000):
            s = k * 0.1
            turn = rotation_exp(np.array([0.05 * np.sin(1.3 * s), 0.15 * np.sin(1.1 * s) + 0.1 * np.sin(0.4 * s), 0.0]))
            t, R = turn @ np.array([0.0, 0.0, range_m]), turn @ back
            if k % 50 == 50 - pictures:
                predicted = prior.predict((k + pictures - 1) * STEP_NS)
            if k % 50 == 49:
                off = SE3(R, t).minus(predicted.T_a_b)
                errors.append(off @ np.linalg.solve(predicted.covariance, off))
            if k % 50 < 50 - pictures:
                off = rng.normal(size=6) * np.sqrt(np.diag(covariance))
                prior.update(k * STEP_NS, fix(t + off[:3], rotation_exp(off[3:]) @ R, covariance))
        assert 0.1 < np.mean(errors) < 6.0
        assert max(errors) < 16.8


def test_velocity_is_followed():
    prior = PosePrior()
    for stamp_ns, _, _, seen in moving(5, np.random.default_rng(2), noise=0.0):
        prior.update(stamp_ns, seen)
    predicted = prior.predict(stamp_ns)
    s = stamp_ns / 1e9
    expected = [0.3 * 0.7 * np.cos(0.7 * s), -0.2 * 0.5 * np.sin(0.5 * s), 0.1]
    assert predicted.rates[:3] == pytest.approx(expected, abs=0.05)
    assert np.all(np.linalg.eigvalsh(predicted.rates_covariance) > 0)


def test_lost_after_a_while_and_found_again():
    prior = PosePrior()
    assert prior.predict(0) is None
    fixes = list(moving(1, np.random.default_rng(3)))
    stamp_ns, _, _, seen = fixes[0]
    prior.update(stamp_ns, seen)
    assert prior.predict(stamp_ns + LIFETIME_NS) is not None
    assert prior.predict(stamp_ns + LIFETIME_NS + 1) is None
    assert prior.predict(stamp_ns - 1) is None
    later_ns = stamp_ns + 10 * LIFETIME_NS
    prior.update(later_ns, fixes[5][3])
    assert prior.predict(later_ns).T_a_b.t_m == pytest.approx(fixes[5][3].t_a_b_m)
    prior.reset()
    assert prior.predict(later_ns) is None


def test_a_fix_elsewhere_starts_it_anew():
    prior = PosePrior()
    fixes = list(moving(3, np.random.default_rng(4)))
    for stamp_ns, _, _, seen in fixes:
        prior.update(stamp_ns, seen)
    stamp_ns, _, R, seen = fixes[-1]
    elsewhere = fix([5.0, -3.0, 9.0], rotation_exp(np.array([0.0, 1.0, 0.0])) @ R, seen.covariance)
    prior.update(stamp_ns + STEP_NS, elsewhere)
    predicted = prior.predict(stamp_ns + STEP_NS)
    assert predicted.T_a_b.t_m == pytest.approx(elsewhere.t_a_b_m)
    assert not predicted.rates.any()
    assert predicted.agreed == 0


def test_the_more_fixes_agreed_the_less_a_pose_out_of_reach_is_worth():
    prior = PosePrior()
    losses = []
    for stamp_ns, t, R, seen in list(moving(1, np.random.default_rng(5)))[:8]:
        prior.update(stamp_ns, seen)
        past = Past.of(prior.predict(stamp_ns + STEP_NS), None, 1e-6, pair_of(IDEAL, IDEAL), Settings())
        away = SE3(R[None], t[None] + np.array((0.0, 6.0, 0.0)))
        assert past.weigh(away, three=True) == pytest.approx(np.log(0.15))
        losses.append(past.weigh(away, three=False)[0] / np.log(0.15))
    assert losses == pytest.approx([1, 2, 3, 4, 5, 6, 6, 6])


@pytest.mark.parametrize("bearing_variance", [1e20, 1e290, np.inf])
def test_lights_of_no_known_direction_leave_a_prediction_finite(bearing_variance):
    """Else a blob's sigma of 1e145 px gave poses the probability NaN, which ended the solver."""
    prior = PosePrior()
    stamp_ns, t, R, seen = next(iter(moving(1, np.random.default_rng(5))))
    prior.update(stamp_ns, seen)
    past = Past.of(prior.predict(stamp_ns + STEP_NS), None, bearing_variance, pair_of(IDEAL, IDEAL), Settings())
    [gain] = past.weigh(SE3(R[None], t[None]), three=False)
    assert np.log(0.15) <= gain < 7.0


def test_a_prediction_that_is_not_a_number_is_an_error():
    """The trigger is rejected, and the earlier poses forgotten (pair.py)."""
    prior = PosePrior()
    stamp_ns, _, _, seen = next(iter(moving(1, np.random.default_rng(5))))
    prior.update(stamp_ns, seen)
    with np.errstate(all="ignore"), pytest.raises(ArithmeticError, match="not finite"):
        Past.of(prior.predict(stamp_ns + STEP_NS), None, np.nan, pair_of(IDEAL, IDEAL), Settings())


def test_no_pose_jumps_by_metres_in_a_tenth_of_a_second():
    """Of one node's left light alone in the picture, and false candidates beside it."""
    world = World(Scenario(seed=312, environment="lake", start_ns=START_NS))
    core = SolverCore(Settings(), [("a", "b")])
    spoken = [one for _, _, one in simulation.messages(world, DivePlan(seconds=40.0, rate_hz=10.0))]
    told = [one for one in spoken if one.stamp_ns < START_NS + 7 * S_NS and not isinstance(one, Truth)]
    poses = [one for one in [*core.handle_many(told), *core.flush()] if isinstance(one, RelativePose)]
    assert len(poses) > 20
    for pose in poses:
        truth = world.truth(pose.stamp_ns, pose.trigger)
        assert pose.t_a_b_m == pytest.approx(truth.t_a_b_m, abs=0.5)
