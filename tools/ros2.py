"""`buddyline ros2`: publish attitudes, depths, poses and tracks for ROS 2, in the form of its middleware rmw_zenoh.

ROS 2 machines with RMW_IMPLEMENTATION=rmw_zenoh_cpp and our hub as their router see them as any other topic. Frames
follow REP 103: the world `map` is east, north, up, with the surface at zero; bodies are forward, left, up; cameras
are right, down, forward, as in this project.
"""

from __future__ import annotations

import argparse
import logging
import os
import struct
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS, Clock, SystemClock
from buddyline.protocol.errors import BuddylineError, MessageError
from buddyline.protocol.messages import Attitude, Depth, Message, NodeInfo, RelativePose, Track
from buddyline.protocol.security import ROS
from buddyline.protocol.topics import ATTITUDE, DEPTH, INFO, POSE, TRACK, TRACK_LAG
from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix
from buddyline.tools.client import client_config
from buddyline.tools.enu import R_ENU_NED, BaseCamera
from buddyline.tools.live import LiveClient, follow

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus
    from buddyline.protocol.envelope import Envelope

log = logging.getLogger(__name__)

MAP: Final = "map"
NODE_NAME: Final = "buddyline"
# Quality of service in rmw_zenoh's liveliness tokens: reliable, volatile, the last 10 kept, the rest default.
QOS: Final = "::,10:,:,:,,"
# builtin_interfaces/Time counts seconds in 32 bits, with a sign.
END_OF_ROS_TIME_NS: Final = 2**31 * S_NS
# After a track has been silent for this time, poses give B's transform again.
TRACK_SILENT_NS: Final = S_NS
# Between forward, left, up and forward, right, down: the matrix is its own inverse.
R_FRD_FLU: Final = np.diag([1.0, -1.0, -1.0])
# Variance of a field that was not measured: large, so that filters ignore the field.
UNKNOWN_VARIANCE: Final = 1e6

POSE_TYPE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY_TYPE: Final = "nav_msgs/msg/Odometry"
IMU_TYPE: Final = "sensor_msgs/msg/Imu"
TF_TYPE: Final = "tf2_msgs/msg/TFMessage"


@dataclass(frozen=True)
class RosMessage:
    """One ROS message: its topic, its ROS type name, and the value as rosbags' class of that type."""

    topic: str
    type_name: str
    value: Any


def name_of(node: str) -> str:
    """Return a node's id as part of a ROS name, which must begin with a letter."""
    return node if node[0].isalpha() else f"node_{node}"


