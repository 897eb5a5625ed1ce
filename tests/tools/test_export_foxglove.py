"""The export for Foxglove, Lichtblick and rerun, read back by the schemas in the file itself."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.codec import encode
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Message
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.cli import main
from mcap.decoder import DecoderFactory
from mcap.records import Schema
from msgspec.structs import replace

from tests.tools.evaluated import INFOS, LEFT, RIGHT, frame, pose, rejection, track, write_log
from tests.tools.watched import PNG, at, attitude, depth, image, solver_status, status

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
decoding = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed")


class JsonDecoder(DecoderFactory):
    """Decodes our own messages, by nothing but what the file says."""

    def decoder_for(self, message_encoding: str, schema: Schema | None) -> Callable[[bytes], Any] | None:
        if message_encoding != "json":
            return None
        assert schema is not None
        assert json.loads(schema.data)["type"] == "object"
        return json.loads


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    from mcap.reader import make_reader

    directory = tmp_path_factory.mktemp("foxglove")
    messages: list[Message] = list(INFOS.values())
    for k in range(5):
        for node in "ab":
            messages += [attitude(node, at(k)), depth(node, at(k)), frame(node, k), image(node, at(k))]
        messages.append(pose(k, blobs_a=(0, 1), blobs_b=(-1, 1)))
    messages += [rejection(5), rejection(6), status("a", at(5), "camera: gone"), status("a", at(6), "camera: gone")]
    messages.append(solver_status(at(6), advice=["turn b 20 deg left", "come 1.5 m closer"]))
    dive = write_log(directory / "dive.mcap", *messages)
    output = directory / "foxglove.mcap"
    assert main(["export", dive, "--format", "foxglove", "-o", str(output)]) == 0
    found: dict[str, list[Any]] = defaultdict(list)
    with open(output, "rb") as file:
        factories = [decoding.DecoderFactory(), JsonDecoder()]
        reader = make_reader(file, decoder_factories=factories)
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert schema is not None
            found[channel.topic].append((schema.name, message))
    return found


def last(exported: dict[str, list[Any]], topic: str) -> Any:
    return exported[topic][-1][1]


def matrix(rotation: Any) -> np.ndarray[Any, Any]:
    return quat_to_matrix(np.array([rotation.x, rotation.y, rotation.z, rotation.w]))


def test_every_topic_has_foxglove_s_own_schema(exported: dict[str, list[Any]]) -> None:
    schemas = {topic: {name for name, _ in messages} for topic, messages in exported.items() if topic[0] == "/"}
    assert schemas == {
        "/log": {"foxglove.Log"},
        **{f"/{node}/rig": {"foxglove.SceneUpdate"} for node in "ab"},
        "/tf": {"foxglove.FrameTransforms"},
        "/pair/a/b/pose": {"foxglove.PoseInFrame"},
        **{f"/{node}/camera/image": {"foxglove.CompressedImage"} for node in "ab"},
        **{f"/{node}/camera/calibration": {"foxglove.CameraCalibration"} for node in "ab"},
        **{f"/{node}/camera/candidates": {"foxglove.ImageAnnotations"} for node in "ab"},
        **{f"/{node}/camera/chosen": {"foxglove.ImageAnnotations"} for node in "ab"},
    }


def test_every_value_of_the_log_can_be_plotted_as_it_is(exported: dict[str, list[Any]]) -> None:
    told = [message for name, message in exported["buddyline/pair/a/b/pose"] if name == "buddyline.RelativePose"]
    assert told == [json.loads(encode(pose(k, blobs_a=(0, 1), blobs_b=(-1, 1)))) for k in range(5)]
    depths = [message for _, message in exported["buddyline/node/b/depth"]]
    assert depths == [json.loads(encode(depth("b", at(k)))) for k in range(5)]


def test_a_problem_a_reason_and_the_coach_are_a_log_and_said_once(exported: dict[str, list[Any]]) -> None:
    said = [(message.name, message.message) for _, message in exported["/log"]]
    assert said == [
        ("pose a/b", "no pose: more than one arrangement fits"),
        ("node a", "camera: gone"),
        ("coach a/b", "turn b 20 deg left, come 1.5 m closer"),
    ]


def test_both_rigs_are_scenes_that_move_with_their_cameras(exported: dict[str, list[Any]]) -> None:
    for node, info in INFOS.items():
        (entity,) = last(exported, f"/{node}/rig").entities
        assert (entity.frame_id, entity.frame_locked) == (f"{node}_camera", True)
        lamps = [(s.pose.position.x, s.pose.position.y, s.pose.position.z) for s in entity.spheres]
        assert lamps == [info.light_left_m, info.light_right_m]
        view = entity.lines[0].points
        # Edges of the view at the camera's own slopes.
        assert {round(abs(p.x / p.z), 2) for p in view if p.z} == {round(410 / 904, 2)}


def test_the_layout_s_panels_show_topics_that_are_in_the_file(tmp_path: Path) -> None:
    messages: list[Message] = [*INFOS.values(), image("a", at(0)), frame("a", 0), frame("b", 0)]
    messages += [message for k in range(25) for message in (track(k, (0.0, 0.0, 3.0)), pose(k))]
    dive, output = write_log(tmp_path / "dive.mcap", *messages, rejection(30)), tmp_path / "dive.foxglove.mcap"
    assert main(["export", dive, "--format", "foxglove", "-o", str(output)]) == 0
    from mcap.reader import make_reader

    with open(output, "rb") as file:
        topics = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    told = json.loads((tmp_path / "dive.foxglove.mcap.layout.json").read_text())
    panels = told["configById"]
    assert set(panels) == {
        *("3D!scene", "Image!a", "Plot!range", "Plot!north", "Plot!azimuth", "RosOut!log"),
    }
    shown = {*panels["3D!scene"]["topics"], panels["RosOut!log"]["topicToRender"]}
    shown |= {panels["Image!a"]["imageMode"]["imageTopic"], *panels["Image!a"]["imageMode"]["annotations"]}
    for name in ("Plot!range", "Plot!north", "Plot!azimuth"):
        paths = [path["value"] for path in panels[name]["paths"]]
        assert paths
        shown |= {path.split('"')[1] for path in paths}
    assert shown <= topics
    placed: list[str] = []

    def walk(part: Any) -> None:
        if isinstance(part, str):
            placed.append(part)
        else:
            walk(part["first"])
            walk(part["second"])

    walk(told["layout"])
    assert sorted(placed) == sorted(panels)
    # Neither of the two files is ever replaced.
    output.unlink()
    assert main(["export", dive, "--format", "foxglove", "-o", str(output)]) == 2


def test_transforms_chain_from_the_surface_to_b(exported: dict[str, list[Any]]) -> None:
    newest = {(t.parent_frame_id, t.child_frame_id): t for _, tf in exported["/tf"] for t in tf.transforms}
    world_a, a_b = newest["world", "a_camera"], newest["a_camera", "b_camera"]
    # A looks north at 12.5 m depth; B is 3 m before it: in east, north, up.
    ahead = np.array([a_b.translation.x, a_b.translation.y, a_b.translation.z])
    origin = np.array([world_a.translation.x, world_a.translation.y, world_a.translation.z])
    np.testing.assert_allclose(origin + matrix(world_a.rotation) @ ahead, (0.0, 3.0, -12.5), atol=1e-9)
    # Down in the picture is down in the world.
    np.testing.assert_allclose(matrix(world_a.rotation) @ (0.0, 1.0, 0.0), (0.0, 0.0, -1.0), atol=1e-9)


def test_a_pose_is_in_a_s_camera_frame(exported: dict[str, list[Any]]) -> None:
    placed = last(exported, "/pair/a/b/pose")
    assert placed.frame_id == "a_camera"
    assert (placed.pose.position.x, placed.pose.position.y, placed.pose.position.z) == (0.0, 0.0, 3.0)


def test_pictures_have_calibration_and_marks_of_the_same_instant(exported: dict[str, list[Any]]) -> None:
    picture = last(exported, "/a/camera/image")
    calibration = last(exported, "/a/camera/calibration")
    candidates = last(exported, "/a/camera/candidates")
    assert picture.data == PNG
    assert calibration.frame_id == picture.frame_id == "a_camera"
    assert (calibration.distortion_model, list(calibration.D), calibration.K[2]) == ("plumb_bob", [0.0] * 5, 409.5)
    instants = {(m.timestamp.seconds, m.timestamp.nanos) for m in (picture, calibration, candidates)}
    assert len(instants) == 1
    assert len(candidates.circles) == 3


def test_chosen_lights_are_named_and_a_missing_one_is_left_out(exported: dict[str, list[Any]]) -> None:
    both, one = last(exported, "/a/camera/chosen"), last(exported, "/b/camera/chosen")
    assert [(text.text, round(text.position.x, 3)) for text in both.texts] == [
        ("L", round(LEFT[0], 3)),
        ("R", round(RIGHT[0], 3)),
    ]
    assert [text.text for text in one.texts] == ["R"]


def test_an_output_is_named_and_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from buddyline.tools.dives import Dive
    from buddyline.tools.export.foxglove import export

    dive = write_log(tmp_path / "dive.mcap", *INFOS.values(), pose(0))
    assert main(["export", dive, "--format", "foxglove"]) == 2
    assert "give -o" in capsys.readouterr().err
    with Dive([dive]) as opened, pytest.raises(BuddylineError, match="exists"):
        export(opened, Path(dive))


def test_a_track_moves_b_and_draws_its_path(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    messages: list[Message] = list(INFOS.values())
    tracks = []
    for k in range(25):
        # A looks north at 12.5 m: its camera's z is north, x east, y down.
        x, y, z = 0.1 * k, -0.05 * k, 3.0
        tracks.append(track(k, (x, y, z), t_ned_m=(z, x, y)))
        messages += [attitude("a", at(k)), depth("a", at(k)), pose(k), tracks[-1]]
    dive, output = write_log(tmp_path / "dive.mcap", *messages), tmp_path / "foxglove.mcap"
    assert main(["export", dive, "--format", "foxglove", "-o", str(output)]) == 0
    found: dict[str, list[Any]] = defaultdict(list)
    with open(output, "rb") as file:
        for _, channel, _, message in make_reader(
            file, decoder_factories=[decoding.DecoderFactory(), JsonDecoder()]
        ).iter_decoded_messages():
            found[channel.topic].append(message)
    assert len(found["/pair/a/b/pose"]) == 25
    of_b = [t for tf in found["/tf"] for t in tf.transforms if t.child_frame_id == "b_camera"]
    told = [(t.translation.x, t.translation.y, t.translation.z) for t in of_b]
    np.testing.assert_allclose(told, [one.t_a_b_m for one in tracks], atol=1e-9)
    pieces = [entity for update in found["/pair/a/b/path"] for entity in update.entities]
    assert len({piece.id for piece in pieces}) == len(pieces) == 3
    assert {piece.frame_id for piece in pieces} == {"world"}
    lines = [[(p.x, p.y, p.z) for p in piece.lines[0].points] for piece in pieces]
    # Each piece begins where the one before ends.
    assert lines[0][-1] == lines[1][0]
    path = lines[0] + lines[1][1:] + lines[2][1:]
    expected = [(one.t_ned_m[1], one.t_ned_m[0], -one.t_ned_m[2] - 12.5) for one in tracks]  # type: ignore[index]
    np.testing.assert_allclose(path, expected, atol=1e-9)
    poses = tmp_path / "poses.mcap"
    assert main(["export", dive, "--format", "foxglove", "--what", "poses", "-o", str(poses)]) == 0
    with open(poses, "rb") as file:
        assert "/pair/a/b/path" not in {c.topic for _, c, _ in make_reader(file).iter_messages()}


def test_b_s_rig_lies_on_its_path_whatever_a_s_compass_says(tmp_path: Path) -> None:
    """A's attitude is 5 degrees off what the track took from both compasses, and A goes down."""
    from mcap.reader import make_reader

    off = (0.0, 0.0, np.sin(np.radians(2.5)), np.cos(np.radians(2.5)))
    messages: list[Message] = list(INFOS.values())
    for k in range(25):
        x, y, z = 0.1 * k, -0.05 * k, 3.0
        now = [attitude("a", at(k), off), depth("a", at(k), 12.5 + 0.02 * k)]
        messages += [*now, pose(k), track(k, (x, y, z), t_ned_m=(z, x, y))]
    dive, output = write_log(tmp_path / "dive.mcap", *messages), tmp_path / "foxglove.mcap"
    assert main(["export", dive, "--format", "foxglove", "-o", str(output)]) == 0
    newest: dict[str, Any] = {}
    drawn: dict[int, tuple[float, float, float]] = {}
    rig: dict[int, np.ndarray[Any, Any]] = {}
    with open(output, "rb") as file:
        reader = make_reader(file, decoder_factories=[decoding.DecoderFactory(), JsonDecoder()])
        for _, channel, record, message in reader.iter_decoded_messages(log_time_order=False):
            if channel.topic == "/tf":
                newest |= {t.child_frame_id: t for t in message.transforms}
                if len(newest) == 2:
                    a, b = newest["a_camera"], newest["b_camera"]
                    in_a = matrix(a.rotation) @ (b.translation.x, b.translation.y, b.translation.z)
                    rig[record.log_time] = np.add(in_a, (a.translation.x, a.translation.y, a.translation.z))
            elif channel.topic == "/pair/a/b/path":
                (piece,) = message.entities
                first = piece.timestamp.seconds * 10**9 + piece.timestamp.nanos
                drawn |= {first + at(k) - at(0): (p.x, p.y, p.z) for k, p in enumerate(piece.lines[0].points)}
    assert len(rig) == len(drawn) == 25
    for stamp_ns, place in drawn.items():
        np.testing.assert_allclose(rig[stamp_ns], place, atol=1e-9)
    # Without a track A stands by its own compass.
    poses = tmp_path / "poses.mcap"
    assert main(["export", dive, "--format", "foxglove", "--what", "poses", "-o", str(poses)]) == 0
    with open(poses, "rb") as file:
        reader = make_reader(file, decoder_factories=[decoding.DecoderFactory(), JsonDecoder()])
        told = [t for _, c, _, tf in reader.iter_decoded_messages() if c.topic == "/tf" for t in tf.transforms]
    ahead = matrix([t for t in told if t.child_frame_id == "a_camera"][-1].rotation) @ (0.0, 0.0, 1.0)
    assert np.degrees(np.arctan2(ahead[0], ahead[1])) == pytest.approx(5.0)


def test_each_frame_of_a_team_has_one_parent(tmp_path: Path) -> None:
    from mcap.reader import make_reader

    pairs = [("a", "b"), ("a", "d"), ("b", "c"), ("c", "d")]
    seen = [replace(pose(k), node_a=one, node_b=two) for k in range(5) for one, two in pairs]
    output = tmp_path / "foxglove.mcap"
    dive = write_log(tmp_path / "dive.mcap", *INFOS.values(), *seen)
    assert main(["export", dive, "--format", "foxglove", "-o", str(output)]) == 0
    with open(output, "rb") as file:
        reader = make_reader(file, decoder_factories=[decoding.DecoderFactory(), JsonDecoder()])
        told = [tf for _, channel, _, tf in reader.iter_decoded_messages() if channel.topic == "/tf"]
    links = {(t.parent_frame_id, t.child_frame_id) for tf in told for t in tf.transforms}
    expected = {("world", "a_camera"), ("a_camera", "b_camera"), ("a_camera", "d_camera"), ("b_camera", "c_camera")}
    assert links == expected
