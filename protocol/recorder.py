"""A dive log written by a thread of its own: whoever records never waits for the disk."""

from __future__ import annotations

import threading
import time
from collections import deque
from pathlib import Path
from typing import Final

from protocol.divelog import DiveLogWriter
from protocol.topics import IMAGE, parse_key

SYNC_INTERVAL_S: Final = 1.0
MAX_QUEUED_BYTES: Final = 64 * 1024 * 1024


class Recorder:
    """Writes payloads into a dive log; at most a second of it is ever off the disk.

    Where the disk cannot keep up, the oldest pictures are dropped first, then the oldest messages; `dropped`
    counts them. `error` holds what made the thread end, None while it is sound.
    """

    def __init__(self, path: Path | str, *, metadata: dict[str, str] | None = None) -> None:
        self._writer = DiveLogWriter(path, metadata=metadata)
        self.path = self._writer.path
        self.dropped = 0
        self.written = 0
        self.error: Exception | None = None
        self._queue: deque[tuple[str, bytes, int, str]] = deque()
        self._queued_bytes = 0
        self._ready = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=f"recorder {self.path.name}", daemon=True)
        self._thread.start()

    def write(self, key: str, payload: bytes, log_time_ns: int, schema: str = "") -> None:
        """Queue one payload."""
        with self._ready:
            self._queue.append((key, payload, log_time_ns, schema))
            self._queued_bytes += len(payload)
            while self._queued_bytes > MAX_QUEUED_BYTES:
                self._drop_one()
            self._ready.notify()

    def _drop_one(self) -> None:
        pictures = (i for i, item in enumerate(self._queue) if (p := parse_key(item[0])) and p[0] is IMAGE)
        oldest = next(pictures, 0)
        payload = self._queue[oldest][1]
        del self._queue[oldest]
        self._queued_bytes -= len(payload)
        self.dropped += 1

    def _run(self) -> None:
        try:
            synced_s = time.monotonic()
            while True:
                with self._ready:
                    if not self._queue and not self._closing:
                        self._ready.wait(SYNC_INTERVAL_S / 4)
                    batch, self._queue = self._queue, deque()
                    self._queued_bytes = 0
                    closing = self._closing
                for key, payload, log_time_ns, schema in batch:
                    self._writer.write(key, payload, log_time_ns, schema=schema)
                self.written += len(batch)
                if time.monotonic() - synced_s >= SYNC_INTERVAL_S:
                    self._writer.flush(sync=True)
                    synced_s = time.monotonic()
                if closing and not batch:
                    break
            self._writer.close()
        except Exception as error:  # the thread's end is reported, whatever ended it
            self.error = error

    def close(self, timeout_s: float = 5.0) -> None:
        """Write what is queued, and the log's end; raise what the thread met."""
        with self._ready:
            self._closing = True
            self._ready.notify()
        self._thread.join(timeout_s)
        if self.error is not None:
            raise self.error

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
