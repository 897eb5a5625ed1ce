"""A dive's report: its numbers by an independent script, what it says of the dive, outliers, paper."""

from __future__ import annotations

import re
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from buddyline.protocol.messages import Candidates, Message, NodeInfo, SolverStatus
from buddyline.tools.cli import main
from buddyline.tools.dives import Dive
from buddyline.tools.monitor.summary import summarize
from msgspec import UNSET
from msgspec.structs import replace

from tests.solver_service.conftest import dive_messages
from tests.tools import recompute_report
from tests.tools.evaluated import INFOS, frame, pose, rejection, track, truth, write_log
from tests.tools.recompute_report import differences, numbers_in, recompute
from tests.tools.watched import at, attitude, image, solver_status, tick

ABOUT = """
title = "Sump 2 <second dive>"
site = "Cueva del Agua"
people = ["Ana", "Bo"]
instrument = "rig 3"
text = "Visibility 8 m."
"""
OUTLIER = 57


def said() -> list[Message]:
    """A dive of 20 s with a stretch without poses, track, truth, sensors, pictures, and one pose far off the track."""
    rng = np.random.default_rng(5)
    messages: list[Message] = list(INFOS.values())
    for k in range(200):
        messages += [one for one in tick(k) if type(one).__name__ not in ("RelativePose", "SolverStatus")]
        true_m = np.array((0.002 * k, 0.1 * np.sin(k / 20), 3.0 + 0.01 * k))
        x, y, z = (true_m + rng.normal(0.0, 0.005, 3)).tolist()
        if 80 <= k < 100:
            messages.append(rejection(k, "ambiguous" if k % 3 else "depth"))
        else:
            off_m = 0.2 if k == OUTLIER else 0.0
            one = pose(k, (x + off_m, y, z), method="refined" if k % 2 else "closed_form")
            ned = (z, x, y)
            messages.append(replace(one, t_ned_m=ned, sigma_ned_m=(0.05, 0.1, 0.02), checks=["range", "depth"]))
        placed = (true_m + rng.normal(0.0, 0.002, 3)).tolist()
        age_s = max(0.0, (k - 80) / 10) if k < 100 else 0.0
        messages += [
            track(
                k, tuple(placed), 0.3 if 90 <= k < 97 else 0.01, age_s=age_s, v_a_b_mps=(0.02, 0.05, 0.1), mode="smooth"
            )
        ]
        messages.append(truth(k, tuple(true_m.tolist())))
    return [*messages, image("a", at(OUTLIER)), replace(solver_status(at(199)), clock_skew_s=-0.004)]


@pytest.fixture(scope="module")
def dive(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    folder = tmp_path_factory.mktemp("report")
    log, report = write_log(folder / "dive.mcap", *said()), folder / "report.html"
    (folder / "about.toml").write_text(ABOUT)
    assert main(["report", log, "--about", str(folder / "about.toml"), "-o", str(report)]) == 0
    return log, report.read_text("utf-8")


def test_every_number_follows_from_the_log_by_an_independent_script(dive: tuple[str, str], tmp_path: Path) -> None:
    log, page = dive
    told = numbers_in(page)
    assert told.pop("about")["people"] == ["Ana", "Bo"]
    assert list(differences(told, recompute(log))) == []
    # Nothing that the script compares is empty here.
    assert told["track"]["covered"] < 1.0
    assert told["triggers"]["without_pose"][0]["seconds"] == pytest.approx(2.1)
    assert told["against_truth"]["track"]["position_without_light"]["count"] > 0
    assert told["error_budget"] == {
        "optics_m": pytest.approx(np.sqrt(6e-4)),
        "compass_m": pytest.approx(np.sqrt(0.0129 - 6e-4)),
        "depth_m": pytest.approx(0.02 * np.sqrt(2)),
        "clock_offset_s": -0.004,
        "clock_m": pytest.approx(0.004 * np.sqrt(0.0129)),
    }
    report = tmp_path / "report.html"
    report.write_text(page.replace('"range_most_m": ', '"range_most_m": 1'))
    assert recompute_report.main(log, str(report)) == 1


def test_a_message_that_several_recordings_have_counts_once(tmp_path: Path) -> None:
    messages = [attitude("a", at(k)) for k in range(40)]
    first = write_log(tmp_path / "first.mcap", *messages[:30])
    second = write_log(tmp_path / "second.mcap", *messages[10:])
    with Dive([first, second]) as dive:
        assert summarize(dive, None).counts == {"buddyline/node/a/attitude": 40}


def test_triggers_whose_outcome_nobody_recorded_are_counted_and_told(tmp_path: Path) -> None:
    """The nodes' own logs have ten triggers, the recording the outcomes of seven of them, and of one more."""
    logs = [write_log(tmp_path / f"{node}.mcap", INFOS[node], *(frame(node, k) for k in range(10))) for node in "ab"]
    outcomes = [*(pose(k) for k in range(3, 9)), rejection(9), rejection(12, "late")]
    recording = write_log(tmp_path / "recorded.mcap", *INFOS.values(), *outcomes)
    report = tmp_path / "report.html"
    assert main(["report", *logs, recording, "-o", str(report)]) == 0
    page = report.read_text("utf-8")
    triggers = numbers_in(page)["triggers"]
    assert (triggers["total"], triggers["with_pose"], triggers["without_outcome"]) == (11, 6, 3)
    assert "3 triggers of the nodes' frames have no recorded outcome" in unescape(page)
    assert "<td>without a recorded outcome</td><td>3</td>" in page.replace("\n", "")
    # The recording alone does not know of them.
    assert main(["report", recording, "-o", str(tmp_path / "alone.html")]) == 0
    alone = (tmp_path / "alone.html").read_text("utf-8")
    assert numbers_in(alone)["triggers"]["without_outcome"] is None
    assert "recorded outcome" not in alone


def test_it_finds_a_number_that_differs() -> None:
    assert list(differences({"a": [1.0, 2.0]}, {"a": [1.0, 2.1]})) == [".a[1]: 2.0 in the report, 2.1 by the log"]
    assert list(differences({"a": 1}, {"b": 1})) == [".a: only in the report", ".b: only in the log"]


def test_site_people_and_instrument_are_on_it(dive: tuple[str, str]) -> None:
    page = dive[1]
    for text in ("<h1>Sump 2 &lt;second dive&gt;</h1>", "Cueva del Agua", "Ana, Bo", "rig 3", "<p>Visibility 8 m.</p>"):
        assert text in page


def test_a_report_of_a_dive_that_is_not_solved_says_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    raw, solved = write_log(tmp_path / "raw.mcap", *INFOS.values()), write_log(tmp_path / "solved.mcap", pose(0))
    for log, warned in ((raw, True), (solved, False)):
        caplog.clear()
        assert main(["report", str(log), "-o", f"{log}.html"]) == 0
        assert ("no poses in it, so that the report has none; solve it first" in caplog.text) == warned


def test_an_unknown_line_of_what_it_says_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "about.toml").write_text('sight = "8 m"\n')
    log = write_log(tmp_path / "dive.mcap", *INFOS.values(), pose(0))
    words = ["report", log, "--about", str(tmp_path / "about.toml"), "-o", str(tmp_path / "r.html")]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "sight" in error


