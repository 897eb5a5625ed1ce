"""`simulate`, `solve` and `evaluate` of dives whose nodes' clocks differ agree with each other."""

import json
import re

import numpy as np
import pytest
from buddyline.node.sim.scenario import Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import S_NS
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import Candidates, LightTruth, NodeInfo, RelativePose, Truth
from buddyline.solver_service.clock_curve import ClockCurve
from buddyline.tools.cli import main
from buddyline.tools.clock_curves import (
    APART,
    CURVES,
    apart_problem,
    apart_text,
    curves_text,
    noted_apart,
    noted_curves,
)
from buddyline.tools.dives import Dive
from buddyline.tools.evaluation.clocks import SimulatedClocks, take_ned_truths
from buddyline.tools.evaluation.recorded import Recorded
from buddyline.tools.monitor.summary import summarize
from buddyline.tools.offline import solve_logs
from msgspec.structs import replace

START_NS = 1_764_000_000 * S_NS
OFFSET_MS, DRIFT_PPM = 300.0, 100.0


@pytest.fixture(scope="module")
def dive(tmp_path_factory):
    """A dive of which B's clock is far ahead, and gains."""
    path = tmp_path_factory.mktemp("clocks_apart") / "dive.mcap"
    words = ["--seconds", "30", "--seed", "8", "--imu", "--inertial", "poor"]
    clocks = ["--clock-offset-ms", str(OFFSET_MS), "--clock-drift-ppm", str(DRIFT_PPM)]
    assert main(["simulate", str(path), *words, *clocks]) == 0
    return path


def evaluated(dive, out, capsys, caplog, *words):
    """Return what `evaluate` tells of a dive, and what it and `solve` warn of."""
    assert main(["solve", str(dive), "-o", str(out), *words]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(out), "--json"]) == 0
    return json.loads(capsys.readouterr().out), [record.getMessage() for record in caplog.records]


def check_track(result):
    [track] = result["tracks"]
    assert track["samples"] > 1400
    assert track["wrong"] == 0
    assert 0.7 < track["nees6"]["mean"] / 6.0 < 1.4
    assert track["position_m"]["median"] < 0.01


def test_what_the_track_has_found_of_the_clocks_counts_for_poses_too(dive, tmp_path, capsys, caplog):
    result, warnings = evaluated(dive, tmp_path / "out.mcap", capsys, caplog)
    check_track(result)
    # Both commands say so, and what to do.
    assert len(warnings) == 2
    for warning in warnings:
        [ms] = re.findall(r"clock of b is (\d+) ms ahead of a's: each pose .* which its sigmas count", warning)
        [s] = re.findall(r"solve again with --nodes a b --clock-offset (0\.\d{4}) ", warning)
        assert float(ms) == pytest.approx(301.5, abs=6.0)
        assert float(s) == pytest.approx(0.3015, abs=0.006)
    assert result["accuracy"]["poses"] > 200
    assert result["accuracy"]["wrong"] == 0
    assert result["accuracy"]["nees6"]["mean"] / 6.0 < 1.4
    # Stamps and triggers are those of the frames, as they were recorded.
    with DiveLogReader(tmp_path / "out.mcap") as reader:
        poses = [one for one in (record.open().message for record in reader.records()) if isinstance(one, RelativePose)]
    assert max(abs(pose.skew_ns) for pose in poses) < S_NS // 50
    assert {pose.trigger - round(pose.stamp_ns * 10 / S_NS) for pose in poses} == {0}
    # The library gives what the command writes.
    found = solve_logs([dive])
    assert found.poses.stamp_ns.tolist() == sorted(pose.stamp_ns for pose in poses)


def test_poses_of_a_live_track_do_not_count_its_clocks(dive, tmp_path, capsys, caplog):
    """It knows them too late. Both commands say that the poses are off by more than they state."""
    result, warnings = evaluated(dive, tmp_path / "out.mcap", capsys, caplog, "--track", "filter")
    assert sum("which its sigmas do not count" in warning for warning in warnings) == 2
    assert result["accuracy"]["nees6"]["mean"] / 6.0 > 3.0


@pytest.mark.parametrize("drifts", [False, True])
def test_poses_and_track_of_a_dive_solved_with_its_clocks_are_right(dive, tmp_path, capsys, caplog, drifts):
    words = ["--clock-offset", "0.3015"]
    if drifts:
        (tmp_path / "clocks.json").write_text(
            json.dumps({"node_a": "a", "node_b": "b", "offset_s": 0.3, "drift": 1e-4, "at_ns": START_NS})
        )
        words = ["--clocks", str(tmp_path / "clocks.json")]
    result, warnings = evaluated(dive, tmp_path / "out.mcap", capsys, caplog, *words)
    assert not any("ahead of" in warning for warning in warnings)
    check_track(result)
    assert result["accuracy"]["poses"] > 200
    assert result["accuracy"]["wrong"] == 0
    assert result["accuracy"]["nees6"]["mean"] / 6.0 < 1.4
    # The poses' candidates are found again, though B's triggers were numbered anew.
    assert result["pairing"]["right_share"] > 0.6
    with Dive([tmp_path / "out.mcap"]) as solved:
        summary = summarize(solved, ("a", "b"))
    assert summary.errors().wrong.sum() == 0
    [track] = summary.track_figures()
    assert track.position_m.median < 0.01


