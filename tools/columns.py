"""A dive's messages as numpy columns, for notebooks and other programs.

Rows are in the order of their stamps; of two samples of a node with one stamp (its own log and a recording of the bus,
say) the first counts, as does the first of two outcomes of a trigger. Unknown numbers are NaN, unknown triggers -1.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias, TypeVar

import numpy as np
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
    Depth,
    Imu,
    Message,
    NodeInfo,
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
class PoseColumns(Columns):
    """Relative poses T_a_b, which map B's camera frame into A's.

    trigger (n,). t_a_b_m (n, 3), m. q_a_b_xyzw (n, 4). covariance (n, 6, 6): position (m), then the small rotation w
    (rad) with R_true = exp(w) R_a_b, both in A's camera frame. range_m, chi2 (n,). lights (n,): from how many of the
    four lights. method (n,): "refined", "three_lights", ... With an attitude of A: t_ned_m, sigma_ned_m (n, 3),
    azimuth_rad (from north, clockwise), inclination_rad (up) and their sigmas (n,), which count the compass's error.
    """

    trigger: Integers
    t_a_b_m: Floats
    q_a_b_xyzw: Floats
    covariance: Floats
    range_m: Floats
    chi2: Floats
    lights: Integers
    method: Texts
    t_ned_m: Floats
    sigma_ned_m: Floats
    azimuth_rad: Floats
    sigma_azimuth_rad: Floats
    inclination_rad: Floats
    sigma_inclination_rad: Floats

    @property
    def sigma_m(self) -> Floats:
        """Standard deviations of the position along A's camera axes, (n, 3)."""
        return _sigma_m(self.covariance)


@dataclass(frozen=True, eq=False)
class TrackColumns(Columns):
    """The fused estimate of T_a_b, also between poses. Columns as in PoseColumns, and:

    v_a_b_mps (n, 3): velocity of B's camera relative to A's, in A's camera frame, A's turning not counted;
    v_covariance (n, 3, 3). lights (n,): number of different lights used at the last trigger. age_s (n,): since a light
    was last used. mode: "smooth" (whole dive), "lag" (a second later), "filter" (live); empty if there is no track.
    """

    t_a_b_m: Floats
    q_a_b_xyzw: Floats
    covariance: Floats
    v_a_b_mps: Floats
    v_covariance: Floats
    lights: Integers
    age_s: Floats
    range_m: Floats
    t_ned_m: Floats
    sigma_ned_m: Floats
    azimuth_rad: Floats
    sigma_azimuth_rad: Floats
    inclination_rad: Floats
    sigma_inclination_rad: Floats
    mode: str

    @property
    def sigma_m(self) -> Floats:
        """Standard deviations of the position along A's camera axes, (n, 3)."""
        return _sigma_m(self.covariance)


@dataclass(frozen=True, eq=False)
class TruthColumns(Columns):
    """True poses T_a_b of a simulated or surveyed dive: trigger (n,), t_a_b_m (n, 3), q_a_b_xyzw (n, 4)."""

    trigger: Integers
    t_a_b_m: Floats
    q_a_b_xyzw: Floats


@dataclass(frozen=True, eq=False)
class RejectionColumns(Columns):
    """Triggers without a pose: trigger, reason (one word), detail (n,)."""

    trigger: Integers
    reason: Texts
    detail: Texts


@dataclass(frozen=True, eq=False)
class AttitudeColumns(Columns):
    """A node's orientation: q_ned_body_xyzw (n, 4), body to north-east-down; sigma_rad (n, 3): roll, pitch, yaw."""

    q_ned_body_xyzw: Floats
    sigma_rad: Floats


@dataclass(frozen=True, eq=False)
class DepthColumns(Columns):
    """A node's depth gauge: depth_m (down, 0 at the surface), sigma_m, pressure_pa, temperature_degc (n,)."""

    depth_m: Floats
    sigma_m: Floats
    pressure_pa: Floats
    temperature_degc: Floats


