"""Every format of `export`, read back by a reader of its own: each number that it carries equals the log's to 1e-9."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.clock import S_NS
from buddyline.protocol.codec import encode
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.messages import (
    Attitude,
    Candidates,
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
    Truth,
)
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.cli import main
from buddyline.tools.export.formats import FORMATS
from msgspec.structs import replace

from tests.tools.evaluated import frame, info, pose, rejection, track, truth
from tests.tools.watched import at, attitude, depth, image, solver_status, status

RNG = np.random.default_rng(11)
# From north, east, down.
ENU_NED = np.array(((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))
NORTH_UP_EAST = np.array(((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)))
FLU = np.diag((1.0, -1.0, -1.0))

Reader = Callable[[list[Message], Path], Iterator[tuple[str, Any, Any]]]
"""Yields name, value in the file, value in the log, of everything that a format carries."""


def three() -> tuple[float, float, float]:
    x, y, z = (RNG.normal(size=3) / 3).tolist()
    return x, y, z


def turn() -> tuple[float, float, float, float]:
    q = RNG.normal(size=4)
    x, y, z, w = (q / np.linalg.norm(q)).tolist()
    return x, y, z, w


def spread(n: int) -> list[float]:
    factor = RNG.normal(size=(n, n)) / 10
    mixed: list[float] = (factor @ factor.T).ravel().tolist()
    return mixed


def estimated() -> dict[str, Any]:
    angles = {
        name: float(RNG.normal())
        for name in ("azimuth_rad", "sigma_azimuth_rad", "inclination_rad", "sigma_inclination_rad")
    }
    sigmas = {name: abs(value) if name.startswith("sigma") else value for name, value in angles.items()}
    sigma_m = (abs(float(RNG.normal())), 0.1 / 3, 0.2 / 7)
    return {"q_a_b_xyzw": turn(), "covariance": spread(6), "t_ned_m": three(), "sigma_ned_m": sigma_m, **sigmas}


def spoken() -> list[Message]:
    lens = replace(
        info("a").camera, fx_px=904.0 + 1 / 3, cx_px=409.5 + 1 / 7, distortion=[0.1 / 3, 0.2, 1e-3, -2e-3, 0.3]
    )
    mounted = {"q_body_camera_xyzw": turn(), "light_left_m": three(), "light_right_m": three()}
    said: list[Message] = [info("a", camera=lens, **mounted), info("b", light_left_m=three(), light_right_m=three())]
    for k in range(6):
        said += [
            replace(attitude("a", at(k), turn()), sigma_rad=(0.01 / 3, 0.02 / 7, 0.1 / 3)),
            depth("a", at(k), 12.5 + k / 7),
            frame("a", k),
            frame("b", k),
            image("a", at(k)),
            pose(
                k, three(), **estimated(), chi2=k / 7, range_gap_m=k / 3e3, twist_gap_rad=1 / 3, heading_gap_rad=0.1 / 7
            ),
            track(k, three(), **estimated(), v_a_b_mps=three(), v_covariance=spread(3), age_s=0.01 / 3, mode="smooth"),
            truth(k, three(), q_a_b_xyzw=turn()),
        ]
        for node in "ab":
            said.append(
                NodePose(
                    net="main", node=node, stamp_ns=at(k), p_m=three(), q_xyzw=turn(), v_mps=three(),
                    covariance=spread(6), fixed=False, mode="smooth", age_s=0.01 / 3,
                )
            )  # fmt: skip
    said += [rejection(7), replace(status("a", at(6), "camera: gone"), uptime_s=100 / 3), solver_status(at(6), "late")]
    return said


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Message], Path]:
    messages, path = spoken(), tmp_path_factory.mktemp("dive") / "dive.mcap"
    with DiveLogWriter(path) as writer:
        for message in messages:
            key = "buddyline/pair/a/b/truth" if isinstance(message, Truth) else None
            writer.write_message(message, key="buddyline/pair/a/b/track" if isinstance(message, Track) else key)
    return messages, path


def of(messages: list[Message], kind: type[Any], **fields: Any) -> list[Any]:
    found = [m for m in messages if isinstance(m, kind) and all(getattr(m, k) == v for k, v in fields.items())]
    assert found
    return found


def matrix(q_xyzw: Any) -> np.ndarray[Any, Any]:
    return np.array(quat_to_matrix(np.array(q_xyzw, dtype=float)))


def xyz(value: Any) -> list[float]:
    return [value.x, value.y, value.z]


def xyzw(value: Any) -> list[float]:
    return [value.x, value.y, value.z, value.w]


def stamp_of(header: Any) -> int:
    return int(header.stamp.sec) * S_NS + int(header.stamp.nanosec)


def tum(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    for line, told in zip(path.read_text().splitlines(), of(messages, Track), strict=True):
        words = line.split()
        yield "time", int(words[0].replace(".", "")), told.stamp_ns
        yield "pose", [float(word) for word in words[1:]], [*told.t_a_b_m, *told.q_a_b_xyzw]


def uncertainty(axes: Sequence[str], covariance: Any) -> dict[str, float]:
    """The columns of a covariance (6, 6): standard deviations, and the upper triangle."""
    found = {f"sd_{axis}_{'m' if i < 3 else 'rad'}": math.sqrt(covariance[i, i]) for i, axis in enumerate(axes)}
    return found | {f"cov_{axis}_{axes[k]}": covariance[i, k] for i, axis in enumerate(axes) for k in range(i, 6)}


def told_in(row: dict[str, Any], named: dict[str, str], expected: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    assert {name: row[name] for name in named} == named
    assert set(row) == {*expected, *named}
    for name, value in expected.items():
        yield name, float(row[name]) if name != "stamp_ns" else int(row[name]), value


def table(messages: list[Message], rows: list[dict[str, Any]]) -> Iterator[tuple[str, Any, Any]]:
    axes = ("x", "y", "z", "wx", "wy", "wz")
    truths = {one.stamp_ns: one for one in of(messages, Truth)}
    for row, told in zip(rows, of(messages, Track), strict=True):
        true, covariance = truths[told.stamp_ns], np.array(told.covariance).reshape(6, 6)
        of_v = np.array(told.v_covariance).reshape(3, 3)
        expected: dict[str, Any] = {name: getattr(told, name) for name in ("stamp_ns", "lights", "age_s", "range_m")}
        for prefix, suffix, values in (
            ("t_a_b_", "_m", told.t_a_b_m),
            ("v_a_b_", "_mps", told.v_a_b_mps),
            ("truth_t_a_b_", "_m", true.t_a_b_m),
        ):
            expected |= {f"{prefix}{axis}{suffix}": x for axis, x in zip("xyz", values, strict=True)}
        # The true quaternions go on without a jump: some have the other sign.
        written = [float(row[f"truth_q_a_b_{axis}"]) for axis in "xyzw"]
        true_q = np.array(true.q_a_b_xyzw) * np.sign(np.array(written) @ true.q_a_b_xyzw)
        for prefix, values in (("q_a_b_", told.q_a_b_xyzw), ("truth_q_a_b_", true_q)):
            expected |= {f"{prefix}{axis}": x for axis, x in zip("xyzw", values, strict=True)}
        for prefix, values in (("t_ned_", told.t_ned_m), ("sd_ned_", told.sigma_ned_m)):
            expected |= {f"{prefix}{axis}_m": x for axis, x in zip(("north", "east", "down"), values, strict=True)}
        for name in ("azimuth", "inclination"):
            expected[f"{name}_rad"] = getattr(told, f"{name}_rad")
            expected[f"sd_{name}_rad"] = getattr(told, f"sigma_{name}_rad")
        expected |= uncertainty(axes, covariance)
        for i, axis in enumerate(axes[:3]):
            expected |= {f"cov_v{axis}_v{axes[k]}": of_v[i, k] for k in range(i, 3)}
        named = {"node_a": told.node_a, "node_b": told.node_b, "mode": told.mode}
        yield from told_in(row, named, expected)


def of_csv(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    with open(path, newline="") as file:
        yield from table(messages, list(csv.DictReader(file)))


def parquet(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    reader = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    yield from table(messages, reader.read_table(path).to_pylist())


def markers(messages: list[Message]) -> dict[str, list[Any]]:
    """Each marker's places in mm: x north, y up, z east."""
    infos = {one.node: one for one in of(messages, NodeInfo)}
    found: dict[str, list[Any]] = {}
    for told in of(messages, NodePose):
        known = infos[told.node]
        for end, place_m in (("", (0.0, 0.0, 0.0)), ("_left", known.light_left_m), ("_right", known.light_right_m)):
            ned_m = np.array(told.p_m) + matrix(told.q_xyzw) @ place_m
            found.setdefault(told.node + end, []).append(1e3 * NORTH_UP_EAST @ ned_m)
    return found


