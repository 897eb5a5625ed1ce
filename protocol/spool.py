"""A new file whose writes never fail: data that the disk refuses stays in memory and is written later."""

from __future__ import annotations

import contextlib
import os
from collections import deque
from pathlib import Path
from typing import Final

HELD_BYTES: Final = 1024 * 1024


class Spool:
    """A new file, opened for writing.

    `write` never fails. `flush` may raise OSError but loses nothing: the next call continues where this one stopped.
    stuck: whether the last flush failed.
    """

    def __init__(self, path: Path) -> None:
        self.stuck = False
        self._path = path
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o666)
        self._held: deque[bytes] = deque()
        self._held_bytes = 0
        self._length = 0

    @property
    def closed(self) -> bool:
        """Whether the file is closed."""
        return self._fd < 0

    @property
    def removed(self) -> bool:
        """Whether the file was deleted, so that what is written can no longer be read by anyone."""
        about = os.fstat(self._fd)
        # Some file systems count no links at all.
        try:
            return about.st_nlink == 0 and not os.path.samestat(about, os.stat(self._path))
        except OSError:
            return True

    def tell(self) -> int:
        """Return the number of bytes written, including queued ones."""
        return self._length

    def write(self, data: bytes) -> int:
        """Queue bytes; beyond HELD_BYTES the queue is flushed, unless the file is stuck. Return their number."""
        self._held.append(bytes(data))
        self._held_bytes += len(data)
        self._length += len(data)
        if self._held_bytes > HELD_BYTES and not self.stuck:
            with contextlib.suppress(OSError):  # `stuck` is set, and the caller's next flush raises
                self.flush()
        return len(data)

    def flush(self) -> None:
        """Write the queued bytes; raise OSError if the system refuses them."""
        self.stuck = True
        while self._held:
            data = self._held.popleft()
            try:
                done = os.write(self._fd, data) if data else 0
            except OSError:
                self._held.appendleft(data)
                raise
            self._held_bytes -= done
            if done < len(data):
                self._held.appendleft(data[done:])
        self.stuck = False

    def sync(self) -> None:
        """Have the system write everything to the disk (fsync); raise OSError."""
        os.fsync(self._fd)

    def close(self) -> None:
        """Close the file; bytes that are still queued are lost."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)
