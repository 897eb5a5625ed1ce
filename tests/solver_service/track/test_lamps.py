"""A lamp that is dark for a dive is named in the solver's status; working lamps never are."""

from functools import cache

import numpy as np
import pytest
from buddyline.node.sim.dive import messages
from buddyline.node.sim.scenario import ENVIRONMENTS, DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import LightTruth, NodePose, Truth
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.track.association import Association
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.lamps import LampWatch
from buddyline.solver_service.track.state import SIZE, State
from buddyline.solver_service.track.visible import found_now, learn_found
from buddyline.solver_service.tracking import TrackSettings

from tests.solver_service.track.dives import EPOCH_NS

# More dives of the same kind.
SLOW = pytest.mark.slow


@cache
def simulated(seed, seconds, dead_lamps, inertial):
    scenario = Scenario(
        ENVIRONMENTS[seed % 5], seed=300 + seed, start_ns=EPOCH_NS, dead_lamps=dead_lamps, inertial=inertial
    )
    plan = DivePlan(seconds=seconds, imu=True)
    found = [message for _, _, message in messages(World(scenario), plan)]
    return [message for message in found if not isinstance(message, Truth | LightTruth | NodePose)]


def status_problem(seed, seconds, *dead_lamps, mode="filter", inertial="good"):
    """What the status says at the end of a simulated dive."""
    core = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset((mode,))))
    for message in simulated(seed, seconds, dead_lamps, inertial):
        core.handle(message)
    if mode == "smooth":
        core.flush()
    return core.report(0, 0, 0, [])[0].problem


@pytest.mark.parametrize(
    ("seed", "lamp"),
    [
        (0, "b.left"),
        pytest.param(2, "a.left", marks=SLOW),
        pytest.param(1, "b.right", marks=SLOW),
        pytest.param(3, "b.left", marks=SLOW),
    ],
)
def test_a_dead_lamp_is_named_within_ten_seconds(seed, lamp):
    node, side = lamp.split(".")
    problem = status_problem(seed, 10.0, lamp)
    assert f"{side} lamp of {node} has not been seen for" in problem
    assert problem.count("lamp of") == 1


def test_a_dead_lamp_is_named_within_ten_seconds_by_a_track_that_starts_late():
    """The track starts after 4 s; the pictures of its replay say it."""
    assert "right lamp of a has not been seen for" in status_problem(1719, 10.0, "a.right", inertial="poor")


def test_a_dead_lamp_is_named_offline():
    assert "left lamp of b has not been seen for" in status_problem(0, 10.0, "b.left", mode="smooth")


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3, pytest.param(1, marks=SLOW), pytest.param(2, marks=SLOW)])
def test_lamps_that_work_are_not_named(seed):
    assert "lamp of" not in status_problem(seed, 15.0)


def test_a_lamp_that_comes_back_is_no_longer_named_and_one_false_candidate_hides_no_dead_one():
    watch = LampWatch()
    for k in range(100):
        watch.take(1, 0.1 * k, np.array((0.99 if k == 30 else 0.02, 0.99)))
    [(node, light, duration_s)] = watch.dark()
    assert (node, light) == (1, 0)
    assert duration_s == pytest.approx(9.9)
    for k in range(100, 110):
        watch.take(1, 0.1 * k, np.array((0.99, 0.99)))
    assert watch.dark() == []


def test_a_lamp_of_nobody_is_refused():
    with pytest.raises(BuddylineError, match="dead_lamps: 'c"):
        Scenario(dead_lamps=("c.left",))


def looked(pictures, first=0.8, second=0.8, *, ambiguous=False):
    """What node a has learned at 10 Hz, from 0.1 s on: by what is seen of each light, and how likely it is in view.

    ambiguous: whether a candidate may well be either light in each picture.
    """
    state = State.at_rest(np.zeros(3), np.stack((np.eye(3), np.eye(3))))
    told = Estimate(0.0, state, np.eye(SIZE), 0.0, confirmed=True, detection=np.array(((first, second), (0.8, 0.8))))
    for k, (seen, within) in enumerate(pictures):
        t_s = 0.1 * (k + 1)
        learn_found(
            told,
            0,
            t_s,
            found_now(told, 0, t_s),
            np.array(within, float),
            Association((), np.array(seen), 0.0, ambiguous),
        )
    return told, 0.1 * len(pictures)


def test_a_lamp_that_is_known_to_be_dark_stays_so_and_others_are_learned():
    told, now_s = looked([((1.0, 1.0), (True, True)), ((0.0, 1.0), (True, True))], 0.0, 0.5)
    assert told.detection[0, 0] == 0.0
    assert found_now(told, 0, now_s)[0] == 0.0
    assert told.detection[0, 1] > 0.5
    assert (told.detection[1] == 0.8).all()
    told, _ = looked([((0.0, 0.0), (False, False))], 0.0, 0.5)
    assert told.detection[0].tolist() == [0.0, 0.5]


IN_VIEW, HIDDEN = ((1.0, 1.0), (True, True)), ((0.0, 1.0), (True, True))


@pytest.mark.parametrize(
    ("pictures", "next_s", "least", "most"),
    [
        ([IN_VIEW] * 40, 0.1, 0.95, 0.98),
        # One picture may have missed it.
        ([IN_VIEW] * 40 + [HIDDEN], 0.1, 0.4, 0.7),
        ([IN_VIEW] * 40 + [HIDDEN] * 3, 0.1, 0.0, 0.2),
        ([IN_VIEW] * 40 + [HIDDEN] * 3, 5.0, 0.8, 0.9),
        # It may as well be outside of these pictures.
        ([IN_VIEW] * 40 + [((0.0, 1.0), (0.5, 1.0))] * 3, 0.1, 0.85, 0.97),
        # Hidden as often as in view, and in view just now.
        (([HIDDEN] * 10 + [IN_VIEW] * 10) * 3, 0.1, 0.9, 0.98),
        (([HIDDEN] * 10 + [IN_VIEW] * 10) * 3, 5.0, 0.3, 0.8),
    ],
)
def test_a_lamp_that_is_hidden_or_in_view_mostly_stays_so(pictures, next_s, least, most):
    """Else a false candidate in a hidden one's place is taken for it, and one lamp of a bar for the other."""
    told, now_s = looked(pictures)
    assert least < found_now(told, 0, now_s + next_s)[0] < most
    assert found_now(told, 0, now_s + next_s)[1] == pytest.approx(0.96, abs=0.02)


def test_which_of_two_lamps_is_hidden_is_not_learned_from_one_that_may_be_either():
    """Such pictures have a cause in common: each would add to the same doubt."""
    doubt = [((0.4, 0.6), (True, True))] * 20
    told, now_s = looked(doubt, ambiguous=True)
    assert found_now(told, 0, now_s).tolist() == pytest.approx([0.8, 0.8])
    assert told.shown_s[0] == pytest.approx(now_s)
    told, now_s = looked(doubt, ambiguous=False)
    assert found_now(told, 0, now_s).tolist() == pytest.approx([0.4, 0.6], abs=0.05)
