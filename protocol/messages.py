"""The messages of the bus and of dive logs, as validated structures.

`codec.decode` checks types, lengths, finite numbers, unit quaternions, and that blobs are inside their picture.
"""

from __future__ import annotations

import math
from typing import Annotated, Final, Literal, TypeAlias

from msgspec import UNSET, Meta, Struct, UnsetType

NODE_ID_PATTERN: Final = r"^[a-z0-9_]{1,32}\Z"
MAX_BLOBS: Final = 64
MAX_HEARD: Final = 16

NodeId: TypeAlias = Annotated[str, Meta(pattern=NODE_ID_PATTERN)]
StampNs: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Count: TypeAlias = Annotated[int, Meta(ge=0, le=2**63 - 1)]
NonNegative: TypeAlias = Annotated[float, Meta(ge=0)]
Positive: TypeAlias = Annotated[float, Meta(gt=0)]
Vector3: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]

Reason: TypeAlias = Literal[
    "unmatched",
    "no_info",
    "too_few_candidates",
    "range_gap",
    "twist_gap",
    "attitude",
    "depth",
    "out_of_range",
    "ambiguous",
    "degenerate",
    "late",
    "duplicate",
    "heading",
    "other_lights",
]
TrackMode: TypeAlias = Literal["filter", "lag", "smooth"]
Role: TypeAlias = Literal["full", "lights", "camera"]


def _check_unit(field: str, q_xyzw: Quaternion) -> None:
    norm = math.sqrt(sum(x * x for x in q_xyzw))
    if not abs(norm - 1.0) <= 1e-3:
        raise ValueError(f"{field}: norm {norm:.6g} is not 1")


def _check_finite(field: str, values: tuple[float, ...]) -> None:
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{field}: not finite")


class Message(Struct, frozen=True, kw_only=True):
    """Base of all messages."""


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
        _check_finite("distortion", tuple(self.distortion))


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
        _check_finite("p_m", self.p_m)
        _check_unit("q_xyzw", self.q_xyzw)


class NodeInfo(Message, frozen=True, kw_only=True):
    """Calibration and identity of a node.

    light_left_m, light_right_m, depth_port_m: in the node's camera frame. sigma_px: candidate noise, 1 sd.
    row_time_ns: 0 for a global shutter. q_body_camera_xyzw: camera to body. declination_rad: 0 where headings
    are magnetic. tags: AR tags on the node, for comparison only. imu_m: place of the inertial unit in the camera
    frame. imu_delay_ns: stamp of an inertial sample minus its true time. role: "lights" has two lamps and no camera,
    "camera" a camera and no lamps (its light_left_m and light_right_m, or its camera, are then not used). fixed: for a
    node that stands still.
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
        _check_unit("q_body_camera_xyzw", self.q_body_camera_xyzw)
        if math.dist(self.light_left_m, self.light_right_m) < 1e-3:
            raise ValueError("light_left_m, light_right_m: less than 1 mm apart")


class Blob(Struct, frozen=True, kw_only=True):
    """One light candidate. Pixel centres at integers, distorted image.

    dt_ns: exposure time of its row minus the frame's stamp_ns. peak: grey levels. score: probability of a light, 0-1.
    """

    u_px: float
    v_px: float
    sigma_px: Positive
    area_px: NonNegative
    peak: Annotated[float, Meta(ge=0, le=255)]
    elongation: NonNegative
    dt_ns: int = 0
    score: Annotated[float, Meta(ge=0, le=1)] | UnsetType = UNSET


class Candidates(Message, frozen=True, kw_only=True):
    """Light candidates of one frame, the most likely first.

    stamp_ns: middle of exposure of the image's middle row. trigger: round(stamp_ns / trigger_period_ns).
    seq: sequence number, from 0 at each boot. truncated: number of candidates left out. elsewhere: only where parts of
    the picture were not searched: how many candidates the last search of the whole picture found in these parts.
    exposure_ns, gain: of this frame. context: whether it was exposed for the scene and not for the lamps. All three are
    absent where not known.
    """

    node: NodeId
    stamp_ns: StampNs
    trigger: Count
    seq: Count
    boot: str
    width_px: Annotated[int, Meta(ge=1, le=65535)]
    height_px: Annotated[int, Meta(ge=1, le=65535)]
    blobs: Annotated[list[Blob], Meta(max_length=MAX_BLOBS)]
    truncated: Count = 0
    elsewhere: Count | UnsetType = UNSET
    exposure_ns: Count | UnsetType = UNSET
    gain: Positive | UnsetType = UNSET
    context: bool | UnsetType = UNSET

    def __post_init__(self) -> None:
        """Check that every blob is inside the picture."""
        for i, blob in enumerate(self.blobs):
            if not -0.5 <= blob.u_px <= self.width_px - 0.5:
                raise ValueError(f"blobs[{i}].u_px: {blob.u_px:g} is outside the image, width {self.width_px}")
            if not -0.5 <= blob.v_px <= self.height_px - 0.5:
                raise ValueError(f"blobs[{i}].v_px: {blob.v_px:g} is outside the image, height {self.height_px}")


class ExpectedLight(Struct, frozen=True, kw_only=True):
    """Where one light should stand in a picture. Pixel centres at integers, distorted image.

    covariance_px2: [uu, uv, vv]. rate_pxps: [u, v], how the place moves. sigma_rate_pxps: by how much the sigma grows
    with each second after the stamp.
    """

    side: Literal["left", "right"]
    u_px: float
    v_px: float
    covariance_px2: tuple[Positive, float, Positive]
    rate_pxps: tuple[float, float]
    sigma_rate_pxps: NonNegative

    def __post_init__(self) -> None:
        """Check that the covariance is positive definite."""
        uu, uv, vv = self.covariance_px2
        if not uv * uv < uu * vv:
            raise ValueError("covariance_px2: not positive definite")


class Expect(Message, frozen=True, kw_only=True):
    """Where the solver's track expects the lights of the node `seen` in a later picture of the node `node`.

    stamp_ns: the instant of the prediction, on node's clock; usually that of node's next picture. It serves until
    valid_ns after the stamp. lights: those that should be in the picture; the others are left out.
    """

    node: NodeId
    seen: NodeId
    stamp_ns: StampNs
    valid_ns: Annotated[int, Meta(ge=1, le=10_000_000_000)]
    lights: Annotated[list[ExpectedLight], Meta(max_length=2)]


class Imu(Message, frozen=True, kw_only=True):
    """Raw inertial sample in the body frame; mag_t is absent without a magnetometer.

    temperature_degc: of the gyroscope, once a second.
    """

    node: NodeId
    stamp_ns: StampNs
    accel_mps2: Vector3
    gyro_radps: Vector3
    mag_t: Vector3 | UnsetType = UNSET
    temperature_degc: float | UnsetType = UNSET


class Attitude(Message, frozen=True, kw_only=True):
    """Orientation, body to NED; sigma_rad: [roll, pitch, yaw], 1 sd."""

    node: NodeId
    stamp_ns: StampNs
    q_ned_body_xyzw: Quaternion
    sigma_rad: tuple[Positive, Positive, Positive]

    def __post_init__(self) -> None:
        """Check the quaternion's norm."""
        _check_unit("q_ned_body_xyzw", self.q_ned_body_xyzw)


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