@dataclass(frozen=True, eq=False)
class ImuColumns(Columns):
    """A node's raw inertial samples in its body frame: accel_mps2, gyro_radps, mag_t (n, 3)."""

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
    Raises BuddylineError naming the file where one is missing or is no dive log.
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
        """Return the solved poses; pair: may be left out where there is one."""
        return pose_columns(self._of_pair(POSE, RelativePose, pair))

    def track(self, pair: Pair | None = None, mode: TrackMode | None = None) -> TrackColumns:
        """Return the fused estimate; pair: may be left out where there is one.

        mode: default: of the modes in the logs the best: smooth, lag, filter.
        """
        found = self._of_pair(TRACK, Track, pair) + self._of_pair(TRACK_LAG, Track, pair)
        return track_columns(in_order(of_mode(found, mode)))

    def truth(self, pair: Pair | None = None) -> TruthColumns:
        """Return the true poses; pair: may be left out where there is one."""
        return truth_columns(self._of_pair(TRUTH, Truth, pair))

    def rejections(self, pair: Pair | None = None) -> RejectionColumns:
        """Return the triggers without a pose; pair: may be left out where there is one."""
        return rejection_columns(self._of_pair(REJECTED, Rejected, pair))

    def attitudes(self, node: str) -> AttitudeColumns:
        """Return a node's attitudes."""
        found = self._of_node(ATTITUDE, Attitude, node)
        return AttitudeColumns(
            _stamps([one.stamp_ns for one in found]),
            _floats([one.q_ned_body_xyzw for one in found], 4),
            _floats([one.sigma_rad for one in found], 3),
        )

    def depths(self, node: str) -> DepthColumns:
        """Return a node's depths."""
        found = self._of_node(DEPTH, Depth, node)
        return DepthColumns(
            _stamps([one.stamp_ns for one in found]),
            _floats([one.depth_m for one in found]),
            _floats([one.sigma_m for one in found]),
            _floats([_known(one.pressure_pa) for one in found]),
            _floats([_known(one.temperature_degc) for one in found]),
        )

    def imu(self, node: str) -> ImuColumns:
        """Return a node's inertial samples."""
        found = self._of_node(IMU, Imu, node)
        return ImuColumns(
            _stamps([one.stamp_ns for one in found]),
            _floats([one.accel_mps2 for one in found], 3),
            _floats([one.gyro_radps for one in found], 3),
            _floats([_NOWHERE if one.mag_t is UNSET else one.mag_t for one in found], 3),
        )

    def candidates(self, node: str) -> CandidateColumns:
        """Return a node's light candidates; of a dive of pictures there are none before `buddyline detect`."""
        return candidate_columns(self._of_node(CANDIDATES, Candidates, node))

    def _of_pair(self, topic: Topic, schema: type[M], pair: Pair | None) -> list[M]:
        if pair is None:
            if len(self.pairs) > 1:
                listed = ", ".join("/".join(one) for one in self.pairs)
                raise BuddylineError(f"{self._name}: holds pairs {listed}; choose one: pair=({self.pairs[0]!r})")
            pair = self.pairs[0] if self.pairs else ("", "")
        elif pair not in self.pairs:
            raise BuddylineError(f"{self._name}: holds nothing of pair {'/'.join(pair)}")
        return self._read(topic, schema, pair)

    def _of_node(self, topic: Topic, schema: type[M], node: str) -> list[M]:
        if node not in self.nodes:
            known = ", ".join(self.nodes) or "none"
            raise BuddylineError(f"{self._name}: holds nothing of node {node!r}; nodes: {known}")
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


_NOWHERE = (np.nan, np.nan, np.nan)
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


def pose_columns(poses: Sequence[RelativePose]) -> PoseColumns:
    """Return the poses, in their order, as columns."""
    return PoseColumns(
        _stamps([pose.stamp_ns for pose in poses]),
        _stamps([pose.trigger for pose in poses]),
        _floats([pose.t_a_b_m for pose in poses], 3),
        _floats([pose.q_a_b_xyzw for pose in poses], 4),
        _floats([pose.covariance for pose in poses], 36).reshape(-1, 6, 6),
        _floats([pose.range_m for pose in poses]),
        _floats([pose.chi2 for pose in poses]),
        _stamps([sum(index >= 0 for index in (*pose.blobs_a, *pose.blobs_b)) for pose in poses]),
        _texts([pose.method for pose in poses]),
        *_ned_columns(poses),
    )


