"""From the nodes' folders to a solved dive and its report."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from buddyline.node.sim.dive import messages
from buddyline.node.sim.scenario import DivePlan, Scenario
from buddyline.node.sim.world import World
from buddyline.protocol.clock import MS_NS, S_NS
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.messages import RelativePose
from buddyline.tools import after
from buddyline.tools.after import logs_in, outings
from buddyline.tools.cli import main
from buddyline.tools.dives import Dive
from buddyline.tools.extras import MissingExtraError

from tests.tools.evaluated import pose, write_log

LOGS = Path(__file__).parents[1] / "data" / "golden"


@pytest.fixture
def folders(tmp_path):
    """What two nodes of one dive recorded; their clocks are 30 ms apart."""
    for node in "ab":
        (tmp_path / node).mkdir()
        shutil.copy(LOGS / f"night_reef_{node}.mcap", tmp_path / node / f"{node}-1.mcap")
    return tmp_path


def moved(source, target, hours):
    """The same log, recorded at another time."""
    with DiveLogReader(source) as reader, DiveLogWriter(target) as writer:
        for record in reader.records():
            writer.write(record.key, record.payload, record.log_time_ns + hours * 3_600_000_000_000)


def corrections(folders, out):
    """Give the times (s) of the poses of both `after` and a plain `solve`, and how far `after` moved B's stamps (s)."""
    logs, without = [str(path) for path in logs_in([folders / "a", folders / "b"])], folders / "without.mcap"
    assert main(["solve", *logs, "--track", "none", "--clock-offset", "0", "-o", str(without)]) == 0
    poses = []
    for path in (out / "solved.mcap", without):
        with Dive([path]) as dive:
            found = [one.message for one in dive.messages("pose")]
        poses.append({one.trigger: one for one in found if isinstance(one, RelativePose)})
    moved, unmoved = poses
    common = sorted(moved.keys() & unmoved.keys())
    times_ns = np.array([unmoved[k].stamp_ns for k in common])
    return times_ns / S_NS, np.array([moved[k].skew_ns - unmoved[k].skew_ns for k in common]) / S_NS


@pytest.mark.slow
def test_a_dive_s_folders_become_poses_track_and_report(folders, capsys):
    out = folders / "dive"
    assert main(["after", str(folders / "a"), str(folders / "b"), "-o", str(out)]) == 0
    said = capsys.readouterr().err
    for name in ("track.tum", "track.csv"):
        assert said.count(f"{out / name}: the track (smooth)") == 1
    assert {path.name for path in out.iterdir()} == {
        "clocks.json",
        "solved.mcap",
        "track.tum",
        "track.csv",
        "report.html",
    }
    with DiveLogReader(out / "solved.mcap") as reader:
        assert {"buddyline/pair/a/b/pose", "buddyline/pair/a/b/track"} <= set(reader.keys)
    _, moved_s = corrections(folders, out)
    told = json.loads((out / "clocks.json").read_text())
    assert moved_s == pytest.approx(told["offset_s"], abs=1e-6)
    assert abs(told["offset_s"] - 0.03) < 3 * told["sigma_s"]
    assert len(moved_s) > 30
    capsys.readouterr()
    assert main(["after", str(folders / "a"), str(folders / "b"), "-o", str(out)]) == 2
    assert "is not empty; name another folder, or empty it" in capsys.readouterr().err


@pytest.mark.slow
def test_a_drift_that_the_dive_tells_is_taken_out(tmp_path):
    """No beacons: B's clock starts 20 ms ahead and gains 150 us a second; with precise fixes two minutes tell it."""
    drift, start_s = 150e-6, 1_764_000_000
    scenario = Scenario(
        seed=8, start_ns=start_s * S_NS, interruptions=False, clock_offset_ns=20 * MS_NS, clock_drift=drift,
        sigma_px=0.15, gross_share=0.0, miss_share=0.0, false_lights=0,
    )  # fmt: skip
    dive = [message for _, _, message in messages(World(scenario), DivePlan(seconds=130.0, rate_hz=4.0, imu=True))]
    for node in "ab":
        (tmp_path / node).mkdir()
        with DiveLogWriter(tmp_path / node / f"{node}.mcap", metadata={"node": node}) as writer:
            for message in dive:
                if getattr(message, "node", "") == node:
                    writer.write_message(message)
    out = tmp_path / "dive"
    assert main(["after", str(tmp_path / "a"), str(tmp_path / "b"), "-o", str(out)]) == 0
    times_s, moved_s = corrections(tmp_path, out)
    left_s = moved_s - (0.02 + drift * (times_s - start_s))
    assert len(left_s) > 300
    # Without the drift 15 ms would be left between start and end, without both 20 ms at the start.
    assert np.ptp(left_s) < 0.005
    assert np.abs(left_s).max() < 0.005


