"""Notifications to systemd (Type=notify), or to another manager that listens at NOTIFY_SOCKET.

sd_notify(3): a datagram of lines KEY=VALUE to the socket of Unix whose path is in NOTIFY_SOCKET; a path that begins
with @ is an abstract one. Without that variable nothing is sent.
"""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Final

MAX_TEXT: Final = 200
PATIENCE_S: Final = 0.5


class Notifier:
    """Says that a service is ready, goes on, or stops. No method raises, or waits for more than PATIENCE_S."""

    def __init__(self) -> None:
        self._socket: socket.socket | None = None
        address = os.environ.get("NOTIFY_SOCKET", "")
        if address[:1] not in ("/", "@"):
            return
        notified = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        try:
            notified.connect("\0" + address[1:] if address[0] == "@" else address)
        except OSError:
            notified.close()  # nobody listens there
            return
        notified.settimeout(PATIENCE_S)
        self._socket = notified

    def ready(self) -> None:
        """Tell that the service has started."""
        self._send("READY=1")

    def tell(self, text: str, *, goes_on: bool) -> None:
        """Send a text for `systemctl status`; goes_on: feed the watchdog, too."""
        lines = f"STATUS={' '.join(text.split())[:MAX_TEXT]}"
        self._send(f"WATCHDOG=1\n{lines}" if goes_on else lines)

    def stopping(self) -> None:
        """Tell that the service is stopping, and close the socket."""
        self._send("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, lines: str) -> None:
        if self._socket is None:
            return
        with contextlib.suppress(OSError):  # without a manager the work goes on
            self._socket.send(lines.encode())
