"""`record`: what it says on a terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import signal
import struct
import subprocess
import sys
import termios
import threading
from collections import Counter
from contextlib import suppress
from pathlib import Path

import pytest
from buddyline.protocol.topics import DEPTH
from buddyline.protocol.zenoh_bus import connect, open_hub
from buddyline.tools.record import progress_words

from tests.processes import PATIENCE_S, REPOSITORY, free_endpoint
from tests.tools.watched import at, depth


def test_rates_of_topics_are_said_as_far_as_they_fit() -> None:
    then, now = Counter(imu=100, depth=10), Counter(imu=500, depth=10, candidates=40)
    assert progress_words(then, now, 2.0, 53_400_000_000, 200) == (
        "550 messages, 53.4 GB free, 220 a second: imu 200, candidates 20, depth 0"
    )
    assert progress_words(then, now, 2.0, 53_400_000_000, 60) == "550 messages, 53.4 GB free, 220 a second: imu 200"


def test_its_line_fits_the_terminal_and_is_gone_before_the_summary(tmp_path: Path) -> None:
    try:
        ours, its = pty.openpty()
    except OSError as error:
        pytest.skip(f"this machine gives no pseudo-terminal: {error}")
    endpoint = free_endpoint()
    fcntl.ioctl(its, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 60, 0, 0))
    plain = {name: value for name, value in os.environ.items() if name not in {"COLUMNS", "LINES"}}
    with open_hub(endpoint):
        bus = connect(endpoint, stop=threading.Event(), on_wait=lambda _: None)
        assert bus is not None
        record = subprocess.Popen(
            [sys.executable, "-m", "buddyline", "record", tmp_path / "rec.mcap", "--connect", endpoint],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=its,
            env={**plain, "PYTHONPATH": str(REPOSITORY)},
        )
        os.close(its)
        said = ""
        try:
            publisher, k = bus.publisher(DEPTH, "a"), 0
            while "a second: depth " not in said:
                publisher.put(depth("a", at(k), 12.5))
                k += 1
                said += os.read(ours, 65536).decode()
            record.send_signal(signal.SIGINT)
            assert record.wait(PATIENCE_S) == 130
            # A terminal that nobody writes to any more ends in an error.
            with suppress(OSError):
                while more := os.read(ours, 65536):
                    said += more.decode()
        finally:
            record.kill()
            record.wait()
            os.close(ours)
            bus.close()
    lines = [line.removesuffix("\x1b[K") for line in said.split("\r") if "GB free" in line]
    assert lines
    assert max(map(len, lines)) < 60
    assert f"\r\x1b[K{tmp_path / 'rec.mcap'}: " in said