def test_each_dive_has_its_folder_and_a_log_without_a_partner_is_left_out(folders):
    for node in "ab":
        moved(folders / node / f"{node}-1.mcap", folders / node / f"{node}-2.mcap", 3)
    moved(folders / "a" / "a-1.mcap", folders / "a" / "a-3.mcap", 9)
    (folders / "b" / "b-4.mcap").write_bytes(b"")
    found = outings(logs_in([folders]))
    assert [(sorted(one.nodes), len(one.logs)) for one in found] == [(["a", "b"], 2), (["a", "b"], 2), (["a"], 1)]


def test_what_cannot_be_used_is_named(folders, capsys):
    (folders / "b" / "b-1.mcap").write_bytes(b"no log at all")
    assert main(["after", str(folders / "a"), str(folders / "b"), "-o", str(folders / "dive")]) == 2
    said = capsys.readouterr().err
    assert "b-1.mcap" in said
    assert "no dive that two nodes recorded" in said
    (folders / "empty").mkdir()
    for words, expected in (([str(folders / "empty")], "holds no log"), ([str(folders / "nowhere")], "does not exist")):
        assert main(["after", *words, "-o", str(folders / "dive")]) == 2
        assert expected in capsys.readouterr().err
    assert not (folders / "dive").exists()


def test_a_folder_that_an_interrupted_call_left_empty_is_taken_and_one_that_cannot_be_is_said(
    folders, monkeypatch, capsys
):
    asked = []
    monkeypatch.setattr(after, "_solve", lambda one, folder: asked.append(folder) or 0)
    (folders / "left").mkdir()
    assert main(["after", str(folders / "a"), str(folders / "b"), "-o", str(folders / "left")]) == 0
    assert asked == [folders / "left"]
    (folders / "file").write_text("")
    assert main(["after", str(folders / "a"), str(folders / "b"), "-o", str(folders / "file" / "new")]) == 2
    assert "cannot be made: Not a directory" in capsys.readouterr().err


def part(source, target, begin_s, end_s):
    """A part of a log."""
    with DiveLogReader(source) as reader, DiveLogWriter(target) as writer:
        for record in reader.records():
            if record.key.endswith("/info") or begin_s <= (record.log_time_ns - reader.start_ns) / S_NS < end_s:
                writer.write(record.key, record.payload, record.log_time_ns)


def test_a_dive_without_a_pose_has_a_report_that_says_why(folders, capsys):
    pytest.importorskip("matplotlib")
    for node, begin_s in (("a", 0), ("b", 3)):
        (folders / f"part_{node}").mkdir()
        part(folders / node / f"{node}-1.mcap", folders / f"part_{node}" / "1.mcap", begin_s, begin_s + 2)
    out = folders / "dive"
    assert main(["after", str(folders / "part_a"), str(folders / "part_b"), "-o", str(out)]) == 1
    said = capsys.readouterr()
    assert f"{out}: report.html, solved.mcap" in said.out
    assert "solve it first" not in said.err


def test_a_dive_that_cannot_be_solved_costs_no_other(folders, monkeypatch, caplog):
    for node in "ab":
        moved(folders / node / f"{node}-1.mcap", folders / node / f"{node}-2.mcap", hours=5)
    asked = []

    def solve(one, folder):
        asked.append(folder.name)
        if len(asked) == 1:
            raise BuddylineError("lights of nobody")
        return 0

    monkeypatch.setattr(after, "_solve", solve)
    assert main(["after", str(folders / "a"), str(folders / "b"), "-o", str(folders / "dive")]) == 1
    assert asked == ["dive-1", "dive-2"]
    assert f"{folders / 'dive' / 'dive-1'}: not solved: lights of nobody" in caplog.text


def test_a_report_that_cannot_be_written_is_a_failure_and_one_without_its_extra_is_not(tmp_path, monkeypatch):
    write_log(tmp_path / "solved.mcap", pose(0))
    one = after.Outing(0, 1, [tmp_path / "a.mcap"], {"a"})
    faults = {"full": BuddylineError("No space left on device"), "bare": MissingExtraError("needs matplotlib")}

    for fault, status in (("full", 1), ("bare", 0)):

        def run(words, fault=fault):
            if words[0] == "report":
                raise faults[fault]
            return 0

        monkeypatch.setattr(after, "run_command", run)
        assert after._solve(one, tmp_path) == status
