"""`bridge` as a command: from a hub to an autopilot, a plotter and a program."""

from __future__ import annotations

import math
import socket
import threading
from collections import Counter
from typing import Any

import pytest
from buddyline.protocol.topics import key_of, topic_of
from buddyline.protocol.zenoh_bus import connect, open_hub
from buddyline.tools.cli import main

from tests.processes import Process, free_endpoint
from tests.tools.bridged import P_NED, estimate, get, oriented, rotation_of
from tests.tools.evaluated import INFOS
from tests.tools.watched import at, depth, solver_status


def test_a_vehicle_on_a_real_hub_reaches_autopilot_plotter_and_program() -> None:
    mavlink = pytest.importorskip("pymavlink.dialects.v20.ardupilotmega", reason="pymavlink is not installed")
    endpoint = free_endpoint()
    receivers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    for receiver in receivers:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(120.0)
    autopilot, plotter = (f"127.0.0.1:{receiver.getsockname()[1]}" for receiver in receivers)
    http_port = int(free_endpoint().rpartition(":")[2])
    words = ["--messages", "odometry,gps", "--place", "47.5,9.5", "--declination", "2.5", "--set-origin"]
    words += ["--mavlink", autopilot, "--nmea", plotter, "--http", f"127.0.0.1:{http_port}"]
    stop = threading.Event()
    with open_hub(endpoint), Process("bridge", "--vehicle", "b", "--connect", endpoint, *words) as bridge:
        bus = connect(endpoint, stop=stop, on_wait=lambda _: None)
        assert bus is not None
        bridge.wait_for("no estimate of b")

        def say() -> None:
            k = 0
            while not stop.wait(0.05):
                k += 1
                for message in (*INFOS.values(), oriented(k), depth("b", at(k)), estimate(k), solver_status(at(k))):
                    topic = topic_of(message)
                    ids = tuple(str(getattr(message, field)) for field in topic.id_fields)
                    publishers.setdefault(key_of(message), bus.publisher(topic, *ids)).put(message)

        publishers: dict[str, Any] = {}
        speaker = threading.Thread(target=say)
        speaker.start()
        try:
            parser, kinds = mavlink.MAVLink(None), Counter[str]()
            # The origin more than once: an autopilot that was not ready, or was started again, gets the next.
            while not ({"HEARTBEAT", "ODOMETRY", "GPS_INPUT"} <= kinds.keys() and kinds["SET_GPS_GLOBAL_ORIGIN"] > 1):
                kinds.update(m.get_type() for m in parser.parse_buffer(receivers[0].recv(65535)) or [])
            assert receivers[1].recv(65535).startswith(b"$GPGGA,")
            bridge.wait_for("b has a place")
            address = f"http://127.0.0.1:{http_port}"
            turned = rotation_of(0, 0, math.radians(2.5)) @ P_NED
            acoustic = get(f"{address}/api/v1/position/acoustic/filtered")
            assert (acoustic["x"], acoustic["y"], acoustic["z"]) == pytest.approx((*turned[:2], 12.5), abs=1e-6)
            assert "buddyline/pair/a/b/track" in get(f"{address}/buddyline")
        finally:
            stop.set()
            speaker.join()
            bus.close()
            for receiver in receivers:
                receiver.close()


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        ((), "bridge: give --mavlink, --nmea or --http"),
        (("--nmea", "nowhere"), "--nmea nowhere: give HOST:PORT"),
        (("--nmea", "a..b:10110"), "--nmea a..b:10110: no host can have this name; give HOST:PORT"),
        (("--http", "127.0.0.1:8", "--messages", "all"), "--messages all"),
        (("--http", "127.0.0.1:8", "--messages", "gps"), "needs --place or --boat"),
        (("--http", "127.0.0.1:8", "--place", "95,1"), "--place 95,1"),
        (("--http", "127.0.0.1:8", "--reference", "b"), "is the vehicle itself"),
        (("--http", "127.0.0.1:8", "--reference", "a", "--net", "main"), "--reference and --net"),
        (("--http", "127.0.0.1:8", "--rate", "-1"), "--rate -1"),
    ],
)
def test_what_cannot_be_meant_is_refused(
    words: tuple[str, ...], fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bridge", "--vehicle", "b", *words]) == 2
    assert fault in capsys.readouterr().err
