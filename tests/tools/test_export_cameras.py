"""Pictures and cameras for photogrammetry: the poses that COLMAP and Metashape take are those of the net."""

from xml.etree import ElementTree

import numpy as np
import pytest
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import CompressedImage, NodePose
from buddyline.protocol.messages.frame import FoxgloveTime
from buddyline.tools.dives import Dive
from buddyline.tools.evaluation.rotation import normalized, rotate
from buddyline.tools.export import colmap, metashape
from msgspec.structs import replace

from tests.tools import survey_world as world

STEP_NS = 100_000_000
ENU_NED = np.array(((0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)))


def pose(k):
    return NodePose(
        net="main",
        node="a",
        stamp_ns=world.START_NS + k * STEP_NS,
        p_m=(1.0 + 0.1 * k, 2.0, 3.0),
        q_xyzw=tuple(normalized(np.array([0.1, -0.6, 0.3, 0.7 + 0.001 * k])).tolist()),
        v_mps=(0.0, 0.0, 0.0),
        covariance=tuple(np.eye(6).ravel().tolist()),
        fixed=False,
        mode="smooth",
        age_s=0.0,
    )


@pytest.fixture
def dive(tmp_path):
    node = world._Node(np.random.default_rng(1), 0, world.Flaws())
    info = replace(node.info, camera=replace(node.info.camera, distortion=[0.1, 0.02, 0.003, 0.004, 0.005]))
    with DiveLogWriter(tmp_path / "solved.mcap") as writer:
        writer.write_message(info)
        for k in range(5):
            writer.write_message(pose(k))
        # At a pose, between two, and after the last.
        for at_ns in (STEP_NS, 5 * STEP_NS // 2, 9 * STEP_NS):
            sec, nsec = divmod(world.START_NS + at_ns, 10**9)
            stamp = FoxgloveTime(sec=sec, nsec=nsec)
            writer.write_message(CompressedImage(timestamp=stamp, frame_id="a_camera", data=b"\xff\xd8", format="jpeg"))
    with Dive([tmp_path / "solved.mcap"]) as opened:
        yield opened


def rotation_of(w, x, y, z):
    return np.column_stack([rotate(np.array([x, y, z, w]), axis) for axis in np.eye(3)])


def expected():
    """East, north, up of the two pictures, and what a point 2 m ahead of each camera is."""
    for place_m, k in (((1.1, 2.0, 3.0), 1.0), ((1.25, 2.0, 3.0), 2.5)):
        q = normalized(np.array([0.1, -0.6, 0.3, 0.7 + 0.001 * k]))
        yield ENU_NED @ place_m, ENU_NED @ (place_m + rotate(q, np.array([0.0, 0.0, 2.0])))


def test_colmap_s_text_has_cameras_and_pictures(tmp_path, dive):
    out = tmp_path / "model"
    assert colmap.export(dive, out) == 2
    (camera,) = [line for line in (out / "cameras.txt").read_text().splitlines() if not line.startswith("#")]
    assert camera.split()[:4] == ["1", "FULL_OPENCV", "820", "616"]
    assert [float(word) for word in camera.split()[8:]] == [0.1, 0.02, 0.003, 0.004, 0.005, 0.0, 0.0, 0.0]
    rows = [line.split() for line in (out / "images.txt").read_text().splitlines() if line and line[0] != "#"]
    for row, (place_m, ahead_m) in zip(rows, expected(), strict=True):
        R, t = rotation_of(*map(float, row[1:5])), np.array([float(word) for word in row[5:8]])
        np.testing.assert_allclose(-R.T @ t, place_m, atol=1e-6)
        np.testing.assert_allclose(R @ ahead_m + t, [0.0, 0.0, 2.0], atol=1e-5)
        assert (out / "images" / row[9]).read_bytes() == b"\xff\xd8"
    assert (out / "points3D.txt").exists()
    with pytest.raises(BuddylineError, match="cannot be written"):
        colmap.export(dive, tmp_path / "nowhere" / "model")
    with pytest.raises(BuddylineError, match="exists"):
        colmap.export(dive, out)


def test_metashape_s_xml_has_the_same(tmp_path, dive):
    out = tmp_path / "model"
    assert metashape.export(dive, out) == 2
    root = ElementTree.parse(out / "cameras.xml").getroot()
    lens = {one.tag: float(one.text) for one in root.find(".//calibration") if one.text and one.tag != "resolution"}
    assert (lens["p1"], lens["p2"], lens["k3"]) == (0.004, 0.003, 0.005)
    for camera, (place_m, ahead_m) in zip(root.findall(".//camera"), expected(), strict=True):
        T = np.array([float(word) for word in camera.findtext("transform").split()]).reshape(4, 4)
        np.testing.assert_allclose(T[:3, 3], place_m, atol=1e-6)
        np.testing.assert_allclose(T @ [0.0, 0.0, 2.0, 1.0], [*ahead_m, 1.0], atol=1e-5)
        assert (out / "images" / camera.get("label")).exists()


def test_a_dive_without_a_net_is_refused_and_leaves_nothing(tmp_path):
    with DiveLogWriter(tmp_path / "raw.mcap") as writer:
        writer.write_message(world._Node(np.random.default_rng(1), 0, world.Flaws()).info)
    with Dive([tmp_path / "raw.mcap"]) as opened, pytest.raises(BuddylineError, match="no poses of a net"):
        colmap.export(opened, tmp_path / "model")
    assert [path.name for path in tmp_path.iterdir()] == ["raw.mcap"]
