"""Where fixed nodes would see another well."""

import math

import numpy as np
import pytest
from buddyline.protocol.messages import FixedPlace
from buddyline.tools.draw.volume import draw_seen_volume, seen_volume
from buddyline.tools.plan import described, expected
from msgspec.structs import replace


def fixed_at(north_m, east_m, heading_deg, node="a"):
    """A node at 2 m depth that looks along a heading."""
    half = math.radians(heading_deg) / 2
    s, c = math.sin(half), math.cos(half)
    # Turned about the vertical, after the camera's axes to north-east-down.
    q = (0.5 * (c - s), 0.5 * (c + s), 0.5 * (c + s), 0.5 * (c - s))
    place = FixedPlace(p_m=(north_m, east_m, 2.0), q_xyzw=q)
    return replace(described(None), node=node, fixed=place)


def at(volume, north_m, east_m):
    i = int(np.abs(volume.north_m - north_m).argmin())
    return volume.sigma_m[i, int(np.abs(volume.east_m - east_m).argmin())]


AREA_M = np.array([[-2.0, -4.0, 2.0], [8.0, 4.0, 2.0]])
ONE = {"a": fixed_at(0.0, 0.0, 0.0)}


@pytest.fixture(scope="module")
def of_one():
    return seen_volume(ONE, described(None), AREA_M)


def test_one_node_sees_ahead_and_worse_far_away(of_one):
    volume = of_one
    assert at(volume, 3.0, 0.0) < at(volume, 6.0, 0.0) < 0.1
    # Behind it, and beside its picture of 49 degrees, nothing is seen.
    assert np.isnan(at(volume, -2.0, 0.0))
    assert np.isnan(at(volume, 2.0, 3.5))
    assert 0.1 < volume.share(0.1) < 0.6
    assert len(draw_seen_volume(volume, ONE).axes) == 2


def test_it_is_the_bound_that_plan_has(of_one):
    """Of two nodes that face each other; plan's has small turns of them in it."""
    (position_m,) = expected(described(None), 0.7, np.array([5.0]))[:, 1]
    assert 0.5 < at(of_one, 5.0, 0.0) * math.sqrt(3.0) / position_m < 1.5


@pytest.mark.slow
def test_a_second_node_helps_where_it_looks(of_one):
    two = ONE | {"b": fixed_at(5.0, -4.0, 90.0, "b")}
    both = seen_volume(two, described(None), AREA_M)
    assert at(both, 5.0, 0.0) < 0.7 * at(of_one, 5.0, 0.0)
    assert both.share(0.1) > of_one.share(0.1)
