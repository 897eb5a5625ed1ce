"""Find a hub that no longer answers on a connection that lives, and cut that, so that Zenoh connects again."""

from __future__ import annotations

import logging
import threading
import time
from typing import Final

import zenoh
from buddyline.protocol.delivery import CLOSE_S
from buddyline.protocol.zenoh_bus.alive import ALIVE
from buddyline.protocol.zenoh_bus.link import Link

# Longer than the lease, after which a silent link and its queries end by themselves. The second probe is for a machine
# that was too busy during the first. On a slow link an answer may take its time, but something is received: only after
# SLOW_S does such a link count as one whose hub hears nothing.
PROBE_S: Final = 4.0
PROBE_AGAIN_S: Final = 1.0
PROBE_EVERY_S: Final = 2.0
SLOW_S: Final = 30.0

log = logging.getLogger(__name__)


class Watchdog:
    """Cuts a connection over which the hub does not answer, so that Zenoh makes a new one.

    Half a connection whose bytes nobody reads at this end is found by `Link`. This finds the others: a new connection
    may meet the old one's end in the hub (Zenoh 1.10), which then keeps it alive and passes nothing on.
    """

    def __init__(self, session: zenoh.Session, link: Link) -> None:
        self._session = session
        self._link = link
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="bus watchdog", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Probe no more. Then close the session, and call join() to wait for a probe that is under way."""
        self._stop.set()

    def join(self) -> None:
        """Wait for the thread's end."""
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        just_cut = False
        answered_s = time.monotonic()
        while not self._stop.wait(PROBE_EVERY_S):
            try:
                # The new connection may also be a half one. One that was just made is probed for a shorter time.
                patience_s = PROBE_AGAIN_S if just_cut else PROBE_S
                deaf = self._times_out(patience_s) and self._times_out(PROBE_AGAIN_S)
            except zenoh.ZError:
                continue
            now_s = time.monotonic()
            if not deaf:
                answered_s = now_s
            elif not (self._link.is_slow and self._link.heard_within(PROBE_S)) or now_s - answered_s > SLOW_S:
                self._cut(patience_s + PROBE_AGAIN_S)
                answered_s = now_s
            just_cut = deaf and not just_cut

    def _times_out(self, timeout_s: float) -> bool:
        """Query the hub for a token that does not exist; return whether its (empty) answer did not come in time.

        Without a hub, or when the lease ends meanwhile, Zenoh itself answers at once.
        """
        replies = self._session.liveliness().get(f"{ALIVE}/probe", timeout=timeout_s)
        return any(reply.err is not None for reply in list(replies))

    def _cut(self, unheard_s: float) -> None:
        connection = self._link.connection()
        if connection is not None:
            with connection:
                if connection.cut():
                    log.warning("the hub has not answered for %g s: connecting again", unheard_s)
