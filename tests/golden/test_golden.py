"""Each stage over the golden dives against its reference, so that a commit shows how it changed results."""

import pytest

from tests.golden import references, stages
from tests.golden.dives import ALL, INERTIAL, NIGHT_REEF, OF_PICTURES, SURVEY
from tests.golden.references import compare_clocks, compare_frames, compare_outcomes, compare_rows, compare_tracks


@pytest.mark.parametrize("dive", OF_PICTURES, ids=lambda dive: dive.name)
def test_pictures_to_candidates(dive, update_refs):
    (log,) = dive.logs
    references.check(f"{dive.name}.candidates", stages.detect(log), compare_frames, update_refs, pictures=True)


@pytest.mark.parametrize("dive", ALL, ids=lambda dive: dive.name)
def test_candidates_to_outcomes(dive, update_refs, tmp_path):
    result = stages.solve(dive.logs, tmp_path / "out.mcap", *dive.options)
    references.check(f"{dive.name}.outcomes", result, compare_outcomes, update_refs, dive.pictures)


@pytest.mark.parametrize("mode", ["smooth", "filter"])
def test_candidates_and_sensors_to_track(mode, update_refs, tmp_path):
    result = stages.track(INERTIAL.logs, tmp_path / "out.mcap", mode)
    references.check(f"{INERTIAL.name}.{mode}", result, compare_tracks, update_refs)


def test_candidates_to_clock_offset(update_refs):
    references.check("night_reef.clock", stages.align(NIGHT_REEF.logs), compare_clocks, update_refs)


def test_logs_to_legs(update_refs, tmp_path):
    solved = tmp_path / "solved.mcap"
    stages.solve(SURVEY.logs, solved)
    result = stages.legs(tmp_path / "cave.toml", [solved, *SURVEY.logs])
    references.check("survey.legs", result, compare_rows, update_refs)
