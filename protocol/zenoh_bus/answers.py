"""Questions and their answers: large, and less urgent than all else."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable
from typing import Final

import zenoh
from buddyline.protocol.delivery import CLOSE_S, FailureLatch
from buddyline.protocol.link_budget import LinkBudget
from buddyline.protocol.zenoh_bus.session import SecondLink

# Questions that wait; of more, the oldest are not answered.
MAX_QUESTIONS: Final = 16
BYTES_PER_S: Final = 250_000.0
# What could not be sent of an answer for so long is left out; nobody waits longer for it.
PATIENCE_S: Final = 10.0
LOOK_S: Final = 0.05


class AnswerDesk:
    """A thread that answers the questions on a key, in the session for large messages.

    budget: says when the link has room to spare, is_sent: whether nothing of the payload before waits any longer. Each
    payload's number in its answer goes as its attachment.
    """

    def __init__(
        self,
        link: SecondLink,
        key: str,
        reply: Callable[[str], Iterable[bytes]],
        budget: LinkBudget,
        is_sent: Callable[[], bool],
        failures: FailureLatch,
    ) -> None:
        self._link = link
        self._key = key
        self._reply = reply
        self._budget = budget
        self._is_sent = is_sent
        self._failures = failures
        self._stop = threading.Event()
        self._declared: zenoh.Queryable[zenoh.Handler[zenoh.Query]] | None = None
        link.open()
        self._thread = threading.Thread(target=self._run, name=f"bus answers {key}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Answer no more, and end the thread."""
        self._stop.set()
        if self._declared is not None:
            self._declared.undeclare()  # type: ignore[no-untyped-call]
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while self._link.session is None:
            if self._stop.wait(LOOK_S):
                return
        try:
            ring: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(MAX_QUESTIONS)
            self._declared = self._link.session.declare_queryable(self._key, ring)
            questions = self._declared.handler
            while not self._stop.is_set():
                try:
                    query = questions.recv()
                except zenoh.ZError:
                    return
                with query:
                    self._answer(query)
        except Exception as error:
            if not self._stop.is_set():
                self._failures.report(self._thread.name, error)

    def _answer(self, query: zenoh.Query) -> None:
        ends_s = time.monotonic() + PATIENCE_S
        for number, payload in enumerate(self._reply(str(query.parameters))):
            while not (self._is_sent() and self._budget.admits_spare(len(payload), time.monotonic())):
                if time.monotonic() > ends_s or self._stop.wait(LOOK_S):
                    return
            # With the priority of the question.
            query.reply(self._key, payload, attachment=number.to_bytes(4, "little"))
            if self._stop.wait(len(payload) / BYTES_PER_S):
                return


def ask(session: zenoh.Session, key: str, text: str, timeout_s: float, cancel: zenoh.CancellationToken) -> list[bytes]:
    """Ask on key; return the payloads that have come within the time, or until cancelled, in their order."""
    replies = session.get(
        f"{key}?{text}",
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        priority=zenoh.Priority.BACKGROUND,
        congestion_control=zenoh.CongestionControl.DROP,
        timeout=timeout_s,
        cancellation_token=cancel,
    )
    found = {
        int.from_bytes(reply.ok.attachment.to_bytes()[:4], "little"): reply.ok.payload.to_bytes()
        for reply in replies
        if reply.ok is not None and reply.ok.attachment is not None
    }
    return [payload for _, payload in sorted(found.items())]
