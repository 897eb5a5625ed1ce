"""From the nodes' folders to a solved dive and its report."""

import shutil
from pathlib import Path

import pytest
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.tools.after import logs_in, outings
from buddyline.tools.cli import main

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


def test_a_dive_s_folders_become_poses_track_and_report(folders, capsys):
    out = folders / "dive"
    assert main(["after", str(folders / "a"), str(folders / "b"), "-o", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == {
        "clocks.json",
        "solved.mcap",
        "track.tum",
        "track.csv",
        "report.html",
    }
    with DiveLogReader(out / "solved.mcap") as reader:
        assert {"buddyline/pair/a/b/pose", "buddyline/pair/a/b/track"} <= set(reader.keys)
    capsys.readouterr()
    assert main(["after", str(folders / "a"), "-o", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err


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
