"""Tracks of rendered pictures: real detection, whose errors last, beside inertial units."""

import json
from pathlib import Path
from typing import Any

import pytest
from buddyline.tools.cli import main


def evaluated(capsys: pytest.CaptureFixture[str], *words: object) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["evaluate", *map(str, words), "--json"]) == 0
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "most"), [("smooth", 2.0), ("filter", 1.2)])
@pytest.mark.parametrize(("water", "seed", "inertial"), [("basin", 9301, "good"), ("night_reef", 9302, "fair")])
def test_a_track_by_pictures_and_inertial_units_errs_as_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], water: str, seed: int, inertial: str, mode: str, most: float
) -> None:
    """With errors taken for new in each picture, NEES / 6 is 3.7 and 4.9, live 1.6 and 1.6."""
    dive, solved = tmp_path / "dive.mcap", tmp_path / "solved.mcap"
    told = ["--environment", water, "--seed", str(seed), "--seconds", "20", "--images", "--imu", "--inertial", inertial]
    assert main(["simulate", *told, str(dive)]) == 0
    assert main(["solve", str(dive), "-o", str(solved), "--track", mode]) == 0
    [track] = evaluated(capsys, solved, "--truth", dive)["tracks"]
    assert track["wrong"] == 0
    assert 0.2 < track["nees6"]["mean"] / 6.0 < most


@pytest.mark.slow
def test_a_network_by_pictures_and_inertial_units_errs_as_it_says(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With errors taken for new in each picture, NEES / 6 of its nodes is 5.2 and 6.1."""
    dive, solved = tmp_path / "dive.mcap", tmp_path / "solved.mcap"
    told = ["--environment", "night_reef", "--seed", "9303", "--seconds", "12", "--images", "--imu"]
    assert main(["simulate", *told, "--nodes", "3", "--fixed", "a", str(dive)]) == 0
    assert main(["solve", str(dive), "-o", str(solved)]) == 0
    nodes = evaluated(capsys, solved, "--net", "--truth", dive)["network"]
    moving = [node for node in nodes if not node["fixed"]]
    assert len(moving) == 2
    for node in moving:
        assert node["wrong"] == 0
        assert 0.2 < node["nees6"]["mean"] / 6.0 < 3.5
