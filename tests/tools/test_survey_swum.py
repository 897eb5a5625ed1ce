"""Places that are swum past, through the whole solver and its track, against truth."""

import numpy as np
import pytest

from tests.tools.swum_survey import nees


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_places_that_are_swum_past_are_as_good_as_they_say():
    # More of them: python -m tests.tools.swum_survey.
    found, count = zip(*(nees(seed, 40.0) for seed in (0, 2)), strict=True)
    every = np.concatenate(found)
    assert len(every) >= 0.8 * sum(count)
    # Of 12 places that a compass's slow error ties to each other.
    assert 0.2 < every.mean() < 2.5