@pytest.mark.parametrize(
    ("frame", "offset_ms"),
    [
        (["--fixed", "a"], 15),
        # Of a frame that moves with a node, too, places count from where that is at the same instant.
        pytest.param([], 15, marks=pytest.mark.slow),
        pytest.param([], 200, marks=pytest.mark.slow),
    ],
)
def test_a_network_whose_clocks_differ_is_right(tmp_path, capsys, frame, offset_ms):
    dive, out = tmp_path / "dive.mcap", tmp_path / "out.mcap"
    words = ["--nodes", "3", *frame, "--seconds", "20", "--seed", "6", "--imu", "--clock-offset-ms", str(offset_ms)]
    assert main(["simulate", str(dive), *words]) == 0
    assert main(["solve", str(dive), "-o", str(out)]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(out), "--json"]) == 0
    figures = {one["node"]: one for one in json.loads(capsys.readouterr().out)["network"]}
    assert [figures[node]["wrong"] for node in "abc"] == [0, 0, 0]
    assert max(figures[node]["nees6"]["mean"] for node in "bc") / 6.0 < 3.0


def test_what_is_still_apart_is_added_to_what_was_taken_into_account():
    curves = {"b": ClockCurve.constant(0.3), "c": ClockCurve.constant(-0.1)}
    told = apart_problem(("a", "b"), -0.02, curves, START_NS, counted=True)
    assert "clock of b is 20 ms behind a's" in told
    assert "--nodes a b --clock-offset 0.2800 " in told
    assert "--nodes b c --clock-offset -0.3500 " in apart_problem(("b", "c"), 0.05, curves, START_NS, counted=True)


@pytest.mark.parametrize(
    ("pair", "curves_s", "ahead_a_s", "between_s"),
    [
        (("a", "b"), {}, 0.0, 0.151),
        (("a", "b"), {"b": 0.3}, 0.0, 0.001),
        (("b", "c"), {}, 0.0, 0.0),
        (("b", "c"), {"b": 0.3, "c": 0.302}, -0.3, -0.301),
        (("b", "a"), {}, 0.0, -0.151),
    ],
)
def test_a_node_s_true_poses_are_taken_from_its_own_clock(pair, curves_s, ahead_a_s, between_s):
    clocks = SimulatedClocks.of(
        {"start_ns": str(START_NS), "clock_offset_ns": str(round(0.3 * S_NS)), "clock_drift": "0.0001"}
    )
    at_ns = START_NS + 20 * S_NS
    true = World(Scenario(start_ns=START_NS)).node_truth("a", at_ns, "main")
    true = replace(true, node=pair[0])
    recorded = Recorded(pair, ned_truths_a=[true])
    take_ned_truths(recorded, clocks, {node: ClockCurve.constant(s) for node, s in curves_s.items()})
    assert [one.stamp_ns - at_ns for one in recorded.ned_truths_a] == [round(ahead_a_s * S_NS)]
    assert [one.stamp_ns - at_ns for one in recorded.ned_truths_between] == [round(between_s * S_NS)]
    assert recorded.ned_truths_between[0].q_xyzw == true.q_xyzw


def test_clocks_that_a_log_notes_wrongly_are_named(dive, tmp_path, capsys):
    with DiveLogReader(dive) as reader, DiveLogWriter(tmp_path / "odd.mcap", metadata={"clock_drift": "x"}) as writer:
        for record in reader.records():
            one = record.open()
            if isinstance(one.message, Truth | RelativePose | LightTruth | Candidates | NodeInfo):
                writer.write_message(one.message, key=one.key)
    assert main(["solve", str(tmp_path / "odd.mcap"), "-o", str(tmp_path / "out.mcap"), "--track", "none"]) == 0
    capsys.readouterr()
    assert main(["evaluate", str(tmp_path / "out.mcap")]) == 2
    assert "out.mcap: its metadata of the simulated clocks" in capsys.readouterr().err


def test_a_curve_of_many_points_is_noted_by_some_of_them():
    stamps_ns = np.arange(0, 3600 * S_NS, S_NS)
    curve = ClockCurve(stamps_ns, (1e-4 * stamps_ns).astype(np.int64))
    text = curves_text({"b": curve, "c": ClockCurve.constant(-0.5)})
    assert len(text) < 10_000
    noted = noted_curves({CURVES: text}, "dive.mcap")
    assert noted["c"].offset_ns(5 * S_NS) == -S_NS // 2
    at_ns = [0, 1_234_567_891_234, 3599 * S_NS]
    assert [noted["b"].offset_ns(one) for one in at_ns] == pytest.approx([curve.offset_ns(one) for one in at_ns], abs=2)


@pytest.mark.parametrize("text", ["{", "[]", '{"b": 1}', '{"b": {"stamps_ns": [], "offsets_ns": []}}', '{"b": {}}'])
def test_a_note_that_does_not_fit_is_named(text):
    with pytest.raises(BuddylineError, match=r"dive\.mcap: its metadata clock_curves"):
        noted_curves({CURVES: text}, "dive.mcap")


@pytest.mark.parametrize("text", ["{", "1", '[["a", 0.3]]', '[["a", "b", "x"]]'])
def test_clocks_that_poses_count_and_that_are_noted_wrongly_are_named(text):
    with pytest.raises(BuddylineError, match=r"dive\.mcap: its metadata clocks_apart"):
        noted_apart({APART: text}, "dive.mcap")


def test_clocks_that_poses_count_are_noted():
    apart_s = {("a", "b"): 0.3, ("a", "c"): -0.125}
    assert noted_apart({APART: apart_text(apart_s)}, "dive.mcap") == apart_s
    assert noted_apart({}, "dive.mcap") == {}
