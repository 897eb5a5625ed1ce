"""A third party's bar gives no pose. Steel beside a compass costs those of two seconds, a compass far off more."""

import math

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import RelativePose
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.compasses import (
    Contradiction,
    HeadingGap,
    compare_headings,
    north_doubt,
    wrong_compass,
)
from buddyline.solver_service.geometry.observation import Heading
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.witness import FEWEST, MOST, Witnesses

from tests.solver_service.conftest import dive_messages
from tests.solver_service.strangers import messages_of, outcome, strangers_dive
from tests.solver_service.test_headings import turned
from tests.solver_service.third_bar import is_wrong, third_bar_dive
from tests.solver_service.track.dives import Setting

# Of both headings' difference, by what they say of themselves; of a pose; of what has been learned.
SENSORS, POSE, LEARNED = math.radians(7.0) ** 2, math.radians(1.0) ** 2, math.radians(5.0) ** 2


def judged(gap_deg, learned_deg=None, *, follows=False):
    learned = None if learned_deg is None else Heading(math.radians(learned_deg), LEARNED)
    found = compare_headings(math.radians(gap_deg), POSE, 0.0, SENSORS, learned, follows=follows)
    return found.agrees, found.contradicts


@pytest.mark.parametrize("sign", [-1, 1])
def test_what_two_compasses_can_explain(sign):
    agrees, neither, contradicts = (True, False), (False, False), (False, True)
    assert judged(15 * sign) == agrees
    # Steel beside one of them, or strangers' lamps: what follows will tell.
    assert judged(20 * sign) == contradicts
    assert judged(40 * sign) == contradicts
    assert judged(156 * sign) == contradicts
    # A pose agrees with what was learned, or with the compasses as they are, at the next station.
    assert judged(80 * sign, 82 * sign) == agrees
    assert judged(92 * sign, 82 * sign) == agrees
    assert judged(15 * sign, 82 * sign) == agrees
    # One that agrees with neither is believed only if it follows from earlier poses.
    assert judged(80 * sign, 0) == contradicts
    assert judged(80 * sign, 0, follows=True) == neither
    assert judged(175 * sign, 90 * sign, follows=True) == contradicts


# A bar that is seen from directions so near each other that noise does not bring the gap below the bound.
@pytest.mark.parametrize(
    ("compass_deg", "apart_deg"), [(3, 10), (3, 25), (3, 60), (6, 10), (6, 40), (10, 10), (10, 25)]
)
def test_a_third_partys_bar_gives_no_pose(compass_deg, apart_deg):
    reasons = []
    for seed, range_m in enumerate((2.5, 4.0, 6.0, 9.0)):
        messages, truths = third_bar_dive(seed, range_m, apart_deg, compass_deg, dead_lamp=(None, 0, 1)[seed % 3])
        core = SolverCore(Settings(), [("b", "c")])
        for found in core.handle_many(messages) + core.flush():
            if isinstance(found, RelativePose):
                assert not is_wrong(found, truths[found.trigger]), (seed, found)
            else:
                reasons.append(found.reason)
    # Farther apart, a pair finds four lights so seldom that chance explains them before any compass is asked.
    assert apart_deg >= 60 or "other_lights" in reasons


def test_a_third_partys_bar_gives_no_pose_before_headings_are_learned():
    """Their compasses are 60 to 100 degrees off what facing each other takes: as far as steel may deflect one."""
    asked = 0
    for seed, apart_deg, kind in ((0, 90, "third"), (2, 105, "third"), (1, 80, "third_goes"), (3, 120, "third_goes")):
        setting = Setting(seconds=8.0, rate_hz=5.0)
        dive = strangers_dive(seed, kind, setting, apart_deg)
        found = outcome(dive, messages_of(dive, setting), modes=())
        assert found.poses == 0
        asked += found.reasons.get("heading", 0)
    assert asked > 0


@pytest.mark.parametrize(
    ("gap_deg", "scatter_deg", "steel"), [(20, 3, True), (-25, 3, True), (40, 3, False), (0, 12, False)]
)
def test_what_stays_at_a_rest_is_taken_for_steel(gap_deg, scatter_deg, steel):
    told = at_rest(5, 2 * 5, gap_deg, scatter_deg)
    assert not any(told[:-1])
    assert (told[-1] is not None) == steel
    if told[-1]:
        assert math.degrees(told[-1].offset_rad) == pytest.approx(gap_deg, abs=3.0)


@pytest.mark.parametrize(("rate_hz", "needed"), [(1, FEWEST), (2, FEWEST), (4, 8), (10, MOST), (20, MOST)])
def test_as_many_witnesses_are_needed_as_two_seconds_have_triggers(rate_hz, needed):
    told = at_rest(rate_hz, MOST + 1, 20, 3)
    assert [k for k, one in enumerate(told, start=1) if one] == list(range(needed, MOST + 2))


