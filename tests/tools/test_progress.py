"""Long tasks say on a terminal how far they are."""

import io
from contextlib import redirect_stderr

import pytest
from buddyline.protocol.divelog import DiveLogReader, DiveLogWriter
from buddyline.protocol.messages import Depth
from buddyline.tools import progress
from buddyline.tools.cli import main

from tests.tools.evaluated import info, pose, track, truth, write_log


class ScreenText(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def terminal(monkeypatch):
    """A terminal, for standard error; tasks count as long at once."""
    monkeypatch.setattr(progress, "SHOW_AFTER_S", -1.0)
    return ScreenText()


def test_items_and_records_are_followed(terminal, tmp_path):
    with redirect_stderr(terminal):
        assert list(progress.counted("abc", "count")) == ["a", "b", "c"]
    assert "count [" in terminal.getvalue()
    with DiveLogWriter(tmp_path / "d.mcap") as writer:
        for k in range(3):
            writer.write_message(Depth(node="a", stamp_ns=10**9 * (k + 1), depth_m=1.0, sigma_m=0.1))
    with DiveLogReader(tmp_path / "d.mcap") as reader, redirect_stderr(terminal):
        assert len(list(progress.followed(reader.records(), "follow", reader.start_ns, reader.end_ns))) == 3
    assert list(progress.followed([], "nothing", None, None)) == []
    assert "follow [" in terminal.getvalue()


def test_the_line_fits_a_narrow_terminal(terminal, monkeypatch):
    monkeypatch.setenv("COLUMNS", "20")
    with redirect_stderr(terminal):
        assert list(progress.counted("abc", "count what there is")) == ["a", "b", "c"]
    lines = [line.removesuffix("\x1b[K") for line in terminal.getvalue().split("\r")]
    assert max(map(len, lines)) == 19


@pytest.mark.parametrize(
    "words",
    [
        ["evaluate", "LOG"],
        ["export", "LOG", "--format", "csv"],
        ["export", "LOG", "--format", "foxglove", "-o", "OUT"],
        ["export", "LOG", "--format", "mcap-ros2", "-o", "OUT"],
        ["report", "LOG", "-o", "OUT"],
        ["repair", "LOG", "-o", "OUT"],
        ["backfill", "LOG", "LOG2", "-o", "OUT"],
    ],
)
def test_commands_that_read_a_whole_dive_show_it(words, terminal, tmp_path):
    told = [one(k) for k in range(3) for one in (pose, track, truth)]
    log = write_log(tmp_path / "solved.mcap", info("a"), info("b"), *told)
    (tmp_path / "second.mcap").write_bytes((tmp_path / "solved.mcap").read_bytes())
    named = {"LOG": log, "LOG2": str(tmp_path / "second.mcap"), "OUT": str(tmp_path / "out")}
    pytest.importorskip("foxglove")
    with redirect_stderr(terminal):
        assert main([named.get(word, word) for word in words]) == 0
    assert "s left" in terminal.getvalue()
