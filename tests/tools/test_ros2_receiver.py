"""`buddyline ros2` heard by an independent receiver, zenoh-ros2-sdk, that knows nothing of ours."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.topics import ATTITUDE, DEPTH, INFO, POSE

from tests.processes import free_endpoint
from tests.tools.evaluated import INFOS, pose
from tests.tools.watched import at, attitude, depth

pytest.importorskip("rosbags", reason="rosbags is not installed")
pytestmark = [pytest.mark.slow, pytest.mark.timeout(300)]

ROOT = Path(__file__).parents[2]
DOMAIN = 7
IMU = "sensor_msgs/msg/Imu"
POSED = "geometry_msgs/msg/PoseWithCovarianceStamped"
TOPICS = {
    "/buddyline/a/attitude": IMU,
    "/buddyline/b/attitude": IMU,
    "/buddyline/a/depth": POSED,
    "/buddyline/b/depth": POSED,
    "/buddyline/a/b/pose": POSED,
    "/tf": "tf2_msgs/msg/TFMessage",
}
EAST = (0.0, 0.0, 0.5**0.5, 0.5**0.5)


@pytest.fixture(scope="module")
def receiver(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, str]]:
    """An environment with the receiver, and its variables; its home is not ours: it edits git's settings."""
    directory = tmp_path_factory.mktemp("ros")
    env = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "ZENOH", "ROS_"))}
    env |= {"HOME": str(directory), "XDG_CONFIG_HOME": str(directory), "XDG_CACHE_HOME": str(directory)}
    python = directory / "venv" / "bin" / "python"
    subprocess.run([sys.executable, "-m", "venv", str(directory / "venv")], check=True, timeout=120)
    installed = subprocess.run(
        [str(python), "-m", "pip", "install", "--quiet", "zenoh-ros2-sdk>=0.1.8"],
        env=env | {k: v for k, v in os.environ.items() if k.startswith("PIP_")},
        capture_output=True,
        text=True,
        timeout=240,
        check=False,
    )
    if installed.returncode != 0:
        last = installed.stderr.strip().splitlines()[-1:]
        pytest.skip(f"zenoh-ros2-sdk cannot be installed here: {' '.join(last)}")
    return python, env


@pytest.fixture
def port() -> Iterator[int]:
    from buddyline.protocol.zenoh_bus import open_hub

    number = int(free_endpoint().rpartition(":")[2])
    with open_hub(f"tcp/127.0.0.1:{number}"):
        yield number


def test_attitude_depth_pose_and_transforms_arrive_as_they_are(
    receiver: tuple[Path, dict[str, str]], port: int, tmp_path: Path
) -> None:
    python, env = receiver
    endpoint = f"tcp/127.0.0.1:{port}"
    words = [f"{topic}={kind}" for topic, kind in TOPICS.items()]
    with (
        open(tmp_path / "bridge.log", "wb") as log,
        open(tmp_path / "heard.log", "wb") as errors,
        subprocess.Popen(
            [str(python), str(Path(__file__).with_name("ros_receiver.py")), str(port), str(DOMAIN), "60", *words],
            env=env,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as listener,
        subprocess.Popen(
            [sys.executable, "-P", "-m", "buddyline", "ros2", "--connect", endpoint, "--domain", str(DOMAIN)],
            cwd=ROOT,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
        ) as bridge,
    ):
        try:
            heard = heard_while_publishing(listener, endpoint)
        finally:
            bridge.terminate()
            listener.terminate()
    assert sorted(heard) == sorted(TOPICS), (tmp_path / "heard.log").read_text() + (tmp_path / "bridge.log").read_text()
    check_poses(heard)
    check_transforms(heard["/tf"])


def heard_while_publishing(listener: subprocess.Popen[str], endpoint: str) -> dict[str, list[Any]]:
    """Publish a pair that stays where it is until the listener has heard of everything; return it by topic."""
    from buddyline.protocol.zenoh_bus import connect

    heard: dict[str, list[Any]] = defaultdict(list)

    def listen() -> None:
        for row in listener.stdout or ():
            said = json.loads(row)
            if "topic" in said:
                heard[said["topic"]].append(said["message"])

    ears = threading.Thread(target=listen)
    ears.start()
    stop = threading.Event()
    bus = connect(endpoint, namespace=None, stop=stop, on_wait=lambda _: None)
    assert bus is not None
    with bus:
        publishers = {
            (topic.name, *ids): bus.publisher(topic, *ids)
            for topic, ids in [(t, (n,)) for t in (INFO, ATTITUDE, DEPTH) for n in "ab"] + [(POSE, ("a", "b"))]
        }
        for node in "ab":
            publishers[INFO.name, node].put(INFOS[node])
        k = 0
        while listener.poll() is None and k < 1200:
            for node in "ab":
                publishers[DEPTH.name, node].put(depth(node, at(k), 12.5))
                publishers[ATTITUDE.name, node].put(attitude(node, at(k), EAST))
            publishers[POSE.name, "a", "b"].put(pose(k))
            k += 1
            stop.wait(0.05)
    listener.terminate()
    ears.join(10)
    return heard


def check_poses(heard: dict[str, list[Any]]) -> None:
    stamp = heard["/buddyline/a/attitude"][-1]["header"]["stamp"]
    assert (stamp["sec"] * S_NS + stamp["nanosec"] - at(0)) % (at(1) - at(0)) == 0
    # A body that heads east has x forward along ROS's east: no turn at all.
    turn = heard["/buddyline/b/attitude"][-1]["orientation"]
    assert abs(turn["w"]) == pytest.approx(1.0)
    assert heard["/buddyline/a/attitude"][-1]["orientation_covariance"][8] == pytest.approx(0.05**2)
    for node in "ab":
        level = heard[f"/buddyline/{node}/depth"][-1]
        assert level["header"]["frame_id"] == "map"
        assert level["pose"]["pose"]["position"]["z"] == -12.5
    sent, found = pose(0), heard["/buddyline/a/b/pose"][-1]
    assert found["header"]["frame_id"] == "a_camera"
    assert [found["pose"]["pose"]["position"][axis] for axis in "xyz"] == list(sent.t_a_b_m)
    turn = [found["pose"]["pose"]["orientation"][axis] for axis in "xyzw"]
    assert abs(np.dot(turn, sent.q_a_b_xyzw)) == pytest.approx(1.0)
    assert found["pose"]["covariance"] == list(sent.covariance)


def check_transforms(heard: list[Any]) -> None:
    chain = {(t["header"]["frame_id"], t["child_frame_id"]): t["transform"] for m in heard for t in m["transforms"]}
    assert set(chain) == {("map", "a_camera"), ("a_camera", "b_camera")}
    assert chain["map", "a_camera"]["translation"] == {"x": 0.0, "y": 0.0, "z": -12.5}
    assert chain["a_camera", "b_camera"]["translation"]["z"] == pose(0).t_a_b_m[2]
