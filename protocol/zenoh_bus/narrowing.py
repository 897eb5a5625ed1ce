"""Shut out a client that floods the bus: the hub then passes on no more of it to this process."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Final

import zenoh
from buddyline.protocol.delivery import CLOSE_S, FailureLatch
from buddyline.protocol.rate_limit import MAX_HEARD, RateLimit
from buddyline.protocol.sequence import OWNER_CHUNKS
from buddyline.protocol.zenoh_bus.intake import Intake

LOOK_S: Final = 0.1
# So long a client is not heard; a node that has just come is, once it is seen.
SHUT_OUT_S: Final = 10.0
NEWCOMERS_S: Final = 1.0
# Without a flood for so many looks the thread ends.
IDLE_LOOKS: Final = 50

Accept = Callable[[zenoh.Sample], bool]


class Narrowing:
    """The subscribers of a subscription: of all owners of keys, or for a time of those that do not flood.

    wanted: key expressions, and what accepts their samples. declare: makes the intake of a key expression. present: the
    nodes that are on the bus. narrow: what is left of a key expression if only these owners count.
    """

    def __init__(
        self,
        wanted: Sequence[tuple[str, Accept]],
        declare: Callable[[str, Accept], Intake],
        limit: RateLimit,
        present: Callable[[], set[str]],
        failures: FailureLatch,
        narrow: Callable[[str, Sequence[str]], list[str]] | None = None,
    ) -> None:
        self._wanted = wanted
        self._narrow = narrow or narrowed
        self._present = present
        self._declare = declare
        self._limit = limit
        self._failures = failures
        self._intakes: list[Intake] = []
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def begin(self, intakes: list[Intake]) -> None:
        """Take the intakes of all that is wanted."""
        self._intakes = intakes

    def watch(self) -> None:
        """Look for floods from now on, while there are any; to be called when something was left out."""
        if self._thread is None and not self._stop.is_set():
            with self._lock:
                if self._thread is None:
                    self._thread = threading.Thread(target=self._run, name="bus flood", daemon=True)
                    self._thread.start()

    def close(self) -> None:
        """Undeclare all, and end the threads."""
        self._stop.set()
        with self._lock:
            for intake in self._intakes:
                intake.close()
            thread = self._thread
        if thread is not None and thread is not threading.current_thread():
            thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            idle = 0
            while idle < IDLE_LOOKS and not self._stop.wait(LOOK_S):
                flooding = self._limit.flooding()
                idle = 0 if flooding else idle + 1
                if flooding:
                    self._shut_out(flooding)
                    self._limit.empty(flooding)
                    self._change(None)
        except Exception as error:
            if not self._stop.is_set():
                self._failures.report("bus flood", error)
        finally:
            with self._lock:
                self._thread = None

    def _shut_out(self, flooding: set[str]) -> None:
        """Hear only the others for SHUT_OUT_S, and nodes that come meanwhile."""
        heard = [one for one in self._limit.owners() if one not in flooding]
        self._change(heard)
        ends_s = time.monotonic() + SHUT_OUT_S
        while time.monotonic() < ends_s and not self._stop.wait(min(NEWCOMERS_S, SHUT_OUT_S)):
            come = sorted(self._present() - flooding - set(heard))[:MAX_HEARD]
            if come and len(heard) < 2 * MAX_HEARD:
                heard += come
                self._change(heard)

    def _change(self, owners: Sequence[str] | None) -> None:
        """Subscribe to what these owners say, and no longer to the rest; None: to all."""
        with self._lock:
            if self._stop.is_set():
                return
            before = self._intakes
            self._intakes = [
                self._declare(key_expr, accept)
                for wanted, accept in self._wanted
                for key_expr in ([wanted] if owners is None else self._narrow(wanted, owners))
            ]
        # Both hear for a moment, so that nothing is missed; what comes twice is told apart by its number.
        for intake in before:
            intake.close()


def narrowed(key_expr: str, owners: Sequence[str]) -> list[str]:
    """Return what is left of a key expression if only these owners' keys count; without a choice of owners, itself."""
    owners = [owner for owner in owners if owner.startswith("buddyline/") and owner.count("/") == OWNER_CHUNKS - 1]
    if key_expr.startswith("buddyline/**"):
        return [owner + key_expr.removeprefix("buddyline") for owner in owners]
    chunks = key_expr.split("/")
    first, rest = chunks[:OWNER_CHUNKS], chunks[OWNER_CHUNKS:]
    if "*" not in first:
        return [key_expr]
    return [
        "/".join([owner, *rest])
        for owner in owners
        if all(a in ("*", b) for a, b in zip(first, owner.split("/"), strict=True))
    ]
