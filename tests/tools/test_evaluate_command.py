"""`buddyline evaluate` as a person calls it: logs in, table or JSON out, one line where it cannot."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.messages import Candidates, NodeInfo, NodePose, Truth
from buddyline.tools.cli import main
from buddyline.tools.evaluation.lights import Blobs, is_right_pair, true_lights
from buddyline.tools.evaluation.truth import TruthTrack, inverted
from msgspec.structs import replace

from tests.tools.evaluated import (
    FIRST,
    INFOS,
    PERIOD_NS,
    frame,
    info,
    light_truth,
    pose,
    rejection,
    track,
    truth,
    write_log,
)

DIVES = Path(__file__).parents[3] / "shared" / "data" / "dives"

SOLVED = (
    *INFOS.values(),
    *(frame(node, k) for k in range(4) for node in "ab"),
    *(pose(k) for k in range(3)),
    rejection(3),
)
TRUTHS = tuple(truth(k) for k in range(4))
LIGHTS = tuple(light_truth(node, k) for k in range(4) for node in "ab")


def evaluated(capsys, *words: object) -> dict:
    assert main(["evaluate", *map(str, words), "--json"]) == 0
    out = capsys.readouterr().out
    assert out.count("\n") == 1
    return json.loads(out, parse_constant=pytest.fail)


def refused(capsys, *words: object) -> str:
    assert main(["evaluate", *map(str, words)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


def test_figures_as_json(tmp_path, capsys):
    solved, beside = write_log(tmp_path / "o.mcap", *SOLVED), write_log(tmp_path / "t.mcap", *TRUTHS, *LIGHTS)
    figures = evaluated(capsys, solved, "--truth", beside)
    assert figures["poses"] == figures["accuracy"]["poses"] == 3
    assert figures["accuracy"]["translation_m"]["median"] == pytest.approx(0.0)
    assert figures["accuracy"]["azimuth_rad"] == {"count": 0, "median": None, "p95": None, "rmse": None, "mean": None}
    assert figures["pairing"]["right_share"] == 0.75
    assert figures["triggers"]["rejected"] == {"ambiguous": 1}
    assert figures["triggers"]["unanswered"] == 0
    assert figures["detection"]["both_first"] == {"3": 1.0, "5": 1.0, "8": 1.0, "all": 1.0}
    assert figures["bins"][0]["from_m"] == 2.0
    assert "errors" not in figures


def test_the_table_has_the_main_figures(tmp_path, capsys):
    solved = write_log(tmp_path / "o.mcap", *SOLVED, *TRUTHS, *LIGHTS)
    assert main(["evaluate", solved]) == 0
    text = capsys.readouterr().out
    for words in ("3 poses of 4 triggers", "1 ambiguous", "75.0 %", "position, m", "NEES", "recall within 2 px"):
        assert words in text
    assert "nan" not in text


def test_coverage_of_a_track_without_poses_is_of_the_triggers(tmp_path, capsys):
    """Both nodes took ten pictures; the track has the first half of that time."""
    frames = [frame(node, k) for k in range(10) for node in "ab"]
    tracks = [track(k, mode="smooth") for k in range(6)]
    outcomes = [rejection(k) for k in range(10)]
    truths = [truth(k) for k in range(10)]
    solved = write_log(tmp_path / "o.mcap", *INFOS.values(), *frames, *outcomes, *tracks, *truths)
    assert main(["evaluate", solved]) == 0
    assert "covers 66.7 % of the time from the first to the last trigger;" in capsys.readouterr().out
    (figures,) = evaluated(capsys, solved)["tracks"]
    assert figures["covered_from"] == "trigger"


def test_poses_in_ned_are_judged_by_true_ned_only(tmp_path, capsys):
    # A looks north, B is 3 m ahead: truly at (3, 0, 0).
    north = [
        NodePose(
            net="main",
            node="a",
            stamp_ns=(FIRST + k) * PERIOD_NS,
            p_m=(0.0, 0.0, 10.0),
            q_xyzw=(0.5, 0.5, 0.5, 0.5),
            v_mps=(0.0, 0.0, 0.0),
            covariance=[0.0] * 36,
            fixed=False,
            mode="truth",
            age_s=0.0,
        )
        for k in range(4)
    ]
    said = pose(
        0,
        t_ned_m=(3.1, 0.2, -0.1),
        sigma_ned_m=(0.05, 0.1, 0.1),
        azimuth_rad=2 * np.pi - 0.06,
        sigma_azimuth_rad=0.02,
        inclination_rad=0.03,
        sigma_inclination_rad=0.06,
    )
    solved = write_log(tmp_path / "o.mcap", *INFOS.values(), said, pose(1), *TRUTHS, *north)
    ned = evaluated(capsys, solved)["ned"]
    assert ned.pop("samples") == 1
    assert ned == pytest.approx({"north": 4.0, "east": 4.0, "down": 1.0, "azimuth": 9.0, "inclination": 0.25})
    assert main(["evaluate", solved]) == 0
    line = (
        "error over sigma against true NED, mean of squares (honest: 1): north 4.00, east 4.00, down 1.00, azimuth 9.00"
    )
    assert line in capsys.readouterr().out
    without = write_log(tmp_path / "w.mcap", *INFOS.values(), said, pose(1), *TRUTHS)
    assert evaluated(capsys, without)["ned"] is None


def test_candidates_and_truth_may_be_in_further_logs(tmp_path, capsys):
    poses = write_log(tmp_path / "o.mcap", *(m for m in SOLVED if not isinstance(m, NodeInfo | Candidates)))
    dives = [
        write_log(tmp_path / f"{node}.mcap", *(m for m in SOLVED if getattr(m, "node", "") == node)) for node in "ab"
    ]
    beside = write_log(tmp_path / "t.mcap", *TRUTHS)
    assert evaluated(capsys, poses, "--truth", beside)["pairing"] is None
    assert evaluated(capsys, poses, *dives, "--truth", beside)["pairing"]["right_share"] == 0.75


def test_truth_from_the_named_log_wins_and_may_be_inverted(tmp_path, capsys):
    solved = write_log(tmp_path / "o.mcap", *SOLVED, *(truth(k, (0.0, 0.0, 9.0)) for k in range(4)))
    beside = write_log(tmp_path / "t.mcap", *(inverted(each) for each in TRUTHS), pair="b/a")
    assert evaluated(capsys, solved)["accuracy"]["wrong"] == 3
    figures = evaluated(capsys, solved, "--truth", beside)
    assert figures["accuracy"]["wrong"] == 0
    assert figures["accuracy"]["rotation_rad"]["median"] == pytest.approx(0.0, abs=1e-9)


def test_poses_of_the_first_log_with_poses_are_used(tmp_path, capsys, caplog):
    solved = write_log(tmp_path / "o.mcap", *SOLVED, *TRUTHS)
    live = write_log(tmp_path / "live.mcap", *(pose(k, (0.0, 0.0, 5.0)) for k in range(4)))
    assert evaluated(capsys, solved, live)["accuracy"]["wrong"] == 0
    assert "live.mcap: its poses are left out" in caplog.text


def test_candidates_alone_are_measured(tmp_path, capsys):
    found = write_log(tmp_path / "c.mcap", *(frame(node, k) for k in range(4) for node in "ab"))
    figures = evaluated(capsys, found, "--truth", write_log(tmp_path / "t.mcap", *LIGHTS))
    assert figures["detection"]["recall_close"] == 1.0
    assert figures["pairing"]["right"] is None


def test_logs_that_cannot_be_evaluated_give_a_one_line_error(tmp_path, capsys):
    solved = write_log(tmp_path / "o.mcap", *SOLVED)
    assert "--truth" in refused(capsys, solved)
    assert "solve it first" in refused(capsys, write_log(tmp_path / "c.mcap", *INFOS.values(), frame("a", 0), *TRUTHS))
    assert "solve it first" in refused(capsys, write_log(tmp_path / "i.mcap", *INFOS.values()))
    later = write_log(tmp_path / "l.mcap", *(truth(k + 1000) for k in range(4)))
    assert f"is the truth in {later} of this dive" in refused(capsys, solved, "--truth", later)
    others = write_log(tmp_path / "x.mcap", *TRUTHS, pair="a/c")
    assert "no truth of pair a/b" in refused(capsys, solved, "--truth", others)
    (tmp_path / "empty.mcap").touch()
    assert "empty.mcap" in refused(capsys, tmp_path / "empty.mcap")
    assert "missing.mcap" in refused(capsys, solved, "--truth", tmp_path / "missing.mcap")


def test_the_truth_of_another_dive_is_told_with_the_figures(tmp_path, capsys, caplog):
    solved = write_log(tmp_path / "o.mcap", *INFOS.values(), *(pose(k) for k in range(12)))
    other = write_log(tmp_path / "t.mcap", *(truth(k, (0.5, 0.0, 3.0)) for k in range(12)))
    assert main(["evaluate", str(solved), "--truth", str(other), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["accuracy"]["wrong"] == 12
    assert f"{solved}: 12 of 12 poses or rows are wrong by the truth in {other}" in caplog.text
    own = write_log(tmp_path / "s.mcap", *(truth(k, (0.1, 0.0, 3.0)) for k in range(12)))
    caplog.clear()
    assert evaluated(capsys, solved, "--truth", own)["accuracy"]["wrong"] == 0
    assert not caplog.text


def test_poses_that_are_wrong_by_the_truth_of_their_own_log_are_measured(tmp_path, capsys):
    both = [each for k in range(12) for each in (pose(k), truth(k, (0.5, 0.0, 3.0)))]
    solved = write_log(tmp_path / "o.mcap", *INFOS.values(), *both)
    assert evaluated(capsys, solved)["accuracy"]["wrong"] == 12


def test_several_pairs_need_a_choice(tmp_path, capsys):
    other = pose(0, node_a="a", node_b="c")
    both = write_log(tmp_path / "o.mcap", *SOLVED, other, *TRUTHS)
    assert "--pair" in refused(capsys, both)
    assert evaluated(capsys, both, "--pair", "b/a")["poses"] == 3
    assert "a/b, a/c" in refused(capsys, both, "--pair", "a/d")
    assert "A/B" in refused(capsys, both, "--pair", "a-b")


def test_bad_messages_and_damage_are_reported_and_the_rest_is_evaluated(tmp_path, capsys):
    def damaged(path):
        assert main(["evaluate", str(path), "--json"]) == 1
        out, err = capsys.readouterr()
        assert json.loads(out)["poses"] == 3
        return err

    with DiveLogWriter(tmp_path / "o.mcap") as writer:
        for message in (*SOLVED, *TRUTHS):
            writer.write_message(message, key="buddyline/pair/a/b/truth" if isinstance(message, Truth) else None)
        writer.write("buddyline/pair/a/b/note", b"{}", FIRST)
        writer.flush()
        writer.write("buddyline/pair/a/b/pose", b'{"node_a": 7}', FIRST)
    assert "o.mcap: buddyline/pair/a/b/pose: 1 refused" in damaged(tmp_path / "o.mcap")
    whole = (tmp_path / "o.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) - 60])
    assert "cut.mcap: breaks off" in damaged(tmp_path / "cut.mcap")


def test_plots_are_written_and_never_overwritten(tmp_path, capsys):
    solved = write_log(tmp_path / "o.mcap", *SOLVED, pose(4, (0.0, 0.0, 5.0)), *TRUTHS, truth(4))
    assert main(["evaluate", solved, "--plots", str(tmp_path / "plots")]) == 0
    written = sorted((tmp_path / "plots").iterdir())
    assert [path.name for path in written] == [
        "errors_over_range.png",
        "errors_over_time.png",
        "normalized_error.png",
        "trajectory.png",
    ]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)
    capsys.readouterr()
    assert "not empty" in refused(capsys, solved, "--plots", tmp_path / "plots")
    assert "exists and is no folder" in refused(capsys, solved, "--plots", solved)


def test_plots_without_matplotlib_say_what_to_install(tmp_path, capsys, monkeypatch):
    solved = write_log(tmp_path / "o.mcap", *SOLVED, *TRUTHS)
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    assert "EXTRAS=plots" in refused(capsys, solved, "--plots", tmp_path / "plots")
    assert not (tmp_path / "plots").exists()


@pytest.mark.skipif(not DIVES.is_dir(), reason="the sample dives are not here")
def test_sample_dive_solved_by_its_own_truth(tmp_path, capsys):
    """Poses made of the truth and of the candidates nearest to the projected lights leave no error."""
    dive, beside = DIVES / "candidates_cavern.mcap", DIVES / "candidates_cavern.truth.mcap"
    frames, infos, truths = {}, {}, []
    for path in (dive, beside):
        with DiveLogReader(path) as reader:
            for record in reader.records(lambda key: key.endswith(("/info", "/candidates", "/truth"))):
                message = record.open().message
                if isinstance(message, Candidates):
                    frames[message.node, message.trigger] = message
                elif isinstance(message, NodeInfo):
                    infos[message.node] = message
                elif isinstance(message, Truth):
                    truths.append(message)
    lights = true_lights(("a", "b"), frames.values(), [], infos, TruthTrack(truths))
    blobs = {key: Blobs.of(each) for key, each in frames.items()}
    poses = []
    for true in truths:
        views = [("a", true.trigger), ("b", true.trigger)]
        if any(view not in frames for view in views):
            continue
        taken = [tuple(blobs[view].distances_px(lights[view]).argmin(axis=0).tolist()) for view in views]
        k = true.trigger - FIRST
        made = pose(k, true.t_a_b_m, q_a_b_xyzw=true.q_a_b_xyzw, blobs_a=taken[0], blobs_b=taken[1])
        poses.append(made)
    solved = write_log(tmp_path / "o.mcap", *poses)
    figures = evaluated(capsys, solved, dive, "--truth", beside)
    assert figures["accuracy"]["poses"] == len(poses) > 500
    assert figures["accuracy"]["translation_m"]["p95"] == pytest.approx(0.0, abs=1e-12)
    assert figures["pairing"]["right"] == figures["pairing"]["detected"]
    assert figures["pairing"]["detected"] == sum(
        is_right_pair(made, blobs, lights) is True and all(lights[node, made.trigger].visible.all() for node in "ab")
        for made in poses
    )
    assert figures["pairing"]["detected"] > 0.7 * figures["pairing"]["visible"]


@pytest.mark.skipif(not DIVES.is_dir(), reason="the sample dives are not here")
def test_projection_of_the_sample_dives_truth_lands_on_their_lights():
    for name in ("cavern", "basin"):
        infos, truths, marked = {}, [], []
        for path in (DIVES / f"{name}.mcap", DIVES / f"{name}.truth.mcap"):
            with DiveLogReader(path) as reader:
                for record in reader.records(lambda key: key.endswith(("/info", "truth"))):
                    message = record.open().message
                    if isinstance(message, NodeInfo):
                        infos[message.node] = message
                    else:
                        (truths if isinstance(message, Truth) else marked).append(message)
        track = TruthTrack(truths)
        empty = [
            Candidates(
                node=light.node,
                stamp_ns=light.stamp_ns,
                trigger=light.trigger,
                seq=0,
                boot="t",
                width_px=820,
                height_px=616,
                blobs=[],
            )
            for light in marked
        ]
        projected = true_lights(("a", "b"), empty, [], infos, track)
        away_px = []
        for light in marked:
            seen = projected[light.node, light.trigger]
            for side, one in enumerate(light.lights):
                away_px.append(float(np.hypot(*(seen.pixels[side] - (one.u_px, one.v_px)))))
        # The exposures jitter by milliseconds about the truth's instants; the swimmers move meanwhile.
        assert max(away_px) < 2.0


def test_other_rigs_are_projected_with_their_own_lights():
    assert info("a", light_left_m=(-0.3, 0.0, 0.0)).light_left_m[0] == -0.3
    narrow = {"a": info("a"), "b": info("b", light_left_m=(-0.22, 0.0, 0.0))}
    lights = true_lights(("a", "b"), [frame("a", 0), frame("b", 0)], [], narrow, TruthTrack([truth(0)]))
    assert lights["a", FIRST].pixels[0, 0] == pytest.approx(409.5 + 904.0 * 0.22 / 3.0)
    assert lights["b", FIRST].pixels[0, 0] == pytest.approx(409.5 + 904.0 * 0.44 / 3.0)


def test_a_truth_that_stands_in_two_logs_is_as_one():
    truths = [replace(truth(k), t_a_b_m=(0.1 * k**2, 0.0, 2.0)) for k in range(5)]
    between_ns = truths[2].stamp_ns + (truths[3].stamp_ns - truths[2].stamp_ns) // 2
    # The cubic through four samples; a straight line gives 0.65 m.
    t_m, _ = TruthTrack(truths).interpolated(between_ns)
    assert t_m[0] == pytest.approx(0.625, abs=1e-9)
    twice, _ = TruthTrack([*truths, *truths]).interpolated(between_ns)
    assert twice.tolist() == t_m.tolist()
