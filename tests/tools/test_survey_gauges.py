"""All gauges' readings in one adjustment: zeros, drifts, tides, and readings that contradict each other."""

import numpy as np
import pytest
from buddyline.tools.survey.gauges import adjust_gauges
from buddyline.tools.survey.network import adjust
from msgspec.structs import replace

from tests.tools import survey_world as world


def visited(rng, dives, *, zero_m=0.03, tide_m_per_h=0.0, noise_m=0.005, legs=12):
    """A line swum out and back in each dive, by gauges with zeros of their own; true depths by station."""
    course = world.line(np.random.default_rng(7), legs)
    out = course.legs
    back = [(j, i, rear) for i, j, rear in reversed(out)]
    depth_m = dict(zip(course.names, course.stations_m[:, 2], strict=True))
    rows = []
    template = world.readings_of(course, np.random.default_rng(1))
    for dive in dives:
        zeros = {node: rng.normal(0, zero_m) for node in world.NODES}
        for k, (i, j, rear) in enumerate([*out, *back]):
            # On the way back the other node stands at each station.
            nodes = world.NODES[rear], world.NODES[1 - rear]
            hours = k / 60
            read = [
                depth_m[course.names[at]] + zeros[node] + tide_m_per_h * hours + rng.normal(0, noise_m)
                for at, node in zip((i, j), nodes, strict=True)
            ]
            start_ns = world.START_NS + dive * 86_400 * 10**9 + round(hours * 3.6e12)
            rows.append(
                replace(
                    template[min(k, len(template) - 1)],
                    from_=course.names[i],
                    to=course.names[j],
                    from_node=nodes[0],
                    to_node=nodes[1],
                    dive=dive,
                    start_ns=start_ns,
                    end_ns=start_ns + 10**10,
                    depth_from_m=read[0],
                    depth_to_m=read[1],
                    **dict.fromkeys(("depth_from_sigma_m", "depth_to_sigma_m"), float(np.hypot(zero_m, noise_m))),
                    **dict.fromkeys(("depth_from_noise_m", "depth_to_noise_m"), noise_m),
                )
            )
    return rows, depth_m


def chi(found, depth_m, shift_m=0.0):
    return np.array(
        [(found.depths[name].depth_m - at_m - shift_m) / found.depths[name].sigma_m for name, at_m in depth_m.items()]
    )


def test_stated_standard_deviations_are_the_scatter():
    """Over many dives; one dive's stations share their gauges' zeros."""
    squares = []
    for seed in range(40):
        rows, depth_m = visited(np.random.default_rng(seed), [1])
        squares.append(float((chi(adjust_gauges(rows), depth_m) ** 2).mean()))
    assert 0.7 < np.mean(squares) < 1.3


def test_gauges_that_disagree_within_their_zeros_make_no_alarm():
    for seed in range(20):
        rows, _ = visited(np.random.default_rng(seed), [1, 2])
        assert not adjust_gauges(rows).alarms
        assert not adjust_gauges(rows).tides_m_per_h


@pytest.mark.parametrize("tide_m_per_h", [0.4, -0.7])
def test_a_tide_is_found_in_stations_visited_twice(tide_m_per_h):
    rows, depth_m = visited(np.random.default_rng(3), [1], tide_m_per_h=tide_m_per_h)
    found = adjust_gauges(rows)
    assert found.tides_m_per_h[1] == pytest.approx(tide_m_per_h, abs=0.1)
    assert not found.alarms
    assert np.abs(chi(found, depth_m)).max() < 4
    # Without it the readings would contradict each other.
    still = [replace(row, start_ns=world.START_NS, end_ns=world.START_NS) for row in rows]
    assert adjust_gauges(still).alarms


def test_another_dive_s_water_level_is_an_unknown():
    rows, depth_m = visited(np.random.default_rng(5), [1, 2])
    flooded = [
        replace(r, depth_from_m=r.depth_from_m + 0.8, depth_to_m=r.depth_to_m + 0.8) if r.dive == 2 else r for r in rows
    ]
    found = adjust_gauges(flooded)
    assert not found.alarms
    assert np.abs(chi(found, depth_m)).max() < 4


def test_a_reading_that_contradicts_the_others_is_an_alarm_and_shows_in_v():
    course = world.loop(np.random.default_rng(2), 14)
    legs = world.readings_of(course, np.random.default_rng(2))
    assert adjust(world.project_of(legs)).loops[0].vertical_ratio < 3
    wrong = [*legs[:-1], replace(legs[-1], depth_to_m=legs[-1].depth_to_m + 0.5)]
    said = adjust_gauges(wrong).alarms
    assert len(said) == 1
    assert f"station {legs[-1].to} " in said[0]
    assert adjust(world.project_of(wrong)).loops[0].vertical_ratio > 3


def test_a_leg_without_gauges_is_no_reading():
    assert adjust_gauges([]).depths == {}
