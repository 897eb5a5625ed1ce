"""What `tests.net_figures` tells the network of each grade of units; `python -m tests.net_figures` takes minutes."""

import pytest
from buddyline.node.sim.inertial import GRADES
from buddyline.solver_service.network import shaking, state

from tests.net_figures import told


def sigmas():
    return state.LEVER_TOLD_M, shaking.SHAKE_RAD


@pytest.mark.parametrize("name", GRADES)
def test_the_simulators_own_sigmas_are_told_and_taken_back(name):
    lever_m, shake_rad = before = sigmas()
    grade = GRADES[name]
    with told(grade):
        assert sigmas() == (grade.lever_sigma_m, shake_rad if grade.shake_radps else 1e-6)
    assert lever_m != grade.lever_sigma_m
    assert sigmas() == before
