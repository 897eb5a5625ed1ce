"""The page's server: its files over HTTP, and what it shows over a WebSocket, each viewer with a state of his own.

Whoever may not look is refused: a request whose Host is not this machine (a page of another site whose name points
here), a WebSocket from a page of another origin, and beyond loopback everyone without the token of the printed link.
"""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import hmac
import ipaddress
import logging
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from http import HTTPStatus
from importlib import resources
from typing import TYPE_CHECKING, Any, Final, Protocol
from urllib.parse import parse_qs, urlsplit

import msgspec
from buddyline.protocol.errors import BuddylineError
from buddyline.tools.extras import needed
from buddyline.tools.monitor.frames import RATE_HZ, PageContents, Viewer, fields

if TYPE_CHECKING:
    from buddyline.tools.monitor.overview import Overview
    from buddyline.tools.pairs import Pair
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

log = logging.getLogger(__name__)

TICK_S: Final = 1.0 / RATE_HZ
MAX_VIEWERS: Final = 16
MAX_COMMAND_BYTES: Final = 1024
# Ports that are tried where the wanted one is in use.
PORTS_TRIED: Final = 20
# A viewer that takes nothing for this long is gone.
GONE_S: Final = 20.0
FILES: Final = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/style.css": ("style.css", "text/css; charset=utf-8"),
    "/scene.js": ("scene.js", "text/javascript; charset=utf-8"),
    "/app.js": ("app.js", "text/javascript; charset=utf-8"),
    "/uPlot.js": ("uPlot.iife.min.js", "text/javascript; charset=utf-8"),
    "/uPlot.css": ("uPlot.min.css", "text/css; charset=utf-8"),
}
SECURITY: Final = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data:; connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}


class Session(Protocol):
    """What one viewer looks at: the running nodes, or a stored dive at an instant of his own.

    lock: held while it is read, and by whoever changes it.
    """

    lock: threading.Lock

    def step(self, commands: list[dict[str, Any]]) -> tuple[Overview, int, bool]:
        """Obey, go on, and return what is watched, its present time (ns), and whether all is to be told again.

        Called from any thread, one call at a time.
        """

    def playback(self) -> dict[str, Any] | None:
        """Return the playback's state for the page; None for running nodes."""

    def close(self) -> None:
        """Let go of what belongs to this viewer alone."""


@dataclass(frozen=True)
class PageServer:
    """Where and for whom the page is. token: "" for this machine alone."""

    listener: socket.socket
    title: str
    token: str
    open_session: Callable[[], Session]
    live: bool

    @property
    def port(self) -> int:
        """The port on which it listens."""
        return int(self.listener.getsockname()[1])

    def run(self, stop: threading.Event) -> None:
        """Serve until stop is set."""
        # websockets reports each request for a file as a rejected handshake.
        logging.getLogger("websockets").setLevel(logging.CRITICAL)
        asyncio.run(_Serving(self).until(stop))

    def close(self) -> None:
        """Stop listening."""
        self.listener.close()


def open_listener(host: str, port: int) -> socket.socket:
    """Listen on host and port, or the next free port; raise BuddylineError if that cannot be."""
    needed("websockets", "the page", "monitor")
    if not 0 <= port < 65536:
        raise BuddylineError(f"--port {port}: 0 to 65535")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    wanted = [0] if port == 0 else range(port, min(port + PORTS_TRIED, 65536))
    fault: OSError | None = None
    for each in wanted:
        listener = socket.socket(family, socket.SOCK_STREAM)
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listener.bind((host, each))
            listener.listen(64)
        except OSError as failed:
            listener.close()
            fault = fault or failed
            continue
        if each != port:
            log.warning("port %d is in use: the page is on port %d", port, listener.getsockname()[1])
        return listener
    assert fault is not None
    raise BuddylineError(f"--host {host} --port {port}: {fault.strerror}; give another address or port") from fault


def is_local(host: str) -> bool:
    """Return whether a host's name or address is this machine's loopback."""
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return host == "localhost"


