"""Our messages as ROS 2's: for the live bridge (`ros2`) and for `export --format mcap-ros2`.

Frames follow REP 103: the world `map` is east, north, up, with the surface at zero; bodies are forward, left, up;
cameras are right, down, forward, as in this project.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from buddyline.protocol.clock import S_NS
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import (
    NODE_ID_PATTERN,
    Attitude,
    CompressedImage,
    Depth,
    Message,
    NodeInfo,
    NodePose,
    NodeStatus,
    Rejected,
    RelativePose,
    SolverStatus,
    Track,
)
from buddyline.solver_service.geometry.rotation import matrix_to_quat, quat_to_matrix
from buddyline.tools.estimate import range_sigma_m
from buddyline.tools.export.enu import R_ENU_NED, SILENT_NS, BaseCamera, FrameTree, NetDepths, net_enu
from buddyline.tools.extras import needed
from buddyline.tools.health.words import reason_words

MAP: Final = "map"
# builtin_interfaces/Time counts seconds in 32 bits, with a sign.
END_OF_ROS_TIME_NS: Final = 2**31 * S_NS
# Between forward, left, up and forward, right, down: the matrix is its own inverse.
R_FRD_FLU: Final = np.diag([1.0, -1.0, -1.0])
# Variance of a field that was not measured: large, so that filters ignore the field.
UNKNOWN_VARIANCE: Final = 1e6
# Range has numbers of single precision; the square of a greater sigma is none.
MOST_SINGLE: Final = float(np.finfo(np.float32).max)
MOST_SIGMA: Final = 1e19

POSE_TYPE: Final = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY_TYPE: Final = "nav_msgs/msg/Odometry"
IMU_TYPE: Final = "sensor_msgs/msg/Imu"
TF_TYPE: Final = "tf2_msgs/msg/TFMessage"
RANGE_TYPE: Final = "sensor_msgs/msg/Range"
IMAGE_TYPE: Final = "sensor_msgs/msg/CompressedImage"
CAMERA_TYPE: Final = "sensor_msgs/msg/CameraInfo"
DIAGNOSTICS_TYPE: Final = "diagnostic_msgs/msg/DiagnosticArray"
DIAGNOSTICS: Final = "/diagnostics"
DISTORTION_MODELS: Final = {"pinhole": "plumb_bob", "fisheye": "equidistant"}
# Levels of diagnostic_msgs/DiagnosticStatus.
OK, WARN, ERROR = 0, 1, 2
# Ranges that sensor_msgs/Range calls valid, m.
MIN_RANGE_M, MAX_RANGE_M = 0.1, 100.0


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
        self._tree = FrameTree()
        self._based_ns = 0
        self._depths = NetDepths()

    def messages(self, message: Message) -> Iterator[RosMessage]:
        """Yield the ROS messages for one of our messages; raise MessageError where ROS cannot say its time."""
        stamp_ns = getattr(message, "stamp_ns", 0)
        if stamp_ns >= END_OF_ROS_TIME_NS and not isinstance(message, NodeInfo):
            raise MessageError(f"stamp_ns {stamp_ns}: the time of ROS 2 ends in 2038")
        if isinstance(message, NodeInfo):
            self._camera.take(message)
        elif isinstance(message, Attitude):
            yield self._imu(message)
            yield from self._camera_in_map(message)
        elif isinstance(message, Depth):
            self._camera.take(message)
            yield self._depth(message)
        elif isinstance(message, RelativePose):
            yield from self._pose(message)
        elif isinstance(message, Track):
            yield from self._track(message)
        elif isinstance(message, NodePose):
            yield from self._node_pose(message)
        elif isinstance(message, CompressedImage):
            yield from self._picture(message)
        elif isinstance(message, Rejected):
            pair = f"{message.node_a}/{message.node_b}"
            values = {"reason": message.reason, "detail": message.detail, "trigger": message.trigger}
            yield self._diagnosis(stamp_ns, f"buddyline: pose {pair}", WARN, reason_words(message.reason), values)
        elif isinstance(message, NodeStatus):
            level = ERROR if message.problem else OK
            values = {f"{what} per second": rate for what, rate in message.rates_hz.items()}
            values |= {f"dropped: {cause}": count for cause, count in message.drops.items()}
            values["uptime s"] = message.uptime_s
            yield self._diagnosis(stamp_ns, f"buddyline: node {message.node}", level, message.problem or "ok", values)
        elif isinstance(message, SolverStatus):
            level = WARN if message.problem else OK
            name = f"buddyline: solver {message.node_a}/{message.node_b}"
            counts = {"matched": message.matched, "solved": message.solved, "late": message.late}
            counts |= {f"rejected: {reason}": count for reason, count in message.rejected.items()}
            yield self._diagnosis(stamp_ns, name, level, message.problem or "ok", counts)

    def _diagnosis(self, stamp_ns: int, name: str, level: int, text: str, values: Mapping[str, object]) -> RosMessage:
        """Return one status of ROS's diagnostics. A pose found says nothing: its absence has the reason."""
        pairs = [self._new("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in values.items()]
        status = self._new(
            "diagnostic_msgs/msg/DiagnosticStatus", level=level, name=name, message=text, hardware_id="", values=pairs
        )
        value = self._new(DIAGNOSTICS_TYPE, header=self._header(stamp_ns, ""), status=[status])
        return RosMessage(DIAGNOSTICS, DIAGNOSTICS_TYPE, value)

    def _picture(self, image: CompressedImage) -> Iterator[RosMessage]:
        """Yield a picture, and its camera's calibration where that is known."""
        node = image.frame_id.removesuffix("_camera")
        # Other programs choose their own frame names, which may be no part of a ROS name.
        if not re.match(NODE_ID_PATTERN, node):
            return
        header = self._header(image.stamp_ns, f"{name_of(node)}_camera")
        data = np.frombuffer(image.data, np.uint8)
        value = self._new(IMAGE_TYPE, header=header, format=image.format, data=data)
        yield RosMessage(f"/buddyline/{name_of(node)}/camera/image/compressed", IMAGE_TYPE, value)
        info = self._camera.infos.get(node)
        if info is not None:
            yield RosMessage(
                f"/buddyline/{name_of(node)}/camera/camera_info", CAMERA_TYPE, self._calibration(info, header)
            )

    def _calibration(self, info: NodeInfo, header: Any) -> Any:
        camera = info.camera
        K = np.array([[camera.fx_px, 0.0, camera.cx_px], [0.0, camera.fy_px, camera.cy_px], [0.0, 0.0, 1.0]])
        whole = self._new(
            "sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False
        )
        return self._new(
            CAMERA_TYPE,
            header=header,
            height=info.height_px,
            width=info.width_px,
            distortion_model=DISTORTION_MODELS[camera.model],
            d=np.array(camera.distortion),
            k=K.ravel(),
            r=np.eye(3).ravel(),
            p=np.hstack((K, np.zeros((3, 1)))).ravel(),
            binning_x=0,
            binning_y=0,
            roi=whole,
        )

    def _range(self, estimate: Track | RelativePose) -> RosMessage:
        """Return the range from A's camera to B's, with its variance."""
        a, b = name_of(estimate.node_a), name_of(estimate.node_b)
        value = self._new(
            RANGE_TYPE,
            header=self._header(estimate.stamp_ns, f"{a}_camera"),
            # Light: of the two kinds that ROS has, infrared is the nearer.
            radiation_type=1,
            field_of_view=0.0,
            min_range=MIN_RANGE_M,
            max_range=MAX_RANGE_M,
            range=min(estimate.range_m, MOST_SINGLE),
            variance=min(range_sigma_m(estimate), MOST_SIGMA) ** 2,
        )
        return RosMessage(f"/buddyline/{a}/{b}/range", RANGE_TYPE, value)

    def _imu(self, attitude: Attitude) -> RosMessage:
        R_enu_flu = R_ENU_NED @ quat_to_matrix(np.array(attitude.q_ned_body_xyzw)) @ R_FRD_FLU
        unknown = np.array([-1.0] + [0.0] * 8)
        nothing = self._new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        value = self._new(
            IMU_TYPE,
            header=self._header(attitude.stamp_ns, f"{name_of(attitude.node)}_body"),
            orientation=self._quaternion(R_enu_flu),
            orientation_covariance=np.diag(np.minimum(attitude.sigma_rad, MOST_SIGMA) ** 2).ravel(),
            # sensor_msgs/Imu: -1 means that a quantity is not given.
            angular_velocity=nothing,
            angular_velocity_covariance=unknown,
            linear_acceleration=nothing,
            linear_acceleration_covariance=unknown,
        )
        return RosMessage(f"/buddyline/{name_of(attitude.node)}/attitude", IMU_TYPE, value)

    def _camera_in_map(self, attitude: Attitude) -> Iterator[RosMessage]:
        """Yield the transform of A's camera. B's follows from the pose, because a frame has only one parent."""
        yield from self._base(attitude.node, attitude.stamp_ns, self._camera.orientation(attitude))

    def _base(self, node: str, stamp_ns: int, R_enu_camera: Any) -> Iterator[RosMessage]:
        """Yield the transform of the node that stands in the map; R_enu_camera: None for none."""
        if R_enu_camera is not None and self._tree.parent(node, stamp_ns) is None:
            x, y, z = self._camera.position_m(node, stamp_ns).tolist()
            yield self._transform(stamp_ns, MAP, f"{name_of(node)}_camera", (x, y, z), R_enu_camera)

    def _depth(self, depth: Depth) -> RosMessage:
        variances = np.full(6, UNKNOWN_VARIANCE)
        variances[2] = min(depth.sigma_m, MOST_SIGMA) ** 2
        value = self._posed(depth.stamp_ns, MAP, (0.0, 0.0, -depth.depth_m), np.eye(3), np.diag(variances).ravel())
        return RosMessage(f"/buddyline/{name_of(depth.node)}/depth", POSE_TYPE, value)

    def _pose(self, pose: RelativePose) -> Iterator[RosMessage]:
        a, b = name_of(pose.node_a), name_of(pose.node_b)
        R_a_b = quat_to_matrix(np.array(pose.q_a_b_xyzw))
        # Position, then rotation about A's fixed axes: the same order and meaning as in ROS.
        value = self._posed(pose.stamp_ns, f"{a}_camera", pose.t_a_b_m, R_a_b, np.array(pose.covariance))
        yield RosMessage(f"/buddyline/{a}/{b}/pose", POSE_TYPE, value)
        tracked_ns = self._tracked_ns.get((a, b))
        if tracked_ns is None or abs(pose.stamp_ns - tracked_ns) > SILENT_NS:
            yield self._range(pose)
            yield from self._placed(pose, R_a_b)

    def _track(self, track: Track) -> Iterator[RosMessage]:
        """Yield a track's sample as an odometry of B's camera, and on /tf the sample of the track that is not late.

        nav_msgs/Odometry: the pose is in the header's frame, A's camera; the twist in the child's, B's camera. So the
        velocity and its covariance are rotated by R_b_a. The velocity has no part from A's rotation. The track does
        not contain B's angular rate.
        """
        a, b = name_of(track.node_a), name_of(track.node_b)
        R_a_b = quat_to_matrix(np.array(track.q_a_b_xyzw))
        placed = self._posed(track.stamp_ns, f"{a}_camera", track.t_a_b_m, R_a_b, np.array(track.covariance))
        of_velocity = R_a_b.T @ np.array(track.v_covariance).reshape(3, 3) @ R_a_b
        value = self._odometry(placed, f"{b}_camera", R_a_b.T @ np.array(track.v_a_b_mps), of_velocity)
        late = track.mode == "lag"
        yield RosMessage(f"/buddyline/{a}/{b}/{'track_lag' if late else 'track'}", ODOMETRY_TYPE, value)
        if not late:
            self._tracked_ns[a, b] = track.stamp_ns
            yield self._range(track)
            yield from self._placed(track, R_a_b)
            yield from self._base(track.node_a, track.stamp_ns, self._camera.tracked(track))

    def _placed(self, estimate: Track | RelativePose, R_a_b: Any) -> Iterator[RosMessage]:
        """Yield B's transform from A's camera, unless the net or another pair places B; A's root stands in the map."""
        a, b, stamp_ns = estimate.node_a, estimate.node_b, estimate.stamp_ns
        if not self._tree.place(a, b, stamp_ns):
            return
        root, base = self._tree.root(a, stamp_ns), self._camera.base
        stands = base is not None and self._tree.parent(base, stamp_ns) is None
        if root == base or not stands or abs(stamp_ns - self._based_ns) > SILENT_NS:
            self._camera.base, self._based_ns = root, stamp_ns
        yield self._transform(stamp_ns, f"{name_of(a)}_camera", f"{name_of(b)}_camera", estimate.t_a_b_m, R_a_b)

    def _node_pose(self, pose: NodePose) -> Iterator[RosMessage]:
        """Yield a node's pose in its net's frame, here east-north-up, as an odometry of its camera and a transform.

        The velocity is in the camera's frame, without a covariance: NodePose has none. The net's zero is as deep as one
        of its nodes says.
        """
        net, node = name_of(pose.net), name_of(pose.node)
        at_m, R_enu_camera = net_enu(pose)
        x, y, z = at_m.tolist()
        turn = np.kron(np.eye(2), R_ENU_NED)
        covariance = (turn @ np.array(pose.covariance).reshape(6, 6) @ turn.T).ravel()
        frame = f"net_{pose.net}"
        placed = self._posed(pose.stamp_ns, frame, (x, y, z), R_enu_camera, covariance)
        velocity_mps = R_enu_camera.T @ R_ENU_NED @ np.array(pose.v_mps)
        unknown = UNKNOWN_VARIANCE * np.eye(3)
        value = self._odometry(placed, f"{node}_camera", velocity_mps, unknown)
        yield RosMessage(f"/buddyline/net/{net}/{node}", ODOMETRY_TYPE, value)
        # No node's id has a slash.
        self._tree.place(f"net/{net}", pose.node, pose.stamp_ns, first=True)
        yield self._transform(pose.stamp_ns, frame, f"{node}_camera", (x, y, z), R_enu_camera)
        up_m = self._depths.up_m(pose, self._camera)
        if up_m is not None:
            yield self._transform(pose.stamp_ns, MAP, frame, (0.0, 0.0, up_m), np.eye(3))

    def _odometry(self, placed: Any, child: str, velocity_mps: Any, of_velocity: Any) -> Any:
        """Return the odometry of a child frame at a placed pose; its velocity and covariance are in that frame."""
        x, y, z = velocity_mps.tolist()
        of_twist = UNKNOWN_VARIANCE * np.eye(6)
        of_twist[:3, :3] = of_velocity
        twist = self._new(
            "geometry_msgs/msg/Twist",
            linear=self._new("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            angular=self._new("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0),
        )
        return self._new(
            ODOMETRY_TYPE,
            header=placed.header,
            child_frame_id=child,
            pose=placed.pose,
            twist=self._new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=of_twist.ravel()),
        )

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


def type_store() -> Any:
    """Return ROS 2 Jazzy's types; raise BuddylineError if rosbags is not installed."""
    typesys = needed("rosbags.typesys", "what ROS 2 reads", "ros2")
    return typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
