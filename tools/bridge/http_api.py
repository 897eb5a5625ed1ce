"""HTTP and JSON: the position in the manner of Water Linked's UGPS, and the last message of every key.

Documented by Water Linked: /api/v1/position/acoustic/filtered (x, y, z from the topside, m), /position/acoustic/raw,
/position/global and /position/master (latitude, longitude, heading), /about. What an acoustic receiver has and we do
not (distances and levels of receivers) is an empty list there.
"""

from __future__ import annotations

import json
import logging
import math
import socket
import sys
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final

from buddyline.protocol import __version__
from buddyline.protocol.clock import S_NS
from buddyline.protocol.envelope import Envelope
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.health import BEHIND_S, stale_after_s
from buddyline.protocol.topics import TRACK
from buddyline.tools.bridge.nmea import M_PER_HDOP
from buddyline.tools.bridge.place import GeoPoint, OnEarth
from buddyline.tools.bridge.placed import Placed

log = logging.getLogger(__name__)

MAX_KEYS: Final = 1024
# Water Linked's value for "no data".
NO_DATA: Final = -1


class Answers:
    """What is answered: the last place, and the last message of each key. Safe to use from several threads."""

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._now_ns = now_ns
        self._lock = threading.Lock()
        self._placed: tuple[Placed, int] | None = None
        self._earth: OnEarth | None = None
        self._place: GeoPoint | None = None
        self._last: dict[str, bytes] = {}

    def take(self, envelope: Envelope) -> None:
        """Keep the last message of a key."""
        with self._lock:
            if envelope.key in self._last or len(self._last) < MAX_KEYS:
                self._last[envelope.key] = envelope.payload

    def place(self, placed: Placed, earth: OnEarth | None, place: GeoPoint | None) -> None:
        """Keep the last place."""
        with self._lock:
            self._placed, self._earth, self._place = (placed, self._now_ns()), earth, place

    def answer(self, path: str) -> Any:
        """Return what a path has, as JSON can say it (bytes: JSON as it is); None for no such path."""
        with self._lock:
            if path in ("/api", "/api/v1/version"):
                return {"version": "v1"}
            if path == "/api/v1/about":
                return {
                    "chipid": "",
                    "hardware_revision": 0,
                    "product": "Buddyline",
                    "variant": "",
                    "version": __version__,
                }
            if path in ("/api/v1/position/acoustic/filtered", "/api/v1/position/acoustic/raw"):
                return self._acoustic()
            if path == "/api/v1/position/global":
                return self._global()
            if path == "/api/v1/position/master":
                return self._master()
            if path == "/buddyline":
                return sorted(self._last)
            return self._last.get(path.removeprefix("/"))

    def _is_fresh(self) -> bool:
        if self._placed is None or self._placed[0].behind_s > BEHIND_S:
            return False
        # Less than nothing: this machine's clock was set back meanwhile.
        return 0 <= self._now_ns() - self._placed[1] < stale_after_s(TRACK) * S_NS

    def _acoustic(self) -> dict[str, object]:
        """Return x north, y east, z the depth (below the reference without a gauge), in metres; std: 1 sd."""
        none: dict[str, object] = {f"receiver_{what}": [] for what in ("distance", "nsd", "rssi", "valid")}
        if self._placed is None:
            return {"position_valid": False, "x": 0.0, "y": 0.0, "z": 0.0, "std": 0.0, **none}
        placed = self._placed[0]
        x, y, down = placed.p_ned_m.tolist()
        z = down if placed.depth_m is None else placed.depth_m
        return {"position_valid": self._is_fresh(), "x": x, "y": y, "z": z, "std": placed.sigma_m, **none}

    def _global(self) -> dict[str, object]:
        if self._placed is None or self._earth is None:
            return _satellite(None, NO_DATA, NO_DATA, NO_DATA, NO_DATA)
        placed, earth = self._placed[0], self._earth
        course = speed = float(NO_DATA)
        if placed.v_ned_mps is not None:
            north, east, _ = placed.v_ned_mps.tolist()
            course, speed = math.degrees(math.atan2(east, north)) % 360.0, 3.6 * math.hypot(north, east)
        where = (earth.latitude_deg, earth.longitude_deg) if self._is_fresh() else None
        orientation = math.degrees(placed.yaw_rad) if placed.is_north_true else float(NO_DATA)
        return _satellite(where, orientation, course, speed, earth.horizontal_m / M_PER_HDOP)

    def _master(self) -> dict[str, object]:
        """Return the reference's place. Its heading is 0: x and y of the acoustic position are north and east."""
        place = self._place
        where = None if place is None else (place.latitude_deg, place.longitude_deg)
        return _satellite(where, NO_DATA if place is None else 0.0, NO_DATA, NO_DATA, NO_DATA)


def _satellite(
    where: tuple[float, float] | None, orientation: float, course: float, speed: float, hdop: float
) -> dict[str, object]:
    latitude_deg, longitude_deg = where or (0.0, 0.0)
    return {
        "lat": latitude_deg,
        "lon": longitude_deg,
        "orientation": orientation,
        "cog": course,
        "sog": speed,
        "fix_quality": 0 if where is None else 1,
        "hdop": hdop,
        "numsats": NO_DATA,
    }


class _Handler(BaseHTTPRequestHandler):
    server: _Server
    # A client that sends nothing must not hold its thread for ever.
    timeout = 10

    def do_GET(self) -> None:
        """Answer one request."""
        host = (self.headers.get("Host") or "").rpartition(":")[0] or (self.headers.get("Host") or "")
        if self.server.is_loopback and host.strip("[]") not in ("127.0.0.1", "localhost", "::1"):
            # A page of another site that has its name point here must not read the position.
            self._send(403, b'{"error":"host not allowed"}')
            return
        path = self.path.partition("?")[0].rstrip("/") or "/"
        found = self.server.state.answer(path)
        if found is None:
            self._send(404, b'{"error":"no such path"}')
        else:
            self._send(200, found if isinstance(found, bytes) else json.dumps(found).encode())

    def _send(self, status: int, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Log requests for those who look for them."""
        log.debug(format, *args)


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def __init__(self, address: tuple[str, int], state: Answers) -> None:
        self.state = state
        self.address_family = socket.AF_INET6 if ":" in address[0] else socket.AF_INET
        self.is_loopback = address[0] in ("127.0.0.1", "localhost", "::1")
        super().__init__(address, _Handler)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Pass over a client that has gone in mid-answer; anything else is a bug, and keeps its traceback."""
        if not isinstance(sys.exception(), OSError):
            super().handle_error(request, client_address)


class HttpApi:
    """Serves Answers until closed. Raises BuddylineError if the port cannot be used."""

    def __init__(self, host: str, port: int, state: Answers) -> None:
        try:
            self._server = _Server((host, port), state)
        except OSError as error:
            raise BuddylineError(f"--http {host}:{port}: {error.strerror}; give another address or port") from error
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, name="http", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(5.0)
