"""The bridge to ROS 2: values in ROS's frames and types, keys and attachments as rmw_zenoh has them."""

from __future__ import annotations

import itertools
import math
import struct
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS, ManualClock
from buddyline.protocol.errors import MessageError
from buddyline.protocol.messages import CompressedImage, FoxgloveTime, Message, NodePose
from buddyline.protocol.topics import DEPTH
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.export.ros_messages import MAP, RANGE_TYPE, RosMessage, Translation, name_of, type_store
from buddyline.tools.ros2 import RosGraph, attachment, dds_type
from msgspec.structs import replace

from tests.processes import PATIENCE_S, Process, free_endpoint
from tests.tools.evaluated import INFOS, pose, track
from tests.tools.watched import at, attitude, depth

pytest.importorskip("rosbags", reason="rosbags is not installed")

HALF = math.sqrt(0.5)
EAST = (0.0, 0.0, HALF, HALF)


@pytest.fixture(scope="module")
def store() -> Any:
    return type_store()


def translated(store: Any, *messages: Message) -> list[RosMessage]:
    translation = Translation(store.types)
    return [out for message in messages for out in translation.messages(message)]


def of(messages: list[RosMessage], topic: str) -> Any:
    return [message.value for message in messages if message.topic == topic][-1]


def turned(q: Any, vector: tuple[float, float, float]) -> np.ndarray[Any, Any]:
    result: np.ndarray[Any, Any] = quat_to_matrix(np.array([q.x, q.y, q.z, q.w])) @ vector
    return result


