"""A third party's bar gives no pose; a compass that is far off costs none."""

import math

import pytest
from buddyline.protocol.messages import RelativePose
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.compasses import compare_headings
from buddyline.solver_service.geometry.observation import Heading
from buddyline.solver_service.geometry.trigger import Settings

from tests.solver_service.conftest import dive_messages
from tests.solver_service.test_headings import turned
from tests.solver_service.third_bar import is_wrong, third_bar_dive

# Of both headings' difference, by what they say of themselves; of a pose; of what has been learned.
SENSORS, POSE, LEARNED = math.radians(7.0) ** 2, math.radians(1.0) ** 2, math.radians(5.0) ** 2


def judged(gap_deg, learned_deg=None, *, follows=False):
    learned = None if learned_deg is None else Heading(math.radians(learned_deg), LEARNED)
    found = compare_headings(math.radians(gap_deg), POSE, SENSORS, learned, follows=follows)
    return found.agrees, found.contradicts


@pytest.mark.parametrize("sign", [-1, 1])
def test_what_two_compasses_can_explain(sign):
    agrees, neither, contradicts = (True, False), (False, False), (False, True)
    assert judged(20 * sign) == agrees
    # Steel beside one of them, about which nothing is known yet.
    assert judged(80 * sign) == neither
    assert judged(156 * sign) == contradicts
    # Learned: it may be believed, and is not left at once.
    assert judged(80 * sign, 82 * sign) == agrees
    assert judged(95 * sign, 82 * sign) == agrees
    assert judged(80 * sign, 0) == contradicts
    assert judged(80 * sign, 0, follows=True) == neither
    assert judged(175 * sign, 90 * sign, follows=True) == contradicts
    # What the compasses say themselves is never held against a pose.
    assert judged(0, 90 * sign) == agrees


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
    assert apart_deg >= 60 or "heading" in reasons


def test_a_compass_far_off_costs_no_pose_and_the_gap_is_published():
    counts = []
    for off in (False, True):
        core = SolverCore(Settings(), [("a", "b")])
        messages, _ = dive_messages(seconds=8.0, seed=11)
        found = core.handle_many([turned(m) if off else m for m in messages]) + core.flush()
        poses = [one for one in found if isinstance(one, RelativePose)]
        counts.append(len(poses))
        late = poses[10:]
        assert all(abs(math.degrees(one.heading_gap_rad) + 80.0 * off) < 30.0 for one in poses)
        assert sum("heading" in one.checks for one in late) > 0.95 * len(late)
    assert counts[0] > 40
    assert counts[1] >= counts[0] - 1
