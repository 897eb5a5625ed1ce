"""A dive's messages as numpy columns, for notebooks and other programs.

Rows are in the order of their stamps; of two samples of a node with one stamp (its own log and a recording of the bus,
say) the first counts, as does the first of two outcomes of a trigger. Unknown numbers are NaN, unknown triggers -1.
"""

from __future__ import annotations

import math
from collections.abc import Hashable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import (
    Attitude,
    Blob,
    Candidates,
    CompressedImage,
    Depth,
    Imu,
    Message,
    NodeInfo,
    NodePose,
    Rejected,
    RelativePose,
    Track,
    TrackMode,
    Truth,
)
from buddyline.protocol.topics import (
    ATTITUDE,
    CANDIDATES,
    DEPTH,
    IMAGE,
    IMU,
    INFO,
    NET_POSE,
    NET_TRUTH,
    POSE,
    REJECTED,
    TRACK,
    TRACK_LAG,
    TRUTH,
    Topic,
)
from buddyline.tools.dives import Dive
from msgspec import UNSET
from numpy.typing import NDArray

Floats: TypeAlias = NDArray[np.float64]
Integers: TypeAlias = NDArray[np.int64]
Texts: TypeAlias = NDArray[np.str_]
Pair: TypeAlias = tuple[str, str]

M = TypeVar("M", bound=Message)
C = TypeVar("C", bound="Columns")


@dataclass(frozen=True, eq=False)
class Columns:
    """What all columns have: stamp_ns (n,), the measurement's time in ns since the epoch, UTC."""

    stamp_ns: Integers

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.stamp_ns)

    @property
    def time_s(self) -> Floats:
        """Seconds since the first row, (n,)."""
        first_ns = self.stamp_ns[0] if len(self) else 0
        seconds: Floats = (self.stamp_ns - first_ns) / 1e9
        return seconds


@dataclass(frozen=True, eq=False)
class EstimateColumns(Columns):
    """Estimates of T_a_b, which maps B's camera frame into A's (camera frame: x right, y down, z forward).

    t_a_b_m (n, 3): B's camera in A's camera frame. q_a_b_xyzw (n, 4). covariance (n, 6, 6): position (m), then the
    small rotation w (rad) with R_true = exp(w) R_a_b, both in A's camera frame. range_m (n,). lights (n,): number of
    different lights used. With an attitude of A: t_ned_m (n, 3), north-east-down; sigma_ned_m (n, 3), azimuth_rad
    (from north, clockwise), inclination_rad (up) and their sigmas (n,), 1 sd, which count the compass's error; else
    NaN.
    """

    t_a_b_m: Floats
    q_a_b_xyzw: Floats
    covariance: Floats
    range_m: Floats
    lights: Integers
    t_ned_m: Floats
    sigma_ned_m: Floats
    azimuth_rad: Floats
    sigma_azimuth_rad: Floats
    inclination_rad: Floats
    sigma_inclination_rad: Floats

    @property
    def sigma_m(self) -> Floats:
        """Standard deviations of the position along A's camera axes, (n, 3)."""
        sigma_m: Floats = np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)[:, :3])
        return sigma_m


@dataclass(frozen=True, eq=False)
class PoseColumns(EstimateColumns):
    """The poses of triggers. trigger (n,): the instant trigger * trigger_period_ns.

    chi2 (n,): of the lights' places in both pictures, two degrees of freedom with four lights. method (n,): that of
    `solve` ("refined", "exact", ...), or "three_lights" where one light was not seen.
    """

    trigger: Integers
    chi2: Floats
    method: Texts


@dataclass(frozen=True, eq=False)
class TrackColumns(EstimateColumns):
    """The fused estimate, also between triggers.

    v_a_b_mps (n, 3): velocity of B's camera relative to A's, in A's camera frame, without the part that comes from A's
    rotation; v_covariance (n, 3, 3). lights: at the last trigger. age_s (n,): time since a light was last used.
    mode: "smooth" (whole dive), "lag" (a second later), "filter" (live); empty if there is no track.
    """

    v_a_b_mps: Floats
    v_covariance: Floats
    age_s: Floats
    mode: str


