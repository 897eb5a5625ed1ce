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


MOST = 1.7e308
CANCELS = np.array(((1.0, -1.0, 0.0), (1.0, -1.0, 0.0), (0.0, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("t_m", "position", "sigma_m"),
    [
        ((0.0, 0.0, 1e200), 1e-4 * np.eye(3), 0.01),
        ((MOST, MOST, MOST), 1e-4 * np.eye(3), 0.01),
        ((0.0, 0.0, 3.0), 1e300 * np.eye(3), 1e150),
        ((1.0, 1.0, 1.0), np.full((3, 3), 1e308), math.sqrt(3.0) * 1e154),
        ((1.0, 1.0, 1.0), MOST * CANCELS, 0.0),
        ((0.0, 0.0, 0.0), 1e-4 * np.eye(3), 0.0),
        ((0.0, 0.0, 3.0), np.zeros((3, 3)), 0.0),
    ],
)
def test_absurd_numbers_give_a_number(t_m: tuple[float, float, float], position: np.ndarray, sigma_m: float) -> None:
    absurd = replace(pose(0, covariance=covariance(position)), t_a_b_m=t_m)
    assert range_sigma_m(absurd) == pytest.approx(sigma_m)
