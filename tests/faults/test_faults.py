"""One of the faults among the slow tests; all of them, twenty times each, by `python -m tests.faults`."""

import pytest

from tests.faults.scenarios import solver


@pytest.mark.slow
def test_a_solver_that_is_killed_and_back_answers_every_trigger_once():
    tally = solver(1).tally
    assert tally.triggers > 10
    assert (tally.lost, tally.duplicated, tally.disordered) == (0, 0, 0)
    assert (tally.without_outcome, tally.outcomes_doubled) == (0, 0)