def of_mode(tracks: Sequence[Track], mode: TrackMode | None = None) -> list[Track]:
    """Return the samples of one mode; None: of the best mode that is among them."""
    modes = {one.mode for one in tracks}
    chosen = mode or next((best for best in BEST_FIRST if best in modes), None)
    return [one for one in tracks if one.mode == chosen]


def track_columns(tracks: Sequence[Track]) -> TrackColumns:
    """Return a track's estimates, in their order and of one mode, as columns."""
    return TrackColumns(
        _stamps([one.stamp_ns for one in tracks]),
        _floats([one.t_a_b_m for one in tracks], 3),
        _floats([one.q_a_b_xyzw for one in tracks], 4),
        _floats([one.covariance for one in tracks], 36).reshape(-1, 6, 6),
        _floats([one.v_a_b_mps for one in tracks], 3),
        _floats([one.v_covariance for one in tracks], 9).reshape(-1, 3, 3),
        _stamps([one.lights for one in tracks]),
        _floats([one.age_s for one in tracks]),
        _floats([one.range_m for one in tracks]),
        *_ned_columns(tracks),
        tracks[0].mode if tracks else "",
    )


def _ned_columns(
    found: Sequence[RelativePose] | Sequence[Track],
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Return place and sigma in NED, azimuth and sigma, inclination and sigma."""
    return (
        _floats([_NOWHERE if one.t_ned_m is UNSET else one.t_ned_m for one in found], 3),
        _floats([_NOWHERE if one.sigma_ned_m is UNSET else one.sigma_ned_m for one in found], 3),
        _floats([_known(one.azimuth_rad) for one in found]),
        _floats([_known(one.sigma_azimuth_rad) for one in found]),
        _floats([_known(one.inclination_rad) for one in found]),
        _floats([_known(one.sigma_inclination_rad) for one in found]),
    )


def _sigma_m(covariance: Floats) -> Floats:
    sigma_m: Floats = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)[:, :3])
    return sigma_m


def truth_columns(truths: Sequence[Truth]) -> TruthColumns:
    """Return true poses, in their order, as columns."""
    return TruthColumns(
        _stamps([one.stamp_ns for one in truths]),
        _stamps([-1 if one.trigger is UNSET else one.trigger for one in truths]),
        _floats([one.t_a_b_m for one in truths], 3),
        _floats([one.q_a_b_xyzw for one in truths], 4),
    )


def rejection_columns(rejected: Sequence[Rejected]) -> RejectionColumns:
    """Return rejections, in their order, as columns."""
    return RejectionColumns(
        _stamps([one.stamp_ns for one in rejected]),
        _stamps([one.trigger for one in rejected]),
        _texts([one.reason for one in rejected]),
        _texts([one.detail for one in rejected]),
    )


def candidate_columns(frames: Sequence[Candidates]) -> CandidateColumns:
    """Return the candidates of frames, in their order, as columns."""
    blobs = [(frame, index, blob) for frame in frames for index, blob in enumerate(frame.blobs)]
    return CandidateColumns(
        _stamps([frame.stamp_ns for frame, _, _ in blobs]),
        _stamps([frame.trigger for frame, _, _ in blobs]),
        _stamps([index for _, index, _ in blobs]),
        _floats([blob.u_px for _, _, blob in blobs]),
        _floats([blob.v_px for _, _, blob in blobs]),
        _floats([blob.sigma_px for _, _, blob in blobs]),
        _floats([blob.area_px for _, _, blob in blobs]),
        _floats([blob.peak for _, _, blob in blobs]),
        _floats([blob.elongation for _, _, blob in blobs]),
        _floats([_known(blob.score) for _, _, blob in blobs]),
        _stamps([frame.stamp_ns for frame in frames]),
        _stamps([frame.trigger for frame in frames]),
    )


def _known(value: object) -> float:
    return value if isinstance(value, float | int) else np.nan


def _stamps(values: list[int]) -> Integers:
    return np.array(values, dtype=np.int64)


def _floats(values: Sequence[float] | Sequence[Sequence[float]], width: int = 0) -> Floats:
    column = np.array(values, dtype=np.float64)
    return column.reshape(-1, width) if width else column


def _texts(values: list[str]) -> Texts:
    return np.array(values, dtype=np.str_)
