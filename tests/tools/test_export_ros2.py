"""A dive as a ROS 2 log and as a Parquet table: every value read back by others' readers equals the log."""

from __future__ import annotations

import csv
import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.messages import Message, NodePose
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.cli import main
from buddyline.tools.export.enu import BaseCamera
from msgspec.structs import replace

from tests.tools.evaluated import INFOS, pose, rejection, track, truth, write_log
from tests.tools.watched import PNG, at, attitude, depth, image, solver_status, status

RNG = np.random.default_rng(3)


def mixed(n: int) -> list[float]:
    factor = RNG.normal(size=(n, n)) / 10
    covariance: list[float] = (factor @ factor.T).ravel().tolist()
    return covariance


def quaternion() -> tuple[float, float, float, float]:
    x, y, z, w = (q := RNG.normal(size=4)) / np.linalg.norm(q)
    return float(x), float(y), float(z), float(w)


def spoken() -> list[Message]:
    said: list[Message] = [*INFOS.values()]
    for k in range(20):
        t_m = (float(x) for x in RNG.normal(size=3))
        estimate = track(k, tuple(t_m), q_a_b_xyzw=quaternion(), covariance=mixed(6))  # type: ignore[arg-type]
        said += [
            attitude("a", at(k), quaternion()),
            depth("a", at(k), 12.5 + k / 7),
            replace(pose(k), covariance=mixed(6)) if k % 5 else rejection(k),
            replace(estimate, v_a_b_mps=(0.1 / 3, -0.2, 0.7), v_covariance=mixed(3)),
        ]
    of_net = NodePose(
        net="main", node="a", stamp_ns=at(6), p_m=(1.0, 2.0, 3.0), q_xyzw=quaternion(), v_mps=(0.4, 0.0, 0.0),
        covariance=mixed(6), fixed=False, mode="smooth", age_s=0.0,
    )  # fmt: skip
    return [*said, of_net, image("a", at(3)), status("a", at(4), "camera: gone"), solver_status(at(5))]


def test_a_camera_stands_above_its_gauges_port() -> None:
    """By as much as its attitude says: level and looking north, and then on its left side."""
    camera = BaseCamera()
    camera.base = "a"
    camera.take(replace(INFOS["a"], depth_port_m=(0.1, 0.25, 0.0)))
    camera.take(depth("a", at(0), 3.0))
    assert camera.position_m("a").tolist() == [0.0, 0.0, -3.0]
    camera.orientation(attitude("a", at(0)))
    assert camera.position_m("a") == pytest.approx((0.0, 0.0, -2.75))
    camera.take(depth("a", at(9), 3.0))
    camera.orientation(attitude("a", at(9), (-math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))))
    assert camera.position_m("a") == pytest.approx((0.0, 0.0, -3.1))
    assert camera.position_m("a", at(1)) == pytest.approx((0.0, 0.0, -2.75))


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Message], Path]:
    messages = spoken()
    path = tmp_path_factory.mktemp("dive") / "dive.mcap"
    write_log(path, *messages)
    return messages, path


