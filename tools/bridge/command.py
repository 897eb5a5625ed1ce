"""`buddyline bridge`: a vehicle's place for autopilots (MAVLink), chart plotters (NMEA 0183) and others (HTTP)."""

from __future__ import annotations

import argparse
import logging
import math
import socket
import threading
from typing import TYPE_CHECKING, Final

from buddyline.protocol import topics
from buddyline.protocol.errors import BuddylineError
from buddyline.protocol.options import above_zero, finite
from buddyline.protocol.topics import check_node_id
from buddyline.tools.client import add_client_arguments, client_config
from buddyline.tools.live import LiveClient, follow_running

if TYPE_CHECKING:
    from buddyline.protocol.bus import Bus
    from buddyline.protocol.envelope import Envelope
    from buddyline.tools.bridge.http_api import Answers
    from buddyline.tools.bridge.place import GeoPoint
    from buddyline.tools.bridge.placed import Placed

log = logging.getLogger(__name__)

DEFAULT_RATE_HZ: Final = 10.0
NMEA_RATE_HZ: Final = 2.0
HEARTBEAT_S: Final = 1.0
# The autopilot takes an origin only once its filter runs, and keeps the first: it is given again with every third
# heartbeat, because datagrams get lost and autopilots are restarted.
ORIGIN_EVERY: Final = 3
MAX_DATAGRAM: Final = 65535


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_client_arguments(parser)
    parser.add_argument("--vehicle", metavar="NODE", required=True, help="the node on the vehicle")
    parser.add_argument(
        "--reference", metavar="NODE", help="the node that stands still; default: the other one of the first pair"
    )
    parser.add_argument("--net", metavar="NET", help="instead of a reference: the vehicle's place in this net")
    place = parser.add_argument_group("where the reference, or the net's origin, is on Earth")
    place.add_argument("--place", metavar="LAT,LON", help="it stands there, WGS 84, degrees")
    place.add_argument(
        "--boat", metavar="HOST:PORT", help="it hangs under a boat, whose GGA or RMC sentences come here by UDP"
    )
    place.add_argument(
        "--declination", type=finite, metavar="DEG", help="where headings are magnetic: true north, east positive; "
        "default: by the World Magnetic Model at --place, if pygeomag is installed"
    )  # fmt: skip
    out = parser.add_argument_group("to whom (one at least)")
    out.add_argument("--mavlink", metavar="HOST:PORT", help="an autopilot or router, by UDP; needs the extra `bridge`")
    out.add_argument(
        "--messages",
        metavar="KIND,...",
        default="odometry",
        help="of odometry, estimate, delta, gps: ODOMETRY, VISION_POSITION_ESTIMATE, VISION_POSITION_DELTA (no compass "
        "needed), GPS_INPUT (with --place or --boat); default: odometry",
    )
    out.add_argument("--system", type=int, default=1, metavar="ID", help="the vehicle's MAVLink system; default: 1")
    out.add_argument("--rate", type=finite, default=DEFAULT_RATE_HZ, metavar="HZ", help="at most; default: %(default)s")
    out.add_argument(
        "--set-origin",
        action="store_true",
        help="give the autopilot the reference's first place as its origin, every 3 s",
    )
    out.add_argument("--nmea", metavar="HOST:PORT", help="a chart plotter, by UDP")
    out.add_argument("--http", metavar="HOST:PORT", help="serve JSON there, in the manner of Water Linked's UGPS")
    parser.add_argument("--seconds", type=above_zero, metavar="S", help="end after this long; default: at Ctrl-C")


