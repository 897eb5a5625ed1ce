"""The comparison with references finds each kind of difference."""

import copy

import pytest

from tests.golden import references
from tests.golden.references import (
    FOLDER,
    compare_frames,
    compare_outcomes,
    compare_rows,
    compare_tracks,
    differences,
)


@pytest.fixture
def outcomes():
    return references._read(FOLDER / "cavern.outcomes.jsonl")[1:]


def _pose(outcomes):
    return next(one for one in outcomes if one["outcome"] == "pose")


def test_a_pose_that_moved_by_a_hundred_thousandth_of_its_sigma_is_seen(outcomes):
    found = copy.deepcopy(outcomes)
    pose = _pose(found)
    pose["t_a_b_m"][0] += 1e-5 * pose["covariance"][0] ** 0.5
    (said,) = differences(outcomes, found, compare_outcomes)
    assert "position by 1e-05 sigma" in said


def test_a_rotation_and_its_negative_quaternion(outcomes):
    found = copy.deepcopy(outcomes)
    pose = _pose(found)
    pose["q_a_b_xyzw"] = [-value for value in pose["q_a_b_xyzw"]]
    assert differences(outcomes, found, compare_outcomes) == []
    x, y, z, w = pose["q_a_b_xyzw"]
    angle = 1e-4 * pose["covariance"][15] ** 0.5
    # exp(angle e_x) times the rotation.
    pose["q_a_b_xyzw"] = [x + angle / 2 * w, y - angle / 2 * z, z + angle / 2 * y, w - angle / 2 * x]
    (said,) = differences(outcomes, found, compare_outcomes)
    assert "rotation by 0.0001 sigma" in said


@pytest.mark.parametrize(
    "change",
    [
        lambda pose: pose.update(blobs_a=[7, 7]),
        lambda pose: pose.update(method="paper"),
        lambda pose: pose.update(checks=[]),
        lambda pose: pose["covariance"].__setitem__(20, pose["covariance"][20] * 1.001),
        lambda pose: pose.update(t_ned_m=[value + 1e-4 for value in pose["t_ned_m"]]),
        lambda pose: pose.pop("t_ned_m"),
        lambda pose: pose.update(t_a_b_m=[float("nan")] * 3),
    ],
)
def test_any_other_change_of_a_pose_is_seen(outcomes, change):
    found = copy.deepcopy(outcomes)
    change(next(one for one in found if "t_ned_m" in one))
    assert len(differences(outcomes, found, compare_outcomes)) == 1


@pytest.mark.parametrize(
    "change",
    [
        lambda row: row["t_a_b_m"].__setitem__(2, row["t_a_b_m"][2] + 1e-5 * row["covariance"][11] ** 0.5),
        lambda row: row["v_a_b_mps"].__setitem__(0, row["v_a_b_mps"][0] + 1e-5 * row["v_covariance"][0] ** 0.5),
        lambda row: row["covariance"].__setitem__(20, row["covariance"][20] * 1.001),
        lambda row: row["v_covariance"].__setitem__(5, row["v_covariance"][5] * 1.001),
        lambda row: row.update(sigma_azimuth_rad=1.001 * row["sigma_azimuth_rad"]),
        lambda row: row.update(inclination_rad=row["inclination_rad"] + 1e-5 * row["sigma_inclination_rad"]),
        lambda row: row.update(lights=row["lights"] - 1),
        lambda row: row.pop("sigma_ned_m"),
        lambda row: row.update(t_ned_m=[float("nan")] * 3),
    ],
)
def test_any_change_of_a_track_is_seen(change):
    rows = references._read(FOLDER / "cavern_inertial.smooth.jsonl")[1:]
    assert len(rows) >= 10
    found = copy.deepcopy(rows)
    assert differences(rows, found, compare_tracks) == []
    change(found[3])
    assert len(differences(rows, found, compare_tracks)) == 1


def test_outcomes_that_are_gone_new_or_double_are_seen(outcomes):
    (said,) = differences(outcomes, outcomes[1:], compare_outcomes)
    assert "is gone" in said
    (said,) = differences(outcomes[1:], outcomes, compare_outcomes)
    assert "is new" in said
    assert len(differences(outcomes, [*outcomes, outcomes[0]], compare_outcomes)) == 1


def test_a_blob_that_moved_is_seen():
    frames = references._read(FOLDER / "basin_pictures.candidates.jsonl")[1:]
    found = copy.deepcopy(frames)
    found[0]["blobs"][0][0] += 1e-5
    assert len(differences(frames, found, compare_frames)) == 1
    assert differences(frames, found, compare_frames, loose=True) == []
    found[0]["blobs"][0][0] += 1.0
    assert len(differences(frames, found, compare_frames, loose=True)) == 1


def test_rows_may_differ_in_their_last_digit_alone():
    assert compare_rows({"a_m": 1.2345}, {"a_m": 1.2346}, False) == []
    assert compare_rows({"a_m": 1.2345}, {"a_m": 1.2348}, False) != []
    assert compare_rows({"fixes": 3}, {"fixes": 4}, False) != []


def test_an_update_rewrites_what_has_changed_and_nothing_else(outcomes, tmp_path, monkeypatch):
    monkeypatch.setattr(references, "FOLDER", tmp_path)
    references.check("x", (0, outcomes), compare_outcomes, update=True)
    before = (tmp_path / "x.jsonl").read_text().splitlines()
    found = copy.deepcopy(outcomes)
    for pose in (one for one in found if one["outcome"] == "pose"):
        pose["t_a_b_m"][0] += 1e-9 * pose["covariance"][0] ** 0.5
    moved = _pose(found)
    moved["t_a_b_m"][1] += 1.0
    with pytest.raises(AssertionError, match="--update-refs"):
        references.check("x", (0, found), compare_outcomes, update=False)
    references.check("x", (0, found), compare_outcomes, update=True)
    after = (tmp_path / "x.jsonl").read_text().splitlines()
    assert sum(one != other for one, other in zip(before, after, strict=True)) == 1
    references.check("x", (0, found), compare_outcomes, update=False)
    with pytest.raises(AssertionError, match="exit status 1, was 0"):
        references.check("x", (1, found), compare_outcomes, update=False)
