"""The hub's session, and the retained messages of clients that are gone."""

from __future__ import annotations

import threading
import time
from functools import partial
from types import TracebackType
from typing import Final, Self

import zenoh
from buddyline.protocol.connection import close_without_wait
from buddyline.protocol.delivery import CLOSE_S
from buddyline.protocol.endpoint import DEFAULT_ENDPOINT
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.security import Tls
from buddyline.protocol.topics import TOPICS
from buddyline.protocol.zenoh_bus.session import config_of
from buddyline.protocol.zenoh_bus.settings import hub_settings

# A client that invents keys or sends huge payloads must not fill the hub's memory.
MAX_RETAINED: Final = 512
MAX_RETAINED_BYTES: Final = 65536
REOPEN_ATTEMPTS: Final = 20
REOPEN_S: Final = 0.1
# Shorter than the lease, after which a silent client's connection is closed.
LOOK_S: Final = 0.5


class Retained:
    """The newest message of each key of the retained topics, for `protocol.bus.Bus.newest`.

    A missed message (a publisher's first may be missed) is not recovered: the next one replaces it.
    """

    def __init__(self, session: zenoh.Session, before: Retained | None = None) -> None:
        self._samples: dict[str, zenoh.Sample] = {} if before is None else before._samples
        self._lock = threading.Lock()
        for topic in TOPICS:
            if topic.retained:
                # Clients may have a namespace, which comes before the key; the hub itself has none.
                key_expr = f"**/{topic.key_any()}"
                session.declare_subscriber(key_expr, self._keep)
                session.declare_queryable(key_expr, partial(self._answer, zenoh.KeyExpr(key_expr)))

    def _keep(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT or len(sample.payload) > MAX_RETAINED_BYTES:
            return
        key = str(sample.key_expr)
        with self._lock:
            if key in self._samples or len(self._samples) < MAX_RETAINED:
                self._samples[key] = sample

    def _answer(self, topic: zenoh.KeyExpr, query: zenoh.Query) -> None:
        # A query over several topics comes once for each of them.
        with self._lock:
            samples = list(self._samples.values())
        for sample in samples:
            if topic.includes(sample.key_expr) and query.key_expr.intersects(sample.key_expr):
                query.reply(sample.key_expr, sample.payload, encoding=sample.encoding)


class Hub:
    """The one process that listens. When it closes, its clients wait for a new hub."""

    def __init__(self, endpoint: str, tls: Tls | None, access: dict[str, object] | None) -> None:
        self.endpoint = endpoint
        self._tls = tls
        self._session = zenoh.open(config_of(hub_settings(endpoint, tls, access)))
        self._retained = Retained(self._session)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hub connections", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(LOOK_S):
            close_without_wait()

    def admit(self, access: dict[str, object]) -> None:
        """Take other access rules: all clients are cut off, and those that are still admitted come back by themselves.

        Zenoh cannot change the rules of an open session. What the hub retains stays, and clients fetch from each other
        what they have missed.
        """
        config = config_of(hub_settings(self.endpoint, self._tls, access))
        self._session.close()  # type: ignore[no-untyped-call]
        for attempt in range(REOPEN_ATTEMPTS):
            try:
                self._session = zenoh.open(config)
                break
            except zenoh.ZError:
                # The port is free as soon as the old session's sockets are.
                if attempt == REOPEN_ATTEMPTS - 1:
                    raise
                time.sleep(REOPEN_S)
        self._retained = Retained(self._session, self._retained)

    def close(self) -> None:
        """Stop listening."""
        self._stop.set()
        self._thread.join(CLOSE_S)
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        """Return the hub."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()


def open_hub(
    endpoint: str = DEFAULT_ENDPOINT, *, tls: Tls | None = None, access: dict[str, object] | None = None
) -> Hub:
    """Listen on endpoint; raise BuddylineError if the port is in use or the address is not this machine's."""
    try:
        return Hub(endpoint, tls, access)
    except zenoh.ZError as error:
        if "Address already in use" in str(error):
            raise BuddylineError(
                f"{endpoint} is in use: a hub runs there already (use that one), or give this one another port"
            ) from error
        raise BuddylineError(f"hub at {endpoint}: cannot listen: {str(error).split(' at /')[0]}") from error
