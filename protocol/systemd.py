"""Notifications to systemd (Type=notify), or to another manager that listens at NOTIFY_SOCKET.

sd_notify(3): a datagram of lines KEY=VALUE to the Unix socket whose path is in the variable NOTIFY_SOCKET. A path that
begins with @ is an abstract socket. Without the variable nothing is sent.
"""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Final

MAX_TEXT: Final = 200
PATIENCE_S: Final = 0.5


class Notifier:
    """Reports that a service is ready, alive or stopping. No method raises, or waits longer than PATIENCE_S."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        address = os.environ.get("NOTIFY_SOCKET", "")
        if address[:1] not in ("/", "@"):
            return
        notified = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        try:
            notified.connect("\0" + address[1:] if address[0] == "@" else address)
        except OSError:
            notified.close()  # nobody listens at the socket
            return
        notified.settimeout(PATIENCE_S)
        self._socket = notified

    def ready(self) -> None:
        """Report that the service has started."""
        self._send("READY=1")

    def tell(self, text: str, *, feed_watchdog: bool) -> None:
        """Send a text for `systemctl status`. feed_watchdog: also report that the service does its work."""
        lines = f"STATUS={' '.join(text.split())[:MAX_TEXT]}"
        self._send(f"WATCHDOG=1\n{lines}" if feed_watchdog else lines)

    def stopping(self) -> None:
        """Report that the service is stopping, and close the socket."""
        self._send("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, lines: str) -> None:
        if self._socket is None:
            return
        with contextlib.suppress(OSError):  # the service also works without a manager
            self._socket.send(lines.encode())
