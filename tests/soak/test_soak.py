"""A minute of the soak; an hour of it: `python -m tests.soak`."""

import pytest

from tests.soak.system import RATE_HZ, soak

SECONDS = 60.0


@pytest.mark.slow
def test_with_everything_running_nothing_is_lost_or_doubled(tmp_path):
    result = soak(tmp_path, SECONDS, every_s=SECONDS / 3)
    assert result.failures == []
    # A busy machine skips pictures; it does not skip most of them.
    assert result.triggers > RATE_HZ * SECONDS / 3
    assert {row.key.rpartition("/")[2] for row in result.rows} >= {"candidates", "attitude", "depth", "imu", "pose"}
