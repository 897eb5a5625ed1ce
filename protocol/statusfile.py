"""A service's health in a small file, for lamps, beepers and scripts.

JSON, rewritten once a second, always whole: `service`, `stamp_ns`, `problems` (plain words; empty where all is well),
and `status`, the last status message (NodeStatus, SolverStatus; null before there is one). The file is
removed when the service ends in good order; one older than a few seconds is from a service that hangs or was killed.
"""

from __future__ import annotations

import contextlib
import logging
import os
import time
from pathlib import Path

import msgspec
from buddyline.protocol.messages import Message

log = logging.getLogger(__name__)


class StatusFile:
    """The status file of one service. A file that cannot be written is reported once; the service goes on."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._failed = False

    @classmethod
    def of(cls, name: str, configured: str = "") -> StatusFile | None:
        """Return the file of a service: where it is configured, else `<name>.json` in the runtime directory.

        That is systemd's RUNTIME_DIRECTORY, else $XDG_RUNTIME_DIR/buddyline; where there is neither, None.
        """
        if configured:
            return cls(Path(configured))
        given = os.environ.get("RUNTIME_DIRECTORY", "").partition(":")[0]
        if given:
            return cls(Path(given) / f"{name}.json")
        session = os.environ.get("XDG_RUNTIME_DIR")
        return cls(Path(session) / "buddyline" / f"{name}.json") if session else None

    def write(self, service: str, problems: list[str], status: Message | None) -> None:
        """Write the present state."""
        content = {"service": service, "stamp_ns": time.time_ns(), "problems": problems, "status": status}
        fresh = self.path.with_name(f".{self.path.name}.{os.getpid()}")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            fresh.write_bytes(msgspec.json.encode(content) + b"\n")
            fresh.replace(self.path)
        except OSError as error:
            if not self._failed:
                log.warning("%s: status file %s cannot be written: %s", service, self.path, error.strerror)
            self._failed = True
        else:
            self._failed = False

    def remove(self) -> None:
        """Remove the file: the service ends."""
        with contextlib.suppress(OSError):
            self.path.unlink()
