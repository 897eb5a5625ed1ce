"""A quarter of a minute of the soak, and a whole one among the slow tests; an hour of it: `python -m tests.soak`."""

import pytest

from tests.soak.system import RATE_HZ, soak


@pytest.mark.parametrize("seconds", [15.0, pytest.param(60.0, marks=pytest.mark.slow)])
def test_with_everything_running_nothing_is_lost_or_doubled(tmp_path, seconds):
    result = soak(tmp_path, seconds, every_s=seconds / 3)
    assert result.failures == []
    # A busy machine skips pictures; it does not skip most of them.
    assert result.triggers > RATE_HZ * seconds / 3
    assert {row.key.rpartition("/")[2] for row in result.rows} >= {"candidates", "attitude", "depth", "imu", "pose"}