def run(args: argparse.Namespace) -> int:
    """Pass places on until stopped."""
    from buddyline.tools.bridge.http_api import Answers, HttpApi
    from buddyline.tools.bridge.mavlink import KINDS

    for node in (args.vehicle, args.reference, args.net):
        if node is not None:
            check_node_id(node)
    if args.reference and args.net:
        raise BuddylineError("--reference and --net: give one of them; a net has its own origin")
    if args.reference == args.vehicle:
        raise BuddylineError(f"--reference {args.reference}: is the vehicle itself")
    if not (args.mavlink or args.nmea or args.http):
        raise BuddylineError("give --mavlink, --nmea or --http")
    if args.place and args.boat:
        raise BuddylineError("--place and --boat: give one of them")
    kinds = tuple(args.messages.split(","))
    for kind in kinds:
        if kind not in KINDS:
            raise BuddylineError(f"--messages {kind}: one of {', '.join(KINDS)}")
    if "gps" in kinds and not (args.place or args.boat):
        raise BuddylineError("--messages gps: needs --place or --boat")
    if not 0.1 <= args.rate <= 100.0:
        raise BuddylineError(f"--rate {args.rate:g}: 0.1 to 100")
    if not 1 <= args.system <= 255:
        raise BuddylineError(f"--system {args.system}: 1 to 255")
    client = LiveClient("bridge", client_config(args), args.seconds)
    from buddyline.protocol.clock import SystemClock

    state = Answers(SystemClock().now_ns)
    bridge = Bridge(args, kinds, state)
    api = HttpApi(*host_and_port("--http", args.http), state) if args.http else None
    # Before the line that says that it is there: whoever waits for it may end it.
    client.handle_signals()
    if api is not None:
        log.info("bridge: http://%s:%d/api/v1/position/acoustic/filtered", args.http.rpartition(":")[0], api.port)

    def work(bus: Bus) -> None:
        from buddyline.protocol.messages import NodePose

        states = [topics.INFO, topics.NODE_STATUS, topics.SOLVER_STATUS]
        streams = [topics.ATTITUDE, topics.DEPTH, topics.TRACK, topics.POSE]
        streams += [topic for topic in topics.TOPICS if topic.schema is NodePose and "truth" not in topic.template]
        follow_running(bus, states, streams, client.refusals, bridge.take, pictures=False)
        while not client.stop.wait(HEARTBEAT_S):
            bridge.tick()

    try:
        if args.boat:
            client.spawn("boat", lambda: bridge.listen(client.stop))
        return client.run(work)
    finally:
        bridge.close()
        if api is not None:
            api.close()


class Bridge:
    """Passes each place on to all who were named."""

    def __init__(self, args: argparse.Namespace, kinds: tuple[str, ...], state: Answers) -> None:
        from buddyline.tools.bridge.mavlink import MavlinkTranslation
        from buddyline.tools.bridge.place import parse_place
        from buddyline.tools.bridge.placed import Placing

        self._lock = threading.Lock()
        self._state = state
        self._place: GeoPoint | None = parse_place(args.place) if args.place else None
        self._heard_boat_ns: int | None = None
        self._placing = Placing(
            args.vehicle, args.reference, args.net, _declination_rad(args.declination, self._place, args.place)
        )
        self._translation = MavlinkTranslation(kinds, args.system) if args.mavlink else None
        self._to_mavlink = Datagrams("--mavlink", args.mavlink) if args.mavlink else None
        self._to_nmea = Datagrams("--nmea", args.nmea) if args.nmea else None
        self._boat = _receiver("--boat", args.boat) if args.boat else None
        self._gives_origin: bool = args.set_origin
        self._origin: GeoPoint | None = None
        self._ticks = 0
        self._least_ns = round(1e9 / args.rate)
        self._sent_ns = self._sent_nmea_ns = 0
        self._said = self._why = ""

    def take(self, envelope: Envelope) -> None:
        """Take one message off the bus; called from the bus's threads."""
        with self._lock:
            self._state.take(envelope)
            placed = self._placing.take(envelope)
            if placed is not None:
                self._pass_on(placed)

    def _pass_on(self, placed: Placed) -> None:
        from buddyline.tools.bridge.nmea import sentences
        from buddyline.tools.bridge.place import on_earth

        place = self._present_place()
        self._why = ""
        if place is not None and not placed.is_north_true:
            self._why = f"headings of {placed.reference} are magnetic: no place on Earth without --declination"
        elif place is None and self._boat is not None:
            self._why = "the boat's place is not known"
        earth = on_earth(placed, place) if place is not None and placed.is_north_true else None
        self._state.place(placed, earth, place)
        # A tenth of slack: a source at just this rate is not halved by its jitter.
        due = _is_due(placed.stamp_ns, self._sent_ns, 0.9 * self._least_ns)
        if self._translation is not None and self._to_mavlink is not None and due:
            self._sent_ns = placed.stamp_ns
            for packet in self._translation.packets(placed, earth):
                self._to_mavlink.send(packet)
        if self._to_nmea is not None and _is_due(placed.stamp_ns, self._sent_nmea_ns, 0.9e9 / NMEA_RATE_HZ):
            self._sent_nmea_ns = placed.stamp_ns
            self._to_nmea.send("".join(sentences(placed, earth)).encode("ascii"))

    def _present_place(self) -> GeoPoint | None:
        from buddyline.protocol.clock import SystemClock
        from buddyline.tools.bridge.place import BOAT_STALE_NS

        if self._heard_boat_ns is None:
            return self._place
        # Less than nothing: this machine's clock was set back meanwhile.
        fresh = 0 <= SystemClock().now_ns() - self._heard_boat_ns <= BOAT_STALE_NS
        return self._place if fresh else None

    def tick(self) -> None:
        """Send what is due each second, and say what is missing, once for each change."""
        with self._lock:
            if self._translation is not None and self._to_mavlink is not None:
                self._to_mavlink.send(self._translation.heartbeat())
                if self._gives_origin and self._origin is None:
                    self._origin = self._present_place()
                if self._origin is not None and self._ticks % ORIGIN_EVERY == 0:
                    self._to_mavlink.send(self._translation.origin(self._origin))
            self._ticks += 1
            why = self._placing.why or self._why
        if why != self._said:
            self._said = why
            log.info("bridge: %s", why or f"{self._placing.vehicle} has a place")

    def listen(self, stop: threading.Event) -> None:
        """Take the boat's place from its receiver's sentences, in a thread of its own."""
        from buddyline.protocol.clock import SystemClock
        from buddyline.tools.bridge.nmea import place_of

        receiver, clock = self._boat, SystemClock()
        assert receiver is not None
        while not stop.is_set():
            try:
                data = receiver.recv(MAX_DATAGRAM)
            except TimeoutError:
                continue
            for line in data.decode("ascii", "replace").splitlines():
                place = place_of(line)
                if place is not None:
                    with self._lock:
                        self._place, self._heard_boat_ns = place, clock.now_ns()

    def close(self) -> None:
        """Close all sockets."""
        for datagrams in (self._to_mavlink, self._to_nmea):
            if datagrams is not None:
                datagrams.close()
        if self._boat is not None:
            self._boat.close()