class FoxgloveTime(Struct, frozen=True, kw_only=True):
    """A Foxglove timestamp."""

    sec: Annotated[int, Meta(ge=0, le=2**32 - 1)]
    nsec: Annotated[int, Meta(ge=0, le=999_999_999)]


class CompressedImage(Message, frozen=True, kw_only=True):
    """A frame as JPEG or PNG (foxglove.CompressedImage); frame_id is `<node>_camera`."""

    timestamp: FoxgloveTime
    frame_id: str
    data: bytes
    format: str

    @property
    def stamp_ns(self) -> int:
        """Middle of exposure of the image's middle row."""
        return self.timestamp.sec * 1_000_000_000 + self.timestamp.nsec


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


class RelativePose(Message, frozen=True, kw_only=True):
    """T_a_b: maps B's camera frame into A's.

    covariance: 6x6 row-major, position in A's camera frame (m), then the small rotation w (rad) with
    R_true = exp(w) R_a_b, in A's camera frame. blobs_a: [left, right] of B's lights, as indices into A's
    Candidates (-1: that light was not seen); blobs_b likewise. skew_ns: stamp_a - stamp_b.
    With attitude only: t_ned_m, azimuth_rad (from north, clockwise), inclination_rad (up positive), and their sigmas
    (1 sd), which count the error of A's attitude as well as the pose's.
    heading_gap_rad: with both attitudes, what is to be added to B's heading for both to agree with the pose.
    """

    node_a: NodeId
    node_b: NodeId
    stamp_ns: StampNs
    trigger: Count
    t_a_b_m: Vector3
    q_a_b_xyzw: Quaternion
    covariance: Annotated[list[float], Meta(min_length=36, max_length=36)]
    range_m: NonNegative
    range_a_m: float
    range_b_m: float
    range_gap_m: float
    twist_gap_rad: float
    chi2: NonNegative
    hypotheses: Count
    blobs_a: tuple[int, int]
    blobs_b: tuple[int, int]
    method: str
    checks: list[str]
    skew_ns: int
    t_ned_m: Vector3 | UnsetType = UNSET
    sigma_ned_m: tuple[NonNegative, NonNegative, NonNegative] | UnsetType = UNSET
    azimuth_rad: float | UnsetType = UNSET
    sigma_azimuth_rad: NonNegative | UnsetType = UNSET
    inclination_rad: float | UnsetType = UNSET
    sigma_inclination_rad: NonNegative | UnsetType = UNSET
    heading_gap_rad: float | UnsetType = UNSET

    def __post_init__(self) -> None:
        """Check the quaternion's norm."""
        _check_unit("q_a_b_xyzw", self.q_a_b_xyzw)


