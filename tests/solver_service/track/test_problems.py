"""A problem of a track's input is said while it lasts, and as ended afterwards."""

from dataclasses import replace

import numpy as np
from buddyline.solver_service.track.problems import Problems

from tests.solver_service.track.dives import EPOCH_NS, Setting, filter_of, make


def test_a_problem_that_ended_says_so_and_may_begin_again() -> None:
    problems = Problems()
    problems.report("node a: 1.01 m/s^2: not used", 1.0)
    problems.report("node a: 1.02 m/s^2: not used", 3.0)
    problems.pass_to(7.0)
    assert problems.texts() == ["node a: 1.01 m/s^2: not used"]
    problems.pass_to(9.0)
    assert problems.texts() == ["node a: 1.01 m/s^2: not used (ended)"]
    problems.report("node a: 1.03 m/s^2: not used", 12.0)
    assert problems.texts() == ["node a: 1.03 m/s^2: not used"]


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
