"""AR tags: pose from the tags of both pictures, false ones told by the layout, real water."""

import json
from pathlib import Path

import numpy as np
import pytest
from buddyline.node.sim import rotation, tags
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import ArTag, CameraModel, RelativePose
from buddyline.tools.cli import main
from buddyline.tools.evaluation.lights import project
from buddyline.tools.evaluation.rotation import conjugate, multiply, normalized, rotate, rotation_vector
from buddyline.tools.experiments import tank
from buddyline.tools.tags.detection import TagFinder
from buddyline.tools.tags.layout import Layout, layout_of, load_layout
from buddyline.tools.tags.pose import CORNER_SIGMA_PX, readings_of, tag_pose

CAMERA = CameraModel(
    model="pinhole", fx_px=904.0, fy_px=904.0, cx_px=409.5, cy_px=307.5, distortion=[-0.2, 0.05, 0.001, 0.0, 0.0]
)
LAYOUTS = [Layout(tags.FAMILY, {tag.id: tag.corners_m for tag in tags.layout(i)}) for i in range(2)]
TANK = Path(__file__).parents[3] / "shared/data/artag/test_vid.mp4"
T_M = np.array([0.1, -0.2, 2.5])
Q = normalized(np.array([0.05, 0.99, 0.02, -0.1]))


def _corners(noise_px, rng, t_m=T_M):
    seen_a = {i: [project(rotate(Q, c) + t_m, CAMERA)] for i, c in LAYOUTS[1].corners_m.items()}
    seen_b = {i: [project(rotate(conjugate(Q), c - t_m), CAMERA)] for i, c in LAYOUTS[0].corners_m.items()}
    for seen in (*seen_a.values(), *seen_b.values()):
        seen[0] = seen[0] + rng.normal(0.0, noise_px, (4, 2))
    return seen_a, seen_b


def _readings(seen_a, seen_b):
    return readings_of(seen_a, LAYOUTS[1], CAMERA, by_a=True) + readings_of(seen_b, LAYOUTS[0], CAMERA, by_a=False)


def _angle_rad(q):
    return np.linalg.norm(rotation_vector(multiply(Q, conjugate(q))))


def test_perfect_corners_give_the_pose_from_both_pictures_or_one():
    seen_a, seen_b = _corners(0.0, np.random.default_rng(1))
    for a, b, count in ((seen_a, seen_b, 4), (seen_a, {}, 2), ({}, seen_b, 2)):
        pose = tag_pose(_readings(a, b))
        assert pose.readings == count
        np.testing.assert_allclose(pose.t_a_b_m, T_M, atol=1e-5)
        assert _angle_rad(pose.q_a_b_xyzw) < 1e-5
        assert abs(pose.range_a_m - pose.range_b_m) < 1e-5


def test_the_covariance_matches_the_errors():
    rng = np.random.default_rng(2)
    nees = []
    for _ in range(12):
        pose = tag_pose(_readings(*_corners(CORNER_SIGMA_PX, rng)))
        error = np.concatenate([T_M - pose.t_a_b_m, rotation_vector(multiply(Q, conjugate(pose.q_a_b_xyzw)))])
        nees.append(error @ np.linalg.solve(pose.covariance, error))
    # The mean of 12 chi-squares of six: 6, with a standard deviation of 1.0.
    assert 3.5 < np.mean(nees) < 8.5


@pytest.mark.parametrize("twice", [False, True])
def test_a_false_tag_is_left_out(twice):
    seen_a, seen_b = _corners(0.2, np.random.default_rng(3))
    false = np.array([(100.0, 80.0), (160, 84), (158, 140), (99, 138)])
    tag_id = next(iter(seen_a))
    seen_a[tag_id] = [false, *seen_a[tag_id]] if twice else [false]
    pose = tag_pose(_readings(seen_a, seen_b))
    assert (pose.readings, pose.left_out) == ((4, 1) if twice else (3, 1))
    assert np.linalg.norm(pose.t_a_b_m - T_M) < 0.03


def test_small_far_tags_fit_two_poses_and_give_none():
    seen_a, _ = _corners(0.0, np.random.default_rng(4), np.array([0.0, 0.0, 9.0]))
    assert tag_pose(_readings(seen_a, {})) is None


