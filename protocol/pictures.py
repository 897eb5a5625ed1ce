"""The pictures of a dive, in files of their own beside its log, so that the oldest can be deleted from a full disk.

The pictures of `a-....mcap` are in the folder `a-....pictures`, in `000000.mcap` and so on; each is a dive log.
"""

from __future__ import annotations

import errno
import logging
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError

log = logging.getLogger(__name__)

SUFFIX: Final = ".pictures"
FULL: Final = frozenset({errno.ENOSPC, errno.EDQUOT})
SEGMENT_BYTES: Final = 128 * 1024 * 1024


def with_pictures(paths: Iterable[Path | str]) -> list[Path]:
    """Return these logs, each followed by the files of its pictures, except files that are listed themselves."""
    named = [Path(path) for path in paths]
    known = {path.resolve() for path in named}
    found = []
    for path in named:
        found.append(path)
        beside = sorted(path.with_suffix(SUFFIX).glob("*.mcap")) if path.suffix == ".mcap" else []
        found += [file for file in beside if file.resolve() not in known]
    return found


class PictureLog:
    """Writes pictures beside a log. On a nearly full disk it deletes the oldest pictures, then stops recording them.

    kin: a pattern that matches the names of this node's logs in the same folder; pictures of older logs are deleted
    first. min_free_bytes: space to leave on the disk. dropped: number of pictures not written. deleted: number of
    files deleted.
    """

    def __init__(
        self, log_path: Path, kin: str, min_free_bytes: int, *, metadata: dict[str, str] | None = None
    ) -> None:
        self.dropped = 0
        self.deleted = 0
        self._folder = log_path.with_suffix(SUFFIX)
        self._kin = kin
        self._min_free_bytes = min_free_bytes
        # Also on a small disk, deleting one file must free enough space.
        self._segment_bytes = min(SEGMENT_BYTES, min_free_bytes // 2) if min_free_bytes else SEGMENT_BYTES
        self._metadata = metadata
        self._writer: DiveLogWriter | None = None
        self._number = 0
        self._error = ""
        self._paused = False

    @property
    def problem(self) -> str:
        """What is wrong, in words; "" if nothing."""
        if self._error and not self._paused:
            return f"pictures are not recorded: {self._error}"
        if self._paused:
            return "the disk is nearly full: no pictures are recorded, everything else is"
        if self.deleted:
            return f"the disk is nearly full: the oldest pictures were deleted ({self.deleted} files)"
        return ""

    def write(self, key: str, payload: bytes, log_time_ns: int, schema: str = "") -> None:
        """Add one picture if there is space. A write error is reported by `problem` and never raised."""
        if self._paused:
            self.dropped += 1
            return
        try:
            if self._writer is None:
                self._writer = self._next_file()
            self._writer.write(key, payload, log_time_ns, schema=schema)
            self._error = ""
            if self._writer.size_bytes > self._segment_bytes:
                self._end_file()
        except (OSError, BuddylineError) as error:
            self._fail(error)

    def flush(self) -> None:
        """Write everything to the disk (fsync)."""
        if self._writer is None:
            return
        try:
            self._writer.flush(sync=True)
        except OSError as error:
            self._fail(error)

    def keep_room(self, *, full: bool = False) -> None:
        """Delete the oldest pictures while there is too little space. full: a write failed for lack of space."""
        try:
            free_bytes = self._free_bytes()
            if not full and free_bytes >= self._min_free_bytes:
                # Resumed only with some space above the limit, so that recording does not start and stop repeatedly.
                if self._paused and free_bytes >= self._min_free_bytes + self._segment_bytes:
                    self._paused, self._error = False, ""
                    log.info("pictures are recorded again")
                return
            for file in self._oldest_first():
                if self._writer is not None and file == self._writer.path:
                    self._end_file()
                self._delete(file)
                free_bytes = self._free_bytes()
                if free_bytes >= self._min_free_bytes:
                    return
        except OSError as error:
            self._fail(error)
            return
        if not self._paused:
            self._paused = True
            log.warning("disk: %.0f MB free: no more pictures are recorded, everything else is", free_bytes / 1e6)

    def close(self) -> None:
        """Finish the last file."""
        try:
            self._end_file()
        except OSError as error:
            self._fail(error)

    def _free_bytes(self) -> int:
        return shutil.disk_usage(self._folder.parent).free

    def _next_file(self) -> DiveLogWriter:
        self._folder.mkdir(exist_ok=True)
        writer = DiveLogWriter(self._folder / f"{self._number:06d}.mcap", metadata=self._metadata, parity=False)
        self._number += 1
        return writer

    def _end_file(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()

    def _oldest_first(self) -> list[Path]:
        # The order of names is the order of time: folders are named by their log's start, and files are numbered.
        return sorted(self._folder.parent.glob(f"{self._kin}{SUFFIX}/*.mcap"))

    def _delete(self, file: Path) -> None:
        size_mb = file.stat().st_size / 1e6
        file.unlink()
        self.deleted += 1
        log.warning("disk: nearly full: pictures %s/%s deleted (%.0f MB)", file.parent.name, file.name, size_mb)
        if file.parent != self._folder and not any(file.parent.iterdir()):
            file.parent.rmdir()

    def _fail(self, error: Exception) -> None:
        self.dropped += 1
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.abandon()
        if isinstance(error, OSError) and error.errno in FULL:
            self._paused = True
        text = (error.strerror if isinstance(error, OSError) else None) or str(error)
        if text != self._error:
            log.warning("pictures are not recorded: %s", text)
        self._error = text
