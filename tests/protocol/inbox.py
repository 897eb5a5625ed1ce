"""A bus handler that keeps its messages, for tests that wait for them."""

from __future__ import annotations

import threading
from collections.abc import Callable

from buddyline.protocol.bus import Received

from tests.processes import PATIENCE_S


class Inbox:
    """Keeps what it receives."""

    def __init__(self) -> None:
        self.received: list[Received] = []
        self._changed = threading.Condition()

    def __call__(self, received: Received) -> None:
        with self._changed:
            self.received.append(received)
            self._changed.notify_all()

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition on what has been received."""
        with self._changed:
            assert self._changed.wait_for(condition, PATIENCE_S), self.received[-20:]

    def wait_for(self, count: int) -> list[Received]:
        """Wait for so many messages; return all."""
        self.wait_until(lambda: len(self.received) >= count)
        return list(self.received)

    def wait_for_key(self, key: str) -> None:
        """Wait for a message on this key."""
        self.wait_until(lambda: key in self.keys)

    @property
    def keys(self) -> list[str]:
        return [received.key for received in self.received]

    def payloads(self, key: str) -> list[bytes]:
        return [received.payload for received in self.received if received.key == key]
