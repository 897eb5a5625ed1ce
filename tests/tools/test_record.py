"""`record`: what it says on a terminal, and what it does when its disk or its file fails."""

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
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from buddyline.protocol.divelog import DiveLogReader
from buddyline.protocol.topics import DEPTH
from buddyline.protocol.zenoh_bus import connect, open_hub
from buddyline.tools.cli import main
from buddyline.tools.record import progress_words

from tests.disks import small_disk
from tests.processes import PATIENCE_S, REPOSITORY, Process, free_endpoint, until
from tests.tools.watched import at, depth


def test_rates_of_topics_are_said_as_far_as_they_fit() -> None:
    then, now = Counter(imu=100, depth=10), Counter(imu=500, depth=10, candidates=40)
    assert progress_words(then, now, 2.0, "53.4 GB free", 200) == (
        "550 messages, 53.4 GB free, 220 a second: imu 200, candidates 20, depth 0"
    )
    assert progress_words(then, now, 2.0, "53.4 GB free", 60) == "550 messages, 53.4 GB free, 220 a second: imu 200"


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


class Published:
    """Sends depths, one after the other."""

    def __init__(self, endpoint: str) -> None:
        bus = connect(endpoint, stop=threading.Event(), on_wait=lambda _: None)
        assert bus is not None
        self.bus, self._publisher, self.count = bus, bus.publisher(DEPTH, "a"), 0

    def put(self) -> None:
        self._publisher.put(depth("a", at(self.count), 12.5))
        self.count += 1


@contextmanager
def recorded(path: Path) -> Iterator[tuple[Process, Published]]:
    """Run `record` into path on a hub of its own."""
    endpoint = free_endpoint()
    with open_hub(endpoint), Process("record", path, "--connect", endpoint) as record:
        record.wait_for("Ctrl-C ends")
        published = Published(endpoint)
        try:
            yield record, published
        finally:
            published.bus.close()


def put_until(published: Published, record: Process, text: str) -> None:
    def found() -> bool:
        published.put()
        return any(text in line for line in record.lines)

    until(found)


def test_a_full_disk_is_named_and_nothing_is_lost_once_there_is_room(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 512) as disk, recorded(disk / "out.mcap") as (record, published):
        ballast = disk / "ballast"
        with suppress(OSError), ballast.open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
        put_until(published, record, "out.mcap: No space left on device; kept in memory")
        ballast.unlink()
        put_until(published, record, "written again; nothing of it is lost")
        record.send(signal.SIGINT)
        assert record.wait() == 130
        summary = next(line for line in record.lines if "messages, " in line)
        with DiveLogReader(disk / "out.mcap") as reader:
            stored = len(list(reader.records()))
        assert f"{stored} messages, 0 dropped, 0 bad" in summary


def test_a_disk_that_stays_full_is_one_line_and_status_2(tmp_path: Path) -> None:
    with small_disk(tmp_path / "disk", 512) as disk, recorded(disk / "out.mcap") as (record, published):
        with suppress(OSError), (disk / "ballast").open("wb", buffering=0) as file:
            while True:
                file.write(bytes(4096))
        put_until(published, record, "No space left on device")
        record.send(signal.SIGINT)
        assert record.wait() == 2
        said = "\n".join(record.lines)
        assert "its end is lost: No space left on device" in said
        assert "Traceback" not in said
        assert "messages, " in said


def test_a_log_that_is_deleted_meanwhile_ends_the_recording(tmp_path: Path) -> None:
    with recorded(tmp_path / "out.mcap") as (record, published):
        until((tmp_path / "out.mcap").exists)
        (tmp_path / "out.mcap").unlink()
        put_until(published, record, "out.mcap: was removed while it was written")
        assert record.wait() == 2
        assert sum("was removed" in line for line in record.lines) == 1


def test_it_does_not_record_into_standard_output(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["record", "-"]) == 2
    assert "-: this does not go to standard output; name a file" in capsys.readouterr().err
