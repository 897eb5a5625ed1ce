"""`buddyline export`: every digit of the log, for other programs."""

from __future__ import annotations

import csv
import io
import math

import numpy as np
import pytest
from buddyline.tools.cli import main
from msgspec.structs import replace

from tests.tools.evaluated import COVARIANCE, FIRST, PERIOD_NS, pose, rejection, truth, write_log

STAMP_NS = 1_764_000_000_123_456_789


def exported(capsys, *words: object) -> str:
    assert main(["export", *map(str, words)]) == 0
    return capsys.readouterr().out


def refused(capsys, *words: object) -> str:
    assert main(["export", *map(str, words)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    return captured.err


@pytest.fixture
def solved(tmp_path):
    t_m = (0.1, -0.2, 1 / 3)
    ned = pose(1, t_ned_m=(1.0, 2.0, -3.0), azimuth_rad=0.5, inclination_rad=-0.25)
    # Out of order in the log, as the solver's results may be.
    return write_log(
        tmp_path / "o.mcap", ned, rejection(2), replace(pose(0, t_m), stamp_ns=STAMP_NS - 10**15), truth(0), truth(1)
    )


def test_tum_has_eight_columns_every_nanosecond_and_every_digit(solved, capsys):
    lines = exported(capsys, solved, "--format", "tum").splitlines()
    assert [line.split()[0] for line in lines] == ["1763000000.123456789", "1764000000.100000000"]
    first = np.array(lines[0].split()[1:], dtype=float)
    assert first.tolist() == [0.1, -0.2, 1 / 3, 0.0, 1.0, 0.0, 0.0]


def test_tum_of_the_truth(solved, capsys):
    lines = exported(capsys, solved, "--format", "tum", "--truth").splitlines()
    assert lines[0] == "1764000000.000000000 0.0 0.0 3.0 0.0 1.0 0.0 0.0"
    assert len(lines) == 2


def test_csv_names_units_and_leaves_unknowns_empty(solved, capsys):
    rows = list(csv.DictReader(io.StringIO(exported(capsys, solved, "--format", "csv"))))
    assert [int(row["stamp_ns"]) for row in rows] == [STAMP_NS - 10**15, (FIRST + 1) * PERIOD_NS]
    assert float(rows[0]["t_a_b_z_m"]) == 1 / 3
    assert rows[0]["azimuth_rad"] == rows[0]["t_ned_north_m"] == ""
    assert [float(rows[1][name]) for name in ("azimuth_rad", "inclination_rad", "t_ned_down_m")] == [0.5, -0.25, -3.0]
    deviations = [float(rows[0][f"sd_{name}"]) for name in ("x_m", "y_m", "z_m", "wx_rad", "wy_rad", "wz_rad")]
    assert deviations == pytest.approx([math.sqrt(v) for v in np.diag(COVARIANCE)])
    assert (rows[0]["checks"], rows[0]["method"], rows[0]["trigger"]) == ("range twist", "refined", str(FIRST))
    assert None not in rows[0]
    assert "reason" not in rows[0]


def test_csv_with_rejections(solved, capsys):
    rows = list(csv.DictReader(io.StringIO(exported(capsys, solved, "--format", "csv", "--rejected"))))
    assert [row["reason"] for row in rows] == ["", "", "ambiguous"]
    assert rows[2]["detail"] == "two, alike"
    assert rows[2]["range_m"] == ""


def test_output_file_is_written_once(solved, tmp_path, capsys):
    out = tmp_path / "poses.tum"
    assert exported(capsys, solved, "--format", "tum", "-o", out) == ""
    written = out.read_bytes()
    assert written.count(b"\n") == 2
    assert "exists" in refused(capsys, solved, "--format", "tum", "-o", out)
    assert out.read_bytes() == written
    assert "cannot be written" in refused(capsys, solved, "--format", "tum", "-o", tmp_path / "none" / "poses.tum")


def test_nothing_to_export_is_one_line(tmp_path, solved, capsys):
    bare = write_log(tmp_path / "t.mcap", truth(0))
    assert "solve it first" in refused(capsys, bare, "--format", "csv")
    assert "no truth" in refused(capsys, write_log(tmp_path / "p.mcap", pose(0)), "--format", "tum", "--truth")
    assert "--truth" in refused(capsys, solved, "--format", "csv", "--truth")
    assert "--rejected" in refused(capsys, solved, "--format", "tum", "--rejected")
    assert exported(capsys, bare, "--format", "tum", "--truth").count("\n") == 1
