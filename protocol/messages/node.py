"""What a node says of itself: calibration, sensors, clock, health, and marks of the survey."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Final, Literal, TypeAlias

from buddyline.protocol.messages.fields import (
    Count,
    Message,
    NodeId,
    NonNegative,
    Positive,
    Quaternion,
    StampNs,
    Vector3,
    check_finite,
    check_unit,
)
from msgspec import UNSET, Meta, Struct, UnsetType

MAX_HEARD: Final = 16
MAX_MEANS: Final = 32
Role: TypeAlias = Literal["full", "lights", "camera"]


def check_apart(light_left_m: Vector3, light_right_m: Vector3) -> None:
    """Raise ValueError for two lights at one place."""
    if math.dist(light_left_m, light_right_m) < 1e-3:
        raise ValueError("light_left_m, light_right_m: less than 1 mm apart")


class CameraModel(Struct, frozen=True, kw_only=True):
    """Camera intrinsics. pinhole: OpenCV's k1 k2 p1 p2 k3; fisheye: k1..k4. Pixel centres at integers."""

    model: Literal["pinhole", "fisheye"]
    fx_px: Positive
    fy_px: Positive
    cx_px: float
    cy_px: float
    distortion: list[float]

    def __post_init__(self) -> None:
        """Check the number of distortion coefficients."""
        expected = 5 if self.model == "pinhole" else 4
        if len(self.distortion) != expected:
            raise ValueError(f"distortion: {len(self.distortion)} coefficients, {self.model} has {expected}")
        check_finite("distortion", tuple(self.distortion))


class ArTag(Struct, frozen=True, kw_only=True):
    """An AR tag on a node. corners_m: of its black square, in the node's camera frame.

    Their order, as seen by an observer who faces the upright tag: top left, top right, bottom right, bottom left.
    family: "36h11", "16h5", ...
    """

    id: Count
    corners_m: tuple[Vector3, Vector3, Vector3, Vector3]
    family: str = "36h11"

    def __post_init__(self) -> None:
        """Check that the corners are distinct."""
        if min(math.dist(self.corners_m[i], self.corners_m[i - 1]) for i in range(4)) < 1e-3:
            raise ValueError("corners_m: two corners less than 1 mm apart")


class FixedPlace(Struct, frozen=True, kw_only=True):
    """Where a node stands still: T_net_camera in the net's frame, which is north-east-down.

    p_m: of the camera's centre; q_xyzw: camera to net. sigma_m, sigma_rad: how well both are known, 1 sd of each axis.
    """

    net: NodeId = "main"
    p_m: Vector3
    q_xyzw: Quaternion
    sigma_m: NonNegative = 0.003
    sigma_rad: NonNegative = 0.002

    def __post_init__(self) -> None:
        """Check the place and the quaternion's norm."""
        check_finite("p_m", self.p_m)
        check_unit("q_xyzw", self.q_xyzw)


class Blink(Struct, frozen=True, kw_only=True):
    """How a node's lamp blinks, so that others know whose it is (protocol/blinking.py).

    code: its number among the codes. lamp: which of the two is switched. slot_ns: the node's trigger period.
    """

    code: Annotated[int, Meta(ge=0, le=9)]
    lamp: Literal["left", "right", "both"]
    slot_ns: Annotated[int, Meta(ge=1, le=2**63 - 1)]


