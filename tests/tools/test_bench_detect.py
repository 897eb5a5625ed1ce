"""The detector's benchmarks run and print what they claim to measure."""

import json

import pytest
from buddyline.tools.bench import detect
from buddyline.tools.bench.__main__ import main


@pytest.fixture(autouse=True)
def one_round(monkeypatch):
    monkeypatch.setattr(detect, "ROUNDS", 1)
    monkeypatch.setattr(detect, "ENVIRONMENTS", ("cavern",))
    monkeypatch.setattr(detect, "find_spec", lambda name: None)


def test_times_are_compared_with_other_finders(capsys):
    assert main(["detect", "--pictures", "2", "--width", "205", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["source"] == "cavern"
    assert row["ms"]["source"] > 0
    assert row["ratio"]["cv2.aruco 36h11"] == pytest.approx(row["ms"]["source"] / row["ms"]["cv2.aruco 36h11"])
    assert row["ms"]["source, guided"] > 0
    assert 0 <= row["guided_share"] <= 1
    assert row["ms"]["pupil-apriltags"] is None
    table = detect.table([row])
    assert "SimpleBlob" in table
    assert "pupil-apriltags: not installed" in table


def test_memory_after_a_tenth_and_after_all_pictures(capsys):
    assert main(["detect", "--frames", "20", "--pictures", "2", "--width", "205", "--json"]) == 0
    resident_kib = json.loads(capsys.readouterr().out)
    assert list(resident_kib) == ["2", "20"]
    assert resident_kib["20"] - resident_kib["2"] < 20_000


def test_lamps_that_the_exposure_keeps_small_are_searched_in_regions(capsys):
    assert main(["detect", "--pictures", "2", "--width", "820", "--lamps", "--json"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["guided_share"] > 0


@pytest.mark.parametrize("words", [["detect", "--pictures", "0"], ["detect", "--frames", "1"]])
def test_bad_arguments_give_a_one_line_error(words, capsys):
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("bench: ")
    assert error.count("\n") == 1


def test_the_count_of_instructions_is_read_from_valgrind(tmp_path, monkeypatch, capsys):
    script = tmp_path / "valgrind"
    script.write_text("#!/bin/sh\necho 4\necho '==7== Collected : 48000000' >&2\n")
    script.chmod(0o755)
    (tmp_path / "callgrind_control").write_text("")
    (tmp_path / "callgrind_control").chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:/bin:/usr/bin")
    words = ["instructions", "--environment", "cavern", "--pictures", "1", "--width", "205", "--json"]
    assert main(words) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row["whole"] == row["guided"] == 12.0
    assert row["pi3_whole_ms"] == pytest.approx(20.0)


def test_without_valgrind_it_says_what_is_missing(monkeypatch, capsys):
    monkeypatch.setenv("PATH", "")
    assert main(["instructions"]) == 2
    assert "valgrind: is not installed" in capsys.readouterr().err
