"""A fixed node that has moved shows it by its own sensors."""

import numpy as np
import pytest
from buddyline.solver_service.geometry.rotation import rotation_exp
from buddyline.solver_service.network.fixed import ON_END, FixedWatch

LEVEL = np.array(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))


def turned(roll_deg=0.0, heading_deg=0.0):
    return rotation_exp(np.radians((0.0, 0.0, heading_deg))) @ rotation_exp(np.radians((roll_deg, 0.0, 0.0))) @ LEVEL


def watched(*said):
    watch = FixedWatch("a", LEVEL)
    return [watch.judge(2.0 * i, R, depth_m) for i, (R, depth_m) in enumerate(said)]


def test_a_node_that_stands_still_is_not_accused():
    """Its frame may be turned against north; its attitude errs by some degrees, and the tide rises slowly."""
    said = [(turned(2.0 * (i % 2), 120.0 + 4.0 * np.sin(i)), 5.0 + 0.0005 * i) for i in range(200)]
    assert not any(watched(*said))


@pytest.mark.parametrize(
    ("after", "fault"),
    [
        ((turned(15.0), 5.0), "tilt"),
        ((turned(0.0, 30.0), 5.0), "heading"),
        ((turned(), 5.5), "depth"),
    ],
)
def test_a_node_that_was_knocked_over_turned_or_sunk_is_named(after, fault):
    found = watched(*[(turned(), 5.0)] * 5, *[after] * ON_END)
    assert not any(found[:-1])
    assert "fixed node a" in found[-1][0]
    assert fault in found[-1][0]


def test_a_moment_is_not_enough_and_no_sensor_tells_nothing():
    assert not any(watched((turned(), 5.0), (turned(20.0), 5.0), (turned(), 5.0), (turned(20.0), 5.0)))
    assert not any(watched(*[(None, None)] * 5))
