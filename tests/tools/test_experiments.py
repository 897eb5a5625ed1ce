"""The experiments: what a quick run writes, and the figures that it is made of."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from buddyline.protocol.messages import RelativePose
from buddyline.tools.bound import pose_bounds
from buddyline.tools.cli import main
from buddyline.tools.evaluation.poses import pose_errors
from buddyline.tools.evaluation.truth import TruthTrack
from buddyline.tools.experiments import numbers

from tests.tools.evaluated import INFOS, pose, truth


def _errors(offsets_m, range_m=3.0):
    """Return the errors of poses straight ahead, each too far by its offset."""
    truths = [truth(k, (0.0, 0.0, range_m)) for k in range(len(offsets_m))]
    poses: list[RelativePose] = [pose(k, (0.0, 0.0, range_m + off)) for k, off in enumerate(offsets_m)]
    track = TruthTrack(truths)
    return pose_errors(poses, track, lambda _: None, None), track


def test_errors_go_into_their_range_bin():
    errors, _ = _errors([0.01, -0.02, 0.03])
    (row,) = numbers.by_range(errors)
    assert (row["from_m"], row["to_m"], row["poses"]) == (3.0, 4.0, 3)
    assert row["position_median_m"] == pytest.approx(0.02, abs=1e-9)
    assert row["range_rmse_m"] == pytest.approx(np.sqrt(14e-4 / 3), rel=1e-6)


def test_near_poses_are_compared_with_the_papers_8_cm():
    errors, _ = _errors([0.01, 0.07, -0.09, 0.5])
    assert numbers.near_share(errors) == 0.5
    assert numbers.near_share(_errors([0.01], range_m=6.0)[0]) is None


def test_rms_is_compared_with_rms_and_median_with_median():
    errors, track = _errors([0.0])
    bound = numbers.bounds(errors, track, INFOS, 0.5)
    (covariance,) = pose_bounds(np.array([[0.0, 0.0, 3.0]]), np.array([[0.0, 1.0, 0.0, 0.0]]), *INFOS.values(), 0.5)
    np.testing.assert_allclose(bound[0], covariance[:3, :3])
    # Errors along the line of sight alone, as large as the bound of all three axes.
    size_m = float(np.sqrt(np.trace(bound[0])))
    errors, track = _errors([size_m, -size_m] * 100)
    (row,) = numbers.over_bound(errors, numbers.bounds(errors, track, INFOS, 0.5))
    assert (row["from_m"], row["poses"]) == (3.0, 200)
    assert row["rms_ratio"] == pytest.approx(1.0, rel=1e-6)
    assert row["bound_rms_m"] == pytest.approx(size_m)
    # Gaussian errors have a smaller median than RMS: one axis is by far the largest here.
    assert 0.6745 * size_m < row["bound_median_m"] < 0.9 * size_m
    assert row["median_ratio"] == pytest.approx(size_m / row["bound_median_m"])


def test_errors_at_the_bound_have_ratios_of_1_within_their_sigma():
    rng = np.random.default_rng(3)
    errors, track = _errors([0.0] * 400)
    bound = numbers.bounds(errors, track, INFOS, 0.5)
    drawn = rng.standard_normal((400, 3)) @ np.linalg.cholesky(bound[0]).T
    errors = replace(errors, translation_m=np.linalg.norm(drawn, axis=1))
    (row,) = numbers.over_bound(errors, bound)
    assert 0.02 < row["rms_sd"] < 0.04
    assert abs(row["rms_ratio"] - 1.0) < 3 * row["rms_sd"]
    assert row["median_ratio"] == pytest.approx(1.0, abs=0.12)


def test_a_method_ends_where_half_of_the_triggers_give_no_pose():
    errors, _ = _errors([0.0, 0.0])
    triggers = errors.trigger.tolist()
    ranges_m = np.array([3.0, 3.5, 5.2, 5.4, 5.6])
    ends = numbers.reach(ranges_m, [*triggers, -1, -2, -3], errors)
    assert ends["ends_m"] == 4.0
    assert [row["share"] for row in ends["bins"]] == [1.0, 0.0]
    assert ends["farthest_m"] == 3.0


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_quick_run_writes_a_report_that_needs_nothing_else(tmp_path, capsys):
    folder = tmp_path / "report"
    assert main(["experiments", "-o", str(folder), "--quick"]) == 0
    found = json.loads((folder / "experiments.json").read_text())
    assert set(found["environments"]) == {"cavern", "night_reef", "lake", "basin"}
    assert found["right_pairs"]["ours"]["all"]["right_share"] > 0.6
    assert found["right_pairs"]["ours"]["all"]["wrong"] == 0
    assert found["near"]["ours"] == 1.0
    assert all(0.5 < row["rms_ratio"] < 1.6 for row in found["bound"])
    assert found["time"]["eq1_ms"] < found["time"]["trigger"]["median_ms"]
    four, basin = found["networks"].values()
    assert [[node["node"] for node in net] for net in (four, basin)] == [["a", "b", "c", "d"], ["a", "b", "c"]]
    assert sum(node["wrong"] for node in [*four, *basin]) == 0
    assert all(node["position_m"]["median"] < 0.01 for node in basin)
    html = (folder / "report.html").read_text()
    assert "a basin at 20 Hz" in html
    assert html.count("data:image/png;base64,") >= 7
    assert not re.search(r'(src|href)="(?!data:)', html)
    assert (folder / "headline.md").read_text().count("\n") >= 8
    assert main(["experiments", "-o", str(folder), "--quick"]) == 2
    assert "cannot be made" in capsys.readouterr().err
