"""Open Zenoh sessions: a client's, which waits for the hub and can be interrupted, and one for large messages."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Mapping
from typing import Final

import zenoh
from buddyline.protocol.security import RefusedError, Tls, refusal
from buddyline.protocol.zenoh_bus.settings import client_settings

RETRY_S: Final = 0.25


def config_of(settings: Mapping[str, object]) -> zenoh.Config:
    """Return Zenoh's form of the settings (zenoh_bus.settings)."""
    config = zenoh.Config()
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config


def open_session(
    endpoint: str, *, stop: threading.Event, on_wait: Callable[[str], None], tls: Tls | None = None
) -> zenoh.Session | None:
    """Open a session as `connect` does, for a client with its own keys and payloads; the caller closes it."""
    return open_client(config_of(client_settings(endpoint, None, tls)), endpoint, tls, stop, on_wait)


def open_client(
    config: zenoh.Config, endpoint: str, tls: Tls | None, stop: threading.Event, on_wait: Callable[[str], None]
) -> zenoh.Session | None:
    """Open a client's session; wait until there is a hub. on_wait is called once, with a text, if it has to wait."""
    return _open_when_there(
        config,
        stop,
        lambda: on_wait(
            f"no hub{' with TLS' if tls else ''} at {endpoint} yet, waiting for it (start one with `buddyline hub`)"
        ),
        lambda: refusal(endpoint, tls),
    )


def _open_when_there(
    config: zenoh.Config,
    stop: threading.Event,
    on_wait: Callable[[], None] = lambda: None,
    why_refused: Callable[[], str | None] = lambda: None,
) -> zenoh.Session | None:
    """Open a session; try again until stop is set. on_wait is called once, after the first failure.

    Raises RefusedError if why_refused returns a reason after a failure.
    """
    waiting = False
    while not stop.is_set():
        session = _try_open(config, stop)
        if session is not None:
            return session
        reason = None if stop.is_set() else why_refused()
        if reason is not None:
            raise RefusedError(reason)
        if not waiting and not stop.is_set():
            on_wait()
            waiting = True
        stop.wait(RETRY_S)
    return None


def _try_open(config: zenoh.Config, stop: threading.Event) -> zenoh.Session | None:
    """Open a session in a thread of its own: a listener that does not answer would block the caller for seconds."""
    opened: list[zenoh.Session] = []
    errors: list[Exception] = []
    ended = threading.Event()
    lock = threading.Lock()
    abandoned = False

    def attempt() -> None:
        try:
            session = zenoh.open(config)
        except Exception as error:
            errors.append(error)
        else:
            with lock:
                if abandoned:
                    session.close()  # type: ignore[no-untyped-call]
                else:
                    opened.append(session)
        ended.set()

    threading.Thread(target=attempt, name="bus connect", daemon=True).start()
    while not ended.wait(0.05):
        if stop.is_set():
            with lock:
                abandoned = True
            break
    if errors and not isinstance(errors[0], zenoh.ZError):
        raise errors[0]
    return opened[0] if opened else None


class SecondLink:
    """A second session of a client, opened on demand: for large messages, or for datagrams.

    In a shared connection, a large message delays all messages that are queued after it, and so does a lost packet.
    """

    def __init__(self, config: zenoh.Config) -> None:
        self.session: zenoh.Session | None = None
        self._config = config
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def open(self) -> None:
        """Start to connect, without waiting; `session` is set when the hub has answered."""
        with self._lock:
            if self._thread is None and not self._stop.is_set():
                self._thread = threading.Thread(target=self._run, name="bus second", daemon=True)
                self._thread.start()

    def close(self) -> None:
        """Close the session."""
        with self._lock:
            self._stop.set()
        if self._thread is not None:
            self._thread.join(1.0)
        if self.session is not None:
            self.session.close()  # type: ignore[no-untyped-call]

    def _run(self) -> None:
        self.session = _open_when_there(self._config, self._stop)
