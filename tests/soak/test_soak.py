"""A minute of the soak; an hour of it: `python -m tests.soak`."""

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.processes import PATIENCE_S, REPOSITORY, until
from tests.soak.system import RATE_HZ, soak

SECONDS = 60.0


@pytest.mark.slow
def test_with_everything_running_nothing_is_lost_or_doubled(tmp_path):
    result = soak(tmp_path, SECONDS, every_s=SECONDS / 3)
    assert result.failures == []
    # A busy machine skips pictures; it does not skip most of them.
    assert result.triggers > RATE_HZ * SECONDS / 3
    assert {row.key.rpartition("/")[2] for row in result.rows} >= {"candidates", "attitude", "depth", "imu", "pose"}


def children(pid):
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True, check=False)
    return [int(word) for word in found.stdout.split()]


@pytest.mark.slow
def test_a_soak_that_is_asked_to_end_leaves_no_process():
    words = ["tests.soak.shared", "--kills", "0", "--nodes", "2", "--rate", "2", "--track", "0", "--seconds", "60"]
    with subprocess.Popen([sys.executable, "-m", *words], cwd=REPOSITORY) as running:
        until(lambda: len(children(running.pid)) == 4, 0.1)
        begun = children(running.pid)
        running.send_signal(signal.SIGTERM)
        assert running.wait(PATIENCE_S) == 143
    until(lambda: not any((Path("/proc") / str(pid)).exists() for pid in begun), 0.1)
