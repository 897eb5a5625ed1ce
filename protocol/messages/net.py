"""What is known of all nodes in one frame."""

from __future__ import annotations

from typing import Annotated

from buddyline.protocol.messages.fields import Message, NodeId, NonNegative, Quaternion, StampNs, Vector3, check_unit
from msgspec import Meta


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
        check_unit("q_xyzw", self.q_xyzw)
