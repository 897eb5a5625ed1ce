"""What a machine with ROS 2 would see: zenoh-ros2-sdk, in an environment of its own, as one JSON object a message.

    python ros_receiver.py PORT DOMAIN SECONDS TOPIC=TYPE ...

Ends when every topic has come, or after SECONDS. The type hashes are the receiver's own, made of the definitions below.
"""

import json
import sys
import threading
import time
from pathlib import Path

# ROS 2 Jazzy's own definitions, without their comments: the package would fetch them with git.
DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "Point position\nQuaternion orientation",
    "geometry_msgs/PoseWithCovariance": "Pose pose\nfloat64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\nPoseWithCovariance pose",
    "geometry_msgs/Transform": "Vector3 translation\nQuaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\nTransform transform",
    "sensor_msgs/Imu": "std_msgs/Header header\n"
    "geometry_msgs/Quaternion orientation\nfloat64[9] orientation_covariance\n"
    "geometry_msgs/Vector3 angular_velocity\nfloat64[9] angular_velocity_covariance\n"
    "geometry_msgs/Vector3 linear_acceleration\nfloat64[9] linear_acceleration_covariance",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}


def plain(value):
    """Return a message as JSON can say it."""
    if hasattr(value, "__dataclass_fields__"):
        return {name: plain(getattr(value, name)) for name in value.__dataclass_fields__ if name != "__msgtype__"}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return value


def main():
    """Receive, print, end."""
    port, domain, seconds = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    import zenoh_ros2_sdk

    for name, text in DEFINITIONS.items():
        package, _, kind = name.partition("/")
        file = Path(zenoh_ros2_sdk.__file__).parents[1] / "messages" / package / "msg" / f"{kind}.msg"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text + "\n")
    missing = set()
    lock, done = threading.Lock(), threading.Event()

    def hear(topic):
        def take(message):
            with lock:
                print(json.dumps({"topic": topic, "message": plain(message)}), flush=True)
                missing.discard(topic)
                if not missing:
                    done.set()

        return take

    wanted = [word.partition("=") for word in sys.argv[4:]]
    missing.update(topic for topic, _, _ in wanted)
    subscribers = [
        zenoh_ros2_sdk.ROS2Subscriber(
            topic=topic, msg_type=kind, callback=hear(topic), domain_id=domain, router_ip="127.0.0.1", router_port=port
        )
        for topic, _, kind in wanted
    ]
    print(json.dumps({"ready": sorted(missing)}), flush=True)
    done.wait(seconds)
    # A moment more, so that each topic is seen going on.
    time.sleep(0.5)
    for subscriber in subscribers:
        subscriber.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
