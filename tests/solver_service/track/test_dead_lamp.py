"""A lamp that is dark for a whole dive: a track from the other three lights, never a wrong one."""

from dataclasses import replace

import numpy as np
import pytest
from buddyline.node.sim.dive import messages
from buddyline.node.sim.scenario import ENVIRONMENTS, DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.messages import LightTruth, NodePose, Track, TrackMode, Truth
from buddyline.solver_service.core import SolverCore
from buddyline.solver_service.geometry.trigger import Settings
from buddyline.solver_service.track import filter
from buddyline.solver_service.track.between import rows_between
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.estimate import Estimate
from buddyline.solver_service.track.inputs import FixSeen
from buddyline.solver_service.track.records import last_ns
from buddyline.solver_service.track.smoother import smoothed
from buddyline.solver_service.track.start import constants_of
from buddyline.solver_service.tracking import TrackSettings

from tests.solver_service.track.dives import EPOCH_NS, KnownDive, Setting, filter_of, make, score

LAMPS = ((1, 0), (1, 1), (0, 0), (0, 1))


def dead_lamp_dive(seed: int, lamp: tuple[int, int], seconds: float) -> KnownDive:
    """A dive that lacks a lamp; its `fixes`, for the scores' span, are those that it would have with it."""
    setting = Setting(seconds=seconds, dead=(lamp,))
    return replace(make(seed, setting), fixes=make(seed, replace(setting, dead=())).fixes)


@pytest.mark.slow
def test_the_live_track_is_honest_from_its_start_on() -> None:
    judged = []
    for seed, lamp in enumerate(LAMPS):
        dive = dead_lamp_dive(40 + seed, lamp, 20.0)
        rows = filter_of(dive.records, ()).advance(last_ns(dive.records), dive.stamps_ns)
        judged.append(score(dive, rows))
    assert sum(one.wrong for one in judged) == 0
    assert np.mean([one.covered for one in judged]) > 0.4
    assert np.mean([one.nees for one in judged]) < 2.0


def test_a_smoothed_track_begins_with_the_dive_not_with_its_start() -> None:
    dive = dead_lamp_dive(41, LAMPS[1], 14.0)
    rows = list(smooth(dive.records, (), dive.stamps_ns).rows)
    judged = score(dive, rows)
    assert rows[0].stamp_ns - dive.stamps_ns[0] < 500_000_000
    assert judged.wrong == 0
    assert judged.covered > 0.95
    assert judged.nees < 2.0


def test_one_wrong_fix_replaces_no_track() -> None:
    """Another diver's lamp in place of a dark one: the fix is wrong, and fits for a while."""
    dive = dead_lamp_dive(40, LAMPS[0], 14.0)
    k = int(np.searchsorted(dive.stamps_ns, dive.stamps_ns[0] + 6_000_000_000))
    wrong = FixSeen(dive.stamps_ns[k], 1.3 * dive.t_a_b_m[k], dive.R_a_b[k], 1e-4 * np.eye(6))
    rows = filter_of(dive.records, (wrong,)).advance(last_ns(dive.records), dive.stamps_ns)
    judged = score(dive, rows)
    assert judged.wrong == 0
    assert judged.covered > 0.4


def simulated(scenario: Scenario, seconds: float, mode: TrackMode = "smooth") -> tuple[int, float]:
    """Solve a dive of the simulator; return how many rows are wrong, and the share of its time that is covered."""
    world = World(scenario)
    core = SolverCore(Settings(), [("a", "b")], track=TrackSettings(frozenset((mode,))))
    told = [
        one
        for _, _, message in messages(world, DivePlan(seconds=seconds, imu=True))
        if not isinstance(message, Truth | LightTruth | NodePose)
        for one in core.handle(message)
    ]
    tracks = [one for one in told + core.flush() if isinstance(one, Track)]
    sigma_m = np.sqrt([one.covariance[0] + one.covariance[7] + one.covariance[14] for one in tracks])
    off_m = np.array([np.subtract(one.t_a_b_m, world.truth(one.stamp_ns, 0).t_a_b_m) for one in tracks]).reshape(-1, 3)
    range_m = np.array([one.range_m for one in tracks])
    wrong = int(((np.linalg.norm(off_m, axis=1) - 3.0 * sigma_m) > 0.1 * range_m).sum())
    return wrong, float((sigma_m < 0.05 * range_m).sum() / (seconds * 20.0))


@pytest.mark.slow
def test_a_track_that_is_replaced_and_that_no_fix_agreed_with_leaves_no_rows() -> None:
    """The first start takes the wrong lamp of a bar; the right one replaces it seconds later."""
    wrong, share = simulated(
        Scenario("lake", seed=2002, start_ns=EPOCH_NS, inertial="poor", dead_lamps=("a.left",)), 16.0
    )
    assert wrong == 0
    assert share > 0.8


def test_a_younger_start_that_explains_the_pictures_better_replaces_a_live_track() -> None:
    """The older one has drifted off when it is confirmed: what it explained before the younger one began is no lead."""
    wrong, share = simulated(
        Scenario("night_reef", seed=2006, start_ns=EPOCH_NS, inertial="poor", dead_lamps=("a.left",)), 12.0, "filter"
    )
    assert wrong == 0
    assert share > 0.3