class NodeInfo(Message, frozen=True, kw_only=True):
    """Calibration and identity of a node.

    light_left_m, light_right_m, depth_port_m: in the node's camera frame. sigma_px: candidate noise, 1 sd.
    row_time_ns: 0 for a global shutter. q_body_camera_xyzw: camera to body. declination_rad: 0 where headings
    are magnetic. tags: AR tags on the node, for comparison only. imu_m: place of the inertial unit in the camera
    frame. imu_delay_ns: stamp of an inertial sample minus its true time. role: "lights" has two lamps and no camera,
    "camera" a camera and no lamps (its light_left_m and light_right_m, or its camera, are then not used). fixed: for a
    node that stands still. blink: for a node with a lamp that is switched by a code. certificate: in PEM; its key signs
    the node's digests.
    """

    node: NodeId
    stamp_ns: StampNs
    width_px: Annotated[int, Meta(ge=1, le=65535)]
    height_px: Annotated[int, Meta(ge=1, le=65535)]
    camera: CameraModel
    light_left_m: Vector3
    light_right_m: Vector3
    sigma_px: Positive
    trigger_period_ns: Annotated[int, Meta(ge=1, le=2**63 - 1)]
    row_time_ns: Count = 0
    q_body_camera_xyzw: Quaternion = (0.5, 0.5, 0.5, 0.5)
    depth_port_m: Vector3 = (0.0, 0.0, 0.0)
    declination_rad: float = 0.0
    software: str = ""
    config_sha256: str = ""
    tags: list[ArTag] | UnsetType = UNSET
    imu_m: Vector3 | UnsetType = UNSET
    imu_delay_ns: int | UnsetType = UNSET
    role: Role | UnsetType = UNSET
    fixed: FixedPlace | UnsetType = UNSET
    blink: Blink | UnsetType = UNSET
    certificate: Annotated[str, Meta(max_length=8192)] | UnsetType = UNSET

    @property
    def has_camera(self) -> bool:
        """Whether the node sees others; without a role it does."""
        return self.role != "lights"

    @property
    def has_lights(self) -> bool:
        """Whether others can see the node's lamps; without a role they can."""
        return self.role != "camera"

    def __post_init__(self) -> None:
        """Check the mount's quaternion and that the two lights are apart."""
        check_unit("q_body_camera_xyzw", self.q_body_camera_xyzw)
        check_apart(self.light_left_m, self.light_right_m)


class Imu(Message, frozen=True, kw_only=True):
    """Raw inertial sample in the body frame; mag_t is absent without a magnetometer, and where it was not read.

    temperature_degc: of the gyroscope, once a second.
    """

    node: NodeId
    stamp_ns: StampNs
    accel_mps2: Vector3
    gyro_radps: Vector3
    mag_t: Vector3 | UnsetType = UNSET
    temperature_degc: float | UnsetType = UNSET


class ImuMeans(Message, frozen=True, kw_only=True):
    """Means of inertial samples over consecutive spans, in the body frame, where a link does not carry the samples.

    ages_ns: how long before stamp_ns the middle of each span was; the last is 0. accel_mps2, gyro_radps: what, constant
    over the span, turns and pushes as much as the samples (coning and sculling are counted).
    """

    node: NodeId
    stamp_ns: StampNs
    ages_ns: Annotated[list[Count], Meta(min_length=1, max_length=MAX_MEANS)]
    accel_mps2: list[Vector3]
    gyro_radps: list[Vector3]

    def __post_init__(self) -> None:
        """Check that there are as many of each, in order, and that all are finite."""
        if not len(self.ages_ns) == len(self.accel_mps2) == len(self.gyro_radps):
            raise ValueError("ages_ns, accel_mps2, gyro_radps: not of one length")
        if self.ages_ns[0] > self.stamp_ns or any(a <= b for a, b in pairwise(self.ages_ns)):
            raise ValueError("ages_ns: not falling, or beyond the epoch")

    def samples(self) -> list[Imu]:
        """Return the means as samples in the middle of their spans."""
        return [
            Imu(node=self.node, stamp_ns=self.stamp_ns - age_ns, accel_mps2=accel_mps2, gyro_radps=gyro_radps)
            for age_ns, accel_mps2, gyro_radps in zip(self.ages_ns, self.accel_mps2, self.gyro_radps, strict=True)
        ]


class Attitude(Message, frozen=True, kw_only=True):
    """Orientation, body to NED; sigma_rad: [roll, pitch, yaw], 1 sd."""

    node: NodeId
    stamp_ns: StampNs
    q_ned_body_xyzw: Quaternion
    sigma_rad: tuple[Positive, Positive, Positive]

    def __post_init__(self) -> None:
        """Check the quaternion's norm."""
        check_unit("q_ned_body_xyzw", self.q_ned_body_xyzw)


class Depth(Message, frozen=True, kw_only=True):
    """Depth of the pressure port: positive down, 0 at the surface."""

    node: NodeId
    stamp_ns: StampNs
    depth_m: float
    sigma_m: Positive
    pressure_pa: float | UnsetType = UNSET
    temperature_degc: float | UnsetType = UNSET


