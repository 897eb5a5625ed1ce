"""Take samples out of Zenoh as soon as they arrive."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final, TypeAlias

import zenoh
from buddyline.protocol.delivery import CLOSE_S, FailureLatch

INTAKE: Final = 2048

RingSubscriber: TypeAlias = zenoh.Subscriber[zenoh.Handler[zenoh.Sample]]


class Intake:
    """A thread that takes samples out of Zenoh at once, so that Zenoh's ring buffer does not overflow.

    name: part of the thread's name. accept: is called with each sample, and must not wait.
    """

    def __init__(
        self,
        name: str,
        subscriber: RingSubscriber,
        accept: Callable[[zenoh.Sample], None],
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
            while True:
                try:
                    sample = self._samples.recv()
                except zenoh.ZError:
                    return
                self._accept(sample)
        except Exception as error:
            self._failures.report(self._thread.name, error)