def test_one_tag_alone_gives_no_pose():
    seen_a, seen_b = _corners(0.0, np.random.default_rng(5))
    assert tag_pose(_readings({3: seen_a[3]}, {})) is None
    assert tag_pose(_readings({3: seen_a[3]}, {0: seen_b[0]})).readings == 2


@pytest.mark.parametrize(
    ("text", "named"),
    [
        ("[]", "no tags"),
        ('[{"id": 1, "corners_m": [[0, 0, 0]]}]', "corners_m"),
        ('[{"id": 1, "corners_m": [[0, 0, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0]]}]', "1 mm"),
        ('[{"id": 1, "family": "x", "corners_m": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]}]', "family"),
    ],
)
def test_a_layout_that_cannot_be_used_is_named(text, named, tmp_path):
    path = tmp_path / "tags.json"
    path.write_text(text)
    with pytest.raises(BuddylineError, match=named) as error:
        load_layout(str(path))
    assert "tags.json" in str(error.value)


def test_two_tags_of_one_id_are_refused():
    tag = ArTag(id=3, corners_m=((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)))
    with pytest.raises(BuddylineError, match="id 3"):
        layout_of([tag, tag], "here")


def test_tags_of_a_rendered_pair_give_the_true_pose():
    world = World(Scenario(environment="cavern", seed=12, tags=True, interruptions=False, other_lamps=0))
    stamp_ns = 3_000_000_000
    readings = []
    for viewer, other, by_a in (("a", "b", True), ("b", "a", False)):
        layout = layout_of(world.info(other, 0, 1).tags, other)
        found = TagFinder(layout).find(world.render(viewer, stamp_ns))
        readings += readings_of(found, layout, world.info(viewer, 0, 1).camera, by_a=by_a)
    truth = world.truth(stamp_ns, 0)
    pose = tag_pose(readings)
    assert pose.readings >= 2
    assert np.linalg.norm(pose.t_a_b_m - truth.t_a_b_m) < 0.05
    R = rotation.from_quaternion(tuple(pose.q_a_b_xyzw.tolist())).T @ rotation.from_quaternion(truth.q_a_b_xyzw)
    assert np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1)) < np.radians(3)


def test_a_dive_of_pictures_becomes_poses_on_their_own_topic_that_evaluate_measures(tmp_path, capsys):
    dive, out = str(tmp_path / "d.mcap"), str(tmp_path / "t.mcap")
    words = ["--images", "--tags", "--seconds", "2", "--rate", "2", "--seed", "12", "--undisturbed", "--lost", "0"]
    assert main(["simulate", dive, *words]) == 0
    capsys.readouterr()
    assert main(["artag", dive, "-o", out, "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    with DiveLogReader(out) as reader:
        poses = [record.open().message for record in reader.records(lambda key: key == "buddyline/pair/a/b/artag")]
    assert summary["poses"] == len(poses) >= 2
    assert {type(pose) for pose in poses} == {RelativePose}
    assert {pose.method for pose in poses} == {"artag"}
    assert main(["evaluate", out, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["environment"] == "cavern"
    assert result["accuracy"]["poses"] == len(poses)
    assert result["accuracy"]["translation_m"]["median"] < 0.05


def test_a_dive_without_tags_gives_a_one_line_error(tmp_path, capsys):
    dive = str(tmp_path / "d.mcap")
    assert main(["simulate", dive, "--images", "--seconds", "1.2", "--rate", "4", "--width", "200"]) == 0
    assert main(["artag", dive, "-o", str(tmp_path / "t.mcap")]) == 2
    assert "--tags a=FILE" in capsys.readouterr().err
    assert not (tmp_path / "t.mcap").exists()


@pytest.mark.skipif(not TANK.exists(), reason="the real tag video is not in ../shared/data/artag")
def test_tags_in_real_water_agree_with_their_stated_layout():
    found = tank.figures(TANK, 80)
    # Some of what reads as two tags is one and a false one: of that there is no pose.
    assert found["poses"] >= 0.8 * found["with_two_tags"] > 3
    assert found["readings_used"] > 2 * found["poses"]
    # The centres are stated to the centimetre: that is what corners may be off by.
    assert found["residual_median_px"] < 1.5
    assert 2.0 < found["range_median_m"] < 6.0