class HeardClock(Struct, frozen=True, kw_only=True):
    """Another node's newest ClockBeacon, as received.

    sent_ns: its stamp_ns, on the sender's clock. received_ns: on the receiver's clock.
    """

    node: NodeId
    boot: str
    sent_ns: StampNs
    received_ns: StampNs


class ClockBeacon(Message, frozen=True, kw_only=True):
    """The time at which a node sent this beacon, and the times at which it received the others' newest beacons.

    The beacons of two nodes hold the four timestamps of a ping, which give the clock offset and the round trip.
    raw_ns: CLOCK_MONOTONIC_RAW at stamp_ns, which nothing sets or slews.
    """

    node: NodeId
    stamp_ns: StampNs
    boot: str
    heard: Annotated[list[HeardClock], Meta(max_length=MAX_HEARD)]
    raw_ns: Count | UnsetType = UNSET


class ClockSet(Message, frozen=True, kw_only=True):
    """A node's clock was set: stamps before this message in its log are moved_ns less than the same clock's now.

    stamp_ns: the instant, by the clock as it is now.
    """

    node: NodeId
    stamp_ns: StampNs
    boot: str
    moved_ns: int


class NodeStatus(Message, frozen=True, kw_only=True):
    """Health of a node, 1 Hz.

    rates_hz: messages per second by topic. drops: lost messages by cause. ages_s: time since the newest sample of each
    device. bus_retries: repeated transfers on the sensors' I2C bus. lights_seen: likely lights in the newest pictures
    (their median), two of which are another node's. throttled_bits: the Pi firmware's (protocol/health.py).
    battery_v, battery_a: at the battery, discharging positive; battery_cell_v: of one cell. leak: water in the housing.
    load: what the node leaves out because of heat or undervoltage. problem: what is wrong, in words; empty if nothing.
    clock_offset_s: this clock minus true time, estimated by chrony. clock_rms_s: its long-term RMS.
    clock_bound_s: greatest possible error of this clock. clock_frequency_ppm: rate at which the uncorrected clock
    gains. clock_source: the reference that chrony follows, empty if none. All five are absent without chrony.
    """

    node: NodeId
    stamp_ns: StampNs
    boot: str
    software: str
    uptime_s: NonNegative
    rates_hz: dict[str, float]
    drops: dict[str, int]
    ages_s: dict[str, float]
    trigger_residual_s: float | UnsetType = UNSET
    detect_s: float | UnsetType = UNSET
    clock_offset_s: float | UnsetType = UNSET
    clock_rms_s: NonNegative | UnsetType = UNSET
    clock_bound_s: NonNegative | UnsetType = UNSET
    clock_frequency_ppm: float | UnsetType = UNSET
    clock_source: str | UnsetType = UNSET
    disk_free_bytes: Count | UnsetType = UNSET
    temperature_degc: float | UnsetType = UNSET
    bus_retries: Count | UnsetType = UNSET
    lights_seen: Count | UnsetType = UNSET
    throttled_bits: Count | UnsetType = UNSET
    battery_v: float | UnsetType = UNSET
    battery_a: float | UnsetType = UNSET
    battery_cell_v: float | UnsetType = UNSET
    leak: bool | UnsetType = UNSET
    load: Literal["full", "no_pictures", "half_rate"] | UnsetType = UNSET
    log: str = ""
    problem: str = ""


class Mark(Message, frozen=True, kw_only=True):
    """A note for the survey about a node at an instant, by a person or by an automatic check.

    kind: station: the node is at the station `name`, from the rest nearest to this instant until it moves. point: the
    node is at a point of interest. note: the text `note` only. alarm: the survey's check `name` failed; measure again.
    leg: the survey's verdict `good` on the present leg. leg_ns: begin of the rest that a verdict is about. earlier:
    that is not the present rest. tag: number of the printed tag that the node's own camera read; it names the station
    of this rest, or of the next one.
    """

    node: NodeId
    stamp_ns: StampNs
    kind: Literal["station", "point", "note", "alarm", "leg"] = "station"
    name: Annotated[str, Meta(max_length=64)] = ""
    note: Annotated[str, Meta(max_length=1024)] = ""
    leg_ns: StampNs | UnsetType = UNSET
    earlier: bool = False
    tag: Count | UnsetType = UNSET
