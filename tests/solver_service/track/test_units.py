"""What is wrong with an accelerometer shows by the attitudes, also while a node turns over."""

from __future__ import annotations

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import Floats, rotation_exp
from buddyline.solver_service.track.units import fault_of

LEVEL_FORCE = np.array([0.0, 0.0, -9.81])


def turning(
    turns: float, axis: tuple[float, float, float] = (0.0, 0.0, 1.0), count: int = 200
) -> tuple[Floats, Floats]:
    """Return R_level_camera (N, 3, 3) of a node that turns so often about an axis, and its sound samples (N, 3)."""
    R = rotation_exp(np.linspace(0.0, 2.0 * np.pi * turns, count)[:, None] * np.array(axis))
    R = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) @ R
    noise = np.random.default_rng(1).normal(0.0, 0.3, (count, 3))
    return R, LEVEL_FORCE @ R + noise


@pytest.mark.parametrize("turns", [0.0, 0.25, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_a_node_that_turns_over_has_a_sound_unit(turns: float, axis: tuple[float, float, float]) -> None:
    """In its own axes gravity's mean over a turn is nothing, and over a quarter 45 degrees off the last attitude's."""
    R, force = turning(turns, axis)
    assert fault_of("a", force, R) is None
    assert fault_of("a", force, None) is None


@pytest.mark.parametrize("turns", [0.0, 0.25, 1.0])
def test_a_unit_in_g_and_one_mounted_otherwise_are_named_while_the_node_turns(turns: float) -> None:
    R, force = turning(turns)
    tilted = force @ rotation_exp(np.array([0.0, 0.0, np.pi / 3])).T
    assert "g in place of m/s^2" in (fault_of("a", force / 9.81, R) or "")
    assert "g in place of m/s^2" in (fault_of("a", force / 9.81, None) or "")
    assert "not gravity" in (fault_of("a", 0.2 * force, R) or "")
    assert "60 deg off the attitude's" in (fault_of("a", tilted, R) or "")
