"""What is known of a pair of nodes: poses, tracks, triggers without a pose, truth, and the solver's health."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

from buddyline.protocol.messages.fields import (
    Count,
    Message,
    NodeId,
    NonNegative,
    Quaternion,
    StampNs,
    Vector3,
    check_unit,
)
from msgspec import UNSET, Meta, UnsetType

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


class RelativePose(Message, frozen=True, kw_only=True):
    """T_a_b: maps B's camera frame into A's.

    covariance: 6x6 row-major, position in A's camera frame (m), then the small rotation w (rad) with
    R_true = exp(w) R_a_b, in A's camera frame. blobs_a: [left, right] of B's lights, as indices into A's
    Candidates (-1: that light was not seen); blobs_b likewise. stamp_ns: mean of both pictures' stamps, so midway
    between both nodes' clocks; skew_ns: stamp_a - stamp_b. A solver that is told how the clocks differ has taken both
    stamps onto the first node's clock before.
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
        check_unit("q_a_b_xyzw", self.q_a_b_xyzw)


class Track(Message, frozen=True, kw_only=True):
    """The fused estimate of T_a_b at stamp_ns, also between triggers.

    stamp_ns: midway between both nodes' clocks, as in RelativePose, also where the track has found how they differ.
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
        check_unit("q_a_b_xyzw", self.q_a_b_xyzw)


class Rejected(Message, frozen=True, kw_only=True):
    """A trigger without a pose, with the reason."""

    node_a: NodeId
    node_b: NodeId
    stamp_ns: StampNs
    trigger: Count
    reason: Reason
    detail: str = ""


class Truth(Message, frozen=True, kw_only=True):
    """True T_a_b of a simulated or surveyed dive. stamp_ns: midway between both nodes' clocks."""

    stamp_ns: StampNs
    t_a_b_m: Vector3
    q_a_b_xyzw: Quaternion
    trigger: Count | UnsetType = UNSET

    def __post_init__(self) -> None:
        """Check the quaternion's norm."""
        check_unit("q_a_b_xyzw", self.q_a_b_xyzw)


class SolverStatus(Message, frozen=True, kw_only=True):
    """Health of the solver, 1 Hz, and sooner where the advice changes; counts since its start.

    latency: from the middle of exposure to the pose, over the poses since the last status (live dives only).
    clock_skew_s: B's clock minus A's, estimated from the dive's own messages; absent until there is an estimate.
    unused: nodes that the solver receives but is configured not to use; absent if there are none.
    advice: what the divers should do for a fix or a better one, a phrase each; absent if there is nothing to do.
    late_imu: inertial samples that came after the track had passed their time, without effect; absent if none did.
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
    advice: list[str] | UnsetType = UNSET
    late_imu: Count | UnsetType = UNSET
