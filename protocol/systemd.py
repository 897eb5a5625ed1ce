"""What a service tells systemd (Type=notify), or whatever else started it and listens at NOTIFY_SOCKET.

sd_notify(3): a datagram of lines KEY=VALUE to the socket of Unix whose path is in NOTIFY_SOCKET; a path that begins
with @ is an abstract one. Without that variable nothing is said.
"""

from __future__ import annotations

import contextlib
import os
import socket
from typing import Final

MAX_TEXT: Final = 200
PATIENCE_S: Final = 0.5


class Notifier:
    """Says that a service is ready, goes on, or stops. Nothing here fails, or waits for long."""

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
        """Say that the start is over."""
        self._send("READY=1")

    def tell(self, text: str, *, goes_on: bool) -> None:
        """Give a text for `systemctl status`, and feed the watchdog where the work goes on."""
        lines = f"STATUS={' '.join(text.split())[:MAX_TEXT]}"
        self._send(f"WATCHDOG=1\n{lines}" if goes_on else lines)

    def stopping(self) -> None:
        """Say that the end has begun; it is the last thing said."""
        self._send("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, lines: str) -> None:
        if self._socket is None:
            return
        with contextlib.suppress(OSError):  # without a manager the work goes on
            self._socket.send(lines.encode())