def of(messages: list[Message], name: str) -> dict[int, Any]:
    return {m.stamp_ns: m for m in messages if type(m).__name__ == name}  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def read(dive: tuple[list[Message], Path]) -> dict[str, dict[int, Any]]:
    """All messages by topic and stamp, as rosbags reads them with the definitions that are in the file alone."""
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    from rosbags.highlevel import AnyReader
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_typestore

    output = dive[1].with_name("ros.mcap")
    assert main(["export", str(dive[1]), "--format", "mcap-ros2", "-o", str(output)]) == 0
    found: dict[str, dict[int, Any]] = {}
    with AnyReader([output], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        for connection, time_ns, data in reader.messages():
            value = reader.deserialize(data, connection.msgtype)
            header = getattr(value, "header", None) or value.transforms[0].header
            stamp_ns = header.stamp.sec * S_NS + header.stamp.nanosec
            assert time_ns == stamp_ns
            found.setdefault(connection.topic, {})[stamp_ns] = value
    with Reader(output) as plain:
        assert {connection.topic for connection in plain.connections} == set(found)
    return found


class TestRos2:
    def test_every_message_is_there(self, dive: tuple[list[Message], Path], read: dict[str, dict[int, Any]]) -> None:
        counts = {topic: len(messages) for topic, messages in read.items()}
        assert counts.pop("/tf") >= 20
        assert counts == {
            "/buddyline/a/attitude": 20,
            "/buddyline/a/depth": 20,
            "/buddyline/a/b/pose": 16,
            "/buddyline/a/b/track": 20,
            "/buddyline/a/b/range": 20,
            "/buddyline/net/main/a": 1,
            "/buddyline/a/camera/image/compressed": 1,
            "/buddyline/a/camera/camera_info": 1,
            "/diagnostics": 5,
        }

    def test_odometry_equals_the_track(self, dive: tuple[list[Message], Path], read: dict[str, dict[int, Any]]) -> None:
        for stamp_ns, told in of(dive[0], "Track").items():
            value = read["/buddyline/a/b/track"][stamp_ns]
            place, turn = value.pose.pose.position, value.pose.pose.orientation
            np.testing.assert_allclose((place.x, place.y, place.z), told.t_a_b_m, rtol=0, atol=1e-9)
            q = np.array((turn.x, turn.y, turn.z, turn.w))
            assert abs(abs(float(q @ np.array(told.q_a_b_xyzw))) - 1) < 1e-9
            np.testing.assert_allclose(value.pose.covariance, told.covariance, rtol=0, atol=1e-9)
            R = quat_to_matrix(q)
            linear = value.twist.twist.linear
            np.testing.assert_allclose(R @ (linear.x, linear.y, linear.z), told.v_a_b_mps, rtol=0, atol=1e-9)
            whole = value.twist.covariance.reshape(6, 6)[:3, :3]
            np.testing.assert_allclose((R @ whole @ R.T).ravel(), told.v_covariance, rtol=0, atol=1e-9)

    def test_poses_depths_and_pictures_equal_the_log_s(
        self, dive: tuple[list[Message], Path], read: dict[str, dict[int, Any]]
    ) -> None:
        for stamp_ns, told in of(dive[0], "RelativePose").items():
            value = read["/buddyline/a/b/pose"][stamp_ns]
            np.testing.assert_allclose(value.pose.covariance, told.covariance, rtol=0, atol=1e-9)
        for stamp_ns, told in of(dive[0], "Depth").items():
            assert read["/buddyline/a/depth"][stamp_ns].pose.pose.position.z == -told.depth_m
        assert read["/buddyline/a/camera/image/compressed"][at(3)].data.tobytes() == PNG
        info = read["/buddyline/a/camera/camera_info"][at(3)]
        assert (info.k[0], info.k[2], info.width) == (904.0, 409.5, 820)
        for stamp_ns, told in of(dive[0], "Track").items():
            measured = read["/buddyline/a/b/range"][stamp_ns]
            assert measured.range == pytest.approx(told.range_m, rel=1e-6)
            assert measured.min_range < measured.max_range

    def test_reasons_and_problems_are_diagnostics(self, read: dict[str, dict[int, Any]]) -> None:
        said = {each.name: each for value in read["/diagnostics"].values() for each in value.status}
        assert said["buddyline: pose a/b"].message == "more than one arrangement fits"
        assert {v.key: v.value for v in said["buddyline: pose a/b"].values}["reason"] == "ambiguous"
        assert (said["buddyline: node a"].message, said["buddyline: node a"].level) == ("camera: gone", 2)

    def test_what_leaves_out_is_left_out_and_nothing_is_overwritten(self, dive: tuple[list[Message], Path]) -> None:
        from rosbags.rosbag2 import Reader

        output = dive[1].with_name("poses.mcap")
        words = ["export", str(dive[1]), "--format", "mcap-ros2", "--what", "poses", "-o", str(output)]
        assert main(words) == 0
        with Reader(output) as plain:
            assert "/buddyline/a/b/track" not in {connection.topic for connection in plain.connections}
        assert main(words) == 2


class TestParquet:
    @pytest.mark.parametrize("what", ["track", "poses"])
    def test_every_value_equals_the_csv_s(
        self, dive: tuple[list[Message], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], what: str
    ) -> None:
        parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
        output = tmp_path / "out.parquet"
        assert main(["export", str(dive[1]), "--format", "parquet", "--what", what, "-o", str(output)]) == 0
        assert main(["export", str(dive[1]), "--format", "csv", "--what", what]) == 0
        rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
        table = parquet.read_table(output)
        assert table.column_names == list(rows[0])
        assert str(table.schema.field("stamp_ns").type) == "int64"
        assert str(table.schema.field("cov_x_wz").type) == "double"
        for row, told in zip(rows, table.to_pylist(), strict=True):
            for name, text in row.items():
                value = told[name]
                assert text == ("" if value is None else str(value)), name


def test_the_csv_of_poses_has_the_whole_covariance(
    dive: tuple[list[Message], Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(dive[1]), "--format", "csv", "--what", "poses"]) == 0
    rows = {int(row["stamp_ns"]): row for row in csv.DictReader(io.StringIO(capsys.readouterr().out))}
    axes = ("x", "y", "z", "wx", "wy", "wz")
    for stamp_ns, told in of(dive[0], "RelativePose").items():
        covariance = np.array(told.covariance).reshape(6, 6)
        for i, one in enumerate(axes):
            assert float(rows[stamp_ns][f"sd_{one}_{'m' if i < 3 else 'rad'}"]) == math.sqrt(covariance[i, i])
            for k in range(i, 6):
                assert float(rows[stamp_ns][f"cov_{one}_{axes[k]}"]) == covariance[i, k]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        ((), "nothing to export in it: no pose, track, attitude, depth or picture (it holds buddyline/pair/a/b/truth)"),
        (("--what", "poses"), "no poses in it; solve it"),
        (("--what", "track"), "no track in it; solve it"),
    ],
)
def test_a_log_without_what_is_asked_for_gives_no_ros_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], named: str
) -> None:
    pytest.importorskip("rosbags", reason="rosbags is not installed")
    log, output = write_log(tmp_path / "t.mcap", truth(0)), tmp_path / "ros.mcap"
    assert main(["export", str(log), "--format", "mcap-ros2", "-o", str(output), *words]) == 2
    assert named in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["t.mcap"]
