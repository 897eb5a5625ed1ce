"""Observe the connection to the hub: whether it is full, and whether anybody reads what arrives."""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from typing import Final

import zenoh
from buddyline.protocol.connection import Connection, TcpState, close_without_wait
from buddyline.protocol.delivery import CLOSE_S
from buddyline.protocol.link_budget import LOOK_S, LinkBudget
from buddyline.protocol.zenoh_bus.session import SecondLink

# The connection is looked for at most this often.
FIND_S: Final = 0.5
# What the kernel takes ahead of what is sent: so much may a less urgent message delay an urgent one.
AHEAD_BYTES: Final = 4096
# Bytes that nobody has read for this time: longer than a busy machine leaves a thread without its turn.
UNREAD_S: Final = 3.0

# Zenoh's own thread hands a message to the kernel within this time.
HANDED_OVER_S: Final = 0.005

log = logging.getLogger(__name__)


class Link:
    """The TCP connection of a session, observed by a thread of its own. Outside Linux nothing is observed.

    budget: takes the observations. bulk: the session for large messages, whose connection shares the link; what the hub
    acknowledges of it counts, too. is_long: whether the round trip is long. Zenoh (1.10) gives up a connection that
    takes too long to open; if this happens after it has started to send and before it has started to receive, half a
    connection stays, whose bytes nobody reads. It is cut, and Zenoh makes a new one.
    """

    def __init__(self, session: zenoh.Session, budget: LinkBudget, bulk: Bulk) -> None:
        self._session = session
        self.bulk = bulk
        self._budget = budget
        self._stop = threading.Event()
        self._flush = threading.Event()
        self.is_long = False
        self._heard_s = time.monotonic()
        # Before the first message: at full rate a second's messages fill the queue of a slow modem.
        with contextlib.suppress(zenoh.ZError):
            connection = self.connection()
            if connection is not None:
                with connection:
                    self._note_length(connection, connection.state())
        self._thread = threading.Thread(target=self._run, name="bus link", daemon=True)
        self._thread.start()

    @property
    def is_slow(self) -> bool:
        """Whether an answer may take long on it."""
        return self.is_long or self._budget.is_slow

    def heard_within(self, seconds: float) -> bool:
        """Return whether Zenoh has read anything from the hub in this time."""
        return time.monotonic() - self._heard_s < seconds

    def flush(self) -> None:
        """Send at once what waits to be sent together."""
        self._flush.set()

    def stop(self) -> None:
        """Look no more. Then close the session, and call join()."""
        self._stop.set()

    def join(self) -> None:
        """Wait for the thread's end."""
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(zenoh.ZError):
                connection = self.connection()
                if connection is not None:
                    with connection:
                        self._follow(connection)
            self._stop.wait(FIND_S)
        self.bulk.close()

    def connection(self) -> Connection | None:
        """Return the session's connection with the hub; None if there is none now."""
        return _connection(self._session)

    def _follow(self, connection: Connection) -> None:
        connection.hold_back(AHEAD_BYTES)
        close_without_wait()
        self.is_long = False
        self._budget.forget(time.monotonic())
        self._note_length(connection, connection.state())
        read, changed_s = -1, time.monotonic()
        look_s = 0.0
        while not self._stop.is_set():
            if self._flush.wait(LOOK_S) and not self._stop.wait(HANDED_OVER_S):
                self._flush.clear()
                # Each packet may be lost, and then holds up all later ones for more than a round trip: if that is long,
                # fewer packets are worth the wait of small messages for each other.
                if self.is_long:
                    connection.cork()
            now_s = time.monotonic()
            if now_s < look_s:
                continue
            look_s = now_s + LOOK_S
            state = connection.state()
            if state is None:
                return
            self._note_length(connection, state)
            self._budget.observe(state, now_s, beside=self.bulk.acked(now_s))
            read_before, read = read, state.received - state.unread
            if read != read_before:
                self._heard_s = now_s
            if read != read_before or not state.unread:
                changed_s = now_s
            elif now_s - changed_s > UNREAD_S:
                log.warning("nobody reads what the hub sends for %.1f s: connecting again", now_s - changed_s)
                connection.cut()
                return

    def _note_length(self, connection: Connection, state: TcpState | None) -> None:
        is_long = state is not None and state.is_long
        if is_long and not self.is_long:
            connection.bear_losses()
            self._budget.begin_low(time.monotonic())
        self.is_long = is_long


class Bulk:
    """The connections of a second session, observed by the thread of `Link`."""

    def __init__(self, link: SecondLink) -> None:
        self._link = link
        self._connection: Connection | None = None
        self._found_s = float("-inf")
        self._before = self._of_this = 0

    def acked(self, now_s: float) -> int:
        """Return how many bytes the hub has acknowledged, over all connections so far."""
        state = None if self._connection is None else self._connection.state()
        if state is not None:
            self._of_this = state.acked
        elif self._link.session is not None and now_s - self._found_s > FIND_S:
            self.close()
            self._found_s = now_s
            with contextlib.suppress(zenoh.ZError):
                self._connection = _connection(self._link.session)
                close_without_wait()
        return self._before + self._of_this

    def is_sent(self) -> bool:
        """Return whether nothing waits to be sent, as far as is known."""
        connection = self._connection
        state = None if connection is None else connection.state()
        return state is None or not state.waiting

    def close(self) -> None:
        """Let go of the connection."""
        self._before, self._of_this = self._before + self._of_this, 0
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()


def _connection(session: zenoh.Session) -> Connection | None:
    for link in session.info.links():
        host, _, port = str(link.src).partition("/")[2].rpartition(":")
        found = Connection.find(host.strip("[]"), int(port)) if port.isdecimal() else None
        if found is not None:
            return found
    return None