class Track(Message, frozen=True, kw_only=True):
    """The fused estimate of T_a_b at stamp_ns, also between triggers.

    covariance: 6x6 row-major as in RelativePose. v_a_b_mps: velocity of B's camera relative to A's, in A's camera
    frame, without the part that comes from A's rotation; v_covariance: 3x3 row-major. lights: number of lights used
    at the last trigger before stamp_ns. age_s: time since a light was last used. With attitude only: t_ned_m and the
    angles; their sigmas include the compass's error.
    """

    node_a: NodeId
    node_b: NodeId
    stamp_ns: StampNs
    t_a_b_m: Vector3
    q_a_b_xyzw: Quaternion
    covariance: Annotated[list[float], Meta(min_length=36, max_length=36)]
    v_a_b_mps: Vector3
    v_covariance: Annotated[list[float], Meta(min_length=9, max_length=9)]
    mode: TrackMode
    lights: Annotated[int, Meta(ge=0, le=4)]
    age_s: NonNegative
    range_m: NonNegative
    t_ned_m: Vector3 | UnsetType = UNSET
    sigma_ned_m: tuple[NonNegative, NonNegative, NonNegative] | UnsetType = UNSET
    azimuth_rad: float | UnsetType = UNSET
    sigma_azimuth_rad: NonNegative | UnsetType = UNSET
    inclination_rad: float | UnsetType = UNSET
    sigma_inclination_rad: NonNegative | UnsetType = UNSET

    def __post_init__(self) -> None:
        """Check the quaternion's norm."""
        _check_unit("q_a_b_xyzw", self.q_a_b_xyzw)


class NodePose(Message, frozen=True, kw_only=True):
    """A node's pose in the frame of a net: T_net_camera.

    p_m: of the camera's centre; q_xyzw: camera to net; v_mps: velocity. All are in the net's frame, which is NED if an
    attitude or a fixed node defines it. covariance: 6x6 row-major, position, then small rotation, both in the net's
    frame. fixed: the configuration declares the node to be at rest.
    """

    net: NodeId
    node: NodeId
    stamp_ns: StampNs
    p_m: Vector3
    q_xyzw: Quaternion
    v_mps: Vector3
    covariance: Annotated[list[float], Meta(min_length=36, max_length=36)]
    fixed: bool
    mode: str
    age_s: NonNegative

    def __post_init__(self) -> None:
        """Check the quaternion's norm."""
        _check_unit("q_xyzw", self.q_xyzw)


class Rejected(Message, frozen=True, kw_only=True):
    """A trigger without a pose, with the reason."""

    node_a: NodeId
    node_b: NodeId
    stamp_ns: StampNs
    trigger: Count
    reason: Reason
    detail: str = ""


class Truth(Message, frozen=True, kw_only=True):
    """True T_a_b of a simulated or surveyed dive."""

    stamp_ns: StampNs
    t_a_b_m: Vector3
    q_a_b_xyzw: Quaternion
    trigger: Count | UnsetType = UNSET

    def __post_init__(self) -> None:
        """Check the quaternion's norm."""
        _check_unit("q_a_b_xyzw", self.q_a_b_xyzw)


class TrueLight(Struct, frozen=True, kw_only=True):
    """The true place of one light of another node in a picture. merged: both lights' clipped cores overlap.

    node: whose light it is, where there are more than two nodes.
    """

    name: Literal["left", "right"]
    u_px: float
    v_px: float
    visible: bool
    merged: bool
    node: NodeId | UnsetType = UNSET


class LightTruth(Message, frozen=True, kw_only=True):
    """The true places of the other nodes' lights in this node's picture."""

    node: NodeId
    stamp_ns: StampNs
    trigger: Count
    lights: list[TrueLight]


class Mark(Message, frozen=True, kw_only=True):
    """A note for the survey about a node at an instant, by a person or by an automatic check.

    kind: station: the node is at the station `name`, from the rest nearest to this instant until it moves. point: the
    node is at a point of interest. note: the text `note` only. alarm: the survey's check `name` failed.
    """

    node: NodeId
    stamp_ns: StampNs
    kind: Literal["station", "point", "note", "alarm"] = "station"
    name: Annotated[str, Meta(max_length=64)] = ""
    note: Annotated[str, Meta(max_length=1024)] = ""


class SolverStatus(Message, frozen=True, kw_only=True):
    """Health of the solver, 1 Hz; counts since its start.

    latency: from the middle of exposure to the pose, over the poses of the last second (live dives only).
    clock_skew_s: B's clock minus A's, estimated from the dive's own messages; absent until there is an estimate.
    unused: nodes that the solver receives but is configured not to use; absent if there are none.
    """

    node_a: NodeId
    node_b: NodeId
    stamp_ns: StampNs
    software: str
    received_a: Count
    received_b: Count
    matched: Count
    solved: Count
    rejected: dict[str, int]
    late: Count
    duplicates: Count
    bad_messages: Count
    pending: Count
    latency_median_s: float | UnsetType = UNSET
    latency_p99_s: float | UnsetType = UNSET
    clock_skew_s: float | UnsetType = UNSET
    problem: str = ""
    unused: list[NodeId] | UnsetType = UNSET