@dataclass(frozen=True, eq=False)
class TruthColumns(Columns):
    """True poses T_a_b of a simulated or surveyed dive: trigger (n,), t_a_b_m (n, 3), q_a_b_xyzw (n, 4)."""

    trigger: Integers
    t_a_b_m: Floats
    q_a_b_xyzw: Floats


@dataclass(frozen=True, eq=False)
class NodePoseColumns(Columns):
    """A node's poses in the frame of a net, camera to net: p_m, v_mps (n, 3), q_xyzw (n, 4), age_s (n,).

    covariance (n, 6, 6): position (m), then the small rotation w (rad) with R_true = exp(w) R, both in the net's frame.
    """

    p_m: Floats
    q_xyzw: Floats
    v_mps: Floats
    covariance: Floats
    age_s: Floats


@dataclass(frozen=True, eq=False)
class RejectionColumns(Columns):
    """Triggers without a pose: trigger, reason, detail (n,).

    reason: one of those that docs/troubleshooting.md explains. detail: the same in words, with figures; may be "".
    """

    trigger: Integers
    reason: Texts
    detail: Texts


@dataclass(frozen=True, eq=False)
class AttitudeColumns(Columns):
    """A node's orientation: q_ned_body_xyzw (n, 4), body (x forward, y right, z down) to north-east-down.

    sigma_rad (n, 3): of roll, pitch, yaw, 1 sd.
    """

    q_ned_body_xyzw: Floats
    sigma_rad: Floats


@dataclass(frozen=True, eq=False)
class DepthColumns(Columns):
    """A node's depth gauge: depth_m (down, 0 at the surface), sigma_m (1 sd), pressure_pa, temperature_degc (n,).

    pressure_pa: absolute, at the gauge's port. temperature_degc: of the water there.
    """

    depth_m: Floats
    sigma_m: Floats
    pressure_pa: Floats
    temperature_degc: Floats


@dataclass(frozen=True, eq=False)
class ImuColumns(Columns):
    """A node's raw inertial samples in its body frame (x forward, y right, z down): (n, 3) each.

    accel_mps2: specific force, (0, 0, -9.8) of a level node at rest. gyro_radps: turn rate. mag_t: uncalibrated
    magnetic field; NaN where it was not read.
    """

    accel_mps2: Floats
    gyro_radps: Floats
    mag_t: Floats


@dataclass(frozen=True, eq=False)
class CandidateColumns(Columns):
    """A node's light candidates, a row a candidate, in each frame the likeliest lights first.

    trigger (n,); blob (n,): its index in its frame. u_px, v_px: place in the distorted image, pixel centres at
    integers; sigma_px, area_px, peak (0-255), elongation, score (0-1) (n,). frame_stamp_ns, frame_trigger (f,): of all
    frames, those without candidates, too.
    """

    trigger: Integers
    blob: Integers
    u_px: Floats
    v_px: Floats
    sigma_px: Floats
    area_px: Floats
    peak: Floats
    elongation: Floats
    score: Floats
    frame_stamp_ns: Integers
    frame_trigger: Integers


