"""A problem of a track's input is said while it lasts, and as ended afterwards."""

from dataclasses import replace

import numpy as np
from buddyline.solver_service.track.dive import smooth
from buddyline.solver_service.track.problems import Problems, merged

from tests.solver_service.track.dives import EPOCH_NS, Setting, filter_of, make


def test_a_problem_that_ended_says_so_and_may_begin_again() -> None:
    problems = Problems()
    problems.report("node a: 1.01 m/s^2: not used", 1.0)
    problems.report("node a: 1.02 m/s^2: not used", 3.0)
    problems.pass_to(7.0)
    assert problems.texts() == ["node a: 1.02 m/s^2: not used"]
    problems.pass_to(9.0)
    assert problems.texts() == ["node a: 1.02 m/s^2: not used (ended)"]
    problems.report("node a: 1.03 m/s^2: not used", 12.0)
    assert problems.texts() == ["node a: 1.03 m/s^2: not used"]


def test_problems_that_differ_by_figures_are_one_with_the_newest() -> None:
    """Node ids may have digits: these are of two nodes."""
    problems = Problems()
    for k, size in enumerate((1010.67, 1009.94, -3.1, 12.0)):
        for node in ("a1", "a2"):
            problems.report(f"node {node}: the accelerometer shows {size:.2f} m/s^2, not gravity; not used", 2.0 * k)
    problems.report("node a1: the accelerometer shows 9.99 m/s^2, not gravity; not used", 1.0)
    said = [f"node {node}: the accelerometer shows 12.00 m/s^2, not gravity; not used" for node in ("a1", "a2")]
    assert problems.texts() == said
    problems.pass_to(20.0)
    assert problems.texts() == [f"{one} (ended)" for one in said]


def test_of_problems_of_several_tracks_the_last_of_each_kind_is_kept() -> None:
    said = ["node a: 1.01 m/s^2: not used (ended)", "node b: 1.02 m/s^2: not used", "node a: 1.03 m/s^2: not used"]
    assert merged(said) == [said[2], said[1]]
    assert merged([said[2], said[0]]) == [said[0]]


def test_a_problem_at_the_end_of_a_dive_s_first_track_has_ended_at_the_dive_s_end() -> None:
    """Where a unit turns to g, the mean passes through what is neither, and one track ends and another begins."""
    dive = make(3, Setting(seconds=12.0))
    a, b = dive.records
    late = b.imu_stamps_ns > EPOCH_NS + 4_000_000_000
    turning = replace(b, accel_mps2=np.where(late[:, None], b.accel_mps2 / 9.80665, b.accel_mps2))
    found = smooth((a, turning), dive.fixes, dive.stamps_ns)
    passing, lasting = (one for one in merged(found.problems) if "the accelerometer" in one)
    assert "not gravity" in passing
    assert passing.endswith("(ended)")
    assert lasting.endswith("g in place of m/s^2; not used")


def test_a_unit_that_is_well_again_is_said_to_be() -> None:
    dive = make(3, Setting(seconds=18.0))
    a, b = dive.records
    early = b.imu_stamps_ns < EPOCH_NS + 8_000_000_000
    in_g = np.where(early[:, None], b.accel_mps2 / 9.80665, b.accel_mps2)
    track = filter_of((a, replace(b, accel_mps2=in_g)), dive.fixes)
    track.advance(EPOCH_NS + 7_000_000_000)
    [problem] = track.problems
    assert "g in place of m/s^2" in problem
    assert not problem.endswith("(ended)")
    track.advance(EPOCH_NS + 18_000_000_000)
    assert all(problem.endswith("(ended)") for problem in track.problems)
    assert any("g in place of m/s^2" in problem for problem in track.problems)
