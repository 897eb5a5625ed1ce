"""A progress bar on stderr, for long tasks."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Collection, Iterable, Iterator
from typing import TYPE_CHECKING, Final, TextIO, TypeVar

from buddyline.protocol.clock import S_NS

if TYPE_CHECKING:
    from buddyline.protocol.divelog import Record

SHOW_AFTER_S: Final = 1.0
WIDTH: Final = 30

T = TypeVar("T")


def terminal_size() -> os.terminal_size:
    """Return the size of the terminal that stdout or, where that goes elsewhere, stderr is; COLUMNS and LINES win."""
    try:
        of_stderr = os.get_terminal_size(sys.stderr.fileno())
    except (OSError, ValueError):
        of_stderr = os.terminal_size((80, 24))
    # A terminal that nobody has given a size says 0.
    found = shutil.get_terminal_size(of_stderr)
    return found if min(found) > 0 else os.terminal_size((80, 24))


def followed(records: Iterable[Record], what: str, start_ns: int | None, end_ns: int | None) -> Iterator[Record]:
    """Yield a log's records, and show by their log time how much is done; start_ns, end_ns: of the log, if any."""
    begin_ns = start_ns or 0
    with Progress(what, ((end_ns or 0) - begin_ns) / S_NS) as progress:
        for record in records:
            progress.show((record.log_time_ns - begin_ns) / S_NS)
            yield record


def counted(items: Collection[T], what: str) -> Iterator[T]:
    """Yield items, and show how many of them are done."""
    with Progress(what, len(items)) as progress:
        for done, item in enumerate(items):
            progress.show(done)
            yield item


class Progress:
    """Shows the progress of a task; shows nothing if stderr is no terminal or the task is short."""

    def __init__(self, what: str, total: float, stream: TextIO | None = None) -> None:
        self.what = what
        self.total = max(total, 1e-9)
        self._stream = stream or sys.stderr
        self._seen = self._stream.isatty()
        self._began_s = time.monotonic()
        self._shown_s = 0.0
        self._shown = False

    def show(self, done: float, note: str = "") -> None:
        """Say how much of the total is done."""
        if not self._seen:
            return
        now_s = time.monotonic()
        if now_s - self._began_s < SHOW_AFTER_S or now_s - self._shown_s < 0.1:
            return
        share = min(max(done / self.total, 0.0), 1.0)
        left_s = (now_s - self._began_s) * (1 - share) / share if share > 0 else 0.0
        bar = "#" * round(share * WIDTH)
        line = f"{self.what} [{bar:<{WIDTH}}] {share:4.0%} {left_s:4.0f} s left {note}"
        # A longer one would go on in the next line, and stay there.
        print(f"\r{line[: max(terminal_size().columns - 1, 0)]}\x1b[K", end="", file=self._stream)
        self._stream.flush()
        self._shown_s, self._shown = now_s, True

    def close(self) -> None:
        """Clear the line."""
        if self._shown:
            print("\r\x1b[K", end="", file=self._stream)
            self._stream.flush()

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
