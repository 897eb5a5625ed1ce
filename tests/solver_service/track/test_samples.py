"""A node's inertial samples between any two times."""

from __future__ import annotations

import numpy as np
import pytest
from buddyline.solver_service.track.samples import Samples

TIMES_S = np.array((1.0, 1.01, 1.02, 1.03))


@pytest.mark.parametrize(("start_s", "end_s"), [(1.01, 1.01), (1.015, 1.015), (1.02, 1.005), (2.0, 2.0), (0.5, 0.5)])
def test_no_time_and_time_backwards_are_one_interval(start_s: float, end_s: float) -> None:
    samples = Samples()
    samples.add(TIMES_S, np.outer(TIMES_S, np.ones(6)))
    grid, at, told = samples.between(start_s, end_s, known_s=3.0)
    assert grid.tolist() == [start_s, end_s]
    assert at[:, :6] == pytest.approx(np.outer(np.clip(grid, 1.0, 1.03), np.ones(6)))
    assert told.shape == (1,)


def test_the_samples_between_are_points_of_the_grid() -> None:
    samples = Samples()
    samples.add(TIMES_S, np.outer(TIMES_S, np.ones(6)))
    grid, at, told = samples.between(1.005, 1.03, known_s=3.0)
    assert grid.tolist() == [1.005, 1.01, 1.02, 1.03]
    assert at[:, 0] == pytest.approx(grid)
    assert told.all()
