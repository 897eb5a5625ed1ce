"""The sample dive: what the tutorial does with it works, and gives what it says."""

from __future__ import annotations

import re

import buddyline
import pytest
from buddyline.tools.cli import main

from tests.processes import REPOSITORY


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_sample_is_solved_reported_and_right(here, capsys):
    assert main(["sample"]) == 0
    assert "buddyline solve sample.mcap" in capsys.readouterr().out
    assert main(["solve", "sample.mcap", "-o", "poses.mcap"]) == 0
    assert main(["report", "poses.mcap", "-o", "report.html"]) == 0
    assert "<svg" in (here / "report.html").read_text()
    assert main(["evaluate", "poses.mcap"]) == 0
    told = capsys.readouterr().out
    assert "wrong poses (position off by more than 10% of the range): 0 of" in told
    assert "track (smooth): covers 100.0 %" in told
    dive = buddyline.open_dive("sample.mcap")
    period_ns = dive.infos["a"].trigger_period_ns
    pictured = [{round(stamp_ns / period_ns) for stamp_ns, _ in dive.pictures(node)} for node in "ab"]
    assert len(pictured[0] & pictured[1]) > 10
    assert len(dive.depths("a")) > 100


def test_its_figures_are_the_tutorial_s_and_its_sigmas_those_of_today_s_detector(here, capsys):
    assert main(["sample"]) == 0
    assert main(["solve", "sample.mcap", "-o", "poses.mcap"]) == 0
    tutorial = (REPOSITORY / "docs" / "tutorial.md").read_text()
    poses, triggers = re.search(r"gave a pose, (\d+) of (\d+), and why", tutorial).groups()
    assert f"{poses} poses of {triggers} triggers" in capsys.readouterr().out
    assert main(["evaluate", "poses.mcap"]) == 0
    told = capsys.readouterr().out
    assert f'"wrong poses ... 0 of {poses}"' in tutorial
    assert f"of the range): 0 of {poses}," in told
    median_m = re.search(r"off by ([\d.]+) m in the\s+median", tutorial)[1]
    assert re.search(rf"^position, m +{poses} +{median_m} ", told, re.MULTILINE)
    nees = re.search(r"^NEES, pose .* ([\d.]+)$", told, re.MULTILINE)[1]
    assert f"here its mean is {float(nees):.1f} where" in tutorial
    assert float(nees) < 9.0
    # The candidates are stored with their sigmas: after a new fit of these the sample is to be made again.
    sigmas = re.search(r"^error over sigma, per axis, .* ([\d.]+)$", told, re.MULTILINE)[1]
    assert 0.8 < float(sigmas) < 1.25


def test_a_file_is_never_overwritten(here, capsys):
    (here / "sample.mcap").write_text("mine")
    for words in (["sample"], ["sample", "-o", "sample.mcap"]):
        assert main(words) == 2
        assert "exists" in capsys.readouterr().err
    assert (here / "sample.mcap").read_text() == "mine"


def test_it_is_written_where_it_is_wanted(here, capsys):
    assert main(["sample", "-o", "dive.mcap"]) == 0
    assert "buddyline solve dive.mcap" in capsys.readouterr().out
    assert main(["sample", "-o", "Höhle 1.mcap"]) == 0
    assert "buddyline solve 'Höhle 1.mcap' -o" in capsys.readouterr().out
    assert {path.name for path in here.iterdir()} == {"dive.mcap", "Höhle 1.mcap"}
