"""Azimuths by gyroscopes: what they measure, and what they do for legs whose compasses are disturbed."""

import math
from itertools import pairwise

import numpy as np
import pytest
from buddyline.protocol.config import ConfigError
from buddyline.tools.survey.averages import wrap
from buddyline.tools.survey.derive import Derived
from buddyline.tools.survey.magnetism import Field, iron_rad
from buddyline.tools.survey.network import adjust
from buddyline.tools.survey.project import AdjustSettings, Known, Place, Turn
from buddyline.tools.survey.readings import of_messages
from buddyline.tools.survey.settings import AlarmSettings, SurveySettings
from msgspec.structs import replace

from tests.tools import survey_world as world

GYRO_DEG = 0.12


def azimuth(course, leg):
    start, end = (course.stations_m[course.names.index(name)] for name in (leg.from_, leg.to))
    return math.atan2(end[1] - start[1], end[0] - start[0])


def errors_deg(adjusted, course):
    """Errors of all legs' azimuths."""
    found = []
    for leg in adjusted.survey.legs:
        way = adjusted.positions[leg.to].position_m - adjusted.positions[leg.from_].position_m
        found.append(math.degrees(wrap(math.atan2(way[0], way[1]) - azimuth(course, leg))))
    return np.array(found)


def turned(course, legs, rng, wander_dps=0.0):
    """Both nodes' turns from leg to leg, by gyroscopes with a zero that wanders within 300 s, and noise of GYRO_DEG."""
    turns = []
    for node in world.NODES:
        zero_dps = rng.normal(0, 0.01)
        slow = world._Slow(np.random.default_rng(rng.integers(2**32) if wander_dps else 0), 300.0)
        for before, after in pairwise(legs):
            sights = [azimuth(course, leg) + math.pi * (leg.from_node != node) for leg in (before, after)]
            seconds = (after.start_ns - before.start_ns) / 1e9
            off_dps = zero_dps + (wander_dps * slow.at((before.start_ns - world.START_NS) / 1e9) if wander_dps else 0.0)
            angle_deg = math.degrees(wrap(sights[1] - sights[0])) + off_dps * seconds + rng.normal(0, GYRO_DEG)
            turns.append(
                Turn(
                    node=node,
                    from_ns=before.start_ns,
                    to_ns=after.start_ns,
                    seconds=seconds,
                    angle_deg=angle_deg,
                    sigma_deg=GYRO_DEG,
                )
            )
    return turns


def disturbed_line(seed, legs=40):
    """A line with every fifth station's iron at work on both compasses, and no field that tells."""
    rng = np.random.default_rng(seed)
    course = world.line(rng, legs)
    rows = world.readings_of(course, rng, compass_deg=1.5)
    iron = {str(k): float(rng.choice([-1, 1]) * rng.uniform(10, 25)) for k in range(3, legs, 5)}
    rows = [
        replace(
            leg,
            azimuth_deg=(leg.azimuth_deg + iron.get(leg.from_, 0.0)) % 360,
            back_azimuth_deg=(leg.back_azimuth_deg + iron.get(leg.to, 0.0)) % 360,
        )
        for leg in rows
    ]
    return course, rows, turned(course, rows, rng)


@pytest.mark.parametrize("seed", range(3))
def test_gyroscopes_carry_azimuths_past_disturbed_compasses(seed):
    course, legs, turns = disturbed_line(seed)
    project = world.project_of(legs)
    without, with_them = adjust(project), adjust(replace(project, turn=turns))
    assert errors_deg(with_them, course).std() < 0.3 * errors_deg(without, course).std()
    assert errors_deg(with_them, course).std() < 0.6
    # Disturbed compasses are no reason to suspect an instrument.
    assert not with_them.blunders
    # Centering and the gyroscopes' zeros are in the sds.
    sigma = with_them.solution.unknown("gyroscope of a in dive 1: zero")[1]
    assert math.degrees(sigma) < 0.02


@pytest.mark.parametrize("seed", range(3))
def test_gyroscopes_that_feel_no_turn_are_named_and_not_the_compasses(seed):
    rng = np.random.default_rng(seed)
    course = world.line(rng, 4)
    legs = world.readings_of(course, rng, compass_deg=1.5)
    turns = [replace(one, angle_deg=rng.normal(0, 5.0), sigma_deg=5.0) for one in turned(course, legs, rng)]
    blunders = adjust(world.project_of(legs, turn=turns)).blunders
    assert blunders
    for blunder in blunders:
        assert blunder.cause.startswith("gyroscope")
        assert blunder.cause not in blunder.others
        assert "180 deg" not in blunder.text


