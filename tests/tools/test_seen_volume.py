"""Where fixed nodes would see another well."""

import math

import numpy as np
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


def test_one_node_sees_ahead_and_worse_far_away():
    fixed = {"a": fixed_at(0.0, 0.0, 0.0)}
    volume = seen_volume(fixed, described(None), AREA_M)
    assert at(volume, 3.0, 0.0) < at(volume, 6.0, 0.0) < 0.1
    # Behind it, and beside its picture of 49 degrees, nothing is seen.
    assert np.isnan(at(volume, -2.0, 0.0))
    assert np.isnan(at(volume, 2.0, 3.5))
    assert 0.1 < volume.share(0.1) < 0.6
    assert len(draw_seen_volume(volume, fixed).axes) == 2


def test_it_is_the_bound_that_plan_has():
    """Of two nodes that face each other; plan's has small turns of them in it."""
    volume = seen_volume({"a": fixed_at(0.0, 0.0, 0.0)}, described(None), AREA_M)
    (position_m,) = expected(described(None), 0.7, np.array([5.0]))[:, 1]
    assert 0.5 < at(volume, 5.0, 0.0) * math.sqrt(3.0) / position_m < 1.5


def test_a_second_node_helps_where_it_looks():
    one = seen_volume({"a": fixed_at(0.0, 0.0, 0.0)}, described(None), AREA_M)
    two = {"a": fixed_at(0.0, 0.0, 0.0), "b": fixed_at(5.0, -4.0, 90.0, "b")}
    both = seen_volume(two, described(None), AREA_M)
    assert at(both, 5.0, 0.0) < 0.7 * at(one, 5.0, 0.0)
    assert both.share(0.1) > one.share(0.1)