class _Serving:
    def __init__(self, server: PageServer) -> None:
        self._server = server
        self._viewers = 0
        # Of running nodes, at which all look together.
        self._contents: dict[Pair | None, PageContents] = {}
        self._packed: dict[str, tuple[bytes, bytes, str]] = {}
        files = resources.files("buddyline.tools.monitor") / "web"
        for path, (name, kind) in FILES.items():
            body = (files / name).read_bytes()
            self._packed[path] = body, gzip.compress(body, 9, mtime=0), kind

    async def until(self, stop: threading.Event) -> None:
        from websockets.asyncio.server import serve

        async with serve(
            self._talk,
            sock=self._server.listener,
            process_request=self._admit,
            max_size=MAX_COMMAND_BYTES,
            max_queue=16,
            ping_interval=GONE_S / 2,
            ping_timeout=GONE_S / 2,
            close_timeout=1.0,
            server_header=None,
            # A viewer gets 20 KB/s: to pack them costs more than to send them.
            compression=None,
        ):
            while not stop.is_set():
                await asyncio.sleep(0.1)

    async def _admit(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request for a file, refuse one that may not be, or let a WebSocket through (None)."""
        host, origin = request.headers.get("Host", ""), request.headers.get("Origin")
        try:
            path, query = urlsplit(request.path).path, urlsplit(request.path).query
            name = urlsplit(f"//{host}").hostname or ""
            asking = host if origin is None else urlsplit(origin).netloc
        except ValueError:
            return self._refuse(connection, HTTPStatus.BAD_REQUEST, "This is no address.")
        # With a token, the page may have any name: whoever has the link was given it.
        if not self._server.token and not is_local(name):
            return self._refuse(connection, HTTPStatus.FORBIDDEN, f"This page is not at {name}.")
        if path != "/ws":
            return self._file(connection, request, path)
        if asking != host:
            return self._refuse(connection, HTTPStatus.FORBIDDEN, "A page of another site may not read this.")
        given = parse_qs(query).get("token", [""])[0]
        if self._server.token and not hmac.compare_digest(given.encode(), self._server.token.encode()):
            return self._refuse(connection, HTTPStatus.UNAUTHORIZED, "Open the link that the program has printed.")
        if self._viewers >= MAX_VIEWERS:
            return self._refuse(connection, HTTPStatus.SERVICE_UNAVAILABLE, f"{MAX_VIEWERS} viewers look already.")
        return None

    def _refuse(self, connection: ServerConnection, status: HTTPStatus, text: str) -> Response:
        response = connection.respond(status, f"{text}\n")
        for name, value in SECURITY.items():
            response.headers[name] = value
        return response

    def _file(self, connection: ServerConnection, request: Request, path: str) -> Response:
        found = self._packed.get(path)
        if found is None:
            return self._refuse(connection, HTTPStatus.NOT_FOUND, "There is no such page.")
        body, packed, kind = found
        response = connection.respond(HTTPStatus.OK, "")
        is_packed = "gzip" in request.headers.get("Accept-Encoding", "")
        response.body = packed if is_packed else body
        for name in ("Content-Type", "Content-Length"):
            del response.headers[name]
        response.headers["Content-Type"] = kind
        response.headers["Content-Length"] = str(len(response.body))
        if is_packed:
            response.headers["Content-Encoding"] = "gzip"
        for name, value in SECURITY.items():
            response.headers[name] = value
        return response

    async def _talk(self, connection: ServerConnection) -> None:
        """Tell one viewer what is new, and take his commands, until he leaves."""
        from websockets.exceptions import ConnectionClosed

        self._viewers += 1
        try:
            commands: list[dict[str, Any]] = []
            with contextlib.suppress(ConnectionClosed):
                async with _reading(connection, commands):
                    await self._tell(connection, commands)
        finally:
            self._viewers -= 1

    async def _tell(self, connection: ServerConnection, commands: list[dict[str, Any]]) -> None:
        server = self._server
        session = await asyncio.to_thread(server.open_session)
        viewer = Viewer(live=server.live, contents=self._contents if server.live else None)
        try:
            await connection.send(msgspec.json.encode({"title": server.title, "live": server.live}).decode())
            while True:
                taken, commands[:] = list(commands), []
                if server.live:
                    # Quicker than the way to another thread and back. A stored dive may take long to find its place.
                    frame = self._frame(session, viewer, taken)
                else:
                    frame = await asyncio.to_thread(self._frame, session, viewer, taken)
                await connection.send(frame, text=True)
                # All viewers get their frames together, which wakes this thread once. A slow one gets fewer of them,
                # never old ones.
                await asyncio.sleep(TICK_S - time.monotonic() % TICK_S)
        finally:
            session.close()

    def _frame(self, session: Session, viewer: Viewer, commands: list[dict[str, Any]]) -> bytes:
        with session.lock:
            overview, now_ns, jumped = session.step(commands)
            said: dict[str, Any] = {}
            for command in commands:
                if "pair" in command:
                    ids = tuple(str(command["pair"]).split("/"))
                    viewer.pair = (ids[0], ids[1]) if len(ids) == 2 else None
                if isinstance(command.get("probe"), list):
                    viewer.choose_fields([str(name) for name in command["probe"]])
                if "fields" in command:
                    said["fields"] = fields(overview)
                if "ping" in command:
                    said["pong"] = command["ping"]
            if jumped:
                viewer.restart()
            said = viewer.frame(overview, now_ns) | said
        playback = session.playback()
        if playback is not None:
            said["playback"] = playback
        return msgspec.json.encode(said)


@contextlib.asynccontextmanager
async def _reading(connection: ServerConnection, commands: list[dict[str, Any]]) -> AsyncIterator[None]:
    """Append the viewer's commands to a list meanwhile; what is no command is ignored."""

    async def read() -> None:
        async for data in connection:
            try:
                command = msgspec.json.decode(data)
            except msgspec.DecodeError:
                continue
            if isinstance(command, dict) and len(commands) < 64:
                commands.append(command)

    task = asyncio.create_task(read())
    try:
        yield
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError, Exception):
            await task
