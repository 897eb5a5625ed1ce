"""Find a connection that receives nothing, and cut it, so that Zenoh connects again."""

from __future__ import annotations

import logging
import threading
from typing import Final

import zenoh
from buddyline.protocol.connection import cut_connection
from buddyline.protocol.delivery import CLOSE_S
from buddyline.protocol.zenoh_bus.alive import ALIVE

# Longer than the lease, after which a silent link and its queries end by themselves. The second probe is for a machine
# that was too busy during the first.
PROBE_S: Final = 4.0
PROBE_AGAIN_S: Final = 1.0
PROBE_EVERY_S: Final = 2.0

log = logging.getLogger(__name__)


class Watchdog:
    """Cuts a connection that receives nothing, so that Zenoh makes a new one.

    Zenoh (1.10) gives up a connection that takes too long to open. If this happens after it has started to send and
    before it has started to receive, half a connection stays: the hub sees no fault, and this end never receives.
    """

    def __init__(self, session: zenoh.Session) -> None:
        self._session = session
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
        answered = just_cut = False
        while not self._stop.wait(PROBE_EVERY_S):
            try:
                # The new connection may also be a half one. One that was just made is probed for a shorter time.
                patience_s = PROBE_AGAIN_S if just_cut else PROBE_S
                deaf = self._times_out(patience_s) and self._times_out(PROBE_AGAIN_S)
            except zenoh.ZError:
                continue
            # A hub that has never answered a probe does not support it: its connection is not cut.
            answered = answered or not deaf
            if deaf and answered:
                self._cut(patience_s + PROBE_AGAIN_S)
            just_cut = deaf and not just_cut

    def _times_out(self, timeout_s: float) -> bool:
        """Query the hub for a token that does not exist; return whether its (empty) answer did not come in time.

        Without a hub, or when the lease ends meanwhile, Zenoh itself answers at once.
        """
        replies = self._session.liveliness().get(f"{ALIVE}/probe", timeout=timeout_s)
        return any(reply.err is not None for reply in list(replies))

    def _cut(self, unheard_s: float) -> None:
        for link in self._session.info.links():
            host, _, port = str(link.src).partition("/")[2].rpartition(":")
            if cut_connection(host.strip("[]"), int(port)):
                log.warning("nothing was received from the hub for %g s: connecting again", unheard_s)
