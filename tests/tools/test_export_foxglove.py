"""The export for Foxglove, Lichtblick and rerun, read back by the schemas in the file itself."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Message
from buddyline.solver_service.geometry.rotation import quat_to_matrix
from buddyline.tools.cli import main

from tests.tools.evaluated import INFOS, LEFT, RIGHT, frame, pose, track, write_log
from tests.tools.watched import PNG, at, attitude, depth, image

pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
decoding = pytest.importorskip("mcap_protobuf.decoder", reason="mcap-protobuf-support is not installed")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    from mcap.reader import make_reader

    directory = tmp_path_factory.mktemp("foxglove")
    messages: list[Message] = list(INFOS.values())
    for k in range(5):
        for node in "ab":
            messages += [attitude(node, at(k)), depth(node, at(k)), frame(node, k), image(node, at(k))]
        messages.append(pose(k, blobs_a=(0, 1), blobs_b=(-1, 1)))
    dive = write_log(directory / "dive.mcap", *messages)
    output = directory / "foxglove.mcap"
    assert main(["export", dive, "--format", "foxglove", "-o", str(output)]) == 0
    found: dict[str, list[Any]] = defaultdict(list)
    with open(output, "rb") as file:
        reader = make_reader(file, decoder_factories=[decoding.DecoderFactory()])
        for schema, channel, _, message in reader.iter_decoded_messages():
            assert schema is not None
            found[channel.topic].append((schema.name, message))
    return found


def last(exported: dict[str, list[Any]], topic: str) -> Any:
    return exported[topic][-1][1]


def matrix(rotation: Any) -> np.ndarray[Any, Any]:
    return quat_to_matrix(np.array([rotation.x, rotation.y, rotation.z, rotation.w]))


def test_every_topic_has_foxglove_s_own_schema(exported: dict[str, list[Any]]) -> None:
    schemas = {topic: {name for name, _ in messages} for topic, messages in exported.items()}
    assert schemas == {
        "/tf": {"foxglove.FrameTransforms"},
        "/pair/a/b/pose": {"foxglove.PoseInFrame"},
        **{f"/{node}/camera/image": {"foxglove.CompressedImage"} for node in "ab"},
        **{f"/{node}/camera/calibration": {"foxglove.CameraCalibration"} for node in "ab"},
        **{f"/{node}/camera/candidates": {"foxglove.ImageAnnotations"} for node in "ab"},
        **{f"/{node}/camera/chosen": {"foxglove.ImageAnnotations"} for node in "ab"},
    }


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
    from buddyline.tools.export_foxglove import export

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
            file, decoder_factories=[decoding.DecoderFactory()]
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
