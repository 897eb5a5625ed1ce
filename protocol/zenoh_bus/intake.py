"""Take samples out of Zenoh as soon as they arrive."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Final, TypeAlias

import zenoh
from buddyline.protocol.delivery import CLOSE_S, FailureLatch

INTAKE: Final = 2048
# Short beside the time in which a flood of 100,000 samples a second fills the ring.
FLOOD_PAUSE_S: Final = 0.005

RingSubscriber: TypeAlias = zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]


class Intake:
    """A thread that takes samples out of Zenoh at once, so that Zenoh's ring buffer does not overflow.

    name: part of the thread's name. accept: is called with each sample, and must not wait; it returns False for one too
    many. Then the thread lets samples gather for a moment.
    """

    def __init__(
        self,
        name: str,
        subscriber: RingSubscriber,
        accept: Callable[[zenoh.Sample], bool],
        failures: FailureLatch,
    ) -> None:
        self._subscriber = subscriber
        # A subscriber cannot be undeclared while a thread waits in its recv; it can while one waits in its handler's.
        self._samples = subscriber.handler
        self._accept = accept
        self._failures = failures
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=f"bus intake {name}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Undeclare the subscriber, take the samples that have arrived, and end the thread."""
        if not self._closed:
            self._closed = True
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]
        if self._thread is not threading.current_thread():
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            while (sample := self._next(wait=True)) is not None:
                is_flood = False
                while sample is not None:
                    is_flood |= not self._accept(sample)
                    # A call that may wait gives the interpreter to a busy thread for milliseconds.
                    sample = self._next(wait=False)
                if is_flood:
                    # The interpreter changes threads every 5 ms where none waits: the others would crawl.
                    time.sleep(FLOOD_PAUSE_S)
        except Exception as error:
            self._failures.report(self._thread.name, error)

    def _next(self, *, wait: bool) -> zenoh.Sample | None:
        """Return the next sample; None at the end, and without a wait also where there is none yet."""
        try:
            return self._samples.recv() if wait else self._samples.try_recv()
        except zenoh.ZError:
            return None
