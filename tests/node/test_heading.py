"""The gated compass alone: what it uses, what it leaves out, and its sigma."""

from __future__ import annotations

import math

import numpy as np
import pytest
from buddyline.node.geomagnetism import EarthField
from buddyline.node.heading import UNKNOWN_SIGMA_RAD, HeadingFilter, wrap

DT_S = 0.05
DIP_RAD = math.radians(62)
HERE = EarthField(0.0, DIP_RAD, 48e-6)
BIAS_SIGMA = math.radians(0.03)
TILT_SIGMA = math.radians(1.5)


def level_field(delta_rad: float, norm_t: float = 48e-6, dip_rad: float = DIP_RAD) -> np.ndarray:
    """The Earth's field in a level frame from which magnetic north is turned by delta about up."""
    horizontal = norm_t * math.cos(dip_rad)
    return np.array([horizontal * math.sin(delta_rad), horizontal * math.cos(delta_rad), -norm_t * math.sin(dip_rad)])


class TurningNode:
    """A node that turns to and fro by 100 deg (twice swing_rad) every 20 s, and a compass with 0.8 uT of noise."""

    def __init__(self, heading: HeadingFilter, seed: int = 1, swing_rad: float = math.radians(50)) -> None:
        self._swing_rad = swing_rad
        self.heading = heading
        self.t_s = 0.0
        self.yaw_rad = 0.0
        self._rng = np.random.default_rng(seed)

    def run(
        self, seconds: float, delta_rad: float, rig_t: float = 0.0, drift_radps: float = 0.0, **field: float
    ) -> float:
        """Simulate further; rig_t: a field fixed to the rig, forward. Return delta at the end."""
        for _ in range(round(seconds / DT_S)):
            self.t_s += DT_S
            delta_rad += drift_radps * DT_S
            yaw_rad = self._swing_rad * math.sin(2 * math.pi * self.t_s / 20.0)
            reading = level_field(delta_rad, **field) + rig_t * np.array([math.cos(yaw_rad), math.sin(yaw_rad), 0.0])
            self.heading.predict(DT_S, BIAS_SIGMA)
            self.heading.update(DT_S, reading + self._rng.normal(0, 0.8e-6, 3), yaw_rad - self.yaw_rad)
            self.yaw_rad = yaw_rad
        return delta_rad

    def off_deg(self, delta_rad: float) -> float:
        return math.degrees(abs(wrap(self.heading.delta_rad - delta_rad)))


@pytest.mark.parametrize("angle", [-7.0, -math.pi, 0.0, 3.0, 9.0])
def test_angles_wrap_to_within_pi(angle):
    assert -math.pi <= wrap(angle) <= math.pi
    assert math.sin(wrap(angle)) == pytest.approx(math.sin(angle), abs=1e-12)


@pytest.mark.parametrize("delta_rad", [0.0, 2.0, 3.1, -3.1])
def test_the_filter_finds_the_angle_and_its_sigma_shrinks(delta_rad):
    node = TurningNode(HeadingFilter(HERE))
    assert node.heading.sigma_rad(TILT_SIGMA) == UNKNOWN_SIGMA_RAD
    node.run(60, delta_rad)
    assert node.off_deg(delta_rad) < 1.0
    assert node.heading.problem == ""
    assert math.degrees(node.heading.sigma_rad(TILT_SIGMA)) < 5


def test_the_filter_follows_a_drifting_gyroscope_across_pi():
    node = TurningNode(HeadingFilter(HERE))
    delta_rad = node.run(120, 3.0, drift_radps=math.radians(0.1))
    assert node.off_deg(delta_rad) < 2.0
    assert node.heading.problem == ""


@pytest.mark.parametrize("changed", [{"norm_t": 53e-6}, {"norm_t": 42e-6}, {"dip_rad": DIP_RAD + 0.15}])
def test_strength_and_dip_that_are_not_the_earths_are_left_out(changed):
    node = TurningNode(HeadingFilter(HERE))
    node.run(60, 1.0)
    node.run(10, 1.5, **changed)
    assert "disturbed" in node.heading.problem
    assert "48 uT" in node.heading.problem
    assert node.off_deg(1.0) < 1.5