class DiveColumns:
    """A stored dive, out of one or more logs. Each method reads what it returns; no file stays open.

    nodes, pairs: those in the logs. infos: each node's calibration. losses: what could not be read of damaged
    logs so far, a line each with file and byte; everything else was used.
    Raises BuddylineError naming the file if one is missing or is no dive log.
    """

    def __init__(self, *logs: str | Path) -> None:
        if not logs:
            raise BuddylineError("give at least one dive log")
        self._logs = [Path(log) for log in logs]
        self.losses: list[str] = []
        with Dive(self._logs) as dive:
            self.infos: dict[str, NodeInfo] = dive.infos()
            self.nodes: list[str] = dive.nodes(*(topic.name for topic in _OF_NODES))
            self.pairs: list[Pair] = [(ids[0], ids[1]) for ids in dive.ids(*(topic.name for topic in _OF_PAIRS))]
            self._note(dive)

    def poses(self, pair: Pair | None = None) -> PoseColumns:
        """Return the solved poses; pair: needed if there are several."""
        return pose_columns(self._of_pair(POSE, RelativePose, pair))

    def track(self, pair: Pair | None = None, mode: TrackMode | None = None) -> TrackColumns:
        """Return the fused estimate; pair: needed if there are several.

        mode: default: the best that the logs have of smooth, lag, filter.
        """
        found = self._of_pair(TRACK, Track, pair) + self._of_pair(TRACK_LAG, Track, pair)
        return track_columns(in_order(of_mode(found, mode)))

    def truth(self, pair: Pair | None = None) -> TruthColumns:
        """Return the true poses; pair: needed if there are several."""
        return columns_of(TruthColumns, self._of_pair(TRUTH, Truth, pair))

    def node_poses(self, node: str, net: str = "main") -> NodePoseColumns:
        """Return a node's poses in a net's frame; none where the dive was solved as a pair."""
        return columns_of(NodePoseColumns, self._read(NET_POSE, NodePose, (net, node)))

    def node_truth(self, node: str, net: str = "main") -> NodePoseColumns:
        """Return a node's true poses, in north-east-down."""
        return columns_of(NodePoseColumns, self._read(NET_TRUTH, NodePose, (net, node)))

    def rejections(self, pair: Pair | None = None) -> RejectionColumns:
        """Return the triggers without a pose; pair: needed if there are several."""
        return columns_of(RejectionColumns, self._of_pair(REJECTED, Rejected, pair))

    def attitudes(self, node: str) -> AttitudeColumns:
        """Return a node's attitudes."""
        return columns_of(AttitudeColumns, self._of_node(ATTITUDE, Attitude, node))

    def depths(self, node: str) -> DepthColumns:
        """Return a node's depths."""
        return columns_of(DepthColumns, self._of_node(DEPTH, Depth, node))

    def imu(self, node: str) -> ImuColumns:
        """Return a node's inertial samples."""
        return columns_of(ImuColumns, self._of_node(IMU, Imu, node))

    def candidates(self, node: str) -> CandidateColumns:
        """Return a node's light candidates; of a dive of pictures there are none before `buddyline detect`."""
        return candidate_columns(self._of_node(CANDIDATES, Candidates, node))

    def pictures(self, node: str) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Yield a node's recorded pictures: stamp_ns, and blue green red (H, W, 3) or grey (H, W), in the log's order.

        A picture that cannot be decoded is left out, and named in losses.
        """
        from buddyline.node.drivers.stored import PictureError, decode_picture

        self._check(node)
        with Dive(self._logs) as dive:
            for envelope in dive.messages(IMAGE.name):
                message = envelope.message
                if envelope.ids != (node,) or not isinstance(message, CompressedImage):
                    continue
                try:
                    picture = decode_picture(
                        message.data, f"{self._name}: picture of node {node} at {message.stamp_ns}"
                    )
                except PictureError as error:
                    self.losses.append(str(error))
                    continue
                yield message.stamp_ns, picture
            self._note(dive)

    def _of_pair(self, topic: Topic, schema: type[M], pair: Pair | None) -> list[M]:
        if pair is None:
            if len(self.pairs) > 1:
                listed = ", ".join("/".join(one) for one in self.pairs)
                raise BuddylineError(f"{self._name}: holds pairs {listed}; choose one: pair={self.pairs[0]!r}")
            pair = self.pairs[0] if self.pairs else ("", "")
        elif pair not in self.pairs:
            raise BuddylineError(f"{self._name}: holds nothing of pair {'/'.join(pair)}")
        return self._read(topic, schema, pair)

    def _check(self, node: str) -> None:
        if node not in self.nodes:
            known = ", ".join(self.nodes) or "none"
            raise BuddylineError(f"{self._name}: holds nothing of node {node!r}; nodes: {known}")

    def _of_node(self, topic: Topic, schema: type[M], node: str) -> list[M]:
        self._check(node)
        return self._read(topic, schema, (node,))

    def _read(self, topic: Topic, schema: type[M], ids: tuple[str, ...]) -> list[M]:
        with Dive(self._logs) as dive:
            found = [
                envelope.message
                for envelope in dive.messages(topic.name)
                if envelope.ids == ids and isinstance(envelope.message, schema)
            ]
            self._note(dive)
        return in_order(found)

    def _note(self, dive: Dive) -> None:
        self.losses += [line for line in dive.losses if line not in self.losses]

    @property
    def _name(self) -> str:
        return ", ".join(map(str, self._logs))


_THREE = (
    "t_a_b_m",
    "p_m",
    "v_mps",
    "t_ned_m",
    "sigma_ned_m",
    "v_a_b_mps",
    "sigma_rad",
    "accel_mps2",
    "gyro_radps",
    "mag_t",
)
# The shape of a column's values by its name; the others are single values.
_SHAPES = dict.fromkeys(_THREE, (3,)) | {
    "q_a_b_xyzw": (4,),
    "q_xyzw": (4,),
    "q_ned_body_xyzw": (4,),
    "covariance": (6, 6),
    "v_covariance": (3, 3),
}
_OF_NODES = (INFO, IMAGE, CANDIDATES, ATTITUDE, DEPTH, IMU)
_OF_PAIRS = (POSE, REJECTED, TRACK, TRACK_LAG, TRUTH)
BEST_FIRST: tuple[TrackMode, ...] = ("smooth", "lag", "filter")


def in_order(found: Iterable[M]) -> list[M]:
    """Return messages of one topic and sender by stamp, one a stamp: the first."""
    first: dict[Hashable, M] = {}
    for message in found:
        first.setdefault(_stamp_ns(message), message)
    return sorted(first.values(), key=_stamp_ns)


def _stamp_ns(message: Message) -> int:
    stamp_ns: int = getattr(message, "stamp_ns")  # noqa: B009  # messages of a dive have one, their base has not
    return stamp_ns


def columns_of(kind: type[C], messages: Sequence[Message | Blob], **own: Any) -> C:
    """Return messages as columns, in their order: each column is the messages' field of its name, unless in own."""
    given: dict[str, Any] = dict(own)
    for name, value_type in ((field.name, field.type) for field in fields(kind) if field.name not in own):
        values = [getattr(message, name) for message in messages]
        shape = _SHAPES.get(name, ())
        if value_type == "Floats":
            unknown = np.full(math.prod(shape), np.nan) if shape else np.nan
            values = [unknown if value is UNSET else value for value in values]
            given[name] = np.array(values, np.float64).reshape(-1, *shape)
        elif value_type == "Integers":
            given[name] = np.array([-1 if value is UNSET else value for value in values], np.int64)
        else:
            given[name] = np.array(values, np.str_)
    return kind(**given)