def trc(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    lines = path.read_text().split("\n")
    expected = markers(messages)
    names = [name for name in lines[3].split("\t")[2:] if name]
    assert sorted(names) == sorted(expected)
    yield "rate", float(lines[2].split("\t")[0]), 10.0
    for k, line in enumerate(lines[6:12]):
        words = [float(word) for word in line.split("\t")]
        yield "time", words[1], k / 10
        yield "places, m", np.array(words[2:]) / 1e3, np.concatenate([expected[name][k] for name in names]) / 1e3


def c3d(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    """C3D has single precision, as its definition says: its numbers equal the log's to that."""
    ezc3d = pytest.importorskip("ezc3d", reason="ezc3d is not installed")
    read = ezc3d.c3d(str(path))
    expected = markers(messages)
    for k, name in enumerate(read["parameters"]["POINT"]["LABELS"]["value"]):
        # The reader gives doubles of what it has read as singles.
        yield name, read["data"]["points"][:3, k].T, np.array(expected[name], np.float32).astype(float)


def colmap(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    camera = of(messages, NodeInfo, node="a")[0].camera
    (line,) = [one for one in (path / "cameras.txt").read_text().splitlines() if one[0] != "#"]
    centre = [camera.cx_px + 0.5, camera.cy_px + 0.5]
    yield (
        "camera",
        [float(x) for x in line.split()[4:]],
        [camera.fx_px, camera.fy_px, *centre, *camera.distortion, 0, 0, 0],
    )
    rows = [one.split() for one in (path / "images.txt").read_text().splitlines() if one and one[0] != "#"]
    for row, told in zip(rows, of(messages, NodePose, node="a"), strict=True):
        w, x, y, z = map(float, row[1:5])
        R_camera_world = matrix((x, y, z, w))
        yield "turn", R_camera_world.T, ENU_NED @ matrix(told.q_xyzw)
        yield "place", -R_camera_world.T @ np.array([float(x) for x in row[5:8]]), ENU_NED @ told.p_m


def metashape(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    from xml.etree import ElementTree

    root = ElementTree.parse(path / "cameras.xml").getroot()
    known = of(messages, NodeInfo, node="a")[0]
    camera, (k1, k2, p1, p2, k3) = known.camera, known.camera.distortion
    lens = {"f": camera.fy_px, "b1": camera.fx_px - camera.fy_px, "k1": k1, "k2": k2, "k3": k3, "p1": p2, "p2": p1}
    lens |= {"cx": camera.cx_px + 0.5 - known.width_px / 2, "cy": camera.cy_px + 0.5 - known.height_px / 2}
    for name, value in lens.items():
        yield name, float(root.findtext(f".//calibration/{name}") or "nan"), value
    for view, told in zip(root.findall(".//camera"), of(messages, NodePose, node="a"), strict=True):
        T = np.array([float(word) for word in (view.findtext("transform") or "").split()]).reshape(4, 4)
        yield "turn", T[:3, :3], ENU_NED @ matrix(told.q_xyzw)
        yield "place", T[:3, 3], ENU_NED @ told.p_m


def foxglove(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    """Our own messages are in it byte by byte; what is drawn is compared, too."""
    decoding = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed")
    from mcap.reader import make_reader

    found: dict[str, list[Any]] = {}
    plain: dict[str, list[Any]] = {}
    with open(path, "rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.message_encoding == "json":
                assert schema is not None
                plain.setdefault(schema.name, []).append(json.loads(message.data))
    with open(path, "rb") as file:
        reader = make_reader(file, decoder_factories=[decoding.DecoderFactory()])
        topics = {c.topic for c in reader.get_summary().channels.values() if c.message_encoding == "protobuf"}  # type: ignore[union-attr]
        for _, channel, _, message in reader.iter_decoded_messages(topics=topics):
            found.setdefault(channel.topic, []).append(message)
    for kind in (Attitude, Depth, RelativePose, Track, Rejected, NodeStatus, SolverStatus, NodePose):
        told = [json.loads(encode(one)) for one in of(messages, kind)]
        assert plain[f"buddyline.{kind.__name__}"] == told, kind
    for placed, told in zip(found["/pair/a/b/pose"], of(messages, RelativePose), strict=True):
        yield "time", placed.timestamp.seconds * S_NS + placed.timestamp.nanos, told.stamp_ns
        yield "pose", [*xyz(placed.pose.position)], told.t_a_b_m
        yield "turn", matrix(xyzw(placed.pose.orientation)), matrix(told.q_a_b_xyzw)
    for node in "ab":
        moved = [t for tf in found["/tf"] for t in tf.transforms if t.child_frame_id == f"{node}_camera"]
        in_net = zip(moved, found[f"/net/main/{node}/pose"], of(messages, NodePose, node=node), strict=True)
        for one, placed, told in in_net:
            assert one.parent_frame_id == placed.frame_id == "net_main"
            for where, q in (
                (one.translation, one.rotation),
                (placed.pose.position, placed.pose.orientation),
            ):
                yield "net place", xyz(where), ENU_NED @ told.p_m
                yield "net turn", matrix(xyzw(q)), ENU_NED @ matrix(told.q_xyzw)
        known = of(messages, NodeInfo, node=node)[0]
        (entity,) = found[f"/{node}/rig"][-1].entities
        yield "lamps", [xyz(s.pose.position) for s in entity.spheres], [known.light_left_m, known.light_right_m]
        for rings, told in zip(found[f"/{node}/camera/candidates"], of(messages, Candidates, node=node), strict=True):
            places = [[c.position.x, c.position.y] for c in rings.circles]
            yield "candidates", places, [[blob.u_px, blob.v_px] for blob in told.blobs]
    camera = of(messages, NodeInfo, node="a")[0].camera
    K = [camera.fx_px, 0, camera.cx_px, 0, camera.fy_px, camera.cy_px, 0, 0, 1]
    for one in found["/a/camera/calibration"]:
        yield "K", list(one.K), K
        yield "D", list(one.D), camera.distortion
    pictures = [one.data for one in found["/a/camera/image"]]
    assert pictures == [one.data for one in of(messages, CompressedImage)]


def ros2(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    highlevel = pytest.importorskip("rosbags.highlevel", reason="rosbags is not installed")
    from rosbags.typesys import Stores, get_typestore

    found: dict[str, list[Any]] = {}
    with highlevel.AnyReader([path], default_typestore=get_typestore(Stores.EMPTY)) as reader:
        for connection, _, data in reader.messages():
            found.setdefault(connection.topic, []).append(reader.deserialize(data, connection.msgtype))
    for value, told in zip(found["/buddyline/a/attitude"], of(messages, Attitude), strict=True):
        yield "time", stamp_of(value.header), told.stamp_ns
        yield "orientation", matrix(xyzw(value.orientation)), ENU_NED @ matrix(told.q_ned_body_xyzw) @ FLU
        yield "orientation covariance", value.orientation_covariance, np.diag(np.square(told.sigma_rad)).ravel()
    for value, told in zip(found["/buddyline/a/depth"], of(messages, Depth), strict=True):
        yield "depth", [value.pose.pose.position.z, value.pose.covariance[14]], [-told.depth_m, told.sigma_m**2]
    for topic, kind in (("pose", RelativePose), ("track", Track)):
        for value, told in zip(found[f"/buddyline/a/b/{topic}"], of(messages, kind), strict=True):
            yield "time", stamp_of(value.header), told.stamp_ns
            yield "position", xyz(value.pose.pose.position), told.t_a_b_m
            yield "orientation", matrix(xyzw(value.pose.pose.orientation)), matrix(told.q_a_b_xyzw)
            yield "covariance", value.pose.covariance, told.covariance
            if kind is Track:
                R, whole = matrix(told.q_a_b_xyzw), value.twist.covariance.reshape(6, 6)[:3, :3]
                yield "velocity", R @ xyz(value.twist.twist.linear), told.v_a_b_mps
                yield "velocity covariance", (R @ whole @ R.T).ravel(), told.v_covariance
    moved = [t for tf in found["/tf"] for t in tf.transforms if t.child_frame_id == "b_camera"]
    # A pose places B, then the first sample of the track, until the net does: a frame has one parent.
    placed = [of(messages, RelativePose)[0], of(messages, Track)[0]]
    by_a = [(one.stamp_ns, "a_camera", one.t_a_b_m, matrix(one.q_a_b_xyzw)) for one in placed]
    by_net = [
        (one.stamp_ns, "net_main", ENU_NED @ one.p_m, ENU_NED @ matrix(one.q_xyzw))
        for one in of(messages, NodePose, node="b")
    ]
    for one, (stamp_ns, parent, t_m, R) in zip(moved, [*by_a, *by_net], strict=True):
        assert one.header.frame_id == parent
        yield "tf time", stamp_of(one.header), stamp_ns
        yield "tf", xyz(one.transform.translation), t_m
        yield "tf turn", matrix(xyzw(one.transform.rotation)), R
    # sensor_msgs/Range has single precision.
    ranges = {np.float32(one.range_m) for one in (*of(messages, Track), *of(messages, RelativePose))}
    assert {np.float32(one.range) for one in found["/buddyline/a/b/range"]} <= ranges
    camera = of(messages, NodeInfo, node="a")[0].camera
    for one in found["/buddyline/a/camera/camera_info"]:
        yield "k", one.k, [camera.fx_px, 0, camera.cx_px, 0, camera.fy_px, camera.cy_px, 0, 0, 1]
        yield "d", one.d, camera.distortion
    pictures = [one.data.tobytes() for one in found["/buddyline/a/camera/image/compressed"]]
    assert pictures == [one.data for one in of(messages, CompressedImage)]
    said = {s.name: {v.key: v.value for v in s.values} for d in found["/diagnostics"] for s in d.status}
    yield "uptime", float(said["buddyline: node a"]["uptime s"]), 100 / 3


AXES = ("north", "east", "down")


def of_nodes(messages: list[Message], rows: list[dict[str, Any]]) -> Iterator[tuple[str, Any, Any]]:
    """The rows of all nodes, of csv or Parquet."""
    turned = (*AXES, *(f"w_{axis}" for axis in AXES))
    for row, told in zip(rows, of(messages, NodePose), strict=True):
        covariance = np.array(told.covariance).reshape(6, 6)
        expected: dict[str, Any] = {"stamp_ns": told.stamp_ns, "age_s": told.age_s, "fixed": int(told.fixed)}
        expected |= {f"{axis}_m": x for axis, x in zip(AXES, told.p_m, strict=True)}
        expected |= {f"v_{axis}_mps": x for axis, x in zip(AXES, told.v_mps, strict=True)}
        expected |= {f"q_{axis}": x for axis, x in zip("xyzw", told.q_xyzw, strict=True)}
        expected |= uncertainty(turned, covariance)
        named = {"net": told.net, "node": told.node, "mode": told.mode}
        yield from told_in(row, named, expected)


def net_csv(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    with open(path, newline="") as file:
        yield from of_nodes(messages, list(csv.DictReader(file)))


def net_parquet(messages: list[Message], path: Path) -> Iterator[tuple[str, Any, Any]]:
    reader = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    yield from of_nodes(messages, reader.read_table(path).to_pylist())


READERS: dict[str, Reader] = {
    "tum": tum,
    "csv": of_csv,
    "trc": trc,
    "c3d": c3d,
    "colmap": colmap,
    "metashape": metashape,
    "parquet": parquet,
    "foxglove": foxglove,
    "mcap-ros2": ros2,
}


# rerun's reader needs an environment of its own: tests/tools/test_export_rerun.py.
@pytest.mark.parametrize("name", [form.name for form in FORMATS if form.name != "rerun"])
def test_every_number_read_back_equals_the_log(name: str, dive: tuple[list[Message], Path], tmp_path: Path) -> None:
    output = tmp_path / ("out.mcap" if name == "mcap-ros2" else f"out.{name}")
    compare(dive, ["--format", name], READERS[name], output)


@pytest.mark.parametrize(("name", "reader"), [("csv", net_csv), ("parquet", net_parquet)])
def test_every_number_of_all_nodes_equals_the_log(
    name: str, reader: Reader, dive: tuple[list[Message], Path], tmp_path: Path
) -> None:
    compare(dive, ["--format", name, "--what", "net"], reader, tmp_path / f"out.{name}")


def compare(dive: tuple[list[Message], Path], words: list[str], reader: Reader, output: Path) -> None:
    messages, log = dive
    assert main(["export", str(log), *words, "-o", str(output)]) == 0
    compared = 0
    for what, found, told in reader(messages, output):
        if isinstance(told, int):
            assert found == told, what
        np.testing.assert_allclose(found, told, rtol=0, atol=1e-9, err_msg=what)
        compared += np.size(told)
    assert compared > 40