def test_the_methods_have_this_dive_s_figures(dive: tuple[str, str]) -> None:
    (text,) = re.findall(r"<h2>Methods</h2><p>(.*?)</p>", dive[1])
    stated = f"a noise of {numbers_in(dive[1])['poses']['light_sigma_median_px']:.2g} px"
    for part in (
        "180 (90.0%)",
        "10 a second",
        "0.880 m",
        stated,
        "range, depth",
        "smoothed over the whole dive",
        "magnetic",
    ):
        assert part in text, part


def test_an_outlier_is_listed_with_its_pictures(dive: tuple[str, str]) -> None:
    page = dive[1]
    told: dict[str, Any] = numbers_in(page)["outliers"]
    assert (told["judged"], told["found"], told["listed"][0]["trigger"]) == (180, 1, pose(OUTLIER).trigger)
    section = page.split("<h2>Outliers")[1].split("<h2>")[0]
    assert "Of the 180 poses with a track at the same time, 1 is further from it" in section
    assert section.count("<svg") == 2
    # The picture of a was recorded; of b there are the candidates alone.
    assert section.count("<image ") == 1
    assert section.count("<circle ") == 6


def test_without_a_track_no_outlier_is_judged(tmp_path: Path) -> None:
    log = write_log(tmp_path / "dive.mcap", *INFOS.values(), *(pose(k) for k in range(5)), attitude("a", at(0)))
    assert main(["report", log, "-o", str(tmp_path / "r.html")]) == 0
    page = (tmp_path / "r.html").read_text("utf-8")
    assert numbers_in(page)["outliers"] is None
    assert "Not judged: the log holds no track" in page


def test_a_missing_track_and_the_solver_s_problems_are_named(tmp_path: Path) -> None:
    """Without attitudes and inertial samples of a the poses start no track."""
    messages = [one for one in dive_messages(seconds=3.0)[0] if isinstance(one, Candidates | NodeInfo)]
    log, output = write_log(tmp_path / "raw.mcap", *messages), str(tmp_path / "solved.mcap")
    assert main(["solve", log, "-o", output]) == 0
    assert main(["report", output, "-o", str(tmp_path / "r.html")]) == 0
    page = unescape((tmp_path / "r.html").read_text("utf-8"))
    assert numbers_in(page)["poses"]
    assert "this log holds no track of this pair" in page
    assert re.search(r"the solver's last status: .*no track: node a told neither attitudes nor inertial samples", page)


def test_a_solved_dive_has_its_status_for_the_report(tmp_path: Path) -> None:
    messages: list[Message] = list(INFOS.values())
    messages += [one for k in range(40) for one in tick(k) if type(one).__name__ in ("Candidates", "Depth")]
    log, output = write_log(tmp_path / "raw.mcap", *messages), str(tmp_path / "solved.mcap")
    assert main(["solve", log, "-o", output, "--track", "none", "--checks", "range,twist"]) == 0
    with Dive([output]) as opened:
        (status,) = [one.message for one in opened.messages("solver_status")]
    assert isinstance(status, SolverStatus)
    assert (status.solved + sum(status.rejected.values()), status.matched) == (40, 40)
    assert status.advice is UNSET