def test_the_replay_of_a_start_decides_the_lights_again() -> None:
    """Lights that are left out because a start has drifted off leave too little for a replay with the others."""
    wrong, share = simulated(
        Scenario("lake", seed=2147, start_ns=EPOCH_NS, inertial="poor", dead_lamps=("a.right",)), 12.0, "filter"
    )
    assert wrong == 0
    assert share > 0.15


def test_the_age_of_the_lights_is_known_before_the_first_is_used() -> None:
    """A replay may leave out the lights of its own start; then there is a row before any light."""
    dive = make(40, Setting(seconds=2.0))
    track = filter_of(dive.records, ())
    state, variances = constants_of(track.nodes, np.stack((np.eye(3), dive.R_a_b[0])), dive.t_a_b_m[0])
    estimate = Estimate(1.0, state, np.diag(variances), 1.0)
    track._open(estimate)
    track._step(estimate, 1.05, None)
    (row,) = rows_between(smoothed(estimate.steps), np.array((1.02,)), [EPOCH_NS])
    assert row.age_s == pytest.approx(0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "told_at_once"), [(9301, False), (9301, True), (9321, False)])
def test_a_lamp_and_its_reflection_are_no_bar(monkeypatch: pytest.MonkeyPatch, seed: int, told_at_once: bool) -> None:
    """Each node has a dark lamp. For some seconds what is lit looks like a whole bar: 6 m off, stated as 4 cm."""
    water = ("cavern", "basin", "lake")[seed % 3]
    dead = ("a.left", "b.right")
    scenario = Scenario(water, seed=seed, start_ns=EPOCH_NS, inertial="poor", dead_lamps=dead)
    if told_at_once:
        monkeypatch.setattr(filter, "LATE_BARS", 0)
    wrong, share = simulated(scenario, 60.0, "filter")
    assert (wrong > 0) == (share > 0.0) == told_at_once


@pytest.mark.slow
def test_a_young_start_that_follows_single_lights_is_not_told() -> None:
    """It was confirmed by seven pictures with both lights; then its range drifts off by a third at a sigma of 6 %."""
    wrong, share = simulated(
        Scenario("lake", seed=2132, start_ns=EPOCH_NS, inertial="poor", dead_lamps=("b.left",)), 14.0, "filter"
    )
    assert wrong == 0
    assert share > 0.05


@pytest.mark.slow
def test_a_start_with_both_compasses_off_takes_the_lamp_that_is_lit() -> None:
    """Their headings are 17 degrees apart: the dark lamp was nearer to where one linear step put the lit one."""
    scenario = Scenario(ENVIRONMENTS[0], seed=1015, start_ns=EPOCH_NS, inertial="poor", dead_lamps=("a.right",))
    wrong, share = simulated(scenario, 40.0, "filter")
    assert wrong == 0
    assert share > 0.7


@pytest.mark.slow
def test_a_second_pass_that_the_dive_s_beginning_leads_astray_begins_with_the_first_pass() -> None:
    """The first start is 11 s late, and what is carried back from it is off by half the range: there was no row."""
    wrong, share = simulated(
        Scenario(ENVIRONMENTS[1], seed=2011, start_ns=EPOCH_NS, inertial="poor", dead_lamps=("a.right",)), 40.0
    )
    assert wrong == 0
    assert share > 0.6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "lamp", "least"), [(2018, "a.left", 0.3), (2018, "b.right", 0.9), (2004, "b.right", 0.9)]
)
def test_a_late_start_that_is_carried_back_is_passed_over_until_it_stays(seed: int, lamp: str, least: float) -> None:
    """The first dive's first start is 7 s late. Carried back, it settles at a false path, with 5 wrong rows.

    That path is 15 sigmas off the one that is not carried back, which is told.
    """
    scenario = Scenario(
        ENVIRONMENTS[3], seed=seed, start_ns=EPOCH_NS, inertial="poor", dead_lamps=(lamp,), stamp_sigma_ns=0
    )
    wrong, share = simulated(scenario, 13.0)
    assert wrong == 0
    assert share > least


@pytest.mark.slow
def test_twenty_dives_with_a_dark_lamp() -> None:
    judged = []
    for seed in range(20):
        lamp = ("b.left", "b.right", "a.left", "a.right")[seed % 4]
        scenario = Scenario(ENVIRONMENTS[seed % 5], seed=1000 + seed, start_ns=EPOCH_NS, dead_lamps=(lamp,))
        judged.append(simulated(scenario, 40.0))
    assert sum(wrong for wrong, _ in judged) == 0
    assert min(share for _, share in judged) > 0.95


@pytest.mark.slow
@pytest.mark.parametrize(("environment", "seed", "dead"), [(1, 3001, ("b.left", "a.right"))])
def test_one_lamp_each_is_enough_for_a_whole_dive(environment: int, seed: int, dead: tuple[str, str]) -> None:
    """Nothing tells the range in any one picture, nor which lamps are lit."""
    scenario = Scenario(ENVIRONMENTS[environment], seed=seed, start_ns=EPOCH_NS, inertial="poor", dead_lamps=dead)
    wrong, share = simulated(scenario, 40.0)
    assert wrong == 0
    assert share > 0.8