def test_a_turned_compass_of_the_right_strength_and_dip_is_left_out_too():
    node = TurningNode(HeadingFilter(HERE))
    node.run(60, 1.0)
    node.run(10, 1.0 + math.radians(30))
    assert "differ" in node.heading.problem
    assert node.off_deg(1.0) < 1.5


def test_sigma_grows_while_the_compass_is_left_out():
    node = TurningNode(HeadingFilter(HERE))
    node.run(60, 1.0)
    before = node.heading.sigma_rad(TILT_SIGMA)
    node.run(60, 1.0, norm_t=60e-6)
    assert node.heading.sigma_rad(TILT_SIGMA) > before


def test_a_rig_field_is_not_taken_for_the_earths_while_the_node_turns():
    """Learned without knowing the place; then iron on the rig, for as long as it stays."""
    node = TurningNode(HeadingFilter(None))
    node.run(60, 1.0)
    node.run(120, 1.0, rig_t=9e-6)
    assert node.off_deg(1.0) < 6.0
    node.run(10, 1.0)
    assert node.heading.problem == ""


def test_started_beside_steel_the_filter_recovers_without_a_known_place():
    """A boat's field at the start, learned for the Earth's; the true one shows by standing still in a turn."""
    node = TurningNode(HeadingFilter(None))
    node.run(10, 1.0 + math.radians(40), norm_t=62e-6, dip_rad=DIP_RAD - 0.3)
    node.run(3, 1.0)
    assert "disturbed" in node.heading.problem
    assert math.degrees(node.heading.sigma_rad(TILT_SIGMA)) > 25
    node.run(60, 1.0)
    assert node.heading.problem == ""
    assert node.off_deg(1.0) < 1.5
    assert math.degrees(node.heading.sigma_rad(TILT_SIGMA)) < 5


def test_a_first_reading_slightly_off_raises_no_lasting_alarm():
    """Started on a deck, 10 % and 4 deg from the field of the place; the node hardly turns."""
    node = TurningNode(HeadingFilter(None), swing_rad=math.radians(10))
    node.run(3, 1.0, norm_t=43e-6, dip_rad=DIP_RAD + 0.07)
    node.run(5, 1.0)
    assert "disturbed" in node.heading.problem
    node.run(30, 1.0)
    assert node.heading.problem == ""
    assert node.off_deg(1.0) < 2.0
    assert math.degrees(node.heading.sigma_rad(TILT_SIGMA)) > 15  # nothing has confirmed it


def test_a_steady_field_of_another_strength_is_not_adopted_where_the_place_is_known():
    node = TurningNode(HeadingFilter(HERE))
    node.run(120, 1.0, norm_t=62e-6)
    assert "disturbed" in node.heading.problem
    assert node.heading.sigma_rad(TILT_SIGMA) == UNKNOWN_SIGMA_RAD


def test_an_unmeasured_rotation_widens_the_gate():
    node = TurningNode(HeadingFilter(HERE))
    node.run(60, 1.0)
    node.heading.widen(math.radians(30))
    assert math.degrees(node.heading.sigma_rad(TILT_SIGMA)) > 30
    node.run(10, 1.0 + math.radians(40))
    assert node.heading.problem == ""
    assert node.off_deg(1.0 + math.radians(40)) < 3


def test_an_unmeasured_rotation_of_any_size_restarts_the_filter():
    node = TurningNode(HeadingFilter(HERE))
    node.run(60, 1.0)
    node.heading.widen(math.pi)
    assert node.heading.sigma_rad(TILT_SIGMA) == UNKNOWN_SIGMA_RAD
    node.run(1, -2.0)
    assert node.off_deg(-2.0) < 5


def test_noise_alone_is_covered_by_sigma():
    """Fifty starts: the angle's error against the sigma of the state, calibration and mount left aside."""
    offs = []
    for seed in range(50):
        node = TurningNode(HeadingFilter(HERE), seed)
        node.run(5, 0.3)
        offs.append(node.off_deg(0.3))
    assert max(offs) < 3 * math.degrees(TurningNode(HeadingFilter(HERE)).heading.sigma_rad(0.0))
    assert np.sqrt(np.mean(np.square(offs))) < 2.0
