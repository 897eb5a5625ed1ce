"""A service's threads: named, watched, and ended together."""

from __future__ import annotations

import logging
import signal
import threading
import time
from collections.abc import Callable
from typing import Final

from protocol.errors import BuddylineError

log = logging.getLogger(__name__)

JOIN_TIMEOUT_S: Final = 1.5


class Service:
    """Runs until `stop` is set or one of its threads fails.

    A thread that ends with an exception ends the service: exit status 2 for a BuddylineError (one line), 1
    for a bug (with its traceback). A thread that returns only ends itself.
    """

    def __init__(self, name: str) -> None:
        self.name = name
        self.stop = threading.Event()
        self.interrupted = False
        self.failure: tuple[str, BaseException] | None = None
        self._threads: list[threading.Thread] = []

    def spawn(self, name: str, target: Callable[[], None]) -> None:
        """Start a thread of this service."""

        def run() -> None:
            try:
                target()
            except Exception as error:  # a dead thread is named, whatever ended it
                self.fail(name, error)

        thread = threading.Thread(target=run, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()

    def fail(self, where: str, error: BaseException) -> None:
        """End the service because of error."""
        if self.failure is None:
            self.failure = (where, error)
        self.stop.set()

    def handle_signals(self) -> None:
        """Stop on SIGINT and SIGTERM; for the main thread of a process."""

        def interrupt(number: int, _frame: object) -> None:
            self.interrupted = number == signal.SIGINT
            self.stop.set()

        signal.signal(signal.SIGINT, interrupt)
        signal.signal(signal.SIGTERM, interrupt)

    def wait(self, seconds: float | None = None) -> None:
        """Wait until the service stops, or for this long."""
        ends_s = None if seconds is None else time.monotonic() + seconds
        # In slices: an Event.wait without an end keeps Python from handling signals on some platforms.
        while not self.stop.wait(0.2):
            if ends_s is not None and time.monotonic() >= ends_s:
                break
        self.stop.set()

    def join(self) -> int:
        """Join all threads, name those that do not end; return the exit status."""
        self.stop.set()
        ends_s = time.monotonic() + JOIN_TIMEOUT_S
        for thread in self._threads:
            thread.join(max(ends_s - time.monotonic(), 0.0))
            if thread.is_alive():
                log.error("%s: thread %s did not end", self.name, thread.name)
        if self.failure is None:
            return 130 if self.interrupted else 0
        where, error = self.failure
        if isinstance(error, BuddylineError):
            log.error("%s: %s", self.name, error)
            return 2
        log.error("%s: thread %s failed", self.name, where, exc_info=error)
        return 1


def start_logging(verbose: bool = False) -> None:
    """Send the log to stderr, as journald and people read it: level and text."""
    logging.basicConfig(level=logging.DEBUG if verbose else logging.INFO, format="%(levelname).1s %(message)s")
