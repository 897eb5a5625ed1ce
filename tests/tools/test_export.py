"""`buddyline export`: every digit of the log, for other programs."""

from __future__ import annotations

import csv
import io
import math

import numpy as np
import pytest
from buddyline.tools.cli import main
from msgspec.structs import replace

from tests.tools.evaluated import COVARIANCE, FIRST, PERIOD_NS, pose, rejection, track, truth, write_log

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
    assert [float(rows[1][f"truth_t_a_b_{axis}_m"]) for axis in "xyz"] == [0.0, 0.0, 3.0]
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


def test_nothing_to_export_gives_a_one_line_error(tmp_path, solved, capsys):
    bare = write_log(tmp_path / "t.mcap", truth(0))
    assert "solve it first" in refused(capsys, bare, "--format", "csv")
    assert "no truth" in refused(capsys, write_log(tmp_path / "p.mcap", pose(0)), "--format", "tum", "--truth")
    assert "--truth" in refused(capsys, solved, "--format", "csv", "--truth")
    assert "--rejected" in refused(capsys, solved, "--format", "tum", "--rejected")
    assert exported(capsys, bare, "--format", "tum", "--truth").count("\n") == 1


@pytest.fixture
def tracked(tmp_path):
    rng = np.random.default_rng(1)
    mixed = rng.standard_normal((6, 6))
    ned = {
        "t_ned_m": (1 / 3, 2.0, -3.0),
        "sigma_ned_m": (0.011, 0.012, 0.013),
        "azimuth_rad": 1.4,
        "sigma_azimuth_rad": 0.07,
        "inclination_rad": 0.98,
        "sigma_inclination_rad": 0.015,
    }
    moving = {"v_a_b_mps": (0.1, -0.2, 0.3), "v_covariance": np.diag([1e-4, 4e-4, 9e-4]).ravel().tolist()}
    rows = [
        track(
            k,
            tuple((3 * rng.standard_normal(3)).tolist()),
            covariance=(mixed @ mixed.T).ravel().tolist(),
            mode="smooth",
            age_s=0.02,
            **moving,
            **ned,
        )
        for k in (2, 0, 1)
    ]
    late, live = track(3, mode="lag"), track(4, mode="filter")
    return rows, write_log(tmp_path / "t.mcap", pose(0), pose(1, **ned), rejection(2), truth(0), *rows, late, live)


def test_csv_of_a_track_equals_the_log(tracked, capsys):
    rows, log = tracked
    assert main(["export", log, "--format", "csv"]) == 0
    captured = capsys.readouterr()
    assert captured.err.splitlines() == [f"{log}: the track (smooth), 3 rows; `export --what poses` gives the poses"]
    found = list(csv.DictReader(io.StringIO(captured.out)))
    axes = ("x", "y", "z", "wx", "wy", "wz")
    for row, one in zip(found, sorted(rows, key=lambda one: one.stamp_ns), strict=True):
        assert int(row["stamp_ns"]) == one.stamp_ns
        assert (row["mode"], row["lights"], float(row["age_s"])) == ("smooth", "4", 0.02)

        def read(*names, row=row):
            return [float(row[name]) for name in names]

        assert read("t_a_b_x_m", "t_a_b_y_m", "t_a_b_z_m") == list(one.t_a_b_m)
        assert read("q_a_b_x", "q_a_b_y", "q_a_b_z", "q_a_b_w") == list(one.q_a_b_xyzw)
        assert read("v_a_b_x_mps", "v_a_b_y_mps", "v_a_b_z_mps") == list(one.v_a_b_mps)
        assert read("t_ned_north_m", "t_ned_east_m", "t_ned_down_m") == list(one.t_ned_m)
        assert read("sd_ned_north_m", "sd_ned_east_m", "sd_ned_down_m") == list(one.sigma_ned_m)
        assert read("azimuth_rad", "sd_azimuth_rad", "inclination_rad", "sd_inclination_rad") == [
            1.4,
            0.07,
            0.98,
            0.015,
        ]
        upper = [(i, k) for i in range(6) for k in range(i, 6)]
        assert read(*(f"cov_{axes[i]}_{axes[k]}" for i, k in upper)) == [one.covariance[6 * i + k] for i, k in upper]
        assert read("cov_vx_vx", "cov_vx_vy", "cov_vz_vz") == [1e-4, 0.0, 9e-4]
        assert read("range_m") == [one.range_m]
        # The log has one truth, at the first sample's time.
        of_truth = [row[f"truth_t_a_b_{axis}_m"] for axis in "xyz"] + [row[f"truth_q_a_b_{axis}"] for axis in "xyzw"]
        known = [0.0, 0.0, 3.0, 0.0, 1.0, 0.0, 0.0] if one.stamp_ns == FIRST * PERIOD_NS else [""] * 7
        assert [text and float(text) for text in of_truth] == known


def test_tum_has_the_track_unless_poses_are_asked_for(tracked, capsys):
    rows, log = tracked
    lines = exported(capsys, log, "--format", "tum").splitlines()
    first = min(rows, key=lambda one: one.stamp_ns)
    assert len(lines) == 3
    assert [float(word) for word in lines[0].split()[1:]] == [*first.t_a_b_m, *first.q_a_b_xyzw]
    assert len(exported(capsys, log, "--format", "tum", "--what", "poses").splitlines()) == 2
    rejected = list(csv.DictReader(io.StringIO(exported(capsys, log, "--format", "csv", "--rejected"))))
    assert [row["reason"] for row in rejected] == ["", "", "ambiguous"]
    assert main(["export", log, "--format", "csv", "--rejected", "-o", f"{log}.csv"]) == 0
    assert "the poses, 2 rows, and 1 rows of triggers without one" in capsys.readouterr().err
    assert exported(capsys, log, "--format", "tum", "-o", "-").splitlines() == lines
    assert main(["export", log, "--format", "tum", "--pair", "b/a", "-o", f"{log}.tum"]) == 0
    assert (
        "3 rows; `export --what poses` gives the poses; the log has a/b: it is b in a's frame"
        in capsys.readouterr().err
    )
    assert [rejected[1][name] for name in ("sd_azimuth_rad", "sd_ned_down_m")] == ["0.07", "0.013"]
    assert rejected[0]["sd_azimuth_rad"] == ""


def test_a_track_that_is_asked_for_must_be_there(solved, tracked, tmp_path, capsys):
    assert "no track in it" in refused(capsys, solved, "--format", "tum", "--what", "track")
    assert "--what track: not with --rejected" in refused(
        capsys, tracked[1], "--format", "csv", "--what", "track", "--rejected"
    )
    alone = write_log(tmp_path / "alone.mcap", track(0, mode="filter"), track(1, mode="lag"), track(2, mode="lag"))
    # Of a recorded live dive the better one.
    assert exported(capsys, alone, "--format", "tum").count("\n") == 2
