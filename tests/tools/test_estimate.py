"""Uncertainties of an estimate, in words of one number."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buddyline.tools.estimate import range_sigma_m
from msgspec.structs import replace

from tests.tools.evaluated import pose


def covariance(position: np.ndarray) -> list[float]:
    whole = np.eye(6)
    whole[:3, :3] = position
    return [float(value) for value in whole.ravel()]


def test_the_ranges_sigma_is_the_positions_along_the_line_of_sight() -> None:
    along = np.array((2.0, -1.0, 2.0)) / 3.0
    position = 0.01**2 * np.eye(3) + (0.05**2 - 0.01**2) * np.outer(along, along)
    for range_m in (0.5, 3.0, 12.0):
        there = tuple(float(value) for value in range_m * along)
        assert range_sigma_m(pose(0, there, covariance=covariance(position))) == pytest.approx(0.05)


@pytest.mark.parametrize(("far_m", "variance"), [(1e200, 1e-4), (1e-200, 1e-4), (3.0, 1e300), (0.0, 1e-4)])
def test_absurd_numbers_give_a_number(far_m: float, variance: float) -> None:
    absurd = replace(pose(0, covariance=covariance(variance * np.eye(3))), t_a_b_m=(0.0, 0.0, far_m))
    sigma_m = range_sigma_m(absurd)
    assert math.isfinite(sigma_m)
    assert far_m < 1e-9 or sigma_m == pytest.approx(math.sqrt(variance))
