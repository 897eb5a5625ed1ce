"""Record a dive log in a thread of its own, so that callers do not wait for the disk."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from heapq import merge
from pathlib import Path
from typing import Final

from buddyline.protocol.divelog import DiveLogWriter
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.pictures import FULL, PictureLog
from buddyline.protocol.topics import IMAGE, parse_key

log = logging.getLogger(__name__)

SYNC_INTERVAL_S: Final = 1.0
RETRY_S: Final = 0.5
MAX_QUEUED_BYTES: Final = 64 * 1024 * 1024

Item = tuple[str, bytes, int, str]


class RecordError(BuddylineError):
    """A log that cannot be written."""


class Recorder:
    """Writes payloads into a dive log and syncs it every second.

    While the disk is slow or refuses to write, messages wait in memory. Beyond 64 MB, with what is being written,
    the oldest pictures are dropped first, then the oldest messages; `dropped` counts them. `error`: why nothing can be
    written; None if it can. After an error of the disk the thread tries again until `close`. `ended`: nothing is
    written any more: the log was removed, there is a bug, or it is closed. pictures: receives the pictures, in
    place of the log.
    """

    def __init__(
        self, path: Path | str, *, metadata: dict[str, str] | None = None, pictures: PictureLog | None = None
    ) -> None:
        self._writer = DiveLogWriter(path, metadata=metadata)
        self.path = self._writer.path
        self.pictures = pictures
        self.dropped = 0
        self.written = 0
        self.error: Exception | None = None
        self.ended = False
        # Two queues, because to search a long one for the oldest picture takes longer than messages take to come.
        self._messages: deque[Item] = deque()
        self._pictures: deque[Item] = deque()
        self._queued_bytes = 0
        self._ready = threading.Condition()
        self._dropped_before = 0
        self._closing = self._last_try = False
        self._thread = threading.Thread(target=self._run, name=f"recorder {self.path.name}", daemon=True)
        self._thread.start()

    def write(self, key: str, payload: bytes, log_time_ns: int, schema: str = "") -> None:
        """Queue one payload."""
        with self._ready:
            self._queue_of(key).append((key, payload, log_time_ns, schema))
            self._queued_bytes += len(payload)
            self._bound()

    def _queue_of(self, key: str) -> deque[Item]:
        return self._pictures if _is_picture(key) else self._messages

    def _bound(self) -> None:
        while self._queued_bytes > MAX_QUEUED_BYTES and (queue := self._pictures or self._messages):
            self._queued_bytes -= len(queue.popleft()[1])
            self.dropped += 1

    def _take(self) -> deque[Item]:
        """Return all that is queued, in the order in which it came."""
        batch = deque(merge(self._messages, self._pictures, key=lambda item: item[2]))
        self._messages.clear()
        self._pictures.clear()
        return batch

    def _run(self) -> None:
        try:
            while not self._turn():
                pass
        except (OSError, RecordError) as error:
            self.error = error  # `close` raises it, or who looks at `ended`
        except Exception as error:  # any error that ends the thread is reported
            log.error("log %s: no longer written", self.path, exc_info=error)
            self.error = error
        self.ended = True

    def _turn(self) -> bool:
        """Write for one second, then sync; return whether the log is closed."""
        ends_s = time.monotonic() + SYNC_INTERVAL_S
        closing, batch = False, deque[Item]()
        try:
            if self.error is not None:
                self._writer.flush(sync=True)  # while this fails, a long queue need not be taken and put back
            while not closing and time.monotonic() < ends_s:
                with self._ready:
                    # Nothing is on the disk before the sync, so no message wakes this thread: waking costs more than
                    # writing.
                    self._ready.wait_for(lambda: self._closing, SYNC_INTERVAL_S / 4)
                    batch = self._take()
                    closing = self._closing
                self._write(batch)
            self._writer.flush(sync=True)
        except OSError as error:
            return self._refused(error, batch)
        if self._writer.removed:
            self._writer.abandon()
            raise RecordError(f"{self.path}: was removed while it was written, so nothing of it is left; start again")
        if self.error is not None:
            lost = self.dropped - self._dropped_before
            words = f"{lost} messages of the time in between are lost" if lost else "nothing of it is lost"
            log.info("log %s: written again; %s", self.path, words)
            self.error = None
        if self.pictures is not None:
            self.pictures.flush()
            self.pictures.keep_room()
        if closing:
            self._close()
        return closing

    def _write(self, batch: deque[Item]) -> None:
        """Write the items of the batch and remove each from it; raise OSError, with the unwritten ones still in it."""
        while batch:
            key, payload, log_time_ns, schema = batch[0]
            if self.pictures is not None and _is_picture(key):
                self.pictures.write(key, payload, log_time_ns, schema)
            else:
                self._writer.write(key, payload, log_time_ns, schema=schema)
            batch.popleft()
            with self._ready:
                self._queued_bytes -= len(payload)
            self.written += 1

    def _refused(self, error: OSError, unwritten: deque[Item]) -> bool:
        """Queue the unwritten items again, free space if the disk is full, and wait; return False, to continue."""
        if self.error is None:
            self._dropped_before = self.dropped
            log.error(
                "log %s: %s; kept in memory, as much as 64 MB, and tried again: make room, or see to the disk",
                self.path,
                error.strerror,
            )
        with self._ready:
            if self._last_try:
                self.dropped += len(unwritten) + len(self._messages) + len(self._pictures)
                self._writer.abandon()
                raise error
            self._last_try = self._closing
            for item in reversed(unwritten):
                self._queue_of(item[0]).appendleft(item)
            self._bound()
        self.error = RecordError(f"{self.path}: {error.strerror}")
        if self.pictures is not None:
            self.pictures.keep_room(full=error.errno in FULL)
        with self._ready:
            self._ready.wait_for(lambda: self._closing, RETRY_S)
        return False

    def _close(self) -> None:
        if self.pictures is not None:
            self.pictures.close()
        self._writer.close()

    def close(self, timeout_s: float = 5.0) -> None:
        """Write the queued messages and the log's end; raise RecordError if the disk refuses to."""
        with self._ready:
            self._closing = True
            self._ready.notify()
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise RecordError(f"{self.path}: its end was not written within {timeout_s:g} s")
        if isinstance(self.error, OSError):
            raise RecordError(f"{self.path}: its end is lost: {self.error.strerror}") from self.error
        if self.error is not None:
            raise self.error

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _is_picture(key: str) -> bool:
    parsed = parse_key(key)
    return parsed is not None and parsed[0] is IMAGE
