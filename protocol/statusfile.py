"""A service's health in a small file, for indicator lamps, beepers and scripts.

JSON, replaced once a second and always complete: `service`, `stamp_ns`, `problems` (in words; empty if there are none),
and `status`, the last status message (NodeStatus or SolverStatus; null before the first). The service removes the file
when it ends properly. A file older than a few seconds belongs to a service that hangs or was killed.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from pathlib import Path

import msgspec
from buddyline.protocol.codec import plain
from buddyline.protocol.messages import Message

log = logging.getLogger(__name__)


def runtime_directory() -> Path | None:
    """Return systemd's RUNTIME_DIRECTORY, else $XDG_RUNTIME_DIR/buddyline; None if there is neither."""
    given = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
    session = os.environ.get("XDG_RUNTIME_DIR")
    return Path(given) if given else Path(session) / "buddyline" if session else None


class StatusFile:
    """The status file of one service. A write error is logged once, and the service continues."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._failed = False

    @classmethod
    def of(cls, name: str, configured: str = "") -> StatusFile | None:
        """Return the file of a service: the configured path, else `<name>.json` in the runtime directory, if any."""
        if configured:
            return cls(Path(configured))
        directory = runtime_directory()
        return cls(directory / f"{name}.json") if directory is not None else None

    def write(self, service: str, problems: list[str], status: Message | None) -> None:
        """Replace the file's content with the present state."""
        content = {"service": service, "stamp_ns": time.time_ns(), "problems": problems, "status": status}
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            fresh.write_bytes(msgspec.json.encode(content, enc_hook=plain) + b"\n")
            fresh.replace(self.path)
        except OSError as error:
            if not self._failed:
                log.warning("%s: status file %s cannot be written: %s", service, self.path, error.strerror)
            self._failed = True
        else:
            self._failed = False

    def remove(self) -> None:
        """Remove the file, when the service ends."""
        with contextlib.suppress(OSError):
            self.path.unlink()