def test_a_body_that_heads_east_points_along_x_with_its_left_to_the_north(store: Any) -> None:
    value = of(translated(store, attitude("a", at(0), EAST)), "/buddyline/a/attitude")
    np.testing.assert_allclose(turned(value.orientation, (1.0, 0.0, 0.0)), (1.0, 0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(turned(value.orientation, (0.0, 1.0, 0.0)), (0.0, 1.0, 0.0), atol=1e-9)
    assert value.header.stamp.sec * S_NS + value.header.stamp.nanosec == at(0)
    assert value.orientation_covariance[8] == pytest.approx(0.05**2)
    assert value.angular_velocity_covariance[0] == -1.0


def test_depth_is_height_under_the_surface(store: Any) -> None:
    value = of(translated(store, depth("a", at(0), 12.5)), "/buddyline/a/depth")
    assert value.pose.pose.position.z == -12.5
    assert value.pose.covariance[14] == pytest.approx(0.02**2)
    assert value.pose.covariance[0] == 1e6


def test_an_absurd_sigma_gives_a_finite_variance(store: Any) -> None:
    absurd = (
        replace(depth("a", at(0), 12.5), sigma_m=1e308),
        replace(attitude("a", at(0), EAST), sigma_rad=(1e308,) * 3),
    )
    messages = translated(store, *absurd)
    assert np.isfinite(of(messages, "/buddyline/a/depth").pose.covariance).all()
    assert np.isfinite(of(messages, "/buddyline/a/attitude").orientation_covariance).all()


@pytest.mark.parametrize("absurd", [{"range_m": 1e308}, {"covariance": [1e80] * 36}])
def test_an_absurd_range_can_be_sent(store: Any, absurd: dict[str, Any]) -> None:
    """ROS has both numbers in single precision."""
    value = of(translated(store, replace(pose(0), **absurd)), "/buddyline/a/b/range")
    assert store.serialize_cdr(value, RANGE_TYPE)


def test_a_pose_is_published_unchanged_with_its_covariance(store: Any) -> None:
    value = of(translated(store, pose(0)), "/buddyline/a/b/pose")
    assert value.header.frame_id == "a_camera"
    assert value.pose.pose.position.z == 3.0
    np.testing.assert_array_equal(value.pose.covariance, pose(0).covariance)


def test_a_track_is_an_odometry_with_its_twist_in_b_s_frame(store: Any) -> None:
    rng = np.random.default_rng(1)
    q = rng.standard_normal(4)
    q /= np.linalg.norm(q)
    mixed = rng.standard_normal((3, 3))
    told = track(
        0, q_a_b_xyzw=tuple(q.tolist()), v_a_b_mps=(0.1, -0.2, 0.3), v_covariance=(mixed @ mixed.T).ravel().tolist()
    )
    value = of(translated(store, told), "/buddyline/a/b/track")
    R_a_b = quat_to_matrix(q)
    assert (value.header.frame_id, value.child_frame_id) == ("a_camera", "b_camera")
    assert value.pose.pose.position.z == 3.0
    np.testing.assert_array_equal(value.pose.covariance, told.covariance)
    linear = value.twist.twist.linear
    np.testing.assert_allclose(R_a_b @ (linear.x, linear.y, linear.z), told.v_a_b_mps, atol=1e-12)
    of_twist = value.twist.covariance.reshape(6, 6)
    np.testing.assert_allclose(R_a_b @ of_twist[:3, :3] @ R_a_b.T, mixed @ mixed.T, atol=1e-12)
    assert of_twist[5, 5] == 1e6


def test_each_node_of_a_net_is_an_odometry_in_east_north_up(store: Any) -> None:
    """It looks north, level, and swims forward: its camera's z is the north, its x the east."""
    forward = (0.5, 0.5, 0.5, 0.5)
    variances = np.diag([1.0, 4.0, 9.0, 0.01, 0.02, 0.03])
    told = NodePose(
        net="main", node="3", stamp_ns=at(0), p_m=(1.0, 2.0, 3.0), q_xyzw=forward, v_mps=(0.4, 0.0, 0.0),
        covariance=variances.ravel().tolist(), fixed=False, mode="filter", age_s=0.0,
    )  # fmt: skip
    value = of(translated(store, told), "/buddyline/net/main/node_3")
    assert (value.header.frame_id, value.child_frame_id) == ("net_main", "node_3_camera")
    place, linear = value.pose.pose.position, value.twist.twist.linear
    assert (place.x, place.y, place.z) == (2.0, 1.0, -3.0)
    np.testing.assert_allclose(turned(value.pose.pose.orientation, (0.0, 0.0, 1.0)), (0.0, 1.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(turned(value.pose.pose.orientation, (1.0, 0.0, 0.0)), (1.0, 0.0, 0.0), atol=1e-12)
    np.testing.assert_allclose((linear.x, linear.y, linear.z), (0.0, 0.0, 0.4), atol=1e-12)
    assert np.diag(value.pose.covariance.reshape(6, 6)).tolist() == pytest.approx([4.0, 1.0, 9.0, 0.02, 0.01, 0.03])
    assert (np.diag(value.twist.covariance.reshape(6, 6)) == 1e6).all()


def test_the_transform_of_b_follows_the_track_that_is_not_late(store: Any) -> None:
    def transforms(*messages: Message) -> int:
        return sum(message.topic == "/tf" for message in translated(store, *messages))

    live, late = track(0, mode="filter"), track(0, mode="lag")
    assert transforms(live, pose(1), pose(9)) == 1
    assert transforms(live, pose(1), pose(11)) == 2
    assert transforms(late, pose(1)) == 1
    topics = [message.topic for message in translated(store, late)]
    assert topics == ["/buddyline/a/b/track_lag"]


def test_transforms_lead_from_the_map_to_b(store: Any) -> None:
    said = translated(
        store, INFOS["a"], INFOS["b"], pose(0), depth("a", at(0)), attitude("a", at(1), EAST), attitude("b", at(1))
    )
    chain = {
        (t.header.frame_id, t.child_frame_id): t.transform
        for message in said
        if message.topic == "/tf"
        for t in message.value.transforms
    }
    assert set(chain) == {("map", "a_camera"), ("a_camera", "b_camera")}
    in_map, in_a = chain["map", "a_camera"], chain["a_camera", "b_camera"].translation
    origin_m = np.array([0.0, 0.0, in_map.translation.z])
    b_m = origin_m + turned(in_map.rotation, (in_a.x, in_a.y, in_a.z))
    np.testing.assert_allclose(b_m, (3.0, 0.0, -12.5), atol=1e-9)


def test_the_chain_leads_to_where_the_track_says_that_b_is_and_not_by_a_s_compass_alone(store: Any) -> None:
    """A's attitude says east, its track that the other compass has B in the north-east, and deeper."""
    ahead = track(1, (0.0, 0.0, 3.0), t_ned_m=(2.0, 2.0, 1.0))
    behind = track(2, (0.0, 0.0, 3.0), t_ned_m=(0.0, -3.0, 0.0))
    other = replace(track(2, (0.0, 0.0, 3.0), t_ned_m=(3.0, 0.0, 0.0)), node_b="c")
    told = [INFOS["a"], depth("a", at(0)), attitude("a", at(0), EAST), attitude("a", at(1), EAST), ahead]
    said = translated(store, *told, depth("a", at(2), 13.0), attitude("a", at(2), EAST), other, behind)
    chain = [t for one in said if one.topic == "/tf" for t in one.value.transforms]
    in_map = {t.header.stamp.nanosec: t.transform for t in chain if t.header.frame_id == MAP}
    assert len([t for t in chain if t.header.frame_id == MAP]) == len(in_map) == 2
    placed = in_map[at(1) % S_NS]
    np.testing.assert_allclose(turned(placed.rotation, (0.0, 0.0, 3.0)), (2.0, 2.0, -1.0), atol=1e-9)
    # Turned by no more than is needed: about the axis between both directions.
    axis = np.cross((3.0, 0.0, 0.0), (2.0, 2.0, -1.0))
    untouched = quat_to_matrix(np.array([0.5, -0.5, 0.5, -0.5]))
    assert axis @ turned(placed.rotation, untouched.T @ axis) == pytest.approx(axis @ axis)
    assert placed.translation.z == -12.5
    # An opposite direction tells no axis: A's attitude stays.
    np.testing.assert_allclose(turned(in_map[at(2) % S_NS].rotation, (0.0, 0.0, 3.0)), (3.0, 0.0, 0.0), atol=1e-9)
    assert in_map[at(2) % S_NS].translation.z == -13.0


def links(said: list[RosMessage]) -> list[tuple[str, str]]:
    """Return parent and child of each transform."""
    return [(t.header.frame_id, t.child_frame_id) for one in said if one.topic == "/tf" for t in one.value.transforms]


def test_each_frame_of_a_team_has_one_parent(store: Any) -> None:
    """B sees c before a sees b. D is seen by a and by c, at the end by c alone."""
    pairs = [("b", "c"), ("a", "b"), ("a", "d"), ("c", "d")]
    told: list[Message] = [INFOS["a"], INFOS["b"]]
    for k in range(10):
        told += [replace(pose(k), node_a=one, node_b=two) for one, two in pairs]
        told += [attitude("b", at(k) + 1), attitude("a", at(k) + 2)]
    early = links(translated(store, *told))
    # Until a is seen to stand above it, b stands in the map.
    assert set(early) == {
        ("b_camera", "c_camera"),
        ("a_camera", "b_camera"),
        ("a_camera", "d_camera"),
        (MAP, "a_camera"),
    }
    late = [replace(pose(k), node_a="c", node_b="d") for k in (20, 40)]
    assert links(translated(store, *told, *late))[len(early) :] == [("c_camera", "d_camera")] * 2


def test_a_net_places_its_nodes_and_stands_as_deep_as_their_gauges_say(store: Any) -> None:
    places = [
        NodePose(
            net="main", node=node, stamp_ns=at(0), p_m=(0.0, north_m, 2.0), q_xyzw=(0.0, 0.0, 0.0, 1.0),
            v_mps=(0.0, 0.0, 0.0), covariance=np.eye(6).ravel().tolist(), fixed=False, mode="filter", age_s=0.0,
        )
        for node, north_m in (("a", 0.0), ("b", 3.0))
    ]  # fmt: skip
    said = translated(
        store, INFOS["a"], INFOS["b"], depth("b", at(0), 12.0), *places, pose(0), attitude("a", at(1)),
        replace(pose(1), node_b="c"),
    )  # fmt: skip
    assert links(said) == [
        ("net_main", "a_camera"), ("net_main", "b_camera"), (MAP, "net_main"), ("a_camera", "c_camera")
    ]  # fmt: skip
    net = [t for one in said if one.topic == "/tf" for t in one.value.transforms if t.header.frame_id == MAP]
    assert net[0].transform.translation.z == -10.0


def test_transforms_of_a_fast_sensor_are_thinned(store: Any) -> None:
    fast = [attitude("a", at(0) + k * 10_000_000) for k in range(100)]
    said = translated(store, INFOS["a"], pose(0), *fast)
    assert sum(message.topic == "/buddyline/a/attitude" for message in said) == 100
    assert sum(message.topic == "/tf" for message in said) == 1 + 20


def test_everything_can_be_encoded_and_read_back(store: Any) -> None:
    for message in translated(store, INFOS["a"], pose(0), depth("a", at(0)), attitude("a", at(1)), track(0)):
        payload = store.serialize_cdr(message.value, message.type_name)
        again = store.deserialize_cdr(payload, message.type_name)
        assert bytes(store.serialize_cdr(again, message.type_name)) == bytes(payload)


def test_a_time_beyond_ros_range_is_refused_and_the_next_is_sent(store: Any) -> None:
    translation = Translation(store.types)
    with pytest.raises(MessageError, match="2038"):
        list(translation.messages(depth("a", 2**31 * S_NS, 12.5)))
    (last,) = translation.messages(depth("a", 2**31 * S_NS - 1, 12.5))
    assert store.serialize_cdr(last.value, last.type_name)


@pytest.mark.parametrize("frame_id", ["", "_camera", "a/b", "Front 1"])
def test_a_picture_whose_frame_is_no_nodes_is_left_out(store: Any, frame_id: str) -> None:
    image = CompressedImage(timestamp=FoxgloveTime(sec=1, nsec=0), frame_id=frame_id, data=b"x", format="jpeg")
    assert list(Translation(store.types).messages(image)) == []


def test_names_of_ros_begin_with_a_letter() -> None:
    assert (name_of("a"), name_of("1a")) == ("a", "node_1a")
    assert dds_type("sensor_msgs/msg/Imu") == "sensor_msgs::msg::dds_::Imu_"


def test_an_attachment_is_33_bytes() -> None:
    gid = bytes(range(16))
    data = attachment(7, 11, gid)
    assert len(data) == 33
    assert struct.unpack("<qqB16s", data) == (7, 11, 16, gid)


def test_over_the_bus_keys_tokens_and_sequence_are_those_of_rmw_zenoh(store: Any) -> None:
    from buddyline.protocol.zenoh_bus import open_hub, open_session

    endpoint = free_endpoint()
    came: list[Any] = []
    enough = threading.Event()

    def take(sample: Any) -> None:
        came.append((str(sample.key_expr), sample.payload.to_bytes(), sample.attachment.to_bytes()))
        if len(came) == 2:
            enough.set()

    stop = threading.Event()
    with open_hub(endpoint):
        sender: Any = open_session(endpoint, stop=stop, on_wait=lambda _: None)
        receiver: Any = open_session(endpoint, stop=stop, on_wait=lambda _: None)
        try:
            graph = RosGraph(sender, store, ManualClock(5), domain=3)
            (first,) = translated(store, depth("a", at(0), 12.5))
            graph.declare(first)
            subscriber = receiver.declare_subscriber("3/**", take)
            # What is sent before the sender knows of the receiver goes nowhere, as in ROS.
            sent = 0
            while not enough.wait(0.02) and sent < PATIENCE_S / 0.02:
                graph.publish(first)
                sent += 1
            assert enough.is_set()
            tokens = sorted(
                str(reply.ok.key_expr) for reply in receiver.liveliness().get("@ros2_lv/**", timeout=PATIENCE_S)
            )
            subscriber.undeclare()
        finally:
            sender.close()
            receiver.close()
    key, payload, beside = came[1]
    kind = "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_"
    hashed = "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
    assert key == f"3/buddyline/a/depth/{kind}/{hashed}"
    assert store.deserialize_cdr(payload, "geometry_msgs/msg/PoseWithCovarianceStamped").pose.pose.position.z == -12.5
    sequence, stamp_ns, gid_length = struct.unpack_from("<qqB", beside)
    assert (stamp_ns, gid_length) == (5, 16)
    assert sequence == struct.unpack_from("<q", came[0][2])[0] + 1
    zid = tokens[0].split("/")[2]
    assert tokens == [
        f"@ros2_lv/3/{zid}/0/0/NN/%/%/buddyline",
        f"@ros2_lv/3/{zid}/0/1/MP/%/%/buddyline/%buddyline%a%depth/{kind}/{hashed}/::,10:,:,:,,",
    ]


def test_no_more_topics_are_declared_than_a_team_has(store: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    from buddyline.protocol.zenoh_bus import open_hub, open_session

    monkeypatch.setattr("buddyline.tools.ros2.MAX_TOPICS", 2)
    endpoint = free_endpoint()
    with open_hub(endpoint):
        session: Any = open_session(endpoint, stop=threading.Event(), on_wait=lambda _: None)
        try:
            graph = RosGraph(session, store, ManualClock(5), domain=3)
            for node in "ab":
                graph.publish(translated(store, depth(node, at(0), 12.5))[0])
            with pytest.raises(MessageError, match="there are 2 topics of ROS already"):
                graph.publish(translated(store, depth("c", at(0), 12.5))[0])
            graph.publish(translated(store, depth("a", at(1), 12.5))[0])
        finally:
            session.close()


def test_messages_that_come_while_it_ends_are_no_fault(store: Any) -> None:
    from buddyline.protocol.zenoh_bus import connect, open_hub

    endpoint, stop = free_endpoint(), threading.Event()
    with open_hub(endpoint), Process("ros2", "--connect", endpoint) as ros2:
        bus = connect(endpoint, stop=stop, on_wait=lambda _: None)
        assert bus is not None
        publisher = bus.publisher(DEPTH, "a")

        def send() -> None:
            for k in itertools.count():
                if stop.wait(0.002):
                    return
                publisher.put(depth("a", at(k), 12.5))

        sender = threading.Thread(target=send)
        sender.start()
        try:
            ros2.wait_for("/buddyline/a/depth")
            assert ros2.end() == 0, ros2.lines
        finally:
            stop.set()
            sender.join()
            bus.close()


def test_a_secured_hub_lets_the_bridge_publish_for_ros_and_nobody_else(store: Any, tmp_path: Path) -> None:
    pytest.importorskip("cryptography", reason="cryptography is not installed")
    from buddyline.protocol.access import access_rules
    from buddyline.protocol.zenoh_bus import open_hub, open_session

    from tests.tools.identities import make_keys, tls, tls_endpoint

    keys = make_keys(tmp_path, "a")
    endpoint = tls_endpoint()
    came: list[str] = []
    enough = threading.Event()

    def take(sample: Any) -> None:
        came.append(f"{sample.key_expr} {sample.payload.to_bytes()[:2]!r}")
        if any("/depth/" in key for key in came):
            enough.set()

    (first,) = translated(store, depth("a", at(0), 12.5))
    with open_hub(endpoint, tls=tls(keys, "hub"), access=access_rules(["a"], "team")):
        sessions: dict[str, Any] = {
            name: open_session(endpoint, stop=threading.Event(), on_wait=lambda _: None, tls=tls(keys, name))
            for name in ("ros2", "viewer", "node-a")
        }
        try:
            for expression in ("*/buddyline/*/depth/*/*", "team/buddyline/**"):
                sessions["viewer"].declare_subscriber(expression, take)
            graph = RosGraph(sessions["ros2"], store, ManualClock(5), domain=0)
            sent = 0
            while not enough.wait(0.02) and sent < PATIENCE_S / 0.02:
                # What is denied goes first, so that it would come before.
                for name, key in (("node-a", "0/buddyline/a/depth/x/y"), ("ros2", "team/buddyline/pair/a/b/pose")):
                    sessions[name].put(key, b"no")
                graph.publish(first)
                sent += 1
            assert enough.is_set()
            tokens = [
                str(one.ok.key_expr) for one in sessions["viewer"].liveliness().get("@ros2_lv/**", timeout=PATIENCE_S)
            ]
        finally:
            for session in sessions.values():
                session.close()
    assert not any(key.endswith("b'no'") for key in came)
    assert len(tokens) == 2
