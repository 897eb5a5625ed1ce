"""The survey's assumptions and tolerances: the project's [settings] and [alarms], each value with a default."""

from __future__ import annotations

from typing import Annotated, Literal

from buddyline.protocol.config import Config
from buddyline.protocol.messages import NonNegative, Positive, Vector3
from msgspec import Meta, field


class SurveySettings(Config, frozen=True, kw_only=True):
    """[settings]: how legs are made from a dive.

    procedure: which node moves if neither marks nor depths show it: the nodes pass one another in turn
    (leapfrog), or node `first` stays. first: the node at the first station (default: the pair's first).
    rest_s, rest_fixes: the minimum for a leg. rest_speed_mps: below it the pair counts as resting. pause_s: where it is
    not 0, a leg is made of each pause so long, by the track and not by poses.
    turn_radps, jolt_mps2: gyroscope and accelerometer above which a node is handled, not held.
    centering_m: 1 sd, how well a node is held at its station, each axis. passing_m: how near to a station a node that
    swims past it is, as it is marked. range_share: 1 sd, error of the ranges'
    scale by calibration. compass_floor_deg, depth_floor_m: 1 sd, what averaging over a rest does not reduce.
    compass_common_deg: 1 sd, an error that all azimuths share (declination, mount): it turns the survey as a whole.
    disturbed_deg: 1 sd of a compass in a disturbed field, used where there is no other compass.
    gyro_zero_dps, gyro_scale: 1 sd of a gyroscope's zero (deg/s) and of its scale, unknowns of each dive.
    gyro_wander_dps: 1 sd, how far the zero wanders. gyro_noise_dps_rthz: its noise density.
    reference_m: node id to its station's point ([x, y, z], camera frame), where that is not the camera's centre.
    """

    procedure: Literal["leapfrog", "stay"] = "leapfrog"
    first: str = ""
    rest_s: Positive = 4.0
    rest_fixes: Annotated[int, Meta(ge=3)] = 8
    rest_speed_mps: Positive = 0.1
    pause_s: NonNegative = 0.0
    turn_radps: Positive = 0.6
    jolt_mps2: Positive = 1.5
    centering_m: NonNegative = 0.01
    passing_m: NonNegative = 0.2
    range_share: NonNegative = 0.0015
    compass_floor_deg: NonNegative = 0.3
    tilt_floor_deg: NonNegative = 0.2
    depth_floor_m: NonNegative = 0.005
    compass_common_deg: NonNegative = 0.5
    disturbed_deg: Positive = 10.0
    gyro_zero_dps: Positive = 0.2
    gyro_scale: Positive = 0.005
    gyro_wander_dps: Positive = 0.003
    gyro_noise_dps_rthz: Positive = 0.01
    point_s: Positive = 2.0
    reference_m: dict[str, Vector3] = field(default_factory=dict)


class AlarmSettings(Config, frozen=True, kw_only=True):
    """The limits above which a leg gets an alarm.

    sights_deg: foresight against backsight. field_share: strength of the magnetic field against the dive's own;
    dip_deg likewise. heading_deg: the compasses' difference against what the nodes see of each other.
    depth_sigmas, depth_m: depths against inclination, and gauges at one station, both exceeded. range_sigmas: of a
    leg's fixes.
    """

    sights_deg: Positive = 2.0
    field_share: Positive = 0.08
    dip_deg: Positive = 5.0
    heading_deg: Positive = 4.0
    depth_sigmas: Positive = 3.0
    depth_m: Positive = 0.1
    range_sigmas: Positive = 3.0