def _is_due(stamp_ns: int, sent_ns: int, least_ns: float) -> bool:
    """Return whether an estimate is to be sent, after one of sent_ns; also where a node's clock was set back."""
    return not 0 <= stamp_ns - sent_ns < least_ns


class Datagrams:
    """Sends datagrams to one address. A receiver that is not there is waited for."""

    def __init__(self, option: str, address: str) -> None:
        host, port = host_and_port(option, address)
        try:
            family, kind, _, _, found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        except OSError as error:
            raise BuddylineError(f"{option} {address}: {error.strerror}") from error
        except UnicodeError as error:
            raise BuddylineError(f"{option} {address}: no host can have this name; give HOST:PORT") from error
        self._address: tuple[object, ...] = found
        self._socket = socket.socket(family, kind)
        self._refused = False

    def send(self, data: bytes) -> None:
        """Send one datagram."""
        try:
            self._socket.sendto(data, self._address)
        except OSError as error:
            if not self._refused:
                log.warning("bridge: %s: %s; tries on", self._address[0], error.strerror)
            self._refused = True
        else:
            self._refused = False

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


def host_and_port(option: str, text: str) -> tuple[str, int]:
    """Return host and port of `HOST:PORT`; raise BuddylineError otherwise."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 <= int(port) < 65536:
        raise BuddylineError(f"{option} {text}: give HOST:PORT")
    return host.strip("[]"), int(port)


def _receiver(option: str, text: str) -> socket.socket:
    host, port = host_and_port(option, text)
    receiver = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
    try:
        receiver.bind((host, port))
    except OSError as error:
        receiver.close()
        raise BuddylineError(f"{option} {text}: {error.strerror}; give another address or port") from error
    receiver.settimeout(0.5)
    return receiver


def _declination_rad(stated_deg: float | None, place: GeoPoint | None, text: str | None) -> float | None:
    """Return what is to be added to magnetic headings; None where it is not known."""
    if stated_deg is not None:
        if not abs(stated_deg) <= 180.0:
            raise BuddylineError(f"--declination {stated_deg:g}: -180 to 180 degrees")
        return math.radians(stated_deg)
    if place is None:
        return None
    from buddyline.node.geomagnetism import earth_field
    from buddyline.protocol.clock import SystemClock

    try:
        field = earth_field(place.latitude_deg, place.longitude_deg, SystemClock().now_ns())
    except BuddylineError as error:
        raise BuddylineError(f"--place {text}: {error}; or give --declination") from error
    log.info("bridge: magnetic headings are taken to be %+.1f deg from true north", math.degrees(field.declination_rad))
    return field.declination_rad
