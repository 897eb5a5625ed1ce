"""One minute of the soak; for an hour of it: `python -m tests.soak`."""

from tests.soak.system import RATE_HZ, soak

SECONDS = 60.0


def test_a_minute_of_everything_loses_and_doubles_nothing(tmp_path):
    result = soak(tmp_path, SECONDS, every_s=SECONDS / 3)
    assert result.failures == []
    # A busy machine skips pictures; it does not skip most of them.
    assert result.triggers > RATE_HZ * SECONDS / 3
    assert {row.key.rpartition("/")[2] for row in result.rows} >= {"candidates", "attitude", "depth", "imu", "pose"}
