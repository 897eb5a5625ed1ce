"""The threads of a service: named, watched, and ended together."""

from __future__ import annotations

import faulthandler
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.systemd import Notifier

if TYPE_CHECKING:
    from buddyline.protocol.messages import Message
    from buddyline.protocol.statusfile import StatusFile

log = logging.getLogger(__name__)

JOIN_TIMEOUT_S: Final = 1.5
STUCK_S: Final = 15.0
# A stuck thread may hold a lock that an orderly end needs: after this time the process ends without one.
END_ANYWAY_S: Final = 10.0
WATCH_S: Final = 0.2
BEAT_S: Final = 1.0 - WATCH_S / 2


class StuckError(RuntimeError):
    """A thread that has stopped sending heartbeats."""


class Service:
    """Runs until `stop` is set or one of its threads fails; reports its health to systemd and the status file.

    A thread that ends with an exception ends the service: exit status 2 for a BuddylineError (one line), 1 for a bug
    (with its traceback). A thread that returns ends only itself. A thread that has called `heartbeat` once and then
    does not call it for STUCK_S ends the process, with its name and status 1; time in which the process waits for a
    processor, or is frozen, does not count. problems: what is wrong, in words.
    status_message: the last status message. Both go into the status file, if there is one.
    """

    def __init__(self, name: str, status_file: StatusFile | None = None) -> None:
        self.name = name
        self.problems: list[str] = []
        self.status_message: Message | None = None
        self._status_file = status_file
        self._notifier = Notifier()
        self.stop = threading.Event()
        self.interrupted = False
        self.failure: tuple[str, BaseException] | None = None
        self._threads: list[threading.Thread] = []
        self._heartbeat_s: dict[str, float] = {}
        self._waited_s: dict[str, float] = {}

    def spawn(self, name: str, target: Callable[[], None]) -> threading.Thread:
        """Start a thread of this service, and return it."""

        def run() -> None:
            try:
                target()
            except Exception as error:  # any error that ends a thread is reported
                self.fail(name, error)
            finally:
                self._heartbeat_s.pop(name, None)

        thread = threading.Thread(target=run, name=name, daemon=True)
        self._threads.append(thread)
        thread.start()
        return thread

    def heartbeat(self) -> None:
        """Report that the calling thread is not stuck. From its first call on, the thread is watched."""
        self._heartbeat_s[threading.current_thread().name] = time.monotonic()

    def fail(self, where: str, error: BaseException) -> None:
        """End the service because of error."""
        if self.failure is None:
            self.failure = (where, error)
        self.stop.set()

    def handle_signals(self) -> None:
        """Stop on SIGINT, SIGTERM and SIGHUP (the terminal closes). Call it in the main thread."""
        # systemd's watchdog ends a process with SIGABRT; the traceback of each thread is then in the journal.
        if sys.__stderr__ is not None:
            faulthandler.enable(sys.__stderr__)

        def interrupt(number: int, _frame: object) -> None:
            self.interrupted = number == signal.SIGINT
            # Not in this thread: it may be inside `stop.wait`, which holds the lock that `set` takes.
            threading.Thread(target=self.stop.set, name="stop").start()

        signal.signal(signal.SIGINT, interrupt)
        signal.signal(signal.SIGTERM, interrupt)
        signal.signal(signal.SIGHUP, interrupt)

    def wait(self, seconds: float | None = None) -> None:
        """Wait until the service stops, or for this time."""
        ends_s = None if seconds is None else time.monotonic() + seconds
        # In short waits: on some platforms Python handles no signal during an Event.wait without a time limit.
        looked_s = time.monotonic()
        self._notifier.ready()
        self._beat()
        beat_s = looked_s
        while not self.stop.wait(WATCH_S):
            now_s = time.monotonic()
            if ends_s is not None and now_s >= ends_s:
                break
            self._look_for_stuck(now_s, now_s - looked_s - WATCH_S)
            looked_s = now_s
            if now_s - beat_s >= BEAT_S:
                self._beat()
                beat_s = now_s
        self.stop.set()

    def progressing(self) -> bool:
        """Return whether the service does its work. If it does not, systemd's watchdog restarts it."""
        return True

    def _beat(self) -> None:
        self._notifier.tell("; ".join(self.problems) or "all is well", feed_watchdog=self.progressing())
        if self._status_file is not None:
            self._status_file.write(self.name, self.problems, self.status_message)

    def _look_for_stuck(self, now_s: float, stood_s: float) -> None:
        """Fail if a thread has sent no heartbeat for STUCK_S. stood_s: by how much this thread's own wait was late.

        A frozen process, or one that a busy machine lets wait, is not stuck: that time is not counted.
        """
        silent = any(now_s - heartbeat_s > STUCK_S / 2 for heartbeat_s in list(self._heartbeat_s.values()))
        before, self._waited_s = self._waited_s, waited_for_processor_s() if silent else {}
        # What a silent thread waits for may be what the one does that has waited longest.
        waited_s = [seconds - before.get(thread, seconds) for thread, seconds in self._waited_s.items()]
        lost_s = max([*waited_s, stood_s if stood_s > WATCH_S else 0.0])
        for name, said_s in list(self._heartbeat_s.items()):
            heartbeat_s = min(said_s + lost_s, now_s)
            if lost_s > 0.0:
                self._heartbeat_s[name] = max(heartbeat_s, self._heartbeat_s.get(name, 0.0))
            if now_s - heartbeat_s > STUCK_S:
                self.fail(name, StuckError(f"thread {name} is stuck: nothing for {now_s - heartbeat_s:.0f} s"))
                faulthandler.dump_traceback(2)
                self._end_anyway()
                return

    def _end_anyway(self) -> None:
        timer = threading.Timer(END_ANYWAY_S, os._exit, (1,))
        timer.daemon = True
        timer.start()

    def join(self) -> int:
        """Join all threads, name those that do not end; return the exit status."""
        self.stop.set()
        self._notifier.stopping()
        if self._status_file is not None:
            self._status_file.remove()
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
        if isinstance(error, StuckError):
            log.error("%s: %s", self.name, error)
            return 1
        log.error("%s: thread %s failed", self.name, where, exc_info=error)
        return 1


def waited_for_processor_s() -> dict[str, float]:
    """Return how long each thread of this process has been ready to run without a processor, s; {} outside Linux."""
    found: dict[str, float] = {}
    for task in Path("/proc/self/task").glob("*"):
        with suppress(OSError, IndexError, ValueError):  # a thread may end meanwhile
            found[task.name] = int((task / "schedstat").read_text().split()[1]) / 1e9
    return found


def start_logging() -> None:
    """Send log messages to stderr, for journald and for people: level and text."""
    logging.basicConfig(level=logging.INFO, format="%(levelname).1s %(message)s")
