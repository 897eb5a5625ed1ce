"""A progress bar on stderr, for long tasks."""

from __future__ import annotations

import os
import shutil
import sys
import time
from typing import Final, TextIO

SHOW_AFTER_S: Final = 1.0
WIDTH: Final = 30


def terminal_size() -> os.terminal_size:
    """Return the size of the terminal that stdout or, where that goes elsewhere, stderr is; COLUMNS and LINES win."""
    try:
        of_stderr = os.get_terminal_size(sys.stderr.fileno())
    except (OSError, ValueError):
        of_stderr = os.terminal_size((80, 24))
    # A terminal that nobody has given a size says 0.
    found = shutil.get_terminal_size(of_stderr)
    return found if min(found) > 0 else os.terminal_size((80, 24))


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
        print(
            f"\r{self.what} [{bar:<{WIDTH}}] {share:4.0%} {left_s:4.0f} s left {note}\x1b[K", end="", file=self._stream
        )
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
