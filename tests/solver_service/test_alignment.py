"""The clocks' offset out of the motion: found where the pair moves, not made up where it rests."""

from dataclasses import replace

import numpy as np
import pytest
from buddyline.solver_service.alignment import ClockAlignment
from buddyline.solver_service.clock_curve import ClockCurve
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.camera import Camera
from buddyline.solver_service.geometry.closed_form import closed_form
from buddyline.solver_service.geometry.rig import Rig
from buddyline.solver_service.geometry.rotation import rotation_exp
from buddyline.solver_service.geometry.trigger import Settings

from tests.solver_service.conftest import dive_messages
from tests.solver_service.test_prior import fix

STEP_S = 0.1
FACING = np.diag([-1.0, 1.0, -1.0])


def rig(left_m=(-0.44, 0.0, 0.0), right_m=(0.44, 0.0, 0.0)):
    camera = Camera("pinhole", 820, 616, 904.0, 904.0, 409.5, 307.5, (0.0,) * 5)
    return Rig(camera=camera, lights_m=np.array([left_m, right_m]))


def pose(s, moving):
    """Where a pair in a swell is at times s (K,): t (K, 3), R (K, 3, 3)."""
    s = s * moving
    t = np.stack((0.5 * np.sin(0.4 * s), 0.3 * np.cos(0.3 * s), 3.0 + np.sin(0.2 * s)), axis=1)
    w = np.stack((0.15 * np.sin(0.9 * s), 0.3 * np.cos(0.6 * s), 0.2 * np.sin(0.8 * s)), axis=1)
    return t, rotation_exp(w) @ FACING


def bearings(points):
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def seen(offset_s, rng, rigs, fixes=250, moving=1.0, noise=1.0):
    """Fixes of a pair that B sees offset_s before its stamp says; noise: in units of the gaps' own."""
    sigma_rad = 0.7 / 904
    s = np.arange(fixes) * STEP_S
    t, R = pose(s, moving)
    t_then, R_then = pose(s - offset_s, moving)
    in_a = bearings(rigs[1].lights_m @ R.swapaxes(1, 2) + t[:, None])
    in_b = bearings((rigs[0].lights_m - t_then[:, None]) @ R_then)
    views = np.stack((in_a, in_b)).transpose(2, 0, 3, 1)
    solved = closed_form(views[0], views[1], *rigs)
    alpha = np.arccos((views[0] * views[1]).sum(1))
    sd = np.sqrt(2.0) * np.hypot(sigma_rad / alpha[0], sigma_rad / alpha[1])
    log_ratio = np.log(solved.range_m[0] / solved.range_m[1]) + noise * sd * rng.normal(size=fixes)
    twist_gap = solved.twist_gap_rad + noise * sd * rng.normal(size=fixes)
    rows = []
    for k in range(fixes):
        now = fix(t[k], R[k], np.eye(6) * 1e-6)
        now = replace(now, range_a_m=3.0 * np.exp(log_ratio[k]), twist_gap_rad=float(twist_gap[k]))
        rows.append((round(s[k] * 1e9), now, (sigma_rad, sigma_rad)))
    return rows


def estimate(rows, rigs, known_s=0.0):
    alignment = ClockAlignment()
    for stamp_ns, now, sigma_rad in rows:
        alignment.add(stamp_ns, now, rigs, known_s, sigma_rad)
    return alignment.estimate()


@pytest.mark.parametrize("rigs", [(rig(), rig()), (rig((-0.4, 0.05, 0.02)), rig((-0.3, 0.0, 0.1), (0.5, 0.02, 0.0)))])
@pytest.mark.parametrize("offset_s", [0.05, -0.02, 0.0])
def test_offset_is_found(rigs, offset_s):
    found = estimate(seen(offset_s, np.random.default_rng(1), rigs), rigs)
    assert found.sigma_s < 0.005
    assert abs(found.offset_s - offset_s) < 3.5 * found.sigma_s


def test_swaying_makes_no_bias():
    # A straight line through two seconds of it is up to a tenth too slow: 4 ms of these 50.
    rigs = (rig(), rig())
    found = estimate(seen(0.05, np.random.default_rng(1), rigs, noise=0.0), rigs)
    assert found.offset_s == pytest.approx(0.05, abs=5e-4)


def test_stated_sigma_is_true():
    rigs = (rig(), rig())
    off = []
    for seed in range(12):
        found = estimate(seen(0.01, np.random.default_rng(seed), rigs, fixes=100), rigs)
        off.append((found.offset_s - 0.01) / found.sigma_s)
    # The bounds of the chi-square distribution of 12 degrees of freedom, one in a thousand on either side.
    assert 2.2 / 12 < np.mean(np.square(off)) < 32.9 / 12


def test_known_part_of_the_offset_is_taken_out():
    rigs = (rig(), rig())
    rows = seen(0.03, np.random.default_rng(2), rigs)
    assert estimate(rows, rigs, known_s=-0.03).offset_s == pytest.approx(estimate(rows, rigs).offset_s - 0.03, abs=1e-6)


def test_a_resting_pair_tells_nothing():
    rigs = (rig(), rig())
    found = estimate(seen(0.05, np.random.default_rng(3), rigs, moving=0.0), rigs)
    assert found is None or found.sigma_s > 1.0


def test_too_few_fixes_tell_nothing():
    rigs = (rig(), rig())
    assert estimate(seen(0.05, np.random.default_rng(4), rigs, fixes=20), rigs) is None


def test_a_dive_with_a_clock_that_is_off():
    messages, _ = dive_messages(seconds=15, seed=1, clock_offset_ns=50_000_000, range_max_m=3.0)
    core = SolverCore(Settings(skew_sigma_s=0.05), [("a", "b")], align=True)
    for message in messages:
        core.handle(message)
    core.flush()
    found = core.pairs["a", "b"].alignment.estimate()
    assert abs(found.offset_s - 0.05) < 4 * found.sigma_s + 0.005
    corrected = SolverCore(Settings(), [("a", "b")], {"b": ClockCurve.constant(0.05)})
    results = [result for message in messages for result in corrected.handle(message)]
    assert corrected.counts["solved"] >= core.counts["solved"] * 0.9
    # B's pictures were taken 50 ms before A's, and are now known to have been.
    assert all(abs(result.skew_ns - 50_000_000) < 10_000_000 for result in results if hasattr(result, "skew_ns"))