def test_iron_turns_a_compass_as_much_as_its_field_tells():
    rng = np.random.default_rng(1)
    usual = Field(48e-6, math.radians(60.0))
    undisturbed = usual.norm_t * np.array([math.cos(usual.dip_rad), 0.0, math.sin(usual.dip_rad)])
    turned, told = [], []
    for north, east, down in undisturbed + rng.normal(0, 1.5e-6, (2000, 3)):
        level = math.hypot(north, east)
        turned.append(math.atan2(east, north))
        told.append(iron_rad(Field(math.hypot(level, down), math.atan2(down, level)), usual))
    assert np.mean(np.square(told)) == pytest.approx(np.mean(np.square(turned)), rel=0.1)
    assert iron_rad(usual, usual) == iron_rad(None, usual) == iron_rad(usual, None) == 0.0


def test_a_known_azimuth_gives_north_without_any_compass():
    course, legs, turns = disturbed_line(5, 12)
    course_m = course.stations_m
    way = world.enu(course_m[1] - course_m[0])
    known = [Known(from_="0", to="1", azimuth_deg=math.degrees(math.atan2(way[0], way[1])), azimuth_sigma_deg=0.05)]
    project = world.project_of(legs, turn=turns, place=Place(declination_deg=0.0))
    ignoring = replace(project, adjust=AdjustSettings(compass="ignore"))
    with pytest.raises(ConfigError, match="north needs"):
        adjust(ignoring)
    adjusted = adjust(replace(ignoring, known=known))
    assert not any(name.startswith("compass") for name in adjusted.fit.instruments)
    assert np.abs(errors_deg(adjusted, course)).max() < 2.0


def test_the_far_end_s_ellipse_holds_a_gyroscope_that_wanders():
    # No compass: gyroscopes alone carry the azimuth between the first leg and the last, where it is known.
    chi2 = []
    for seed in range(40):
        rng = np.random.default_rng([seed, 3])
        course = world.line(rng, 25)
        legs = world.readings_of(course, rng, compass_deg=1.5)
        known = [
            Known(from_=leg.from_, to=leg.to, azimuth_deg=math.degrees(azimuth(course, leg)), azimuth_sigma_deg=0.05)
            for leg in (legs[0], legs[-1])
        ]
        project = world.project_of(
            legs,
            turn=turned(course, legs, rng, wander_dps=0.003),
            place=Place(declination_deg=0.0),
            known=known,
            settings=SurveySettings(centering_m=0.001, range_share=0.0, gyro_scale=1e-5, gyro_zero_dps=0.01),
        )
        adjusted = adjust(replace(project, adjust=AdjustSettings(compass="ignore")))
        end = adjusted.positions["25"]
        error = (end.position_m - world.enu(course.stations_m[-1] - course.stations_m[0]))[:2]
        chi2.append(error @ np.linalg.solve(end.covariance[:2, :2], error) / 2)
    # The mean of 40 has a sd of 0.16.
    assert 0.6 < np.mean(chi2) < 1.4


def test_a_gyroscope_s_turns_are_those_of_the_legs():
    rng = np.random.default_rng(4)
    course = world.line(rng, 4)
    messages = world.dive(course, rng, world.Flaws(), 10.0, 12.0)
    derived = Derived()
    derived.add(of_messages(messages), SurveySettings(), AlarmSettings())
    legs = {leg.start_ns: leg for leg in derived.legs}
    assert len(derived.turns) == 6
    off = []
    for one in derived.turns:
        before, after = legs[one.from_ns], legs[one.to_ns]
        sights = [azimuth(course, leg) + math.pi * (leg.from_node != one.node) for leg in (before, after)]
        off.append(math.degrees(wrap(math.radians(one.angle_deg) - sights[1] + sights[0])))
        assert one.sigma_deg < 2.0
        # Four rests tell a zero of 0.1 deg/s to a third or so; the adjustment does the rest.
        off[-1] /= one.seconds
    assert np.abs(off).max() < 0.2
    # A gap in the samples may hide a turn.
    gap = [
        m
        for m in messages
        if not (type(m).__name__ == "Imu" and m.node == "a" and 18 < (m.stamp_ns - world.START_NS) / 1e9 < 22)
    ]
    cut = Derived()
    cut.add(of_messages(gap), SurveySettings(), AlarmSettings())
    assert {one.node for one in cut.turns if one.from_ns == min(legs)} == {"b"}
