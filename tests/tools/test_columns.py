"""The library: dives as columns, solved in memory, detected in an array; beside what the commands say."""

import subprocess
import sys
from dataclasses import replace

import buddyline
import numpy as np
import pytest
from buddyline.protocol.divelog import DiveLogWriter
from buddyline.tools.cli import main
from buddyline.tools.columns import in_order

from tests.golden.logs import read_log, write_log
from tests.golden.references import FOLDER
from tests.processes import PATIENCE_S, REPOSITORY

DATA = REPOSITORY / "tests" / "data" / "golden"
CAVERN = DATA / "cavern.mcap"


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    path = tmp_path_factory.mktemp("solved") / "solved.mcap"
    assert main(["solve", str(CAVERN), "-o", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def in_memory():
    return buddyline.solve(CAVERN)


def test_poses_are_those_of_the_log(solved):
    poses = buddyline.open_dive(solved).poses()
    said = [entry.message for entry in read_log(solved) if entry.topic == "pose"]
    said.sort(key=lambda pose: pose["stamp_ns"])
    n = len(said)
    assert n > 100
    assert (poses.t_a_b_m.shape, poses.q_a_b_xyzw.shape, poses.covariance.shape) == ((n, 3), (n, 4), (n, 6, 6))
    assert poses.stamp_ns.dtype == np.int64
    np.testing.assert_array_equal(poses.stamp_ns, [pose["stamp_ns"] for pose in said])
    np.testing.assert_array_equal(poses.trigger, [pose["trigger"] for pose in said])
    np.testing.assert_array_equal(poses.t_a_b_m, [pose["t_a_b_m"] for pose in said])
    np.testing.assert_array_equal(poses.covariance[3], np.reshape(said[3]["covariance"], (6, 6)))
    np.testing.assert_array_equal(poses.method, [pose["method"] for pose in said])
    assert set(poses.lights[poses.method == "three_lights"]) == {3}
    assert set(poses.lights[poses.method == "refined"]) == {4}
    np.testing.assert_allclose(poses.sigma_m[0], np.sqrt(np.diag(poses.covariance[0])[:3]))
    assert poses.time_s[0] == 0.0
    assert poses.time_s[-1] == pytest.approx((said[-1]["stamp_ns"] - said[0]["stamp_ns"]) / 1e9)


def test_solving_in_memory_and_by_command_give_the_same(solved, in_memory):
    dive, memory = buddyline.open_dive(solved), in_memory
    assert memory.pair == ("a", "b")
    assert dive.pairs == [("a", "b")]
    poses, rejections = dive.poses(), dive.rejections()
    np.testing.assert_array_equal(memory.poses.trigger, poses.trigger)
    # The command solves fewer triggers in one set of arrays.
    np.testing.assert_allclose(memory.poses.t_a_b_m, poses.t_a_b_m, atol=1e-9)
    np.testing.assert_allclose(memory.poses.t_ned_m, poses.t_ned_m, atol=1e-9)
    np.testing.assert_array_equal(memory.rejections.trigger, rejections.trigger)
    np.testing.assert_array_equal(memory.rejections.reason, rejections.reason)


def test_the_track_in_memory_equals_that_of_the_log(solved, in_memory):
    memory, dive = in_memory.track, buddyline.open_dive(solved).track()
    said = [entry.message for entry in read_log(solved) if entry.topic == "track"]
    said.sort(key=lambda one: one["stamp_ns"])
    n = len(said)
    assert n > 300
    assert dive.mode == memory.mode == "smooth"
    np.testing.assert_array_equal(dive.stamp_ns, [one["stamp_ns"] for one in said])
    for name in ("t_a_b_m", "q_a_b_xyzw", "v_a_b_mps", "lights", "age_s", "range_m", "t_ned_m", "sigma_ned_m"):
        np.testing.assert_array_equal(getattr(dive, name), [one[name] for one in said], err_msg=name)
    for name in ("azimuth_rad", "sigma_azimuth_rad", "inclination_rad", "sigma_inclination_rad"):
        np.testing.assert_array_equal(getattr(dive, name), [one[name] for one in said], err_msg=name)
    np.testing.assert_array_equal(dive.covariance.reshape(n, 36), [one["covariance"] for one in said])
    np.testing.assert_array_equal(dive.v_covariance.reshape(n, 9), [one["v_covariance"] for one in said])
    np.testing.assert_array_equal(memory.stamp_ns, dive.stamp_ns)
    np.testing.assert_allclose(memory.t_a_b_m, dive.t_a_b_m, atol=1e-6)
    np.testing.assert_allclose(dive.sigma_m[0], np.sqrt(np.diag(dive.covariance[0])[:3]))


def test_a_track_can_be_left_out_and_a_mode_must_be_known():
    without = buddyline.solve(CAVERN, track="none")
    assert len(without.track) == 0
    assert without.track.mode == ""
    assert without.track.covariance.shape == (0, 6, 6)
    assert len(without.poses) > 100
    with pytest.raises(buddyline.BuddylineError, match="track = 'best': known are smooth, lag, filter, none"):
        buddyline.solve(CAVERN, track="best")
    with pytest.raises(buddyline.BuddylineError, match="track_hz = 0"):
        buddyline.solve(CAVERN, track_hz=0.0)


def test_the_best_track_of_a_recording_is_taken(tmp_path, solved):
    tracks = [entry for entry in read_log(solved) if entry.topic == "track"][:10]
    live = [entry.saying(mode="filter") for entry in tracks]
    late = [replace(entry.saying(mode="lag"), key=entry.key.replace("/track", "/track_lag")) for entry in tracks[:4]]
    dive = buddyline.open_dive(write_log(tmp_path / "live.mcap", live + late))
    assert (dive.track().mode, len(dive.track())) == ("lag", 4)
    assert (dive.track(mode="filter").mode, len(dive.track(mode="filter"))) == ("filter", 10)
    assert len(dive.track(mode="smooth")) == 0


def test_sensors_truth_and_candidates_are_columns():
    dive = buddyline.open_dive(CAVERN)
    assert dive.nodes == ["a", "b"]
    assert dive.infos["a"].width_px == 820
    attitudes, depths, truth, lights = dive.attitudes("a"), dive.depths("b"), dive.truth(), dive.candidates("a")
    assert attitudes.q_ned_body_xyzw.shape == (700, 4)
    np.testing.assert_allclose(np.linalg.norm(attitudes.q_ned_body_xyzw, axis=1), 1.0, atol=1e-6)
    assert len(depths) == 140
    assert (depths.depth_m > 5).all()
    assert (np.diff(truth.trigger) == 1).all()
    assert len(lights) > len(lights.frame_stamp_ns)
    assert set(lights.trigger) <= set(lights.frame_trigger)
    assert (lights.blob[np.flatnonzero(np.diff(lights.trigger)) + 1] == 0).all()
    assert len(dive.imu("a")) == 0
    assert dive.imu("a").mag_t.shape == (0, 3)
    assert dive.poses().covariance.shape == (0, 6, 6)
    assert len(buddyline.open_dive(DATA / "survey.mcap").imu("a")) > 50
    assert dive.losses == []


def test_of_two_samples_with_one_stamp_the_first_counts(tmp_path):
    depths = [
        buddyline.Depth(node="a", stamp_ns=ns, depth_m=m, sigma_m=0.1) for ns, m in ((2, 1.0), (1, 2.0), (2, 3.0))
    ]
    assert [one.depth_m for one in in_order(depths)] == [2.0, 1.0]
    with DiveLogWriter(tmp_path / "a.mcap") as writer:
        for number, depth in enumerate(depths):
            writer.write_message(depth, number)
    found = buddyline.open_dive(tmp_path / "a.mcap").depths("a")
    assert found.depth_m.tolist() == [2.0, 1.0]
    assert np.isnan(found.pressure_pa).all()


def test_damage_is_reported_and_the_rest_is_used():
    dive = buddyline.open_dive(DATA / "basin_damaged.mcap")
    assert len(dive.attitudes("a")) > 300
    assert any("basin_damaged.mcap" in line and "byte" in line for line in dive.losses)
    assert len(buddyline.solve(DATA / "basin_damaged.mcap", track="none").poses) > 50


def test_a_dive_of_three_nodes_asks_for_a_pair(tmp_path):
    entries = read_log(CAVERN)
    third = [
        entry.saying(node="c").__class__(**{**vars(entry.saying(node="c")), "key": entry.key.replace("/b/", "/c/")})
        for entry in entries
        if entry.key.startswith("buddyline/node/b/") and entry.topic != "light_truth"
    ]
    log = write_log(tmp_path / "three.mcap", [*entries, *third])
    with pytest.raises(buddyline.BuddylineError, match="choose a pair"):
        buddyline.solve(log)
    assert len(buddyline.solve(log, pair=("a", "c"), track="none").poses) > 100


def test_errors_name_what_is_wrong(tmp_path):
    dive = buddyline.open_dive(CAVERN)
    with pytest.raises(buddyline.BuddylineError, match="holds nothing of node 'x'; nodes: a, b"):
        dive.depths("x")
    with pytest.raises(buddyline.BuddylineError, match="holds nothing of pair b/c"):
        dive.poses(("b", "c"))
    with pytest.raises(buddyline.BuddylineError, match=r"none\.mcap"):
        buddyline.open_dive(tmp_path / "none.mcap")
    with pytest.raises(buddyline.BuddylineError, match="give at least one dive log"):
        buddyline.open_dive()
    with pytest.raises(buddyline.BuddylineError, match="method = 'guess'"):
        buddyline.solve(CAVERN, method="guess")
    with pytest.raises(buddyline.BuddylineError, match="candidates of nodes none"):
        buddyline.solve_messages([])
    with pytest.raises(buddyline.BuddylineError, match="float64 pixels"):
        buddyline.detect(np.zeros((4, 4)))
    with pytest.raises(AttributeError, match="no attribute 'solver'"):
        buddyline.solver  # noqa: B018


def test_lights_are_detected_in_an_array():
    picture = np.zeros((200, 300), np.uint8)
    rows, columns = np.mgrid[:200, :300]
    picture[:] = np.clip(20 + 300 * np.exp(-((rows - 80.25) ** 2 + (columns - 120.5) ** 2) / 18), 0, 255)
    blob = buddyline.detect(picture)[0]
    assert (blob.u_px, blob.v_px) == (pytest.approx(120.5, abs=0.1), pytest.approx(80.25, abs=0.1))


def test_a_calibration_is_read_from_a_log_or_json(tmp_path):
    info = buddyline.read_info(CAVERN)
    assert info == buddyline.open_dive(CAVERN).infos["a"]
    entry = next(entry for entry in read_log(CAVERN) if entry.topic == "info")
    (tmp_path / "a.json").write_bytes(entry.payload)
    assert buddyline.read_info(tmp_path / "a.json") == info


def test_every_public_name_is_there_and_described():
    assert sorted(buddyline.__all__) == buddyline.__all__
    for name in buddyline.__all__:
        value = getattr(buddyline, name)
        assert name == "__version__" or value.__doc__, name
    assert set(dir(buddyline)) == set(buddyline.__all__)


def test_importing_the_library_imports_nothing_else():
    program = "import sys; before = set(sys.modules); import buddyline; print(*sorted(set(sys.modules) - before))"
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S, check=True
    )
    imported = done.stdout.split()
    assert "buddyline" in imported
    ours = {name for name in imported if name.startswith("buddyline")}
    assert ours == {"buddyline"}
    assert {name.partition(".")[0] for name in imported} - ours <= set(sys.stdlib_module_names)


def test_the_librarys_checks_match_the_solvers():
    from buddyline.solver_service.choices import CHECKS

    assert buddyline.ALL_CHECKS == CHECKS
    assert (FOLDER / "cavern.outcomes.jsonl").exists()


def test_pictures_of_a_node_are_arrays_and_a_damaged_one_is_named(tmp_path):
    entries = read_log(DATA / "night_reef_pictures.mcap")
    dive = buddyline.open_dive(DATA / "night_reef_pictures.mcap")
    found = list(dive.pictures("a"))
    assert len(found) == sum(entry.key == "buddyline/node/a/image" for entry in entries)
    stamp_ns, picture = found[0]
    assert picture.shape == (dive.infos["a"].height_px, 480, 3)
    assert stamp_ns > 0
    images = [entry for entry in entries if entry.key == "buddyline/node/a/image"]
    spoilt = [one.saying(data="bm8gcGljdHVyZQ==") if one is images[0] else one for one in entries]
    dive = buddyline.open_dive(write_log(tmp_path / "spoilt.mcap", spoilt))
    assert len(list(dive.pictures("a"))) == len(found) - 1
    assert "picture of node a at" in dive.losses[0]
    with pytest.raises(buddyline.BuddylineError, match="nothing of node 'c'"):
        next(dive.pictures("c"))