def test_after_a_pause_no_fewer_witnesses_are_needed():
    told = at_rest(10, MOST + 1, 20, 3, pause_s=20)
    assert [k for k, one in enumerate(told, start=1) if one] == [MOST, MOST + 1]


def test_north_is_doubtful_as_compasses_contradict_each_other():
    variances, of_pose = np.array((0.05**2, 0.1**2)), np.diag((0.0, 0.01**2))
    weights = variances[::-1] / variances.sum()
    # Within what they state, nothing is doubtful.
    assert north_doubt(np.array((0.0, 0.1)), variances, of_pose) == 0.0
    # Of their weighted mean, it is what Birge's ratio makes of it.
    off_rad = 0.4 * np.array((-weights[1], weights[0]))
    mean_variance = variances.prod() / variances.sum()
    birge = mean_variance * 0.4**2 / variances.sum()
    assert north_doubt(off_rad, variances, np.zeros((2, 2))) == pytest.approx(birge - mean_variance)
    # How well all headings are known together does not count.
    of_all = np.full((2, 2), 0.3**2)
    assert north_doubt(off_rad, variances, of_all) == pytest.approx(birge - mean_variance)


@pytest.mark.parametrize(("nodes", "wrong"), [(1, 0), (2, 1), (3, 1), (4, 1), (4, 2)])
def test_north_errs_as_stated_whichever_compass_is_off(nodes, wrong):
    rng = np.random.default_rng(4)
    sigma_rad, squares, named = math.radians(4.0), [], []
    variances = np.full(nodes, sigma_rad**2)
    for off in rng.choice((-1.0, 1.0), 2000) * math.radians(25.0):
        compasses = sigma_rad * rng.standard_normal(nodes)
        which = rng.permutation(nodes)[:wrong]
        compasses[which] += off
        # As a pose tells it, by A's compass, and as a track or a network does, by the mean of all.
        for north, told in ((compasses[0], sigma_rad**2), (compasses.mean(), sigma_rad**2 / nodes)):
            doubt = north_doubt(compasses - north, variances, np.zeros((nodes, nodes)))
            squares.append(north**2 / (told + doubt))
        found = wrong_compass(compasses, variances, np.zeros((nodes, nodes)))
        named.append(None if found is None else found[0] in which)
    by_one, by_mean = np.reshape(squares, (-1, 2)).mean(axis=0)
    # Where half of four are off alike, nothing tells it.
    assert 0.6 < by_one < (2.0 if wrong == 2 else 1.3)
    assert 0.7 < by_mean < (2.5 if wrong == 2 else 1.4)
    # By a majority one is named, and hardly ever a sound one.
    told = wrong == 1 and nodes > 2
    assert (named.count(True) > 1500) == told
    assert named.count(None) > 1900 or told
    assert named.count(False) < 40


def at_rest(rate_hz, count, gap_deg, scatter_deg, pause_s=0):
    """What so many triggers of nodes that do not move have witnessed, one after another; a pause after the third."""
    witnesses, told = Witnesses(), []
    for k, off_deg in enumerate(np.random.default_rng(3).normal(gap_deg, scatter_deg, count)):
        gap = HeadingGap(math.radians(off_deg), 1e-4, 0.5, agrees=False, contradicts=True)
        stamp_ns = k * S_NS // rate_hz + (pause_s * S_NS if k >= 3 else 0)
        told.append(witnesses.take(stamp_ns, Contradiction(gap, 4.0)))
    return told


@pytest.mark.parametrize("off_deg", [-80, 45])
def test_the_motion_shows_that_a_compass_is_off(off_deg):
    setting = Setting(seconds=24.0, rate_hz=5.0)
    dive = strangers_dive(4, "none", setting)
    found = outcome(dive, messages_of(dive, setting, math.radians(off_deg)), modes=())
    assert found.wrong_poses == 0
    assert found.poses > 20
    assert found.reasons["heading"] >= 10


def test_the_gap_to_a_compass_far_off_is_published():
    core = SolverCore(Settings(), [("a", "b")])
    messages, _ = dive_messages(seconds=20.0, seed=11)
    found = core.handle_many(map(turned, messages)) + core.flush()
    poses = [one for one in found if isinstance(one, RelativePose)]
    assert len(poses) > 40
    assert all(abs(math.degrees(one.heading_gap_rad) + 80.0) < 30.0 for one in poses)
    assert sum("heading" in one.checks for one in poses) > 0.95 * len(poses)
