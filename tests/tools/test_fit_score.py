"""The fit of the detector's score: what it finds, what it writes, and that the score it ships is a probability."""

import io
import tomllib

import cv2
import numpy as np
import pytest
from buddyline.node.detect.score import NAMES, fitted, probability
from buddyline.tools.cli import main
from buddyline.tools.progress import Progress
from buddyline.tools.tune import scenes, score
from buddyline.tools.tune.score import Sample


def test_the_fit_finds_the_weights_that_made_the_lamps():
    rng = np.random.default_rng(3)
    weights = np.array([-1.0, 2.0, -1.5])
    found = np.column_stack([np.ones(20000), rng.normal(size=(20000, 2))])
    lamp = rng.random(20000) < probability(found, weights)
    samples = [Sample("lake", found, lamp)]
    fitted_weights = score.fit(samples)
    assert fitted_weights == pytest.approx(weights, abs=0.1)
    assert score.calibration_error(samples, fitted_weights) < 0.02
    assert score.calibration_error(samples, fitted_weights + np.array([2.0, 0.0, 0.0])) > 0.1


@pytest.mark.slow
def test_the_shipped_score_is_a_probability_in_fresh_waters():
    samples = list(score.simulated((3001, 3002), Progress("test", 1, io.StringIO())))
    assert score.calibration_error(samples, fitted()) < 0.1
    waters = {sample.source for sample in samples}
    assert len(waters) == 5
    likely = [probability(sample.found, fitted()) >= 0.5 for sample in samples]
    lamps = [sample.lamp for sample in samples]
    assert np.concatenate(likely)[np.concatenate(lamps)].mean() > 0.6
    assert sum((a & ~b).sum() for a, b in zip(likely, lamps, strict=True)) < 0.6 * len(samples)


def test_the_command_writes_weights_with_their_provenance(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(scenes, "SEEDS", range(1, 2))
    monkeypatch.setattr(scenes, "HELD_OUT", range(2, 3))
    monkeypatch.setattr(scenes, "VIEWS", 2)
    monkeypatch.setattr(scenes, "SIZES", ((410, 308),))
    picture = np.random.default_rng(1).integers(0, 255, (40, 60), np.uint8)
    cv2.imwrite(str(tmp_path / "stones.png"), cv2.resize(picture, None, fx=4, fy=4))
    assert main(["tune", "--fit", str(tmp_path), "--note", 'stones, "dry"']) == 0
    said = tomllib.loads(capsys.readouterr().out)
    assert list(said["weights"]) == list(NAMES)
    assert said["provenance"]["real_pictures_without_lamps"] == [str(tmp_path)]
    assert said["provenance"]["note"] == 'stones, "dry"'
    assert said["provenance"]["pictures"]["real"] >= 1
    assert set(said["calibration_error"]) == {"basin", "cavern", "day_reef", "lake", "night_reef"}