def pose_columns(poses: Sequence[RelativePose]) -> PoseColumns:
    """Return the poses, in their order, as columns."""
    lights = [sum(index >= 0 for index in (*pose.blobs_a, *pose.blobs_b)) for pose in poses]
    return columns_of(PoseColumns, poses, lights=np.array(lights, np.int64))


def of_mode(tracks: Sequence[Track], mode: TrackMode | None = None) -> list[Track]:
    """Return the samples of one mode; None: of the best mode that is among them."""
    modes = {one.mode for one in tracks}
    chosen = mode or next((best for best in BEST_FIRST if best in modes), None)
    return [one for one in tracks if one.mode == chosen]


def track_columns(tracks: Sequence[Track]) -> TrackColumns:
    """Return a track's estimates, in their order and of one mode, as columns."""
    return columns_of(TrackColumns, tracks, mode=tracks[0].mode if tracks else "")


def candidate_columns(frames: Sequence[Candidates]) -> CandidateColumns:
    """Return the candidates of frames, in their order, as columns."""
    of_blobs = [(frame.stamp_ns, frame.trigger, index) for frame in frames for index in range(len(frame.blobs))]
    of_frames = [(frame.stamp_ns, frame.trigger) for frame in frames]
    stamps_ns, triggers, indices = np.array(of_blobs, np.int64).reshape(-1, 3).T
    frame_stamps_ns, frame_triggers = np.array(of_frames, np.int64).reshape(-1, 2).T
    return columns_of(
        CandidateColumns,
        [blob for frame in frames for blob in frame.blobs],
        stamp_ns=stamps_ns,
        trigger=triggers,
        blob=indices,
        frame_stamp_ns=frame_stamps_ns,
        frame_trigger=frame_triggers,
    )
