"""Notices a connection that hears nothing, and has it made anew."""

from __future__ import annotations

import logging
import threading
from typing import Final

import zenoh
from buddyline.protocol.connection import cut_connection
from buddyline.protocol.delivery import CLOSE_S
from buddyline.protocol.zenoh_bus.alive import ALIVE

# Longer than the lease: a link that fell silent ends by that, and its questions with it. Then once more, for a
# machine that was too busy.
PROBE_S: Final = 4.0
PROBE_AGAIN_S: Final = 1.0
PROBE_EVERY_S: Final = 2.0

log = logging.getLogger(__name__)


class Watchdog:
    """Ends a connection on which nothing comes in, so that Zenoh makes a new one.

    Zenoh (1.10) gives up a connection that takes too long to open. Where that falls between its sending and its
    receiving being started, half of it is left: the hub is content, and this end hears nothing, for good.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bus watchdog", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Look no longer; join() waits for the end of a look that has begun, once the session is closed."""
        self._stop.set()

    def join(self) -> None:
        """Wait for the thread's end."""
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        answered = just_cut = False
        while not self._stop.wait(PROBE_EVERY_S):
            try:
                # Cutting one half may leave another: what was just made anew needs no long proof.
                patience_s = PROBE_AGAIN_S if just_cut else PROBE_S
                deaf = self._times_out(patience_s) and self._times_out(PROBE_AGAIN_S)
            except zenoh.ZError:
                continue
            # A hub that answers nobody's question is not judged by it.
            answered = answered or not deaf
            if deaf and answered:
                self._cut(patience_s + PROBE_AGAIN_S)
            just_cut = deaf and not just_cut

    def _times_out(self, timeout_s: float) -> bool:
        """Ask the hub for nothing; return whether the answer, which is that there is nothing, did not come.

        Where there is no hub, or its lease runs out meanwhile, that is the answer.
        """
        replies = self._session.liveliness().get(f"{ALIVE}/probe", timeout=timeout_s)
        return any(reply.err is not None for reply in list(replies))

    def _cut(self, unheard_s: float) -> None:
        for link in self._session.info.links():
            host, _, port = str(link.src).partition("/")[2].rpartition(":")
            if cut_connection(host.strip("[]"), int(port)):
                log.warning("the hub was not heard for %g s: the connection is made anew", unheard_s)
