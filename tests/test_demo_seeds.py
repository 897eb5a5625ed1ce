"""The demo's dives without processes: poses and tracks are right, and wrong ones are counted."""

from dataclasses import replace

from buddyline.node.sim.scenario import ENVIRONMENTS, Scenario
from buddyline.node.sim.world import World

from tests.demo_seeds import START_NS, dives, judged, swum, told_track


def test_nothing_is_wrong_in_a_dive_of_the_demo_but_much_against_anothers_truth():
    scenario = Scenario(environment="day_reef", seed=4, start_ns=START_NS)
    outcomes = swum(World(scenario), 2.0)
    dive = judged(World(scenario), outcomes)
    assert dive.poses >= 15
    assert set(dive.tracks) == {"filter", "lag", "smooth"}
    assert min(figures.samples for figures in dive.tracks.values()) >= 20
    assert dive.wrong == 0
    other = judged(World(replace(scenario, seed=6)), outcomes)
    assert other.wrong_poses == other.poses
    assert all(figures.wrong == figures.samples for figures in other.tracks.values())
    lag = other.tracks["lag"]
    assert told_track([lag, lag]).startswith(f"{2 * lag.wrong} of {2 * lag.samples} (")
    assert told_track([lag, lag]).endswith(f"NEES/6 {lag.nees6.mean / 6:.2f})")


def test_each_seed_comes_in_one_water_first_then_in_the_others():
    found = list(dives(1, 10, 5))
    assert len(set(found)) == 50
    assert {seed for seed, _ in found[:10]} == set(range(1, 11))
    assert {environment for _, environment in found[:5]} == set(ENVIRONMENTS)