class Translation:
    """Translates our messages into ROS's. Its state is what earlier messages said. types: of a rosbags type store."""

    def __init__(self, types: dict[str, Any]) -> None:
        self._types = types
        self._camera = BaseCamera()
        self._tracked_ns: dict[tuple[str, str], int] = {}

    def messages(self, message: Message) -> Iterator[RosMessage]:
        """Yield the ROS messages for one of our messages; raise MessageError where ROS cannot say its time."""
        if isinstance(message, Attitude | Depth | RelativePose | Track) and message.stamp_ns >= END_OF_ROS_TIME_NS:
            raise MessageError(f"stamp_ns {message.stamp_ns}: the time of ROS 2 ends in 2038")
        if isinstance(message, NodeInfo):
            self._camera.take(message)
        elif isinstance(message, Attitude):
            yield self._imu(message)
            yield from self._camera_in_map(message)
        elif isinstance(message, Depth):
            self._camera.take(message)
            yield self._depth(message)
        elif isinstance(message, RelativePose):
            self._camera.base = message.node_a
            yield from self._pose(message)
        elif isinstance(message, Track):
            self._camera.base = message.node_a
            yield from self._track(message)

    def _imu(self, attitude: Attitude) -> RosMessage:
        R_enu_flu = R_ENU_NED @ quat_to_matrix(np.array(attitude.q_ned_body_xyzw)) @ R_FRD_FLU
        unknown = np.array([-1.0] + [0.0] * 8)
        nothing = self._new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        value = self._new(
            IMU_TYPE,
            header=self._header(attitude.stamp_ns, f"{name_of(attitude.node)}_body"),
            orientation=self._quaternion(R_enu_flu),
            orientation_covariance=np.diag(np.array(attitude.sigma_rad) ** 2).ravel(),
            # sensor_msgs/Imu: -1 means that a quantity is not given.
            angular_velocity=nothing,
            angular_velocity_covariance=unknown,
            linear_acceleration=nothing,
            linear_acceleration_covariance=unknown,
        )
        return RosMessage(f"/buddyline/{name_of(attitude.node)}/attitude", IMU_TYPE, value)

    def _camera_in_map(self, attitude: Attitude) -> Iterator[RosMessage]:
        """Yield the transform of A's camera. B's follows from the pose, because a frame has only one parent."""
        R = self._camera.orientation(attitude)
        if R is not None:
            x, y, z = self._camera.position_m(attitude.node).tolist()
            yield self._transform(attitude.stamp_ns, MAP, f"{name_of(attitude.node)}_camera", (x, y, z), R)

    def _depth(self, depth: Depth) -> RosMessage:
        variances = np.full(6, UNKNOWN_VARIANCE)
        variances[2] = depth.sigma_m**2
        value = self._posed(depth.stamp_ns, MAP, (0.0, 0.0, -depth.depth_m), np.eye(3), np.diag(variances).ravel())
        return RosMessage(f"/buddyline/{name_of(depth.node)}/depth", POSE_TYPE, value)

    def _pose(self, pose: RelativePose) -> Iterator[RosMessage]:
        a, b = name_of(pose.node_a), name_of(pose.node_b)
        R_a_b = quat_to_matrix(np.array(pose.q_a_b_xyzw))
        # Position, then rotation about A's fixed axes: the same order and meaning as in ROS.
        value = self._posed(pose.stamp_ns, f"{a}_camera", pose.t_a_b_m, R_a_b, np.array(pose.covariance))
        yield RosMessage(f"/buddyline/{a}/{b}/pose", POSE_TYPE, value)
        tracked_ns = self._tracked_ns.get((a, b))
        if tracked_ns is None or abs(pose.stamp_ns - tracked_ns) > TRACK_SILENT_NS:
            yield self._transform(pose.stamp_ns, f"{a}_camera", f"{b}_camera", pose.t_a_b_m, R_a_b)

    def _track(self, track: Track) -> Iterator[RosMessage]:
        """Yield a track's sample as an odometry of B's camera, and on /tf the sample of the track that is not late.

        nav_msgs/Odometry: the pose is in the header's frame, A's camera; the twist in the child's, B's camera. So the
        velocity and its covariance are rotated by R_b_a. The velocity has no part from A's rotation. The track does
        not contain B's angular rate.
        """
        a, b = name_of(track.node_a), name_of(track.node_b)
        R_a_b = quat_to_matrix(np.array(track.q_a_b_xyzw))
        x, y, z = (R_a_b.T @ np.array(track.v_a_b_mps)).tolist()
        of_twist = UNKNOWN_VARIANCE * np.eye(6)
        of_twist[:3, :3] = R_a_b.T @ np.array(track.v_covariance).reshape(3, 3) @ R_a_b
        placed = self._posed(track.stamp_ns, f"{a}_camera", track.t_a_b_m, R_a_b, np.array(track.covariance))
        value = self._new(
            ODOMETRY_TYPE,
            header=placed.header,
            child_frame_id=f"{b}_camera",
            pose=placed.pose,
            twist=self._new(
                "geometry_msgs/msg/TwistWithCovariance",
                twist=self._new(
                    "geometry_msgs/msg/Twist",
                    linear=self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                    angular=self._new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0),
                ),
                covariance=of_twist.ravel(),
            ),
        )
        late = track.mode == "lag"
        yield RosMessage(f"/buddyline/{a}/{b}/{'track_lag' if late else 'track'}", ODOMETRY_TYPE, value)
        if not late:
            self._tracked_ns[a, b] = track.stamp_ns
            yield self._transform(track.stamp_ns, f"{a}_camera", f"{b}_camera", track.t_a_b_m, R_a_b)

    def _posed(self, stamp_ns: int, frame_id: str, t_m: tuple[float, float, float], R: Any, covariance: Any) -> Any:
        x, y, z = t_m
        pose = self._new(
            "geometry_msgs/msg/Pose",
            position=self._new("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._quaternion(R),
        )
        with_covariance = self._new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
        return self._new(POSE_TYPE, header=self._header(stamp_ns, frame_id), pose=with_covariance)

    def _transform(self, stamp_ns: int, parent: str, child: str, t_m: tuple[float, float, float], R: Any) -> RosMessage:
        x, y, z = t_m
        stamped = self._new(
            "geometry_msgs/msg/TransformStamped",
            header=self._header(stamp_ns, parent),
            child_frame_id=child,
            transform=self._new(
                "geometry_msgs/msg/Transform",
                translation=self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                rotation=self._quaternion(R),
            ),
        )
        return RosMessage("/tf", TF_TYPE, self._new(TF_TYPE, transforms=[stamped]))

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        time = self._new("builtin_interfaces/msg/Time", sec=stamp_ns // S_NS, nanosec=stamp_ns % S_NS)
        return self._new("std_msgs/msg/Header", stamp=time, frame_id=frame_id)

    def _quaternion(self, R: Any) -> Any:
        x, y, z, w = (float(value) for value in matrix_to_quat(R))
        return self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _new(self, type_name: str, **fields: Any) -> Any:
        return self._types[type_name](**fields)


class RosGraph:
    """One ROS node and its publishers in the form of rmw_zenoh: keys, liveliness tokens, attachments."""

    def __init__(self, session: Any, store: Any, clock: Clock, domain: int) -> None:
        self._session = session
        self._store = store
        self._clock = clock
        self._domain = domain
        self._zid = str(session.zid())
        self._endpoints: dict[str, RosEndpoint] = {}
        self._tokens = [session.liveliness().declare_token(self._token(0, "NN"))]

    def _token(self, entity: int, kind: str) -> str:
        # An empty enclave and the root namespace are both written as %.
        return f"@ros2_lv/{self._domain}/{self._zid}/0/{entity}/{kind}/%/%/{NODE_NAME}"

    def publish(self, message: RosMessage) -> None:
        """Send one message; its topic is declared at the first message."""
        self.declare(message)
        endpoint = self._endpoints[message.topic]
        payload = bytes(self._store.serialize_cdr(message.value, message.type_name))
        endpoint.sequence += 1
        endpoint.publisher.put(payload, attachment=attachment(endpoint.sequence, self._clock.now_ns(), endpoint.gid))

    def declare(self, message: RosMessage) -> None:
        """Declare the topic of a message, if it is not declared yet."""
        if message.topic in self._endpoints:
            return
        entity = len(self._endpoints) + 1
        type_key = f"{dds_type(message.type_name)}/{self._store.hash_rihs01(message.type_name)}"
        mangled = message.topic.replace("/", "%")
        publisher = self._session.declare_publisher(f"{self._domain}/{message.topic.lstrip('/')}/{type_key}")
        token = f"{self._token(entity, 'MP')}/{mangled}/{type_key}/{QOS}"
        self._tokens.append(self._session.liveliness().declare_token(token))
        log.info("ros2: %s (%s)", message.topic, message.type_name)
        self._endpoints[message.topic] = RosEndpoint(publisher, os.urandom(16))


@dataclass
class RosEndpoint:
    """One publisher of a ROS topic. gid: its id in every sample."""

    publisher: Any
    gid: bytes
    sequence: int = 0


def dds_type(type_name: str) -> str:
    """Return DDS's form of `package/msg/Type`: `package::msg::dds_::Type_`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def attachment(sequence: int, stamp_ns: int, gid: bytes) -> bytes:
    """Return rmw_zenoh's attachment of a sample: two int64, then the gid with its length before it."""
    return struct.pack("<qqB", sequence, stamp_ns, len(gid)) + gid


def type_store() -> Any:
    """Return ROS 2 Jazzy's types; raise BuddylineError if rosbags is not installed."""
    try:
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise BuddylineError("ros2 needs rosbags, which is not installed: make install EXTRAS=ros2") from error
    return get_typestore(Stores.ROS2_JAZZY)


def run(args: argparse.Namespace) -> int:
    """Translate until stopped."""
    store = type_store()
    client = LiveClient("ros2", client_config(args, ROS), args.seconds)

    def translate(bus: Bus) -> None:
        from buddyline.protocol.zenoh_bus import open_session

        # ROS's keys and payloads do not go over our bus, but over a session of their own.
        tls = client.config.tls
        session: Any = open_session(client.config.connect, stop=client.stop, on_wait=log.info, tls=tls)
        if session is None:
            return
        try:
            translation, graph = Translation(store.types), RosGraph(session, store, SystemClock(), args.domain)
            lock = threading.Lock()

            def publish(envelope: Envelope) -> None:
                # Each subscription has a thread of its own; sequence numbers must rise one by one.
                with lock:
                    try:
                        for translated in translation.messages(envelope.message):
                            graph.publish(translated)
                    except MessageError as error:
                        client.refusals.note(envelope.key, error)

            follow(bus, INFO.key_any(), client.refusals, publish, capacity=64)
            for topic in (ATTITUDE, DEPTH, POSE, TRACK, TRACK_LAG):
                follow(bus, topic.key_any(), client.refusals, publish, capacity=256, history=False)
            client.wait()
        finally:
            session.close()

    return client.run(translate)
